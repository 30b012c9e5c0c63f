"""Cache of fields, keyed by the geometry that they are built from.

The fields of the phantoms ship in `data`, written by `tools/ship_fields.py`.
"""

import contextlib
import hashlib
import io
import lzma
import os
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path

import numpy as np

from cathsim_dmc import files
from cathsim_dmc.anatomy.centreline import VesselTree
from cathsim_dmc.anatomy.field import Field
from cathsim_dmc.anatomy.parts import End, Surface
from cathsim_dmc.file_maps import mapped

KEPT = 4_000_000_000  # bytes of all fields; a pool of 1,000 random arches has 2.6 GB
MOST_ROOM = 1.0  # m³ around a lumen; its field has a brick for each 4 mm of it
_NAMES = ("head", "coarse", "index", "samples")
_DIGEST = "digest"
_SHIPPED = Path(__file__).parent / "data"
_DIGITS = 9  # of lengths, m, that count: processors round differently
_SUFFIX = ".npy"
_FILTERS = [{"id": lzma.FILTER_DELTA, "dist": 2}, {"id": lzma.FILTER_LZMA2}]
# Modules whose code determines a field; it is part of the key.
_MODULES = ("field", "tree_depth", "surface_depth")


def cache_folder() -> Path:
    """Folder of the cache: ``cathsim_dmc/fields`` in the user's cache folder."""
    home = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(home) / "cathsim_dmc" / "fields"


def field_of(lumen: VesselTree | Surface, ends: Sequence[End] = ()) -> Field:
    """As `Field.of`, but memory-mapped from the cache if it was built before.

    A damaged file is built again. Without a writable folder nothing is cached.

    Raises:
        ValueError: if the box around the lumen is larger than `MOST_ROOM`.
    """
    _require_size(lumen)
    digest = hashlib.sha256(_name(lumen, ends).encode() + _code()).hexdigest()
    name, path = f"{digest[:32]}{_SUFFIX}", None
    try:
        path = cache_folder() / name
        field = _read(path)
    except (OSError, ValueError, RuntimeError):  # RuntimeError without a home folder
        field = _shipped(shipped_name(lumen, ends)) or Field.of(lumen, ends)
        with contextlib.suppress(OSError, ValueError):
            if path is not None:
                _keep(field, path)
                field = _read(path)
    else:
        with contextlib.suppress(OSError):
            os.utime(path)
    return field


def _require_size(lumen: VesselTree | Surface) -> None:
    if isinstance(lumen, Surface):
        low, high = lumen.vertices.min(axis=0), lumen.vertices.max(axis=0)
    else:
        lines = [vessel.centreline for vessel in lumen.vessels.values()]
        low = np.min([(one.points.T - one.radii).min(axis=1) for one in lines], axis=0)
        high = np.max([(one.points.T + one.radii).max(axis=1) for one in lines], axis=0)
    sides = high - low
    if not sides.prod() <= MOST_ROOM:
        size = " x ".join(f"{side:.3g}" for side in sides)
        raise ValueError(
            f"the lumen lies in a box of {size} m; it may have {MOST_ROOM:g} m³, so is "
            "its unit right?"
        )


def shipped_name(lumen: VesselTree | Surface, ends: Sequence[End] = ()) -> str:
    """Name of the field of a lumen among those that ship: 16 hexadecimal digits."""
    return _name(lumen, ends)[:16]


def _shipped(name: str) -> Field | None:
    # The file name lists the names of its fields in their order.
    for path in _SHIPPED.glob(f"*{name}*.field"):
        stream = io.BytesIO(lzma.decompress(path.read_bytes()))
        for one in path.stem.split("-"):
            record = np.load(stream, allow_pickle=False)[0]
            if one == name:
                return Field(**{part: record[part].copy() for part in _NAMES})
    return None


def _name(lumen: VesselTree | Surface, ends: Sequence[End]) -> str:
    if isinstance(lumen, Surface):
        parts = [lumen.vertices, lumen.faces]
    else:
        lines = [vessel.centreline for vessel in lumen.vessels.values()]
        parts = [part for line in lines for part in (line.points, line.radii)]
    flat = [(*e.position, *e.direction, e.radius, e.open) for e in ends]
    digest = hashlib.sha256()
    for part in (*parts, np.array(flat)):
        rounded = np.round(part, _DIGITS) + 0  # no negative zeros
        digest.update(f"{part.dtype}{part.shape}".encode() + rounded.tobytes())
    return digest.hexdigest()


def _read(path: Path) -> Field:
    """The field in a file; ValueError if the file is damaged."""
    with open(path, "rb") as stream:
        if np.lib.format.read_magic(stream) != (1, 0):
            raise ValueError(f"{path} is of another format")
        dtype = np.lib.format.read_array_header_1_0(stream)[-1]
        start, pages = stream.tell(), mapped(stream)
    record = np.frombuffer(pages, dtype, 1, start)[0]
    field = Field(**{name: record[name] for name in _NAMES}, pages=pages)
    if record[_DIGEST].tobytes() != field.digest:
        raise ValueError(f"{path} is damaged")
    return field


@cache
def _code() -> bytes:
    digest = hashlib.sha256()
    for name in _MODULES:
        digest.update(Path(__file__).with_name(f"{name}.py").read_bytes())
    return digest.digest()


def ship(folder: Path, fields: Mapping[str, Field]) -> Path:
    """Writes similar fields, by `shipped_name`, to one compressed file in `folder`."""
    stream = io.BytesIO()
    for field in fields.values():
        np.save(stream, _record(field), allow_pickle=False)
    path = folder / f"{'-'.join(fields)}.field"
    data = lzma.compress(stream.getvalue(), filters=_FILTERS)
    return files.write_bytes(path, data)


def _record(field: Field) -> np.ndarray:
    """Record (1,) of all arrays of a field and their checksum."""
    digest = np.frombuffer(field.digest, np.uint8)
    arrays = dict(zip((*_NAMES, _DIGEST), (*field.arrays, digest), strict=True))
    kinds = [(name, array.dtype, array.shape) for name, array in arrays.items()]
    record: np.ndarray = np.empty(1, np.dtype(kinds, align=True))
    for name, array in arrays.items():
        record[name] = array
    return record


def _keep(field: Field, path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with files.atomic_path(path) as temporary, open(temporary, "wb") as stream:
        np.save(stream, _record(field), allow_pickle=False)
    with contextlib.suppress(OSError):  # another process may delete a file
        kept = [(entry.stat(), entry) for entry in path.parent.glob(f"*{_SUFFIX}")]
        kept.sort(key=lambda pair: pair[0].st_mtime, reverse=True)
        total = np.cumsum([size.st_size for size, _ in kept])
        for _, entry in kept[np.searchsorted(total, KEPT, side="right") :]:
            entry.unlink(missing_ok=True)
