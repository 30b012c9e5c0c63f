"""Training: make the environment, make the learner, loop."""

import contextlib
import math
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import nn
from torchrl.envs import EnvBase

from cathsim_dmc import bounds, files, locks
from cathsim_dmc.agents.checkpoint import (
    Checkpoint,
    CheckpointError,
    checkpoints_in,
    save_checkpoint,
)
from cathsim_dmc.agents.collection import make_collector
from cathsim_dmc.agents.config import ConfigError, TrainingConfig, require
from cathsim_dmc.agents.episodes import EpisodeTracker
from cathsim_dmc.agents.interruption import noted_interruption
from cathsim_dmc.agents.learner import Learner
from cathsim_dmc.agents.learners import LEARNERS, check_usable
from cathsim_dmc.agents.networks import NetworkShapes, bounded
from cathsim_dmc.agents.policies import TrainedPolicy, load_policy
from cathsim_dmc.agents.training_log import TrainingLog, crossed, read_metrics
from cathsim_dmc.simulation import environments
from cathsim_dmc.simulation.environments import EnvFactory
from cathsim_dmc.tasks import observations

CONFIG_FILE = "config.json"
# Settings that must agree for a policy to take the weights of another.
_ALIKE = ("hidden", "activation", "subtract_background",
          "convolutions", "cnn_features", "observation_clip")  # fmt: skip
_COIN = 0.5  # standard deviation of an entry that is 0 or 1 equally often


@dataclass(frozen=True)
class TrainingResult:
    """Result of a call of `train`.

    Attributes:
        run: Directory of the run.
        checkpoint: Directory of the newest checkpoint.
        frames: Number of frames, over all processes of the run.
        seconds: Wall time over all processes of the run, s.
        interrupted: Whether a signal ended it before total_frames.
        metrics: Last row of metrics.csv.
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
    without_replay: bool = False,
    on_checkpoint: Callable[[Path], Any] | None = None,
) -> TrainingResult:
    """Train an agent, or continue a run from its newest checkpoint.

    The directory receives config.json, metrics.csv and checkpoints/<frames>/ (SAC and
    DAgger: also replay/), and errors/ with the last physics errors. SIGINT or SIGTERM
    end the run after the current batch with a checkpoint. After kill -9, `resume=True`
    continues from the newest complete checkpoint: frames are counted from there, rows
    of metrics.csv beyond it are dropped, episodes that were running start anew. One
    process at a time trains there.

    Args:
        resume: Whether to continue the run in `out_dir`. A run that was killed before
            its first checkpoint starts anew.
        progress: Whether to show progress on standard error.
        make_env: As for `evaluate`.
        without_replay: Whether a run that is resumed starts with an empty replay
            (SAC, DAgger), as when its files are lost.
        on_checkpoint: Function that is called with the directory of each checkpoint
            when it is complete; it does not change the state of torch's generator.

    Raises:
        ConfigError: `config` is of another kind; the directory holds a run that was not
            to be resumed, or one with other settings, or none that could be resumed;
            another process trains in it; the torch device cannot be used; or
            `without_replay` lacks `resume`.
        CheckpointError: the checkpoint to continue from is damaged.
        ReplayError: the files of its replay are missing or damaged.
        FloatingPointError: a loss is not finite; the last checkpoint stays.
        OSError: the disk is full, or the directory cannot be written to.
    """
    settings = "settings, as make_config(...) returns them"
    require(isinstance(config, TrainingConfig), "config", config, settings)
    if without_replay and not resume:
        raise ConfigError(
            "without_replay=True (--without-replay) is for a run that is resumed; give "
            "resume=True (--resume) too, or leave it out"
        )
    run = files.as_path("out_dir", out_dir)
    call = on_checkpoint or (lambda checkpoint: None)
    require(callable(call), "on_checkpoint", call, "a function of a directory, or None")
    environments.require_factory(make_env)
    check_usable(config)
    with contextlib.ExitStack() as stack:
        stack.enter_context(_only_process(run))
        checkpoint = _prepare(run, config, resume)
        stack.callback(torch.set_num_threads, torch.get_num_threads())
        torch.set_num_threads(config.torch_threads)
        env = _environment(config, make_env, checkpoint.frames if checkpoint else 0)
        environments.record_errors(env, run / "errors")
        torch.manual_seed(config.seed)
        shapes = NetworkShapes.of(env.observation_spec, env.action_spec)
        learner = LEARNERS[config.algorithm].learner(config, shapes, run)
        learner.attach(env)
        state = _start(learner, env, checkpoint, without_replay)
        collector = make_collector(config, learner, env, make_env, state["frames"])
        stack.callback(collector.shutdown)
        files.write_json(run / CONFIG_FILE, config.to_dict())
        # Seeded last, since making the networks and collectors draws numbers.
        if checkpoint:
            torch.set_rng_state(state["rng"])
        else:
            torch.manual_seed(config.seed + 1)
        log = TrainingLog(run, learner, state, progress)
        stack.callback(log.close)
        interruption = stack.enter_context(noted_interruption(progress))
        return _loop(run, iter(collector), learner, log, interruption, call)


def _environment(config: TrainingConfig, make_env: EnvFactory, frames: int) -> EnvBase:
    """Make the environment of a run that has already collected `frames` frames."""
    # The seed depends on the frames, so that a resumed run gets new episodes.
    state = np.random.SeedSequence([config.seed, frames]).generate_state(1)
    try:
        return make_env(
            config.task, observation=config.collected_observation,
            num_envs=config.num_envs, num_threads=config.num_threads,
            task_kwargs=config.training_kwargs, seed=int(state[0]) % 2**31,
            **bounds.option_simulation_device(config.simulation_device),
        )  # fmt: skip
    except ValueError as error:
        if config.training_reward and str(error).startswith("reward "):
            raise ConfigError(f"training_{error}") from error
        raise


@contextlib.contextmanager
def _only_process(run: Path) -> Iterator[None]:
    """Make and lock the directory of a run; a killed process releases the lock."""
    files.require_folder(run, make=True)
    lock_file = run / ".lock"
    text = f"another process trains in {run}; wait for its end, or choose a new folder"
    with locks.only_process(lock_file, ConfigError, text):
        try:
            yield
        finally:
            # If no run was begun, the lock and an empty directory are removed.
            if not (run / CONFIG_FILE).exists():
                with contextlib.suppress(OSError):
                    lock_file.unlink()
                    run.rmdir()


def no_run(path: str | Path) -> str:
    """Return the error message for resuming in a directory without a run."""
    return (
        f"there is no run in {path} to resume: give the directory of one, or start a "
        "new one without resume (--resume)."
    )


def _prepare(run: Path, config: TrainingConfig, resume: bool) -> Checkpoint | None:
    """Check the directory against the request; return the checkpoint to resume from."""
    existing, alone = checkpoints_in(run), config.initial_policy is None
    if config.initial_std is not None and alone and not existing:
        raise ConfigError("initial_std is of use with initial_policy alone: add it")
    read_metrics(run / "metrics.csv")  # raises before any work if damaged
    if existing and not resume:
        raise ConfigError(
            f"{run} already holds a run: resume it (resume=True, --resume), or choose "
            "another directory."
        )
    if resume and not existing and not (run / CONFIG_FILE).exists():
        raise ConfigError(no_run(run))
    if not existing:
        return None
    checkpoint = Checkpoint.open(existing[-1])
    if changed := checkpoint.config.changed_for_resume(config):
        # With another algorithm nearly all settings differ.
        if "algorithm" in changed:
            changed = {"algorithm": changed["algorithm"]}
        may = sorted(checkpoint.config.resumable - set(changed))
        annealed = "total_frames" in changed and vars(config).get("anneal")
        why = (
            " The learning rate of this run falls over its length." if annealed else ""
        )
        raise ConfigError(
            f"{run} cannot be resumed with other settings ({_differing(changed)})."
            f"{why} Resume with the run's own, or start a new run in another "
            f"directory. These may change: {may}."
        )
    checkpoint.require_sizes()
    return checkpoint


def _differing(pairs: Mapping[str, tuple[Any, Any]]) -> str:
    return "; ".join(
        f"{name}: it has {old!r}, given is {new!r}"
        for name, (old, new) in pairs.items()
    )


def _start(
    learner: Learner, env: EnvBase, checkpoint: Checkpoint | None, without_replay: bool
) -> dict[str, Any]:
    """Load a checkpoint or an initial policy; return the counts of the run so far."""
    if checkpoint is None:
        config = learner.config
        if config.initial_policy is not None:
            take_over(learner.network, config, learner.shapes)
        # The first update sees normalised observations.
        if config.normalisation_frames and learner.lacks_statistics:
            steps = math.ceil(config.normalisation_frames / config.num_envs)
            learner.observe(env.rollout(steps, break_when_any_done=False))
        return {"frames": 0, "seconds": 0.0, "episodes": 0, "window": []}
    policy, state = checkpoint.policy_state(), checkpoint.learning_state()
    if without_replay:
        state["learner"].pop("replay", None)
    text = (
        f"{checkpoint.path} cannot be continued from, though its policy may still be "
        f"evaluated: it does not fit what {checkpoint.config.algorithm} learns with"
    )
    wrong = KeyError, TypeError, AttributeError, RuntimeError
    with files.refused(CheckpointError, text, wrong):
        learner.load(policy, state.pop("learner"))
    return {"frames": checkpoint.frames, "seconds": checkpoint.seconds, **state}


def take_over(
    network: nn.Module, config: TrainingConfig, shapes: NetworkShapes
) -> None:
    """Give a policy the weights and observation statistics of `initial_policy`.

    The policy may have more entries in its observation, if these come last in
    alphabetical order, as those of `route_retry` after `route`. Their weights start
    at 0.

    A state-dependent deviation (SAC) starts from a constant one (PPO, cloning) as the
    same in all states; a constant one takes the bias of a state-dependent one.

    Raises:
        ConfigError: the other policy has another network, sizes or observation.
        CheckpointError: the initial policy is missing or damaged.
    """
    name = f"initial_policy={config.initial_policy!r}"
    source = load_policy(str(config.initial_policy), scripted=False)
    if not isinstance(source, TrainedPolicy):
        raise ConfigError(
            f"{name} has no network: give the directory of a run or of a checkpoint, "
            'or "pretrained:NAME".'
        )
    pairs = {n: (getattr(source.config, n), getattr(config, n)) for n in _ALIKE}
    seen = source.config.observation, config.observation
    known, wanted = map(observations.plain_keys, seen)
    same = known == wanted
    pairs["sizes"] = source.shapes, shapes
    if not same and source.shapes.vector:  # the rest must agree
        pairs["sizes"] = replace(source.shapes, vector=0), replace(shapes, vector=0)
    pairs = {name: pair for name, pair in pairs.items() if pair[0] != pair[1]}
    if wanted[: len(known)] != known:
        pairs["observation"] = seen
    if pairs:
        raise ConfigError(
            f"{name} does not fit ({_differing(pairs)}); give the same settings, or "
            "another policy."
        )
    given, state = source.network.state_dict(), network.state_dict()
    if not same:
        numbers = source.shapes.vector
        given = {key: _widened(key, given, state[key], numbers) for key in given}
    (middle,) = (v for n, v in given.items() if n.endswith(("log_std", "log_std.bias")))
    if config.initial_std is not None:
        middle = torch.full_like(middle, config.initial_std).log()
    kept = given.keys() == state.keys() and config.initial_std is None
    for key, value in state.items():
        if kept or "log_std" not in key:
            state[key] = given[key]
        elif value.ndim == 1:
            state[key] = bounded(middle)
        else:
            state[key] = torch.zeros_like(value)  # equal in all states
    network.load_state_dict(state)


def _widened(
    key: str, given: Mapping[str, torch.Tensor], own: torch.Tensor, known: int
) -> torch.Tensor:
    """Return a tensor widened to the shape of `own` by entries new to its policy.

    New entries come after the `known` numbers of the vector, before the features of
    images. Their weights are 0; their statistics are mean 0 and deviation `_COIN`.
    """
    old = given[key]
    if old.shape == own.shape:
        return old
    wide, features = torch.zeros_like(own), old.shape[-1] - known
    wide[..., :known] = old[..., :known]
    wide[..., own.shape[-1] - features :] = old[..., known:]
    module, _, name = key.rpartition(".")
    count = given.get(f"{module}.count")
    if count is not None:
        start = {"squares": _COIN**2 * float(count), "scale": 1.0 / _COIN}
        wide[..., known:] = start.get(name, 0.0)
    return wide


def _loop(
    run: Path,
    batches: Iterator[TensorDictBase],
    learner: Learner,
    log: TrainingLog,
    interruption: threading.Event,
    on_checkpoint: Callable[[Path], Any],
) -> TrainingResult:
    """Collect, learn, log and save, to the last frame or to an interruption."""
    config = learner.config

    def save() -> Path:
        learning = {
            "learner": learner.learning_state(),
            "rng": torch.get_rng_state(),
            "episodes": log.episodes,
            "window": list(log.window),
        }
        before = checkpoints_in(run)
        newest = save_checkpoint(run, learner, log.frames, log.seconds, learning)
        if newest not in before:
            with torch.random.fork_rng(devices=[]):
                on_checkpoint(newest)
        return newest

    tracker = EpisodeTracker(config.num_envs)
    saved, since = log.frames, time.monotonic()
    while log.frames < config.total_frames and not interruption.is_set():
        batch = next(batches)
        finished = tracker.add(batch)
        _truncate_diverged(batch)
        losses = learner.update(batch, log.frames / config.total_frames)
        frames = log.frames + batch.numel()
        broken = {name: x for name, x in losses.items() if not math.isfinite(x)}
        if broken:
            raise FloatingPointError(
                f"after {frames} frames these are not finite: {broken}. Nothing was "
                f"saved since {max(checkpoints_in(run), default='the start')}; lower "
                "the learning rate, or look at the observations."
            )
        step_reward = float(batch["next", "reward"].mean())
        last = frames >= config.total_frames or interruption.is_set()
        log.add(batch.numel(), finished, step_reward, losses, last)
        if (
            crossed(saved, log.frames, config.checkpoint_frames)
            or time.monotonic() - since >= config.checkpoint_seconds
        ):
            save()
            saved, since = log.frames, time.monotonic()
    # However it ended; writes nothing if the last batch has just been saved.
    newest, short = save(), log.frames < config.total_frames
    return TrainingResult(run, newest, log.frames, log.seconds, short, log.row)


def _truncate_diverged(batch: TensorDictBase) -> None:
    """Mark diverged simulations as truncated, not as terminated."""
    # Rewards are negative distances: the agent would learn to break the simulation.
    batch["next", "terminated"] &= ~batch["next", "info", "physics_error"].bool()
