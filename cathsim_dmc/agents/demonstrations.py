"""Expert demonstrations: recorded as Minari datasets, read back for learning."""

import collections
import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from dm_env import specs
from tensordict import TensorDict, TensorDictBase

from cathsim_dmc import bounds, extras, files, suite
from cathsim_dmc.agents import hub
from cathsim_dmc.agents.networks import NetworkShapes
from cathsim_dmc.policies import View
from cathsim_dmc.policies.expert import ExpertPolicy
from cathsim_dmc.recording import dataset
from cathsim_dmc.recording.dataset import (
    DatasetError,
    read_episodes,
    recordings_in,
    repeat_episodes,
)
from cathsim_dmc.simulation import environments
from cathsim_dmc.simulation.batch import BatchSimulation
from cathsim_dmc.simulation.episodes import play
from cathsim_dmc.tasks import observations
from cathsim_dmc.tasks.observation_kind import Sizes

DEMONSTRATION_SEED = 2_000_000  # apart from the seeds of evaluation
# Key of the infos with the expert's action before noise is added.
EXPERT_ACTION = "expert_action"
# Options that must agree between demonstrations and training, beside those of the
# objective; its rewards serve only learners that read them.
_ALIKE = ("device", "devices", "goal", "access")
_REWARD = "reward"
_SIMULATIONS = 16


@dataclasses.dataclass(frozen=True)
class Demonstrations:
    """Summary of recorded demonstrations.

    Attributes:
        path: Directory of the dataset.
        episodes: Number of episodes.
        successes: Number of episodes that reached the goal.
        steps: Number of control steps in all.
        mean_force: Mean over the episodes of `EpisodeForces.mean_force`, N.
        max_force: Maximum over the episodes of `EpisodeForces.max_force`, N.
    """

    path: Path
    episodes: int
    successes: int
    steps: int
    mean_force: float
    max_force: float


def record_demonstrations(
    task: str,
    out: str | Path,
    episodes: int = 20,
    *,
    observation: str | Sequence[str] = "tracking",
    seed: int = DEMONSTRATION_SEED,
    noise: float = 0.0,
    task_kwargs: Mapping[str, Any] | None = None,
    num_threads: int | None = None,
    say: Callable[[str], None] | None = None,
) -> Demonstrations:
    """Write episodes of the expert as a Minari dataset.

    Noise moves the device off the route, so that the dataset has corrections; the
    expert's action without noise is "expert_action" in the infos.

    Args:
        out: Directory of the dataset, which must not exist.
        seed: Seed of the first episode; the others count up. The noise of an episode
            is drawn from its seed too.
        noise: Standard deviation of normal noise added to every entry of the
            expert's action, which is clipped to [-1, 1] afterwards.
        task_kwargs: Further options of the task; must be JSON-able.
        num_threads: Number of threads of the simulation; None takes one per core.

    Raises:
        ValueError: a number is out of range, the task or an option is unknown, or the
            task's device cannot be steered.
        FileExistsError: `out` exists, or another process records it.
        FileNotFoundError: the directory around `out` does not exist.
        ModuleNotFoundError: minari is not installed.
    """
    out = files.as_path("out", out)
    bounds.whole("episodes", episodes, 1)
    bounds.seeds("seed", seed, episodes)
    bounds.number("noise", noise, 0.0, 1.0)
    bounds.option_threads(num_threads)
    extras.require("gym", "gymnasium", "minari", "h5py")
    from cathsim_dmc.simulation import gymnasium

    names = observation if isinstance(observation, str) else list(observation)
    options: dict[str, Any] = bounds.options("task_kwargs", task_kwargs)
    options |= {"observation": names}
    with dataset.reserved(out):
        count, spec = min(episodes, _SIMULATIONS), gymnasium.env_spec(task, **options)
        made = suite.make_task(task, **options)
        simulation = BatchSimulation(made, count, num_threads=num_threads or 0)
        buffers: list[Any] = []
        while len(buffers) < episodes:
            seeds = np.arange(count) + seed + len(buffers)
            played = _play(simulation, seeds, noise)
            buffers += played[: episodes - len(buffers)]
            if say is not None:
                say(f"{len(buffers)} of {episodes} episodes")
        single = np.dtype("float32")
        action = specs.BoundedArray((simulation.num_actions,), single, -1.0, 1.0)
        write = functools.partial(
            dataset.write,
            buffers=buffers,
            env_spec=spec,
            observation_space=gymnasium.space_of(made.observation_specs, single),
            action_space=gymnasium.space(action, single),
            algorithm=f"scripted expert, noise {noise:g}",
            description=f"{episodes} demonstrations of the task {task} of cathsim_dmc, "
            f"seeds from {seed}",
        )
        done = _summary(out, buffers)
        files.write_result(out, write, "the dataset")
        return done


def _summary(path: Path, buffers: Sequence[Any]) -> Demonstrations:
    """Return the summary of a dataset from Minari's buffers."""
    means = [np.mean(buffer.infos["wall_force_mean_sum"][1:]) for buffer in buffers]
    largest = [np.max(buffer.infos["wall_force_mean_max"][1:]) for buffer in buffers]
    return Demonstrations(
        path=path,
        episodes=len(buffers),
        successes=sum(bool(buffer.infos["success"][-1]) for buffer in buffers),
        steps=sum(len(buffer.rewards) for buffer in buffers),
        mean_force=float(np.mean(means)),
        max_force=float(np.max(largest)),
    )


def _play(simulation: Any, seeds: np.ndarray, noise: float) -> list[Any]:
    """Play an episode of the expert for each seed, in one batch; return the buffers."""
    simulation.seed(seeds.tolist())
    generators = [np.random.default_rng(int(seed)) for seed in seeds]
    expert, view = ExpertPolicy(), View(simulation)
    chosen = np.zeros(0, np.float32)

    def act(observation: Any) -> np.ndarray:
        nonlocal chosen
        chosen = expert.act(None).astype(np.float32)
        if not noise:
            return chosen
        size = chosen.shape[-1]
        drawn = np.stack([draw.normal(0.0, noise, size) for draw in generators])
        action = np.clip(chosen + drawn, -1.0, 1.0).astype(np.float32)
        expert.follow(action)
        return action

    begin = functools.partial(expert.reset, view)
    columns: dict[str, Any] = collections.defaultdict(list)
    for action, step, running in play(simulation, act, begin):
        columns["observations"].append(step.observation)
        columns["infos"].append(step.info())
        if action is not None:
            columns["running"].append(running.copy())
            columns["chosen"].append(chosen)
            columns["actions"].append(action)
            columns["rewards"].append(step.outcome.reward)
            columns["terminations"].append(step.terminated)
            columns["truncations"].append(step.truncated)
    return [_buffer(int(seed), row, columns) for row, seed in enumerate(seeds)]


def _buffer(seed: int, row: int, columns: Mapping[str, Any]) -> Any:
    """Return the first episode of simulation `row` as Minari's buffer.

    The expert's last action is repeated, since infos have a row more than actions.
    """
    from minari.data_collector import EpisodeBuffer

    steps = sum(running[row] for running in columns["running"])

    def stacked(parts: Sequence[Mapping[str, np.ndarray]]) -> dict[str, Any]:
        parts = parts[: steps + 1]
        return {key: np.stack([part[key][row] for part in parts]) for key in parts[0]}

    shown, infos = stacked(columns["observations"]), stacked(columns["infos"])
    for key, values in shown.items():
        if values.dtype != np.uint8:
            shown[key] = values.astype(np.float32)
    own = {
        name: np.stack([one[row] for one in columns[name][:steps]])
        for name in ("actions", "rewards", "terminations", "truncations", "chosen")
    }
    chosen = own.pop("chosen")
    infos[EXPERT_ACTION] = np.append(chosen, chosen[-1:], axis=0)
    return EpisodeBuffer(seed=seed, observations=shown, infos=infos, **own)


def alike(task: str, task_kwargs: Mapping[str, Any]) -> dict[str, Any]:
    """Return task and options that demonstrations must share, None for a default."""
    own = {*suite.TASKS[suite.known(task)].objective_options} - {_REWARD}
    given = {"task": task, **task_kwargs}
    shared = {name: dataset.chosen(given, name) for name in (*_ALIKE, *sorted(own))}
    listed = {k: list(v) if isinstance(v, tuple) else v for k, v in shared.items()}
    return {"task": task, **listed}


def require_dataset(path: str | Path | None) -> str | Path:
    """Return the path without reading it; DatasetError if there is no dataset."""
    if not path:
        raise DatasetError(
            "demonstrations is not given: bc needs the directory of a dataset; "
            "`cathsim demos` writes one."
        )
    if not (hub.is_reference(path) or recordings_in(path)):
        dataset.metadata_of(path)
    return path


def load_transitions(
    path: str | Path,
    observation: str | Sequence[str],
    shapes: NetworkShapes,
    **options: Any,
) -> TensorDictBase:
    """Return the transitions of a dataset's successful episodes, as a collector does.

    Args:
        path: Directory of a dataset, or of episodes as `cathsim play --out` writes
            them, which are simulated again; or "hf:OWNER/NAME@COMMIT".
        observation: Name or names of the observations that the networks read; the
            dataset may hold others beside them.
        **options: As for `read_episodes`.

    Returns:
        A TensorDict (n,) on the CPU with VECTOR and/or PIXELS, "action",
        "expert_action" and under "next" the observation, "reward", "done" and
        "terminated".

    Raises:
        DatasetError: there is none, it is damaged, or it holds no successful episode,
            or observations or actions of other sizes.
        ModuleNotFoundError: minari is not installed.
    """
    names = observations.resolve(observation)
    if hub.is_reference(path):
        path = hub.dataset(str(path))
    if recordings_in(path):
        read = repeat_episodes(path, names, **options)
    else:
        read = read_episodes(path, **options)
    episodes = [_tensors(path, e, names) for e in read]
    succeeded = [one for one in episodes if one is not None]
    if not succeeded:
        raise DatasetError(f"none of the {len(episodes)} episodes in {path} succeeds")
    transitions = TensorDict.cat(succeeded)
    found = NetworkShapes.of(transitions, transitions["action"])
    if found != shapes:
        raise DatasetError(
            f"{path} holds {found}, and the task with the observation {observation!r} "
            f"has {shapes}: record it for the same task and options"
        )
    return transitions


def _tensors(path: str | Path, episode: Any, names: Sequence[str]) -> TensorDict | None:
    """Return the transitions of an episode; None if it did not succeed."""
    given = set(episode.observations)
    single, coaxial = (
        set(observations.entry_specs(observations.resolve(names, kind), Sizes()))
        for kind in (None, True)
    )
    # Entries that only coaxial devices have identify their episodes.
    keys = coaxial if (coaxial - single) & given else single
    missing = sorted(keys - given)
    if missing:
        raise DatasetError(
            f"{path} lacks {', '.join(missing)}; it has {', '.join(sorted(given))}: "
            "record the observation that the learner is to see"
        )
    if not np.any(episode.infos.get("success", False)):
        return None
    arrays = {key: torch.as_tensor(episode.observations[key]) for key in keys}
    seen = environments.standard(arrays, 1)
    steps = len(episode.actions)
    ends, outs = np.asarray(episode.terminations), np.asarray(episode.truncations)
    done = ends.astype(bool) | outs.astype(bool)
    chosen = episode.infos.get(EXPERT_ACTION, episode.actions)[:steps]
    with files.refused(DatasetError, f"{path} cannot be used", ValueError):
        bounds.array(EXPERT_ACTION, chosen, shape=episode.actions.shape)
    return TensorDict(
        {
            **{key: value[:-1] for key, value in seen.items()},
            "action": torch.as_tensor(episode.actions).float().clamp(-1.0, 1.0),
            EXPERT_ACTION: torch.as_tensor(chosen).float().clamp(-1.0, 1.0),
            "next": {
                **{key: value[1:] for key, value in seen.items()},
                "reward": torch.as_tensor(np.asarray(episode.rewards)).float()[:, None],
                "done": torch.as_tensor(done)[:, None],
                "terminated": torch.as_tensor(ends).bool()[:, None],
            },
        },
        batch_size=[steps],
    )
