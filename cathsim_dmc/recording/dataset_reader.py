"""Reads Minari datasets without Minari: arrays and JSON, nothing is executed.

Minari itself makes the environment that a dataset names if the spaces are missing,
and so imports and calls whatever the file says. Here metadata.json is read as JSON and
main_data.hdf5 as plain arrays of numbers; links that lead out of the file are refused.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from cathsim_dmc import bounds, files

METADATA = "metadata.json"
_ARRAYS = "main_data.hdf5"
_MAX_METADATA = 2**24  # bytes; the bounds of large images are spelt out in it
_MAX_ARRAY = 2**33  # bytes of one array of one episode


class DatasetError(ValueError):
    """A dataset is missing, damaged, or not what was asked for."""


@dataclasses.dataclass(frozen=True)
class DatasetEpisode:
    """One episode of T steps.

    Attributes:
        seed: Seed of its reset; None if it was not noted.
        observations: name to array (T+1, ...), before each step and after the last.
        actions: (T, A), carried out.
        rewards: (T,).
        terminations: (T,) bool.
        truncations: (T,) bool.
        infos: name to array (T+1, ...), those of the reset first.
    """

    seed: int | None
    observations: Mapping[str, np.ndarray]
    actions: np.ndarray
    rewards: np.ndarray
    terminations: np.ndarray
    truncations: np.ndarray
    infos: Mapping[str, np.ndarray]

    @property
    def success(self) -> bool:
        """Whether any step reached the goal."""
        return bool(np.any(self.infos.get("success", False)))


def read_metadata(path: str | Path) -> dict[str, Any]:
    """Metadata of a dataset.

    Args:
        path: Directory of the dataset, or the directory `data` in it.

    Raises:
        DatasetError: there is none, or its metadata cannot be used.
    """
    file = _data(path) / METADATA
    try:
        values = files.read_json(file, _MAX_METADATA, "the metadata of a dataset")
    except ValueError as error:
        raise DatasetError(str(error)) from error
    if not isinstance(values, dict) or values.get("data_format") != "hdf5":
        raise DatasetError(
            f"{file} does not describe a dataset in HDF5; `cathsim demos` writes one"
        )
    if values.get("jpeg_encoding") is not False:
        raise DatasetError(
            f"{file} says images are JPEG, which loses what they show; write it anew "
            "with jpeg_encoding=False"
        )
    return values


def read_episodes(path: str | Path) -> Iterator[DatasetEpisode]:
    """Episodes of a dataset, one after the other.

    Args:
        path: Directory of the dataset, or the directory `data` in it.

    Raises:
        DatasetError: there is none, or it is damaged.
        ModuleNotFoundError: h5py is not installed.
    """
    try:
        import h5py
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(
            "h5py is not installed; `pip install cathsim-dmc[gym]` adds it"
        ) from error
    read_metadata(path)
    file = _data(path) / _ARRAYS
    try:
        with h5py.File(file, "r") as whole:
            for index in range(len(whole)):
                yield _episode(_Group(file, whole, f"episode_{index}"))
    except DatasetError:
        raise
    # What h5py raises where the file is damaged.
    except (OSError, KeyError, ValueError, TypeError, RuntimeError) as error:
        line = " ".join(str(error).split())
        raise DatasetError(f"{file} cannot be read: {line}") from error


def _data(path: str | Path) -> Path:
    path = Path(path)
    if (path / METADATA).is_file():
        return path
    if (path / "data" / METADATA).is_file():
        return path / "data"
    raise DatasetError(
        f"no dataset in {path}: give a directory that `cathsim demos` has written, "
        f"with data/{METADATA} in it"
    )


class _Group:
    """A group of an HDF5 file that is looked at with care."""

    def __init__(self, file: Path, parent: Any, name: str):
        import h5py

        self._file, self._name = file, name
        self._group = self._hard(parent, name)
        if not isinstance(self._group, h5py.Group):
            raise DatasetError(f"{file}: {name} must be a group of arrays")

    def _hard(self, parent: Any, name: str) -> Any:
        """A member that lies in this file."""
        import h5py

        link = parent.get(name, getlink=True)
        if not isinstance(link, h5py.HardLink):
            what = "is missing" if link is None else "leads elsewhere"
            raise DatasetError(f"{self._file}: {self._name}: {name} {what}")
        return parent[name]

    @property
    def seed(self) -> int | None:
        """Seed that is noted as an attribute."""
        given = self._group.attrs.get("seed")
        if given is None:
            return None
        try:
            return bounds.whole("seed", given, 0)
        except ValueError as error:
            raise DatasetError(f"{self._file}: {self._name}: {error}") from error

    def __contains__(self, name: str) -> bool:
        """Whether there is a member of that name."""
        return name in self._group

    def array(self, name: str) -> np.ndarray:
        """Member that is an array of numbers."""
        import h5py

        found = self._hard(self._group, name)
        plain = isinstance(found, h5py.Dataset) and found.dtype.kind in "biuf"
        if not plain or not found.shape or found.is_virtual or found.external:
            raise DatasetError(
                f"{self._file}: {self._name}/{name} must be an array of numbers in "
                "this file, with a row for each step"
            )
        if found.nbytes > _MAX_ARRAY:
            raise DatasetError(
                f"{self._file}: {self._name}/{name} takes {found.nbytes / 1e9:.0f} GB"
            )
        return found[()]

    def arrays(self, name: str) -> dict[str, np.ndarray]:
        """Members of a group that are arrays of numbers."""
        inner = _Group(self._file, self._group, name)
        return {key: inner.array(key) for key in inner._group}


def _episode(group: _Group) -> DatasetEpisode:
    episode = DatasetEpisode(
        seed=group.seed,
        observations=group.arrays("observations"),
        actions=group.array("actions"),
        rewards=group.array("rewards"),
        terminations=group.array("terminations"),
        truncations=group.array("truncations"),
        infos=group.arrays("infos") if "infos" in group else {},
    )
    steps = len(episode.actions)
    lengths = {
        **{name: len(getattr(episode, name)) for name in _BY_STEP},
        **{name: len(v) - 1 for name, v in episode.observations.items()},
        **{name: len(v) - 1 for name, v in episode.infos.items()},
    }
    wrong = [name for name, length in lengths.items() if length != steps]
    if wrong or not steps:
        raise DatasetError(
            f"{group._file}: {group._name} has {steps} actions, and {wrong} do not fit"
        )
    numbers = {
        "actions": episode.actions,
        "rewards": episode.rewards,
        **{f"observations/{name}": v for name, v in episode.observations.items()},
    }
    for name, values in numbers.items():
        if not np.isfinite(values).all():
            raise DatasetError(f"{group._file}: {group._name}: {name} are not finite")
    return episode


_BY_STEP = ("rewards", "terminations", "truncations")
