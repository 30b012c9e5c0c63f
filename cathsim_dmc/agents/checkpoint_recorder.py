"""Records an episode of every checkpoint of a run in training.rrd."""

import sys
from pathlib import Path
from typing import Any

import torch

from cathsim_dmc import suite
from cathsim_dmc.agents.checkpoint import Checkpoint
from cathsim_dmc.agents.config import ConfigError, TrainingConfig
from cathsim_dmc.agents.evaluation import EVALUATION_SEED
from cathsim_dmc.agents.metrics import read_metrics
from cathsim_dmc.agents.policies import TrainedPolicy
from cathsim_dmc.policies import in_environment
from cathsim_dmc.recording.drawing import Drawing
from cathsim_dmc.recording.recorder import EpisodeRecorder
from cathsim_dmc.recording.rerun_training import TrainingRecording
from cathsim_dmc.recording.scene import body_geoms
from cathsim_dmc.recording.viewer import ViewerError, live_address

RECORDING_FILE = "training.rrd"


class CheckpointRecorder:
    """Plays the evaluation's first episode with each checkpoint and records it.

    The training waits for the episode; its random numbers are not touched.
    """

    def __init__(self, run: Path, config: TrainingConfig):
        """Checks that it can be done.

        Args:
            run: Directory of the run.
            config: Settings of the run.

        Raises:
            ConfigError: the task is none of the suite, or the viewer cannot be used.
        """
        if config.task not in suite.SUITE:
            raise ConfigError(
                f"rerun=True needs a task of the suite, task is {config.task!r}: "
                "record its checkpoints with EpisodeRecorder, or leave rerun out."
            )
        self._run, self._config, self._count = run, config, 0
        self._viewer = None
        if config.rerun_viewer is not None:
            try:
                self._viewer = live_address(config.rerun_viewer)
            except ViewerError as error:
                raise ConfigError(f"rerun_viewer: {error}.") from error
        self._recording: TrainingRecording | None = None
        self._env: Any = None

    def saved(self, checkpoint: Path, last: bool = False) -> None:
        """Record a checkpoint if it is due; an error is printed and ends nothing.

        Args:
            checkpoint: Directory of the checkpoint.
            last: Whether it is the last one, which is recorded whatever its number.
        """
        self._count += 1
        if not last and self._count % self._config.rerun_every:
            return
        try:
            with torch.random.fork_rng(devices=[]):
                self._record(Checkpoint.open(checkpoint))
        except Exception as error:
            print(
                f"checkpoint {checkpoint.name} is not recorded, the training goes on: "
                f"{type(error).__name__}: {error}",
                file=sys.stderr,
            )

    def _record(self, checkpoint: Checkpoint) -> None:
        config, steps = self._config, self._config.rerun_steps
        if self._recording is None:
            path = self._run / RECORDING_FILE
            self._recording = TrainingRecording(path, steps, self._viewer)
        if checkpoint.frames <= self._recording.frames:
            return
        if self._env is None:
            options = {**config.task_kwargs, "observation": config.observation}
            self._env = suite.load(
                suite.DOMAIN, config.task, task_kwargs={**options, "random": 0}
            )
        env = self._env
        recorder = EpisodeRecorder(env, config.task, dict(config.task_kwargs))
        policy = in_environment(TrainedPolicy(checkpoint), env)
        episode = recorder.record_episode(policy, EVALUATION_SEED, steps)
        drawing = Drawing.of(
            episode,
            env.task.scene.anatomy.surface,
            robot_geoms=body_geoms(env.physics),
        )
        rows = read_metrics(self._run / "metrics.csv")
        self._recording.add(episode, drawing, checkpoint.frames, rows)
