"""Training: make the environment, make the learner, loop."""

import contextlib
import json
import math
import os
import shutil
import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictSequential
from torchrl.collectors import Collector
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType

from cathsim_dmc.agents.checkpoint import Checkpoint, checkpoints_in, save_checkpoint
from cathsim_dmc.agents.configs import ConfigError, TrainingConfig
from cathsim_dmc.agents.episodes import INFO, EpisodeOutcome, EpisodeTracker
from cathsim_dmc.agents.interruption import Interruption
from cathsim_dmc.agents.metrics import MetricsFile
from cathsim_dmc.agents.networks import Signature
from cathsim_dmc.agents.ppo import PPO
from cathsim_dmc.agents.progress import Progress
from cathsim_dmc.agents.sac import SAC
from cathsim_dmc.simulation import environments

EnvFactory = Callable[..., EnvBase]

# Finished episodes over which the running figures are taken.
EPISODE_WINDOW = 100

# The rest of metrics.csv's columns are the learner's own.
COLUMNS = (
    "frames",
    "seconds",
    "frames_per_second",
    "episodes",
    "episode_reward",
    "episode_length",
    "success",
    "mean_force",
    "max_force",
    "step_reward",
)


@dataclass(frozen=True)
class TrainingResult:
    """What a call of `train` leaves behind.

    Attributes:
        run: directory of the run.
        checkpoint: directory of the newest checkpoint.
        frames: seen in all, over all processes of the run.
        seconds: wall time in all.
        interrupted: whether a signal ended it before total_frames.
        metrics: the last row of metrics.csv.
    """

    run: Path
    checkpoint: Path
    frames: int
    seconds: float
    interrupted: bool
    metrics: dict[str, float | None]


def train(
    config: TrainingConfig,
    out_dir: str | Path,
    resume: bool = False,
    progress: bool = True,
    make_env: EnvFactory = environments.make_env,
) -> TrainingResult:
    """Train an agent, or continue a run from its newest checkpoint.

    The directory receives config.json, metrics.csv and checkpoints/<frames>/ (SAC:
    also replay/). SIGINT or SIGTERM end the run after the current batch with a
    checkpoint. After kill -9, `resume=True` continues from the newest complete
    checkpoint: frames are counted from there, rows of metrics.csv beyond it are
    dropped, episodes that were running start anew.

    Args:
        config: what to train, and how.
        out_dir: directory of the run.
        resume: continue the run there; with none there, start one.
        progress: show progress on standard error.
        make_env: see `environments.make_env`; another one may be put in its place.

    Raises:
        ConfigError: the directory holds a run that was not to be resumed, or one with
            other settings.
        FloatingPointError: a loss is not finite; the last checkpoint stays.
    """
    run = Path(out_dir)
    checkpoint = _prepare(run, config, resume)
    frames = checkpoint.frames if checkpoint else 0
    seconds_before = checkpoint.seconds if checkpoint else 0.0

    with contextlib.ExitStack() as stack:
        stack.enter_context(_torch_threads(config.torch_threads))
        # A resumed run gets fresh episodes: another stretch of the same seeds.
        env_seed = int(
            np.random.SeedSequence([config.seed, frames]).generate_state(1)[0]
        )
        env = make_env(
            config.task,
            observation=config.observation,
            num_envs=config.num_envs,
            num_threads=config.num_threads,
            seed=env_seed % 2**31,
            path=config.path,
            task_kwargs=config.task_kwargs,
        )
        torch.manual_seed(config.seed)
        signature = Signature.of(env)
        learner = _make_learner(config, signature, run)
        if checkpoint:
            state = checkpoint.learning_state()
            learner.load(checkpoint.policy_state(), state["learner"])
        elif not learner.random_frames:
            _observe_random_actions(env, learner, config)
        collector = Collector(
            env,
            _on_cpu(learner.policy, learner.device),
            frames_per_batch=config.frames_per_batch,
            total_frames=-1,
            init_random_frames=_random_frames(learner, config, frames),
            exploration_type=ExplorationType.RANDOM,
            trust_policy=True,
            track_traj_ids=False,
            auto_register_policy_transforms=False,
        )
        stack.callback(collector.shutdown)
        # After everything that draws numbers while being made.
        if checkpoint:
            torch.set_rng_state(state["rng"])
        else:
            torch.manual_seed(config.seed + 1)

        columns = [*COLUMNS, *learner.metrics]
        table = MetricsFile(
            run / "metrics.csv", columns, frames if checkpoint else None
        )
        board = _tensorboard(run, config)
        stack.callback(board.close)
        bar = stack.enter_context(
            Progress(
                f"{config.algorithm} {config.task}",
                config.total_frames,
                start=frames,
                enabled=progress,
            )
        )
        interruption = stack.enter_context(Interruption())
        tracker = EpisodeTracker(config.num_envs)
        window: deque[EpisodeOutcome] = deque(maxlen=EPISODE_WINDOW)
        episodes = int(state["episodes"]) if checkpoint else 0
        row: dict[str, float | None] = {}
        began = time.monotonic()
        saved = checkpoint.path if checkpoint else None
        first_frames = frames

        def save() -> Path:
            return save_checkpoint(
                run,
                config=config,
                signature=signature,
                frames=frames,
                seconds=seconds_before + time.monotonic() - began,
                policy=learner.policy_state(),
                learning={
                    "learner": learner.learning_state(),
                    "rng": torch.get_rng_state(),
                    "episodes": episodes,
                },
            )

        batches = iter(collector)
        while frames < config.total_frames and not interruption.requested:
            batch = next(batches)
            before, frames = frames, frames + batch.numel()
            finished = tracker.add(batch)
            _excuse_divergence(batch)
            window.extend(finished)
            episodes += len(finished)
            losses = learner.update(batch, min(before / config.total_frames, 1.0))
            _require_finite(losses, frames, saved)

            step_reward = float(batch["next", "reward"].mean())

            last = frames >= config.total_frames or interruption.requested
            if last or _crossed(before, frames, config.metrics_frames):
                elapsed = time.monotonic() - began
                row = {
                    "frames": frames,
                    "seconds": seconds_before + elapsed,
                    "frames_per_second": (frames - first_frames) / elapsed,
                    "episodes": episodes,
                    **_episode_means(window),
                    "step_reward": step_reward,
                    **losses,
                }
                table.append(row)
                board.add(row)
            bar.update(frames, {"step_reward": step_reward, **_episode_means(window)})
            if _crossed(before, frames, config.checkpoint_frames):
                saved = save()
        # However the loop ended; writes nothing if the last batch has just been saved.
        saved = save()
        return TrainingResult(
            run=run,
            checkpoint=saved,
            frames=frames,
            seconds=seconds_before + time.monotonic() - began,
            interrupted=frames < config.total_frames,
            metrics=row,
        )


def _prepare(run: Path, config: TrainingConfig, resume: bool) -> Checkpoint | None:
    """Check the directory against the request; return where to continue from."""
    existing = checkpoints_in(run)
    if existing and not resume:
        raise ConfigError(
            f"{run} already holds a run: resume it, or choose another directory."
        )
    checkpoint = Checkpoint.open(existing[-1]) if existing else None
    if checkpoint is not None:
        changed = checkpoint.config.changed_for_resume(config)
        if changed:
            lines = "; ".join(
                f"{name}: the run has {old!r}, given is {new!r}"
                for name, (old, new) in changed.items()
            )
            raise ConfigError(
                f"{run} cannot be resumed with other settings ({lines}). Resume with "
                f"the run's own, or start a new run in another directory. These may "
                f"change: {sorted(config.resumable)}."
            )
    run.mkdir(parents=True, exist_ok=True)
    temporary = run / "config.json.tmp"
    temporary.write_text(json.dumps(config.to_dict(), indent=2) + "\n")
    os.replace(temporary, run / "config.json")
    if checkpoint is None:
        # Left by a run that was killed before its first checkpoint.
        shutil.rmtree(run / "replay", ignore_errors=True)
    return checkpoint


def _make_learner(config: TrainingConfig, signature: Signature, run: Path) -> PPO | SAC:
    if config.algorithm == "ppo":
        return PPO(config, signature)
    if config.algorithm == "sac":
        return SAC(config, signature, run)
    raise ConfigError(f"no learner for algorithm {config.algorithm!r}.")


def _observe_random_actions(
    env: EnvBase, learner: PPO | SAC, config: TrainingConfig
) -> None:
    """Start the observation statistics, so that the first update sees sane inputs."""
    if not config.normalisation_frames:
        return
    steps = math.ceil(config.normalisation_frames / config.num_envs)
    learner.observe(env.rollout(steps, break_when_any_done=False))


def _random_frames(
    learner: PPO | SAC, config: TrainingConfig, frames: int
) -> int | None:
    """Frames still to be collected at random, in whole batches."""
    left = max(learner.random_frames - frames, 0)
    whole = math.ceil(left / config.frames_per_batch) * config.frames_per_batch
    return whole or None


def _excuse_divergence(batch: TensorDictBase) -> None:
    """Count a diverged simulation as cut off, not as ended by the task.

    Rewards are negative distances, so an end worth nothing afterwards would be the
    best of all: the agent would learn to break the simulation.
    """
    error = batch.get(("next", INFO, "physics_error"), None)
    if error is not None:
        batch["next", "terminated"] &= ~error


def _on_cpu(
    policy: TensorDictSequential, device: torch.device
) -> Callable[[TensorDictBase], TensorDictBase]:
    """A policy that takes and gives CPU tensors wherever its weights are."""
    if device.type == "cpu":
        return policy

    def act(observation: TensorDictBase) -> TensorDictBase:
        outside = observation.select(*policy.in_keys).to(device)
        return observation.update(policy(outside).to("cpu"))

    return act


@contextlib.contextmanager
def _torch_threads(count: int) -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def _crossed(before: int, after: int, interval: int) -> bool:
    return before // interval != after // interval


def _require_finite(losses: dict[str, float], frames: int, saved: Path | None) -> None:
    broken = {name: value for name, value in losses.items() if not math.isfinite(value)}
    if broken:
        raise FloatingPointError(
            f"after {frames} frames these are not finite: {broken}. Nothing was saved "
            f"since {saved}; lower the learning rate, or look at the observations."
        )


def _episode_means(window: deque[EpisodeOutcome]) -> dict[str, float | None]:
    """Means over the last finished episodes; None where nothing is known."""

    def mean(name: str) -> float | None:
        known = [value for o in window if (value := getattr(o, name)) is not None]
        return float(np.mean(known)) if known else None

    return {
        "episode_reward": mean("reward"),
        "episode_length": mean("length"),
        "success": mean("success"),
        "mean_force": mean("mean_force"),
        "max_force": mean("max_force"),
    }


class _NoBoard:
    def add(self, row: dict[str, Any]) -> None:
        """Nothing to write to."""

    def close(self) -> None:
        """Nothing to close."""


class _Board:
    def __init__(self, writer: Any):
        self.writer = writer

    def add(self, row: dict[str, Any]) -> None:
        for name, value in row.items():
            if name != "frames" and value is not None:
                self.writer.add_scalar(name, value, row["frames"])

    def close(self) -> None:
        self.writer.close()


def _tensorboard(run: Path, config: TrainingConfig) -> _Board | _NoBoard:
    if not config.tensorboard:
        return _NoBoard()
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError as error:
        raise ConfigError(
            "tensorboard=True needs the extra: pip install 'cathsim-dmc[tensorboard]'."
        ) from error
    return _Board(SummaryWriter(run / "tensorboard"))
