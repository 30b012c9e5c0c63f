"""Reading a lumen's triangles from a file, and guessing their unit."""

from __future__ import annotations

import importlib
import importlib.util
import io
import re
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from cathsim_dmc.anatomy.parts import Surface
from cathsim_dmc.anatomy.scan.topology import areas
from cathsim_dmc.anatomy.scan.units import UNITS
from cathsim_dmc.anatomy.surface import sampled

# Endings, and the least bytes a triangle takes where no header counts them: a face
# "f 1 2 3" and half a vertex in OBJ, seven lines of text in STL.
FORMATS = {"obj": 35, "stl": 100, "ply": 12, "vtp": 12}
MOST = 4_000_000  # triangles; reading more takes gigabytes
# Largest radius (95th percentile) of a scan's lumen, m: between that of a single
# cerebral artery and that of an aneurysm of the aorta.
WIDTH = (1.2e-3, 35e-3)
TYPICAL = 7e-3  # m, that radius where two units are possible
_SAMPLES = 3000


def read_triangles(path: str | Path) -> tuple[np.ndarray, np.ndarray]:
    """Triangles of a file as they are.

    Args:
        path: OBJ, STL, PLY or VTP.

    Returns:
        (vertices (V, 3) float64 in the file's unit, faces (F, 3) int64).

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if the format is unknown, the file is empty, damaged, holds no
            triangles or far too many; the message is one line.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(
            f"no mesh file {path}; give the path of the lumen surface (OBJ, STL, PLY "
            "or VTP)."
        )
    kind = path.suffix.lower().lstrip(".")
    if kind not in FORMATS:
        raise ValueError(
            f"{path} has the ending {path.suffix!r}; give a mesh in one of the formats "
            f"{', '.join(FORMATS)}."
        )
    if kind == "vtp" and importlib.util.find_spec("vtkmodules") is None:
        raise ValueError(
            f"{path} needs VTK: pip install 'cathsim-dmc[vtp]', or save it as STL."
        )
    size = path.stat().st_size
    if size == 0:
        raise ValueError(f"{path} is empty (0 bytes); export it again.")
    count = announced(path, kind, size)
    if count > MOST:
        raise ValueError(
            f"{path} has some {count / 1e6:.1f} million triangles ({size / 1e6:.0f} "
            f"MB); at most {MOST / 1e6:g} million are read. Decimate it before export "
            "(3D Slicer: Surface Toolbox, Decimate)."
        )
    try:
        vertices, faces = _parsed(path.read_bytes(), kind)
    except Exception as error:  # readers raise whatever their format leads to
        said = re.sub(r"\s+", " ", str(error)).strip()[:150] or type(error).__name__
        raise ValueError(
            f"{path} cannot be read as {kind.upper()}: {said}. Export it again."
        ) from error
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


def announced(path: Path, kind: str, size: int) -> int:
    """Triangles that a file announces, or the most its size leaves room for."""
    with path.open("rb") as stream:
        head = stream.read(4096)
    text = None
    if kind == "stl":
        binary = not head.lstrip().startswith(b"solid") or b"\0" in head
        if binary and len(head) >= 84:
            return (size - 84) // 50  # whatever the header says
    elif kind == "ply":
        text = re.search(rb"element face (\d+)", head)
    elif kind == "vtp":
        text = re.search(rb'NumberOfPolys="\s*(\d+)', head)
    if text:
        # A header that says less than follows may not hide it.
        return max(int(text[1]), size // 400)
    return size // FORMATS[kind]


def guess_units(
    vertices: np.ndarray, faces: np.ndarray, units: str | None
) -> tuple[str, str]:
    """The unit in which a lumen has a plausible width, and a line that says why.

    Args:
        vertices: (V, 3), in the file's unit.
        faces: (F, 3).
        units: as given by the user, or None to guess.

    Raises:
        ValueError: if none is given and the lumen has no plausible width in any.
    """
    width = typical_radius(vertices, faces)
    fits = [u for u, s in UNITS.items() if WIDTH[0] <= width * s <= WIDTH[1]]
    if units is None:
        if not fits:
            raise ValueError(
                f"the lumen's radius is {width:.3g} units of the file, which no vessel "
                f"has in {', '.join(UNITS)} (allowed {WIDTH[0] * 1e3:g} to "
                f"{WIDTH[1] * 1e3:g} mm); check the unit of the export."
            )
        units = min(fits, key=lambda u: abs(np.log(width * UNITS[u] / TYPICAL)))
        others = [u for u in fits if u != units]
        doubt = f"; {others[0]} is possible too: pass units" if others else ""
        return units, (
            f"unit guessed: {units}, which makes the widest lumen "
            f"{width * UNITS[units] * 2e3:.1f} mm wide{doubt}"
        )
    if units not in fits:
        better = f"pass units={' or '.join(map(repr, fits))}" if fits else "check it"
        return units, (
            f"unit: {units}, as given, which makes the widest lumen "
            f"{width * UNITS[units] * 2e3:.3g} mm wide ({WIDTH[0] * 2e3:g} to "
            f"{WIDTH[1] * 2e3:g} mm are usual); if that is wrong, {better}"
        )
    return units, f"unit: {units}, as given"


def typical_radius(vertices: np.ndarray, faces: np.ndarray) -> float:
    """Radius (file's unit) of the wide part of a tube-like surface.

    The 95th percentile, by area, of the radius of the largest ball that touches the
    surface at a place and holds no other part of it: neither holes nor turned faces
    disturb it (Ma et al., 3D medial axis point approximation, 2012).
    """
    if not areas(vertices, faces).sum() > 0.0:
        raise ValueError("all triangles have no area; give the surface of a lumen.")
    points, normals = sampled(Surface(vertices, faces), _SAMPLES)
    tree = cKDTree(np.concatenate([points, vertices[np.unique(faces)]]))
    size = float(np.linalg.norm(np.ptp(vertices, axis=0)))
    radii = np.minimum(*(_ball(tree, points, s * normals, size) for s in (1.0, -1.0)))
    found = radii[radii < 0.4 * size]
    if len(found) < 0.2 * _SAMPLES:
        raise ValueError(
            "the surface is no tube: hardly any place of it faces another one; give "
            "the surface of a lumen."
        )
    return float(np.percentile(found, 95))


def _ball(
    tree: cKDTree, points: np.ndarray, normals: np.ndarray, size: float
) -> np.ndarray:
    """Radii of the balls that touch at ``points`` on the side of ``normals``."""
    radii = np.full(len(points), size)
    active = np.arange(len(points))
    for _ in range(30):
        centre = points[active] + radii[active, None] * normals[active]
        gap, other = tree.query(centre)
        away = points[active] - tree.data[other]
        square = np.einsum("nd,nd->n", away, away)
        slope = np.einsum("nd,nd->n", normals[active], away)
        with np.errstate(divide="ignore", invalid="ignore"):
            smaller = -0.5 * square / slope
        # Points beside the place itself say nothing: the surface is not smooth.
        steep = slope < -0.35 * np.sqrt(square)
        shrinks = (gap < 0.999 * radii[active]) & steep
        if not shrinks.any():
            break
        active = active[shrinks]
        radii[active] = np.minimum(smaller[shrinks], 0.999 * radii[active])
    return radii


def _parsed(data: bytes, kind: str) -> tuple[np.ndarray, np.ndarray]:
    if kind == "vtp":
        return _read_vtp(data)
    import trimesh

    # From bytes and without a resolver: nothing beside the file is opened.
    options = {"skip_materials": True} if kind == "obj" else {}
    mesh = trimesh.load_mesh(io.BytesIO(data), file_type=kind, process=False, **options)
    if isinstance(mesh, trimesh.Scene):
        mesh = mesh.to_mesh()
    faces = np.asarray(mesh.faces, dtype=np.int64).reshape(-1, 3)
    return np.array(mesh.vertices, dtype=np.float64).reshape(-1, 3), faces


def _read_vtp(data: bytes) -> tuple[np.ndarray, np.ndarray]:
    """Triangles of a VTK PolyData file, by VTK; polygons and strips are divided."""
    modules = ("vtkCommonCore", "vtkFiltersCore", "vtkIOXML", "util.numpy_support")
    core, filters, xml, arrays = (
        importlib.import_module(f"vtkmodules.{name}") for name in modules
    )
    core.vtkObject.GlobalWarningDisplayOff()  # it prints what it cannot read
    reader, triangles = xml.vtkXMLPolyDataReader(), filters.vtkTriangleFilter()
    reader.SetReadFromInputString(True)
    reader.SetInputString(data)
    reader.Update()
    read = reader.GetOutput()
    for cells in (read.GetVerts(), read.GetLines(), read.GetPolys(), read.GetStrips()):
        # VTK does not look, and would read beyond the arrays.
        corners = arrays.vtk_to_numpy(cells.GetConnectivityArray())
        stops = arrays.vtk_to_numpy(cells.GetOffsetsArray())
        beyond = stops[-1:] != len(corners) or np.diff(stops, prepend=0).min() < 0
        if beyond or np.any((corners < 0) | (corners >= read.GetNumberOfPoints())):
            raise ValueError("its cells name points that it does not have")
    if reader.GetErrorCode() or not read.GetNumberOfPoints():
        raise ValueError("it is damaged, or no PolyData")
    triangles.SetInputData(read)
    triangles.PassLinesOff()
    triangles.PassVertsOff()
    triangles.Update()
    found = triangles.GetOutput()
    corners = arrays.vtk_to_numpy(found.GetPolys().GetConnectivityArray())
    points = np.array(
        arrays.vtk_to_numpy(found.GetPoints().GetData()), dtype=np.float64
    )
    return points, corners.astype(np.int64).reshape(-1, 3)
