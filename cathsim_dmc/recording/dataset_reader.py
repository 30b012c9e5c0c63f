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
    """A dataset is missing, damaged or of another kind."""


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
                yield _episode(file, whole, f"episode_{index}")
    except DatasetError:
        raise
    # What a damaged file leads to.
    except (
        OSError,
        LookupError,
        ValueError,
        TypeError,
        RuntimeError,
        AttributeError,
    ) as error:
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


def _member(file: Path, group: Any, name: str) -> Any:
    """A member of a group: an array of numbers, or a group as a dictionary of these."""
    import h5py

    where = f"{file}: {group.name.strip('/')}"
    link = group.get(name, getlink=True)
    if not isinstance(link, h5py.HardLink):
        what = "is missing" if link is None else "leads elsewhere"
        raise DatasetError(f"{where}: {name} {what}")
    found = group[name]
    if isinstance(found, h5py.Group):
        return {inner: _member(file, found, inner) for inner in found}
    if (
        found.dtype.kind not in "biuf"
        or not found.shape
        or (found.is_virtual or found.external)
    ):
        raise DatasetError(
            f"{where}/{name} must be an array of numbers in this file, with a row for "
            "each step"
        )
    if found.nbytes > _MAX_ARRAY:
        raise DatasetError(f"{where}/{name} takes {found.nbytes / 1e9:.0f} GB")
    return found[()]


def _episode(file: Path, whole: Any, name: str) -> DatasetEpisode:
    for part in (name, *(f"{name}/{field}" for field in _FIELDS)):
        if part not in whole:
            raise DatasetError(f"{file}: {part} is missing")
    members = _member(file, whole, name)
    seed = whole[name].attrs.get("seed")
    episode = DatasetEpisode(
        seed=None if seed is None else bounds.whole("seed", seed, 0),
        infos=members.get("infos", {}),
        **{field: members[field] for field in _FIELDS},
    )
    parts = {f"infos/{key}": value for key, value in episode.infos.items()}
    numbers = {f"observations/{key}": v for key, v in episode.observations.items()}
    by_step = {key: getattr(episode, key) for key in _FIELDS[1:]}
    steps = len(episode.actions)
    wrong = [key for key, value in by_step.items() if len(value) != steps]
    wrong += [k for k, value in {**parts, **numbers}.items() if len(value) != steps + 1]
    if wrong or not steps:
        raise DatasetError(
            f"{file}: {name} has {steps} actions, and {wrong} do not fit"
        )
    for key, values in {**by_step, **numbers}.items():
        if not np.isfinite(values).all():
            raise DatasetError(f"{file}: {name}: {key} are not finite")
    return episode


_FIELDS = ("observations", "actions", "rewards", "terminations", "truncations")
