"""The process that `checkpoint_recorder` starts: plays checkpoints and records them."""

import os
import sys
import traceback
from collections.abc import Iterable, Iterator
from pathlib import Path

import torch

from cathsim_dmc import suite
from cathsim_dmc.agents.checkpoint import Checkpoint, CheckpointError
from cathsim_dmc.agents.config import TrainingConfig
from cathsim_dmc.agents.evaluation import EVALUATION_SEED
from cathsim_dmc.agents.metrics import read_metrics
from cathsim_dmc.agents.policies import TrainedPolicy
from cathsim_dmc.policies import in_environment
from cathsim_dmc.recording.drawing import Drawing
from cathsim_dmc.recording.episode import Episode
from cathsim_dmc.recording.recorder import EpisodeRecorder
from cathsim_dmc.recording.rerun_training import TrainingRecording
from cathsim_dmc.recording.scene import body_geoms

RECORDING_FILE = "training.rrd"


class _Player:
    """Plays episodes with policies of one run, by the rule of the evaluation."""

    def __init__(self, config: TrainingConfig, max_steps: int):
        options = {**config.task_kwargs, "observation": config.observation}
        self._env = suite.load(
            suite.DOMAIN, config.task, task_kwargs={**options, "random": 0}
        )
        self._recorder = EpisodeRecorder(
            self._env, config.task, dict(config.task_kwargs)
        )
        self._max_steps = max_steps

    def play(self, policy: TrainedPolicy) -> tuple[Episode, Drawing]:
        """One episode of the seed of evaluations, and what to draw it with."""
        episode = self._recorder.record_episode(
            in_environment(policy, self._env), EVALUATION_SEED, self._max_steps
        )
        surface = self._env.task.scene.anatomy.surface
        geoms = body_geoms(self._env.physics)
        return episode, Drawing.of(episode, surface, robot_geoms=geoms)


def record(
    run: Path, max_steps: int, viewer: str | None, checkpoints: Iterable[Path]
) -> bool:
    """Record checkpoints of a run, each that is newer than those before.

    What goes wrong with one is printed, and the next one is tried.

    Args:
        run: Directory of the run.
        max_steps: Number of control steps after which an episode is cut off.
        viewer: Address of a viewer; None for none.
        checkpoints: Directories of checkpoints.

    Returns:
        Whether everything was recorded that was there.
    """
    recording = TrainingRecording(run / RECORDING_FILE, max_steps, viewer)
    player, complete = None, True
    for path in checkpoints:
        try:
            checkpoint = Checkpoint.open(path)
            if checkpoint.frames <= recording.frames:
                continue
            policy = TrainedPolicy(checkpoint)
        except CheckpointError as error:
            # It has made room for newer ones in the meantime.
            print(f"{path.name} is left out: {error}", flush=True)
            continue
        try:
            player = player or _Player(checkpoint.config, max_steps)
            episode, drawing = player.play(policy)
            rows = read_metrics(run / "metrics.csv")
            recording.add(episode, drawing, checkpoint.frames, rows)
        except Exception:
            print(
                f"{path.name} cannot be recorded:\n{traceback.format_exc()}", flush=True
            )
            player, complete = None, False
    return complete


def newest_lines(descriptor: int) -> Iterator[Path]:
    """Paths, a line each, from a pipe until it ends; of several waiting the last."""
    rest, ended = b"", False
    while not ended:
        data = os.read(descriptor, 2**16)
        ended = not data
        *lines, rest = (rest + data).split(b"\n")
        if lines:
            yield Path(os.fsdecode(lines[-1]))


def main(arguments: list[str]) -> int:
    """Record what standard input names until it ends.

    Args:
        arguments: Directory of the run, number of steps, and the viewer's address, if
            there is one.

    Returns:
        Exit code: 1 if something could not be recorded.
    """
    torch.set_num_threads(1)
    run, steps, viewer = Path(arguments[0]), int(arguments[1]), arguments[2:]
    checkpoints = newest_lines(sys.stdin.fileno())
    return int(not record(run, steps, viewer[0] if viewer else None, checkpoints))


if __name__ == "__main__":
    code = main(sys.argv[1:])
    sys.stdout.flush()
    # Not sys.exit, which waits for a viewer that takes nothing more.
    os._exit(code)
