"""Reading a lumen's triangles from a mesh, or a label map of a segmented scan."""

import bz2
import gzip
import io
import math
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cathsim_dmc import extras
from cathsim_dmc.anatomy.scan.units import to_lps

# Endings, and the least bytes that a triangle takes where no header counts them.
FORMATS = {"obj": 35, "stl": 50, "ply": 12, "vtp": 12}
_STL_TEXT = 100  # seven lines
MOST = 4_000_000  # triangles; reading more takes gigabytes
MOST_VOXELS = 500_000_000  # of a label map: 512 x 512 x 1,900
LABEL_MAPS = (".nii", ".nii.gz", ".nrrd")
BLUR = 0.7  # voxels, standard deviation that takes the steps off a surface
_PAD = 3  # voxels around the labels
_MOST_LABELS = 500
_NIFTI_UNITS = {"meter": 1.0, "mm": 1e-3, "micron": 1e-6, "unknown": 1e-3}


def _parsed(path: Path, kind: str, read: Callable[[Path], Any], extra: str) -> Any:
    if not path.is_file():
        raise FileNotFoundError(
            f"no mesh file {path}; give a lumen's surface (STL, OBJ, PLY or VTP), or a "
            "label map (NIfTI, NRRD)."
        )
    if not path.stat().st_size:
        raise ValueError(f"{path} is empty (0 bytes); export it again.")
    try:
        return read(path)
    except ImportError as error:
        raise ValueError(
            f"{path} needs {error.name}: {extras.adding(extra)}."
        ) from error
    except Exception as error:  # readers raise whatever their format leads to
        said = re.sub(r"\s+", " ", str(error)).strip()[:150] or type(error).__name__
        raise ValueError(
            f"{path} cannot be read as {kind.upper()}: {said}. Export it again."
        ) from error


def read_triangles(path: str | Path) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) float64 in the file's unit and faces (F, 3) int64, as they are.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if the format is unknown, the file is empty, damaged, holds no
            triangles or far too many; the message is one line.
    """
    path = Path(path)
    kind = path.suffix.lower().lstrip(".")
    if kind not in FORMATS:
        raise ValueError(
            f"{path} has the ending {path.suffix!r}; give a mesh in one of the formats "
            f"{', '.join(FORMATS)}."
        )
    count = _parsed(path, kind, _announced, "")
    if count > MOST:
        raise ValueError(
            f"{path} has some {count / 1e6:.1f} million triangles; at most "
            f"{MOST / 1e6:g} million are read. Decimate it before export (3D Slicer: "
            "Surface Toolbox, Decimate)."
        )
    read = _read_vtp if kind == "vtp" else _read_mesh
    vertices, faces = _parsed(path, kind, read, "vtp")
    if len(faces) < 4:
        raise ValueError(
            f"{path} has {len(faces)} triangles; give a triangle mesh of the lumen "
            "(points, lines and volumes are none)."
        )
    bad = int((~np.isfinite(vertices).all(axis=1)).sum())
    if bad:
        raise ValueError(
            f"{path} has {bad} vertices whose coordinates are NaN or infinite; export "
            "it again."
        )
    return vertices, faces


def _announced(path: Path) -> int:
    """Triangles that a file announces, or the most its size leaves room for."""
    kind = path.suffix.lower().lstrip(".")
    with path.open("rb") as stream:
        # The counts of a VTP file may stand anywhere in it.
        head = stream.read(-1 if kind == "vtp" else 4096)
    faces = re.findall(rb'element face (\d+)|NumberOf(?:Polys|Strips)="\s*(\d+)', head)
    corners = re.findall(rb'element vertex (\d+)|NumberOfPoints="\s*(\d+)', head)
    if faces or corners:
        count, points = (sum(int(a or b) for a, b in one) for one in (faces, corners))
        return max(count, points // 3)  # where no two triangles share a vertex
    size = path.stat().st_size
    if kind != "stl":
        return size // FORMATS[kind]
    if head.lstrip().startswith(b"solid") and b"\0" not in head:
        return size // _STL_TEXT
    whole, held = int.from_bytes(head[80:84], "little"), max(size - 84, 0) // 50
    if b"\0" in head and held < whole <= MOST:
        raise ValueError(f"it ends early, after {held:,} of {whole:,} triangles")
    return held


def _read_mesh(path: Path) -> tuple[np.ndarray, np.ndarray]:
    import trimesh

    kind = path.suffix.lower().lstrip(".")
    # From bytes and without a resolver: nothing beside the file is opened.
    options = {"skip_materials": True} if kind == "obj" else {}
    data = io.BytesIO(path.read_bytes())
    mesh = trimesh.load_mesh(data, file_type=kind, process=False, **options)
    faces = np.asarray(mesh.faces, dtype=np.int64).reshape(-1, 3)
    return np.array(mesh.vertices, dtype=np.float64).reshape(-1, 3), faces


def _read_vtp(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Triangles of a VTK PolyData file; polygons and strips are divided."""
    from vtkmodules import vtkCommonCore, vtkFiltersCore, vtkIOXML
    from vtkmodules.util.numpy_support import vtk_to_numpy

    vtkCommonCore.vtkObject.GlobalWarningDisplayOff()  # it prints what it cannot read
    reader = vtkIOXML.vtkXMLPolyDataReader()
    reader.SetFileName(str(path))
    reader.Update()
    read = reader.GetOutput()
    for cells in (read.GetVerts(), read.GetLines(), read.GetPolys(), read.GetStrips()):
        # VTK does not look, and would read beyond the arrays.
        corners = vtk_to_numpy(cells.GetConnectivityArray())
        stops = vtk_to_numpy(cells.GetOffsetsArray())
        beyond = stops[-1:] != len(corners) or np.diff(stops, prepend=0).min() < 0
        if beyond or np.any((corners < 0) | (corners >= read.GetNumberOfPoints())):
            raise ValueError("its cells name points that it does not have")
    if reader.GetErrorCode() or not read.GetNumberOfPoints():
        raise ValueError("it is damaged, or no PolyData")
    triangles = vtkFiltersCore.vtkTriangleFilter()
    triangles.SetInputData(read)
    triangles.PassLinesOff()
    triangles.PassVertsOff()
    triangles.Update()
    found = triangles.GetOutput()
    corners = vtk_to_numpy(found.GetPolys().GetConnectivityArray())
    points = vtk_to_numpy(found.GetPoints().GetData()).astype(np.float64)
    return points, corners.astype(np.int64).reshape(-1, 3)


def label_surface(
    path: str | Path, labels: Sequence[int] = ()
) -> tuple[np.ndarray, np.ndarray, str]:
    """Surface of the labels of a label map that are the lumen, or of its only one.

    Returns:
        (vertices (V, 3) m in LPS, faces (F, 3), a line that says what was taken).

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is no label map, the package that reads it is missing, or
            the labels are not in it; lists those that are.
    """
    from scipy.ndimage import find_objects, gaussian_filter
    from skimage.measure import marching_cubes

    path = Path(path)
    nrrd = path.suffix.lower() == ".nrrd"
    read, kind = (_nrrd, "nrrd") if nrrd else (_nifti, "nii")
    voxels, matrix, origin, names = _parsed(path, kind, read, "segmentation")
    if voxels.ndim != 3:
        raise ValueError(
            f"{path} has the shape {voxels.shape}; give one label map in three "
            "dimensions (3D Slicer: export the segmentation as a label map)."
        )
    if not np.array_equal(np.rint(voxels), voxels):
        raise ValueError(
            f"{path} holds numbers that are not whole, so it is an image or a "
            "probability map; give a segmentation (label map)."
        )
    values, counts = np.unique(voxels, return_counts=True)
    seen = {int(k): int(n) for k, n in zip(values, counts, strict=True) if k != 0}
    if not set(labels) & set(seen) and len(seen) > _MOST_LABELS:
        raise ValueError(
            f"{path} holds {len(seen):,} different numbers, so it is an image; give a "
            "segmentation (label map) of its lumen."
        )
    chosen = [int(k) for k in labels] or list(seen)
    if (not labels and len(seen) != 1) or not set(chosen) <= set(seen):
        listed = ", ".join(
            f"{k} {names.get(k, '')}".strip() + f" ({n:,} voxels)"
            for k, n in list(seen.items())[:20]
        )
        missing = [k for k in chosen if k not in seen]
        lacks = f"no label {missing[0]}; it has " if missing else ""
        raise ValueError(
            f"{path} has {lacks}{len(seen)} labels: {listed or 'all voxels are 0'}; "
            "choose those of the lumen (--label)."
        )
    mask = np.isin(voxels, chosen)
    (box,) = find_objects(mask.astype(np.uint8))
    low = [rows.start for rows in box]
    part = gaussian_filter(np.pad(mask[box], _PAD).astype(np.float32), BLUR)
    points, faces, _, _ = marching_cubes(part, 0.5)
    vertices = (points + low - _PAD) @ matrix.T + origin
    if np.linalg.det(matrix) > 0.0:
        faces = faces[:, ::-1]
    size = " x ".join(f"{x * 1e3:.2g}" for x in np.linalg.norm(matrix, axis=0))
    called = ", ".join(f"{k} {names.get(k, '')}".strip() for k in chosen)
    taken = f"label {called} of {path.name}: {int(mask.sum()):,} voxels of {size} mm"
    return vertices, faces.astype(np.int64), f"{taken}; unit and frame are the file's"


def _require_few(shape: Sequence[int]) -> int:
    """Number of voxels that a header announces; ValueError if there are too many."""
    count = math.prod(map(int, shape))
    if not 0 <= count <= MOST_VOXELS:
        raise ValueError(
            f"it announces {count / 1e6:,.0f} million voxels; at most "
            f"{MOST_VOXELS / 1e6:,.0f} million are read: crop it to the lumen"
        )
    return count


def _require_end(path: Path, count: int, encoding: str) -> None:
    """ValueError if the packed voxels of a NRRD file go on after its last voxel.

    Its reader unpacks the file to its end.
    """
    opened = {"gz": gzip.open, "bz": bz2.open}
    if encoding[:2] not in opened:
        return
    left = 8 * count + 2**16  # bytes; no voxel has more than 8
    with path.open("rb") as stream:
        while stream.readline().strip():
            pass
        unpacked = opened[encoding[:2]](stream)
        while left > 0 and (part := unpacked.read(2**20)):
            left -= len(part)
    if left <= 0:
        raise ValueError(f"it holds more than the {count:,} voxels that it announces")


def _nifti(path: Path):
    """Voxels, matrix (3, 3) and origin (3,) to m in LPS, names of labels."""
    import nibabel

    image: Any = nibabel.load(path)
    unit = _NIFTI_UNITS.get(image.header.get_xyzt_units()[0], 1e-3)
    affine = unit * to_lps("m", "RAS") @ image.affine[:3]
    _require_few(image.shape)
    voxels = np.asanyarray(image.dataobj)
    shape = voxels.shape[:3] + tuple(n for n in voxels.shape[3:] if n != 1)
    return voxels.reshape(shape), affine[:, :3], affine[:, 3], {}


def _nrrd(path: Path):
    """As `_nifti`; Slicer's files name their labels."""
    import nrrd

    header = nrrd.read_header(str(path))
    if {"datafile", "data file"} & set(header):
        raise ValueError("its voxels are in another file; save both as one .nrrd file")
    count = _require_few(np.atleast_1d(header["sizes"]).tolist())
    _require_end(path, count, str(header.get("encoding")))
    voxels, header = nrrd.read(str(path))
    space = str(header.get("space", "LPS")).upper()
    space = "".join(re.findall(r"\b\w", space)) if "-" in space else space
    to = to_lps("mm", space)
    if "space directions" not in header:
        raise ValueError(
            "its header lacks 'space directions', the size and place of its voxels"
        )
    rows = np.asarray(header["space directions"], dtype=float)
    origin = np.asarray(header.get("space origin", np.zeros(3)), dtype=float)
    names = {
        int(value): str(header.get(key.replace("_LabelValue", "_Name"), ""))
        for key, value in header.items()
        if key.endswith("_LabelValue")
    }
    return voxels, to @ rows.T, to @ origin, names
