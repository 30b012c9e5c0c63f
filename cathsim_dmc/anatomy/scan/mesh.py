"""Reading a lumen's triangles from a mesh file."""

import io
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from cathsim_dmc import extras
from cathsim_dmc.anatomy.scan import vtk_files

# Endings, and the least bytes that a triangle takes where no header counts them.
FORMATS = {"obj": 35, "stl": 50, "ply": 12, "vtp": 12, "vtk": 12}
_STL_TEXT = 100  # seven lines
MOST = 4_000_000  # triangles; reading more takes gigabytes


def parsed(path: Path, kind: str, read: Callable[[Path], Any], extra: str) -> Any:
    """What a function reads from a file; errors say what to do, in one line."""
    if not path.is_file():
        raise FileNotFoundError(
            f"no mesh file {path}; give a lumen's surface (STL, OBJ, PLY, VTP or VTK), "
            "or a label map (NIfTI, NRRD, MHA)."
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
    count = parsed(path, kind, _announced, "")
    if count > MOST:
        raise ValueError(
            f"{path} has some {count / 1e6:.1f} million triangles; at most "
            f"{MOST / 1e6:g} million are read. Decimate it before export (3D Slicer: "
            "Surface Toolbox, Decimate)."
        )
    read = vtk_files.triangles if kind in ("vtp", "vtk") else _read_mesh
    vertices, faces = parsed(path, kind, read, "vtp")
    if len(faces) < 4:
        raise ValueError(
            f"{path} has {len(faces)} triangles; give a triangle mesh of the lumen "
            "(points and volumes are none, and lines are centrelines: --centreline)."
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
