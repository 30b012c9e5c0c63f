"""Episodes as a Minari dataset, which Gymnasium and TorchRL load."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cathsim_dmc.files import atomic_directory
from cathsim_dmc.recording.episode import Episode

# Options that say what is observed. An episode does not hold observations: they come
# from repeating it, and may be others than those it was recorded with.
_OBSERVED = ("observation", "fluoroscopy", "endoluminal_size")
# Rewards of a repeated episode may differ by rounding on another machine.
TOLERANCE = 1e-9

_NO_MINARI = "minari is not installed; `pip install cathsim-dmc[gym]` adds it"
_VERSION = re.compile(r"-v\d+$")


def export(
    episodes: Iterable[Episode],
    path: str | os.PathLike[str],
    *,
    observation: str | Sequence[str] | None = None,
    task_kwargs: Mapping[str, Any] | None = None,
) -> Path:
    """Repeats recorded episodes and writes them as a dataset, see `write`.

    Every step is taken again from the episode's seed and compared with the record.

    Args:
        episodes: of one task, with the same options, seeded and not empty.
        path: directory of the dataset, which must not exist.
        observation: names of observations; None for those of the record, or "internal".
        task_kwargs: further options of what is observed, such as `fluoroscopy`.

    Raises:
        ValueError: if the episodes do not belong together or do not repeat.
        FileExistsError: the directory exists.
        ModuleNotFoundError: if minari is not installed.
    """
    try:
        from cathsim_dmc.simulation.gymnasium import make
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(_NO_MINARI) from error
    check_free(Path(path))
    episodes = list(episodes)
    task, options = _common(episodes)
    options.update(task_kwargs or {})
    if observation is not None:
        options["observation"] = observation
    single = all((e.action == e.action.astype(np.float32)).all() for e in episodes)
    environment = make(task, dtype="float32" if single else "float64", **options)
    try:
        return write(
            path,
            [_repeat(environment, episode) for episode in episodes],
            env_spec=environment.spec,
            observation_space=environment.observation_space,
            action_space=environment.action_space,
            algorithm="recorded episodes",
            description=f"{len(episodes)} recorded episodes of the task {task} of "
            "cathsim_dmc",
        )
    finally:
        environment.close()


def write(
    path: str | os.PathLike[str],
    buffers: Sequence[Any],
    *,
    env_spec: Any,
    observation_space: Any,
    action_space: Any,
    algorithm: str,
    description: str,
) -> Path:
    """Writes a dataset into a directory of its own, whole or not at all.

    `minari.MinariDataset(path / "data")` loads it; so does `minari.load_dataset(name)`
    if the name of the directory ends in a version, as in "lcca-v0", and
    MINARI_DATASETS_PATH is the directory around it.

    Args:
        path: Directory of the dataset, which must not exist.
        buffers: `minari.data_collector.EpisodeBuffer` of each episode.
        env_spec: Spec of the Gymnasium environment, see
            `simulation.gymnasium.env_spec`.
        algorithm: What acted, for the metadata.

    Returns:
        The directory.

    Raises:
        FileExistsError: the directory exists.
        FileNotFoundError: the directory around it does not.
        ModuleNotFoundError: minari is not installed.
    """
    path = Path(path)
    check_free(path)
    try:
        from minari.dataset.minari_storage import MinariStorage
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(_NO_MINARI) from error
    from importlib.metadata import version

    name = path.name
    with atomic_directory(path) as temporary:
        storage = MinariStorage.new(
            # Minari looks for the files of a relative path beneath that path again.
            temporary.absolute() / "data",
            observation_space,
            action_space,
            env_spec,
            "hdf5",
            jpeg_encoding=False,
        )
        storage.update_metadata(
            {
                # The last part of an id is a name with a version.
                "dataset_id": name if _VERSION.search(name) else f"{name}-v0",
                "algorithm_name": algorithm,
                "description": description,
                "minari_version": version("minari"),
            }
        )
        storage.update_episodes(buffers)
    return path


class DatasetError(ValueError):
    """A dataset is missing, damaged or of another kind."""


def read_episodes(path: str | os.PathLike[str]) -> Iterator[Any]:
    """Episodes of a dataset, one after the other, as `minari.EpisodeData`.

    Args:
        path: Directory of the dataset, or the directory `data` in it.

    Raises:
        DatasetError: there is none, or it is damaged.
        ModuleNotFoundError: minari is not installed.
    """
    try:
        import minari
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(_NO_MINARI) from error
    data = next(Path(path).glob("data"), Path(path)) / "metadata.json"
    if not data.is_file():
        raise DatasetError(
            f"no dataset in {path}: give a directory that `cathsim demos` has written"
        )
    try:
        # Without its spaces Minari would make the environment that the file names.
        if not {"observation_space", "action_space"} <= set(
            json.loads(data.read_text())
        ):
            raise ValueError("metadata.json lacks the spaces")
        for number, episode in enumerate(minari.MinariDataset(data.parent)):
            _check_episode(episode, number)
            yield episode
    # What a damaged file leads to.
    except (AssertionError, AttributeError, LookupError, OSError, RuntimeError,
            TypeError, ValueError) as error:  # fmt: skip
        line = " ".join(str(error).split()) or type(error).__name__
        raise DatasetError(f"{data.parent} cannot be read: {line}") from error


def _check_episode(episode: Any, number: int) -> None:
    """Raises ValueError unless all columns are as long as they must be, and finite."""
    steps = len(episode.actions)
    columns = {
        name: (episode.observations[name], steps + 1) for name in episode.observations
    }
    for name in ("actions", "rewards", "terminations", "truncations"):
        columns[name] = getattr(episode, name), steps
    for name, (values, length) in columns.items():
        if not steps or len(values) != length or not np.isfinite(values).all():
            raise ValueError(f"episode {number}: {name} are not {length} finite rows")


def check_free(path: Path) -> None:
    """Raises unless a dataset can be written there; see `write`."""
    if path.exists():
        raise FileExistsError(f"{path} exists: choose another directory, or remove it")
    if not path.parent.is_dir():
        raise FileNotFoundError(f"no directory {path.parent}; create it first")


def _common(episodes: Sequence[Episode]) -> tuple[str, dict[str, Any]]:
    """Task and options that all episodes share."""
    given = [episode.meta.get("task_kwargs", {}) for episode in episodes]
    unseen = {"random", *_OBSERVED}
    kinds = [{k: v for k, v in one.items() if k not in unseen} for one in given]
    tasks = sorted({episode.task for episode in episodes})
    if len(tasks) != 1 or any(kind != kinds[0] for kind in kinds):
        raise ValueError(
            f"{len(episodes)} episodes of the tasks {tasks}, or with different "
            "options, make no dataset; export each kind as one of its own"
        )
    for index, episode in enumerate(episodes):
        if episode.seed is None or not episode.steps:
            raise ValueError(
                f"episode {index} has {episode.steps} steps and the seed "
                f"{episode.seed}; only seeded episodes with steps can be repeated"
            )
    observed = {key: given[0][key] for key in _OBSERVED if key in given[0]}
    return tasks[0], {**kinds[0], **observed}


def _repeat(environment, episode: Episode):
    """Takes every step of an episode again; returns it as Minari's buffer.

    Raises:
        ValueError: if it goes another way.
    """
    from minari.data_collector import EpisodeBuffer

    dtype = environment.action_space.dtype
    first = environment.reset(seed=episode.seed)
    seen, infos, ends = [first[0]], [first[1]], []
    for step, action in enumerate(episode.action.astype(dtype)):
        observation, reward, *end, info = environment.step(action)
        seen.append(observation)
        infos.append(info)
        ends.append(end)
        if abs(reward - episode.reward[step]) > TOLERANCE:
            raise ValueError(
                f"episode with seed {episode.seed} does not repeat: reward {reward} "
                f"instead of {episode.reward[step]} at step {step}; it was recorded "
                f"with {episode.meta.get('versions')}"
            )
        if any(end) and step + 1 < episode.steps:
            raise ValueError(
                f"episode with seed {episode.seed} ends at step {step} instead of "
                f"{episode.steps - 1}; export it with the options it was recorded with"
            )
    # The operator may have stopped the recording, which no step shows.
    terminated, truncated = np.array(ends).T
    truncated[-1] |= not terminated[-1]
    return EpisodeBuffer(
        seed=episode.seed,
        observations=_columns(seen),
        actions=episode.action.astype(dtype),
        rewards=episode.reward.tolist(),
        terminations=terminated.tolist(),
        truncations=truncated.tolist(),
        infos=_columns(infos),
    )


def _columns(rows: Sequence[Mapping[str, Any]]) -> dict[str, np.ndarray]:
    return {key: np.array([row[key] for row in rows]) for key in rows[0]}
