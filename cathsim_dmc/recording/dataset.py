"""Episodes as a Minari dataset, which Gymnasium and TorchRL load."""

import contextlib
import json
import os
import re
import types
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cathsim_dmc import bounds, extras, locks, suite
from cathsim_dmc.files import (
    as_path,
    atomic_directory,
    fill,
    refused,
    require_folder,
    require_room,
)
from cathsim_dmc.recording.episode import SUFFIX, Episode
from cathsim_dmc.tasks.config import NavigationConfig

# Options of the observation, which a recorded episode does not hold.
_OBSERVED = ("observation", "fluoroscopy", "endoluminal_size", "cameras")
# Tolerances of a repeated episode, of the reward and of each position (m, rad):
# machines round differently.
_SAME_REWARD = _SAME_POSITION = 1e-9


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
        algorithm: Name of the policy, for the metadata.

    Returns:
        The directory.

    Raises:
        FileExistsError: the directory exists.
        OSError: the directory around it is missing or read-only, or the disk is full.
        ModuleNotFoundError: minari is not installed.
    """
    path = as_path("path", path)
    check_free(path)
    extras.require("gym", "minari")
    import minari
    from minari.dataset.minari_storage import MinariStorage

    name, seen, acted = path.name, observation_space, action_space
    about = {
        # The last part of an id is a name with a version.
        "dataset_id": name if re.search(r"-v\d+$", name) else f"{name}-v0",
        "algorithm_name": algorithm,
        "description": description,
        "minari_version": minari.__version__,
    }
    with atomic_directory(path) as temporary:
        _check_space(temporary / "space", buffers)
        # Minari looks for the files of a relative path beneath that path again.
        data = temporary.absolute() / "data"
        storage = MinariStorage.new(data, seen, acted, env_spec, jpeg_encoding=False)
        storage.update_metadata(about)
        storage.update_episodes(buffers)
    return path


def _check_space(path: Path, buffers: Sequence[Any]) -> None:
    """Raises OSError unless disk and quota have room for the arrays of episodes."""
    # On a full disk HDF5 ends the process with a segmentation fault.
    size = 0
    for one in buffers:
        arrays = *one.observations.values(), *one.infos.values(), one.actions
        size += 2**18 + sum(array.nbytes for array in arrays) * 5 // 4  # with chunks
    fill(path, size)
    path.unlink()


class DatasetError(ValueError):
    """A dataset is missing, damaged or of another kind."""


def chosen(options: Mapping[str, Any], name: str) -> Any:
    """Returns an option of a task; None if it is missing or has its default.

    Args:
        options: Options, with the name of the task as "task".
    """
    value, default = options.get(name), getattr(NavigationConfig, name, None)
    if (definition := suite.TASKS.get(options.get("task", ""))) is not None:
        own = {**definition.objective_defaults, **definition.options}
        default = own.get(name, default)
    return None if value == default else value


def _require_options(own: Mapping[str, Any], wanted: Mapping[str, Any]) -> None:
    """Raises ValueError unless episodes have the task and options that are wanted."""
    for name in wanted:
        pair = chosen(own, name), chosen(wanted, name)
        if pair[0] != pair[1]:
            told = ["the default" if one is None else repr(one) for one in pair]
            raise ValueError(
                f"its {name} is {told[0]}, not {told[1]}; record with the {name} of "
                "the training, or train with that of the recording"
            )


def metadata_of(path: str | os.PathLike[str]) -> Path:
    """Returns the path of a dataset's metadata.json; DatasetError if there is none."""
    data = next(Path(path).glob("data"), Path(path)) / "metadata.json"
    if not data.is_file():
        if Path(path).suffix == SUFFIX:
            raise DatasetError(
                f"{path} is a file: put episodes of `cathsim play` or `cathsim record` "
                "into a folder and give that (--demonstrations)"
            )
        raise DatasetError(
            f"no dataset in {path}: give one of `cathsim demos`, also to a run that is "
            "resumed (--demonstrations)"
        )
    return data


def read_episodes(path: str | os.PathLike[str], **options: Any) -> Iterator[Any]:
    """Yields the episodes of a dataset as `minari.EpisodeData`.

    Args:
        path: Directory of the dataset, or the directory `data` in it.
        **options: Task and options that it must have been recorded with.

    Raises:
        DatasetError: there is none, or it is damaged, or recorded with other options.
        ModuleNotFoundError: minari is not installed.
    """
    extras.require("gym", "minari")
    import minari

    data = metadata_of(path)
    # Errors that a damaged file causes.
    wrong = (
        AssertionError, AttributeError, LookupError, OSError, RuntimeError, TypeError,
        ValueError,
    )  # fmt: skip
    with refused(DatasetError, f"{data.parent} cannot be used", wrong):
        # Without the spaces Minari would make the environment that the file names.
        named = json.loads(data.read_text())
        if not {"observation_space", "action_space"} <= set(named):
            raise ValueError("metadata.json lacks the spaces")
        own = json.loads(named.get("env_spec") or "{}").get("kwargs", {})
        if own:
            _require_options(own, options)
        for file in data.parent.glob("*.hdf5"):
            check_stored(file)
        for number, episode in enumerate(minari.MinariDataset(data.parent)):
            _check_episode(episode, number)
            yield episode


def check_stored(path: Path) -> None:
    """Raises ValueError if an HDF5 file unpacks to too much or names other files."""
    import h5py

    links: list[tuple[str, Any]] = []
    with h5py.File(path) as file:
        file.visititems_links(lambda *link: links.append(link))
        unpacked = 0
        for name, link in links:
            if not isinstance(link, h5py.HardLink):
                raise ValueError(f"{name} is a link to another place")
            one = file[name]
            if isinstance(one, h5py.Dataset):
                if one.external or one.is_virtual:
                    raise ValueError(f"{name} lies in another file")
                unpacked += int(one.size or 0) * max(one.dtype.itemsize, 1)
        require_room(unpacked, path.stat().st_size)


def _check_episode(episode: Any, number: int) -> None:
    """Raises ValueError unless all columns are finite and of the right length."""
    steps, seen = len(episode.actions), episode.observations
    columns = {name: (seen[name], steps + 1) for name in seen}
    for name in ("actions", "rewards", "terminations", "truncations"):
        columns[name] = getattr(episode, name), steps
    for name, (values, length) in columns.items():
        if not steps or len(values) != length or not np.isfinite(values).all():
            raise ValueError(f"episode {number}: {name} are not {length} finite rows")


def check_free(path: Path) -> None:
    """Raises unless a dataset can be written there; see `write`."""
    if path.exists():
        raise FileExistsError(f"{path} exists: choose another directory, or remove it")
    require_folder(path.parent)


@contextlib.contextmanager
def reserved(path: Path) -> Iterator[None]:
    """Reserves a path for a dataset that the block writes at its end, see `write`."""
    check_free(path)
    with locks.only_writer(path):
        check_free(path)  # another process may have written it meanwhile
        yield


def export(
    episodes: Iterable[Episode],
    path: str | os.PathLike[str],
    *,
    observation: str | Sequence[str] | None = None,
    task_kwargs: Mapping[str, Any] | None = None,
) -> Path:
    """Repeats recorded episodes and writes them as a dataset, see `write`.

    Each episode is simulated again from its seed; its rewards must equal the recorded
    ones. With another `reward`, its positions must.

    Args:
        episodes: Episodes of one task with equal options, with a seed and with steps.
        path: Directory of the dataset, which must not exist.
        observation: Names of observations; None for those of the record.
        task_kwargs: Further options of the observation, such as `fluoroscopy`, and
            `reward` for rewards other than the recorded ones.

    Returns:
        The directory.

    Raises:
        ValueError: the episodes do not belong together, or do not repeat.
        FileExistsError: the directory exists, or another process writes it.
        ModuleNotFoundError: gymnasium or minari is not installed.
    """
    path = as_path("path", path)
    check_free(path)
    extras.require("gym", "gymnasium", "minari", "h5py")
    from minari.data_collector import EpisodeBuffer

    from cathsim_dmc.simulation import gymnasium

    episodes = bounds.several("episodes", episodes, "a list of at least one Episode")
    for each in episodes:
        bounds.instance("an episode", each, Episode)
    task, options = _common(episodes)
    further = bounds.options("task_kwargs", task_kwargs)
    rewarded = further.get("reward", options.get("reward")) == options.get("reward")
    options |= further
    if observation is not None:
        options["observation"] = observation
    single = all((e.action == e.action.astype(np.float32)).all() for e in episodes)
    kind = np.dtype("float32" if single else "float64")
    with (
        reserved(path),
        contextlib.closing(suite.load(suite.DOMAIN, task, options)) as environment,
    ):
        seen = environment.task.observation_specs
        return write(
            path,
            [
                EpisodeBuffer(**_repeated(environment, e, kind, rewarded))
                for e in episodes
            ],
            env_spec=gymnasium.env_spec(task, **options, dtype=kind.name),
            observation_space=gymnasium.space_of(seen, kind),
            action_space=gymnasium.space(environment.action_spec(), kind),
            algorithm="recorded episodes",
            description=f"{len(episodes)} recorded episodes of the task {task} of "
            "cathsim_dmc",
        )


def recordings_in(path: str | os.PathLike[str]) -> list[Path]:
    """Returns the .npz files of a directory, as `cathsim play --out` writes them."""
    return sorted(Path(path).glob(f"*{SUFFIX}"))


def repeat_episodes(
    path: str | os.PathLike[str], observation: str | Sequence[str], **options: Any
) -> Iterator[Any]:
    """Simulates recorded episodes again; yields them as `read_episodes` does.

    Args:
        path: Directory of .npz files.
        observation: Name or names of the observations that a learner is to see.
        **options: Task and options that they must have been recorded with.

    Raises:
        DatasetError: a file is damaged, was recorded with other options, or does not
            repeat.
    """
    environment, made = None, None
    wrong = ValueError, TypeError, LookupError, AttributeError
    for file in recordings_in(path):
        with refused(DatasetError, f"{file} is no demonstration", wrong):
            episode = Episode.load(file)
            task, own = _common([episode])
            _require_options({"task": task, **own}, options)
            wanted = task, {**own, "observation": observation}
            if made != wanted:
                environment = suite.load(suite.DOMAIN, task, wanted[1])
                made = wanted
            columns = _repeated(environment, episode, np.dtype("float32"))
            yield types.SimpleNamespace(**columns)


def _common(episodes: Sequence[Episode]) -> tuple[str, dict[str, Any]]:
    """Returns the common task and options, with the observation of the first episode.

    Raises:
        ValueError: the episodes differ in these, or one lacks a seed or steps.
    """
    given = [dict(one.meta.get("task_kwargs", {}), random=None) for one in episodes]
    kinds = [{k: v for k, v in o.items() if k not in _OBSERVED} for o in given]
    tasks = sorted({episode.task for episode in episodes})
    if len(tasks) != 1 or any(kind != kinds[0] for kind in kinds):
        raise ValueError(
            f"{len(episodes)} episodes of the tasks {tasks}, or with different "
            "options, make no dataset; export each kind as one of its own"
        )
    for number, one in enumerate(episodes):
        if one.seed is None or not one.steps:
            raise ValueError(
                f"episode {number} has {one.steps} steps and the seed {one.seed}; only "
                "seeded episodes with steps can be repeated"
            )
    return tasks[0], {k: v for k, v in given[0].items() if k != "random"}


def _repeated(
    environment: Any, episode: Episode, kind: np.dtype, rewarded: bool = True
) -> dict[str, Any]:
    """Simulates an episode again; returns its columns, or ValueError if it differs.

    Args:
        kind: Type of the numbers in the columns. The simulation gets the recorded
            actions, in double precision.
        rewarded: Whether the environment has the reward of the record.
    """

    def shown(timestep: Any) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        row = {
            key: np.array(value, value.dtype if value.dtype == np.uint8 else kind)
            for key, value in timestep.observation.items()
        }
        return row, environment.task.info()

    environment.random_state.seed(episode.seed)
    seen, ends = [shown(environment.reset())], []
    rewards: list[float] = []
    for step, action in enumerate(episode.action):
        timestep = environment.step(action)
        seen.append(shown(timestep))
        ends.append(timestep.last())
        rewards.append(float(timestep.reward))
        moved = np.abs(environment.physics.data.qpos - episode.qpos[step + 1]).max()
        off = abs(rewards[step] - episode.reward[step]) > _SAME_REWARD
        if off if rewarded else moved > _SAME_POSITION:
            raise ValueError(_difference(episode, step, rewards[step], moved))
        if ends[-1] and step + 1 < episode.steps:
            raise ValueError(
                f"episode with seed {episode.seed} ends at step {step} instead of "
                f"{episode.steps - 1}; export it with the options it was recorded with"
            )
    terminated = np.array(ends) & (timestep.discount == 0)
    truncated = np.arange(1, episode.steps + 1) == episode.steps
    observations, infos = (
        {key: np.array([row[key] for row in rows]) for key in rows[0]}
        for rows in zip(*seen, strict=True)
    )
    return {
        "seed": episode.seed,
        "observations": observations,
        "actions": episode.action.astype(kind),
        "rewards": episode.reward.tolist() if rewarded else rewards,
        "terminations": terminated.tolist(),
        # An episode that the operator has stopped is truncated too.
        "truncations": (truncated & ~terminated).tolist(),
        "infos": infos,
    }


def _difference(episode: Episode, step: int, reward: float, moved: float) -> str:
    """Returns the text on a step that does not repeat; `moved` in m or rad."""
    objects = ", ".join(episode.meta.get("objects", ())) or "effects and other objects"
    return (
        f"episode with seed {episode.seed} does not repeat: reward {reward} instead of "
        f"{episode.reward[step]}, positions {moved:.2g} apart, at step {step}; it was "
        f"recorded with {episode.meta.get('versions')} and the options "
        f"{episode.meta.get('task_kwargs')}, without {objects}, which no file holds"
    )
