"""Recorded episodes, such as those of a hand, as demonstrations: played again."""

import types
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cathsim_dmc import suite
from cathsim_dmc.recording.dataset import DatasetError
from cathsim_dmc.recording.episode import SUFFIX, Episode

# Joint positions of a replay on another processor differ in the last digits at most.
_SAME = 1e-6  # m, rad


def recordings_in(path: str | Path) -> list[Path]:
    """Files of episodes in a directory, as `cathsim play --out` writes them."""
    return sorted(Path(path).glob(f"*{SUFFIX}"))


def replayed(
    path: str | Path, observation: str | Sequence[str], **options: Any
) -> Iterator[Any]:
    """Episodes of a directory with the observations that a learner is to see.

    An episode file holds actions and states, no observations: its actions are played
    again from its seed, which gives the same states.

    Args:
        path: Directory of .npz files.
        observation: Name or names of the observations.
        **options: Task and options that the episodes must have been recorded with.

    Yields:
        Objects with "observations", "actions", "rewards", "terminations",
        "truncations" and "infos", as those of `dataset.read_episodes`.

    Raises:
        DatasetError: a file is damaged, was recorded with other options or without a
            seed, or does not give the same states here.
    """
    env, made = None, None
    for file in recordings_in(path):
        try:
            episode = Episode.load(file)
            kwargs = dict(episode.meta.get("task_kwargs") or {})
            _require_options({"task": episode.task, **kwargs}, options)
            if episode.seed is None:
                raise ValueError("it has no seed, so it cannot be played again")
            if not episode.steps:
                raise ValueError("it has no step")
            wanted = episode.task, {**kwargs, "observation": observation}
            if env is None or made != wanted:
                env, made = suite.load(suite.DOMAIN, *wanted), wanted
            yield _played(env, episode)
        except (ValueError, TypeError, LookupError) as error:
            line = " ".join(str(error).split())
            raise DatasetError(f"{file} is no demonstration: {line}") from error


def _require_options(own: Mapping[str, Any], options: Mapping[str, Any]) -> None:
    for name, value in options.items():
        if own.get(name) != value:
            raise ValueError(f"its {name} is {own.get(name)!r}, not {value!r}")


def _played(env: Any, episode: Episode) -> Any:
    """An episode again; ValueError if its states are others."""
    env.random_state.seed(episode.seed)
    timestep = env.reset()
    seen, rewards, ends = [timestep.observation], [], []
    for action in episode.action:
        timestep = env.step(action)
        seen.append(timestep.observation)
        rewards.append(timestep.reward)
        ends.append(timestep.last())
    found = np.array(env.physics.data.qpos)
    same = found.shape == episode.qpos[-1].shape
    if not same or np.abs(found - episode.qpos[-1]).max() > _SAME:
        raise ValueError(
            "its actions lead elsewhere here: it was recorded with another version "
            f"({episode.meta.get('versions')}) or other options"
        )
    done = np.array(ends)
    done[-1] = True  # the operator may have ended it
    success = episode.success
    return types.SimpleNamespace(
        observations={
            key: np.stack([_single(one[key]) for one in seen]) for key in seen[0]
        },
        actions=episode.action.astype(np.float32),
        rewards=np.array(rewards, np.float64),
        terminations=done & success,
        truncations=done & (not success),
        infos={"success": np.array([success])},
    )


def _single(value: np.ndarray) -> np.ndarray:
    return value if value.dtype == np.uint8 else value.astype(np.float32)
