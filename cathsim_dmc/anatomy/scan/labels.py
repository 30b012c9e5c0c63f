"""Surface of the labels of a segmented scan."""

import bz2
import gzip
import math
import os
import re
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np

from cathsim_dmc import bounds
from cathsim_dmc.anatomy.scan import frames, voxel_files
from cathsim_dmc.anatomy.scan.mesh import parsed
from cathsim_dmc.anatomy.scan.units import UNITS, to_lps

BLUR = 0.7  # voxels, standard deviation of the smoothing of voxel steps
MOST_VOXELS = 500_000_000  # of a label map: 512 x 512 x 1,900
_PAD = 3  # voxels around the labels
_MOST_LABELS = 500
_DIFFER = 0.3  # least share of differing neighbours in an image; labels: far less
_MOST_UNEVEN = 1e4  # condition number of the matrix of a voxel; usual ones: below 10
_HEADER = 16_384  # bytes of a MetaImage that hold its header
_MOST_LISTED = 2**20  # bytes of its list of files
# Types of voxels that VTK reads from a MetaImage. With others, such as MET_LONG_LONG,
# it returns undefined numbers or writes beyond its memory.
_TYPES = [
    f"MET_{kind}" for kind in "UCHAR CHAR USHORT SHORT UINT INT FLOAT DOUBLE".split()
]
# Names of units of length in files, and axes of the spaces of NRRD files in LPS.
_UNITS = {
    "mm": "mm millimeter millimetre millimeters millimetres",
    "cm": "cm centimeter centimetre centimeters centimetres",
    "m": "m meter metre meters metres",
    "um": "um µm μm micron microns micrometer micrometre micrometers micrometres",
    "inch": "in inch inches",
}
_SPACES = {"LPS": (1.0, 1.0, 1.0), "RAS": (-1.0, -1.0, 1.0), "LAS": (1.0, -1.0, 1.0)}


class Labelled(NamedTuple):
    """The surface of labels: vertices (V, 3) m in LPS, faces (F, 3).

    `notes` state what was assumed and ask about gaps; `unit` is that of the file.
    """

    vertices: np.ndarray
    faces: np.ndarray
    notes: tuple[str, ...]
    unit: str


class _Voxels(NamedTuple):
    """Voxels, matrix (3, 3) and origin (3,) to m in LPS, names of labels.

    `unit` is that of the header, or None; `frame` is a question if it has no frame.
    """

    voxels: np.ndarray
    matrix: np.ndarray
    origin: np.ndarray
    names: dict[int, str]
    unit: str | None = None
    frame: str = ""


def label_surface(
    path: str | Path, labels: Sequence[int] = (), units: str | None = None
) -> Labelled:
    """Surface of the lumen's labels in a label map; by default of its only label.

    ``units`` replace those of its header.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is no label map, the package that reads it is missing, or
            the labels are not in it; lists the labels that are.
    """
    from scipy.ndimage import find_objects, gaussian_filter
    from skimage.measure import marching_cubes

    path = Path(path)
    ending = path.suffix.lower().lstrip(".")
    read, kind, extra = _READERS.get(ending, _READERS["nii"])
    voxels, matrix, origin, names, said, frame = parsed(path, kind, read, extra)
    unit = units or said or "mm"
    factor = UNITS[unit] / UNITS[said or "mm"]
    matrix, origin = factor * matrix, factor * origin
    seen = _counted(path, voxels)
    _require_place(path, matrix, origin)
    chosen = [int(k) for k in labels] or list(seen)
    missing = [k for k in chosen if k not in seen]
    if missing or (not labels and len(seen) != 1):
        listed = ", ".join(
            f"{k} {names.get(k, '')}".strip() + f" ({n:,} voxels)"
            for k, n in list(seen.items())[:20]
        )
        lacks = f"no label {missing[0]}; it has " if missing else ""
        raise ValueError(
            f"{path} has {lacks}{len(seen)} labels: {listed or 'all voxels are 0'}; "
            "choose those of the lumen (--label)."
        )
    mask = np.isin(voxels, chosen)
    (box,) = find_objects(mask.astype(np.uint8))
    low = [rows.start for rows in box]
    part = gaussian_filter(np.pad(mask[box], _PAD).astype(np.float32), BLUR)
    called = ", ".join(f"{k} {names.get(k, '')}".strip() for k in chosen)
    if not part.max() > 0.5:
        raise ValueError(
            f"label {called} of {path} has {int(mask.sum()):,} voxels, too few or too "
            "thin for a surface; choose another one (--label), or make voxels finer."
        )
    points, faces, _, _ = marching_cubes(part, 0.5)
    vertices = (points + low - _PAD) @ matrix.T + origin
    if np.linalg.det(matrix) > 0.0:
        faces = faces[:, ::-1]
    size = " x ".join(f"{x * 1e3:.2g}" for x in np.linalg.norm(matrix, axis=0))
    taken = f"label {called} of {path.name}: {int(mask.sum()):,} voxels of {size} mm"
    taken += f"; {_source(units, said)}" + ("" if frame else "; frame is the file's")
    notes = (taken, frame) if frame else (taken,)
    return Labelled(vertices, faces.astype(np.int64), notes, unit)


def _counted(path: Path, voxels: np.ndarray) -> dict[int, int]:
    """Number of voxels of each label but 0; ValueError if it is no label map."""
    if voxels.ndim != 3 or not voxels.size:
        raise ValueError(
            f"{path} has the shape {voxels.shape}; give one label map in three "
            "dimensions (3D Slicer: export the segmentation as a label map)."
        )
    values, counts = np.unique(voxels, return_counts=True)
    if grey := _grey(voxels, values):
        raise ValueError(
            f"{path} holds {grey}, so it is an image; segment its lumen first (3D "
            "Slicer, TotalSegmentator) and give the label map."
        )
    return {int(k): int(n) for k, n in zip(values, counts, strict=True) if k != 0}


def _require_place(path: Path, matrix: np.ndarray, origin: np.ndarray) -> None:
    """ValueError unless voxels have edges (3, 3), in columns, and an origin (3,), m."""
    place = np.column_stack([matrix, origin])
    if not (np.isfinite(place).all() and np.linalg.cond(matrix) < _MOST_UNEVEN):
        raise ValueError(
            f"{path} gives its voxels no place in space: the edges of one are "
            f"{_rows(1e3 * matrix.T)} mm, the first is at {_rows(1e3 * origin[None])} "
            "mm. Mend spacing, directions and origin in its header (3D Slicer: "
            "Volumes), or export it again."
        )


def _source(given: str | None, said: str | None) -> str:
    """Text on the source of the unit of a label map."""
    if given is None:
        return f"unit {said}, as its header says" if said else "no unit named: mm taken"
    return f"unit {given}, as given" + (f" (its header says {said})" if said else "")


def _unit(names: Sequence[str]) -> str | None:
    """Key of `UNITS` for the unit names of a header; None without a name."""
    names = sorted({name.strip().lower() for name in names} - {"", "none", "???"})
    found = [k for k, called in _UNITS.items() if set(names) <= set(called.split())]
    if names and not found:
        raise ValueError(
            f"the unit of its coordinates is {' and '.join(names)}; save it in one of "
            f"{', '.join(UNITS)}"
        )
    return found[0] if names else None


def _require_few(shape: Sequence[int]) -> int:
    """Number of voxels that a header announces; ValueError if there are too many."""
    count = math.prod(map(int, shape))
    if not 0 <= count <= MOST_VOXELS:
        raise ValueError(
            f"it announces {count / 1e6:,.0f} million voxels; at most "
            f"{MOST_VOXELS / 1e6:,.0f} million are read: crop it to the lumen"
        )
    return count


def _require_end(stream: IO[bytes], count: int, encoding: str) -> None:
    """ValueError if a file holds more compressed voxels than it announces.

    The reader of NRRD files would unpack them all. Other readers stop before the
    checksum at the end, and return what damaged voxels are unpacked to.
    """
    opened = {"gz": gzip.open, "bz": bz2.open}
    if encoding[:2] not in opened:
        return
    left = 8 * count + 2**16  # bytes; no voxel has more than 8
    unpacked = opened[encoding[:2]](stream)
    while left > 0 and (part := unpacked.read(2**20)):
        left -= len(part)
    if left <= 0:
        raise ValueError(f"it holds more than the {count:,} voxels that it announces")


def _require_whole(path: Path, start: int, most: int) -> None:
    """ValueError if compressed voxels from an offset on are damaged, or over `most`.

    Both are bytes. VTK only prints that voxels are damaged, and returns undefined ones.
    It also reports a file that is missing.
    """
    if path.is_file():
        unpacker = zlib.decompressobj(zlib.MAX_WBITS | 32)
        unpacker.decompress(path.read_bytes()[start:], most + 1)
        if not unpacker.eof:
            raise ValueError("it is damaged or cut off, or holds too many voxels")


def _rows(table: np.ndarray) -> str:
    """Vectors (n, 3) as text."""
    return ", ".join("(" + ", ".join(f"{x:g}" for x in row) + ")" for row in table)


def _grey(voxels: np.ndarray, values: np.ndarray) -> str:
    """Evidence that voxels are grey values of an image; empty for labels."""
    if voxels.dtype.kind not in "biuf":
        return f"voxels of several numbers (type {voxels.dtype})"
    if not (np.isfinite(values).all() and np.array_equal(np.rint(values), values)):
        return "numbers that are not whole"
    if values[0] < 0:
        return f"negative numbers (from {values[0]:g} on)"
    if len(values) > _MOST_LABELS:
        return f"{np.count_nonzero(values):,} different numbers"
    # Labels are the same in whole regions; grey values differ from voxel to voxel.
    differ = both = 0
    for axis in range(3):
        along = np.moveaxis(voxels, axis, 0)
        one, other = along[1:], along[:-1]
        inside = (one != 0) & (other != 0)
        both += int(inside.sum())
        differ += int((inside & (one != other)).sum())
    if differ > _DIFFER * both:
        return f"neighbours that differ at {differ / both:.0%} of the places"
    return ""


def _nifti(path: Path) -> _Voxels:
    import nibabel

    image: Any = nibabel.load(path)
    unit = _unit([image.header.get_xyzt_units()[0].replace("unknown", "")])
    affine = UNITS[unit or "mm"] * to_lps("m", "RAS") @ image.affine[:3]
    frame = frames.of_nifti(image, 1e3 * UNITS[unit or "mm"])
    count = _require_few(image.shape)
    if path.suffix.lower() == ".gz":
        with path.open("rb") as stream:
            _require_end(stream, count, "gz")
    voxels = np.asanyarray(image.dataobj)
    shape = voxels.shape[:3] + tuple(n for n in voxels.shape[3:] if n != 1)
    matrix, origin = affine[:, :3], affine[:, 3]
    return _Voxels(voxels.reshape(shape), matrix, origin, {}, unit, frame)


def _nrrd(path: Path) -> _Voxels:
    """Voxels of a NRRD file; those of 3D Slicer name their labels."""
    import nrrd

    header = nrrd.read_header(str(path))
    data, detached = path, {"datafile", "data file"} & set(header)
    if detached:
        if path.suffix.lower() != ".nhdr":
            raise ValueError(
                "its voxels are in another file; save both as one .nrrd file"
            )
        data = voxel_files.beside(path, str(header[detached.pop()]))
    count = _require_few(np.atleast_1d(header["sizes"]).tolist())
    with data.open("rb") as stream:
        while data is path and stream.readline().strip():
            pass
        _require_end(stream, count, str(header.get("encoding")))
    voxels, header = nrrd.read(str(path))
    space, frame = frames.of_nrrd(header)
    letters = space.upper()
    letters = "".join(re.findall(r"\b\w", letters)) if "-" in letters else letters
    if letters not in _SPACES:
        raise ValueError(
            f"its space is {bounds.shown(space)}; save it in one of "
            f"{', '.join(_SPACES)} (such as left-posterior-superior)"
        )
    unit = _unit(np.atleast_1d(header.get("space units", [])).tolist())
    to = np.diag(_SPACES[letters]) * UNITS[unit or "mm"]
    rows = frames.directions(header)
    origin = np.asarray(header.get("space origin", np.zeros(3)), dtype=float)
    names = {
        int(value): str(header.get(key.replace("_LabelValue", "_Name"), ""))
        for key, value in header.items()
        if key.endswith("_LabelValue")
    }
    return _Voxels(voxels, to @ rows.T, to @ origin, names, unit, frame)


def _meta_header(path: Path) -> dict[str, list[str]]:
    """Entries of a MetaImage's header; ValueError if VTK would not read it whole."""
    entries: dict[str, list[str]] = {}
    with path.open("rb") as stream:
        while "ElementDataFile" not in entries and stream.tell() < _HEADER:
            key, _, value = os.fsdecode(stream.readline(_HEADER)).partition("=")
            entries[key.strip()] = value.split()
        start = stream.tell()
        listed = stream.read(_MOST_LISTED)
    sizes = [int(size) for size in entries.get("DimSize", [])]
    if entries.get("NDims") != ["3"] or len(sizes) != 3:
        raise ValueError("its header does not say NDims = 3 and three sizes (DimSize)")
    count = _require_few(sizes)
    kind = " ".join(entries.get("ElementType", []))
    channels = " ".join(entries.get("ElementNumberOfChannels", ["1"]))
    if kind not in _TYPES or channels != "1":
        raise ValueError(
            f"its voxels are {channels} x {kind or 'of no type'}; save them as one "
            f"channel of {', '.join(_TYPES)}"
        )
    named = " ".join(entries.get("ElementDataFile", []))
    others = voxel_files.of_meta(path, named, listed, sizes)
    if entries.get("CompressedData", ["False"])[0][:1] in "Tt1":
        if others:
            for other in others:
                _require_whole(other, 0, 8 * count)
        elif "CompressedDataSize" in entries:
            _require_whole(path, start, 8 * count)
        else:
            raise ValueError("its header does not say CompressedDataSize")
    return entries


def _meta(path: Path) -> _Voxels:
    from vtkmodules import vtkCommonCore, vtkIOImage
    from vtkmodules.util.numpy_support import vtk_to_numpy

    entries = _meta_header(path)
    frame = frames.of_meta(entries)

    def numbers(names: str, default: np.ndarray) -> np.ndarray:
        given = [entries[name] for name in names.split() if name in entries]
        return np.array(given[0], dtype=float) if given else default

    # A row is the direction of an axis.
    turn = numbers("TransformMatrix Rotation Orientation", np.eye(3).ravel())
    spacing = numbers("ElementSpacing ElementSize", np.zeros(3))
    origin = numbers("Offset Position Origin", np.zeros(3))
    reader = vtkIOImage.vtkMetaImageReader()
    reader.SetFileName(str(path))
    # VTK leaves missing voxels undefined. It reports them by an event only, and only
    # with its warnings on.
    vtkCommonCore.vtkObject.GlobalWarningDisplayOn()
    failed: list[str] = []
    told = vtkCommonCore.vtkCommand.ErrorEvent
    reader.AddObserver(told, lambda _, event: failed.append(event))
    reader.Update()
    image = reader.GetOutput()
    if failed or reader.GetErrorCode() or not image.GetNumberOfPoints():
        raise ValueError(
            "it is damaged or cut off, no MetaImage, or lacks the file of its voxels"
        )
    data = vtk_to_numpy(image.GetPointData().GetScalars())
    voxels = data.reshape(image.GetDimensions()[::-1]).transpose()
    matrix = 1e-3 * turn.reshape(3, 3).T * spacing
    return _Voxels(voxels, matrix, 1e-3 * origin, {}, frame=frame)


_READERS = {
    "nii": (_nifti, "nii", "segmentation"),
    "nrrd": (_nrrd, "nrrd", "segmentation"),
    "nhdr": (_nrrd, "nrrd", "segmentation"),
    "mha": (_meta, "mha", "vtp"),
    "mhd": (_meta, "mha", "vtp"),
}
