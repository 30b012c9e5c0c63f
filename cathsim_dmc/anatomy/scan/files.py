"""Reading a scan: the lumen's mesh and the centrelines drawn in it."""

from __future__ import annotations

import csv
import json
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

UNITS = {"mm": 1e-3, "cm": 1e-2, "m": 1.0}  # metres per unit
# Diagonal of the box around a vessel tree, m: an intracranial segment, a whole aorta
# with arms and legs.
SIZE = (15e-3, 2.5)
MERGE = 1e-6  # of the mesh's size: vertices nearer than this are one
INSIDE = 0.7  # share of a centreline's points that must lie in the lumen
# 3D Slicer wrote numbers before it wrote names.
_SYSTEMS = {"LPS": 1.0, "1": 1.0, "RAS": -1.0, "0": -1.0}


@dataclass(frozen=True)
class Curve:
    """A centreline as given: points (n, 3) m in LPS, radii (n,) m or None."""

    name: str
    path: Path
    points: np.ndarray
    radii: np.ndarray | None


def metres_per(units: str) -> float:
    """Metres per unit of length; ValueError lists the units."""
    try:
        return UNITS[units]
    except KeyError:
        raise ValueError(
            f"units are {units!r}; give one of {', '.join(UNITS)}."
        ) from None


def frame_sign(frame: str) -> np.ndarray:
    """Factors (3,) that take a point of ``frame`` ("LPS" or "RAS") to LPS."""
    try:
        sign = _SYSTEMS[str(frame)]
    except KeyError:
        raise ValueError(
            f"coordinate system is {frame!r}; give 'LPS' or 'RAS'."
        ) from None
    return np.array([sign, sign, 1.0])


def read_mesh(
    path: str | Path, units: str = "mm", frame: str = "LPS"
) -> tuple[np.ndarray, np.ndarray]:
    """Read a closed lumen surface.

    Args:
        path: any format trimesh reads (OBJ, STL, PLY, ...).
        units: of its coordinates, a key of ``UNITS``.
        frame: "LPS" or "RAS".

    Returns:
        (vertices (V, 3) m in LPS, faces (F, 3) with outward normals).

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if the format is unknown, the file is damaged, the surface is not
            closed or has several parts, or its size is not that of vessels.
    """
    import trimesh

    path = Path(path)
    scale, sign = metres_per(units), frame_sign(frame)
    if not path.is_file():
        raise FileNotFoundError(
            f"no mesh file {path}; give the path of the lumen surface (OBJ, STL, PLY)."
        )
    kind = path.suffix.lower().lstrip(".")
    known = sorted(trimesh.exchange.load.mesh_formats())
    if kind not in known:
        raise ValueError(
            f"{path} has the ending {path.suffix!r}; give a mesh in one of the formats "
            f"{', '.join(known)}."
        )
    try:
        mesh = trimesh.load_mesh(path, process=False)
        if isinstance(mesh, trimesh.Scene):
            mesh = mesh.to_mesh()
        vertices = np.asarray(mesh.vertices, dtype=np.float64)
        faces = np.asarray(mesh.faces, dtype=np.int64)
    except Exception as error:  # readers raise whatever their format leads to
        raise ValueError(
            f"{path} cannot be read as {kind.upper()}: {error}. Export it again."
        ) from error
    if len(faces) < 4 or not np.isfinite(vertices).all():
        raise ValueError(
            f"{path} has {len(faces)} triangles and "
            f"{'only finite' if np.isfinite(vertices).all() else 'non-finite'} "
            "coordinates; give a closed triangle mesh."
        )
    vertices, faces = _merged(vertices, faces)
    _check_closed(path, vertices, faces)
    mesh = trimesh.Trimesh(vertices * sign * scale, faces, process=False)
    if not mesh.is_winding_consistent:
        trimesh.repair.fix_winding(mesh)
    vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    a, b, c = (vertices[faces[:, k]] - vertices[0] for k in range(3))
    if np.einsum("nd,nd->", a, np.cross(b, c)) < 0.0:
        faces = faces[:, ::-1]
    size = float(np.linalg.norm(np.ptp(vertices, axis=0)))
    if not SIZE[0] <= size <= SIZE[1]:
        raise ValueError(
            f"{path} is {size:.3g} m across when its unit is {units!r}, which no "
            f"vessel tree is (allowed {SIZE[0]:g} to {SIZE[1]:g} m). "
            f"{_better_unit(size, units)}"
        )
    return vertices, np.ascontiguousarray(faces)


def read_curve(path: str | Path, units: str = "mm", frame: str = "LPS") -> Curve:
    """Read a centreline from a 3D Slicer markup (.json) or a table (.csv, .txt).

    A table holds x, y, z and optionally the radius per line, in ``units`` and
    ``frame``; a markup says both itself.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it holds no centreline.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(
            f"no centreline file {path}; give a 3D Slicer markup (.mrk.json) or a "
            "table x,y,z[,radius] (.csv)."
        )
    if path.suffix.lower() == ".json":
        points, radii = _read_markup(path)
    elif path.suffix.lower() in (".csv", ".txt", ".tsv"):
        points, radii = _read_table(path)
        points = points * frame_sign(frame) * metres_per(units)
        radii = None if radii is None else radii * metres_per(units)
    else:
        raise ValueError(
            f"{path} has the ending {path.suffix!r}; give a 3D Slicer markup "
            "(.mrk.json) or a table x,y,z[,radius] (.csv, .tsv, .txt)."
        )
    apart = np.linalg.norm(np.diff(points, axis=0), axis=1) > 1e-9
    keep = np.concatenate([[True], apart])
    if keep.sum() < 2 or not np.isfinite(points).all():
        raise ValueError(
            f"{path} holds {keep.sum()} distinct points; a centreline needs at least "
            "2, all finite."
        )
    name = vessel_name(path)
    return Curve(name, path, points[keep], None if radii is None else radii[keep])


def vessel_name(path: str | Path) -> str:
    """Name of the vessel in a file: centreline-LCCA.mrk.json is "lcca"."""
    stem = re.sub(r"(\.mrk)?\.[A-Za-z]+$", "", Path(path).name).lower()
    stem = re.sub(r"^cent(er|re)[ _-]?line([ _-]*curve)?[ _-]*", "", stem)
    stem = re.sub(r"[^a-z0-9]+", "_", stem).strip("_")
    if not stem:
        raise ValueError(
            f"no vessel name in {Path(path).name!r}; name the file after its vessel, "
            "e.g. centreline-LCCA.mrk.json."
        )
    return stem


def check_inside(curve: Curve, depth: np.ndarray, mirrored: np.ndarray) -> np.ndarray:
    """Indices of the points of ``curve`` to keep: from the first to the last inside.

    Args:
        curve: as read.
        depth: (n,) m, of its points in the lumen.
        mirrored: (n,) m, of the points with x and y negated.

    Raises:
        ValueError: if less than ``INSIDE`` of the points lie in the lumen.
    """
    share = float((depth > 0.0).mean())
    if share < INSIDE:
        hint = (
            "Draw it in the segment the mesh was made from, and check that both have "
            "the same unit (units=...) and origin"
        )
        if (mirrored > 0.0).mean() >= INSIDE:
            hint = (
                "With x and y negated it lies inside: one of the two is in RAS; pass "
                "mesh_frame='RAS' or correct coordinateSystem in the markup"
            )
        raise ValueError(
            f"{curve.path}: only {share:.0%} of the centreline lies in the lumen "
            f"(at least {INSIDE:.0%} must). {hint}."
        )
    return np.nonzero(depth > 0.0)[0]


def _merged(vertices, faces):
    """One vertex per place, and no triangle without area or twice."""
    size = np.linalg.norm(np.ptp(vertices, axis=0))
    cell = np.rint(vertices / max(size * MERGE, 1e-30)).astype(np.int64)
    _, first, inverse = np.unique(cell, axis=0, return_index=True, return_inverse=True)
    faces = inverse.reshape(-1)[faces]
    a, b, c = faces.T
    faces = faces[(a != b) & (b != c) & (c != a)]
    _, once = np.unique(np.sort(faces, axis=1), axis=0, return_index=True)
    faces = faces[np.sort(once)]
    used, renumbered = np.unique(faces, return_inverse=True)
    return vertices[first][used], renumbered.reshape(-1, 3)


def _check_closed(path, vertices, faces):
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    edges = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    _, times = np.unique(edges, axis=0, return_counts=True)
    border, crowded = int((times == 1).sum()), int((times > 2).sum())
    if border or crowded:
        parts = []
        if border:
            parts.append(f"{border} boundary edges (holes)")
        if crowded:
            parts.append(f"{crowded} edges shared by more than two triangles")
        raise ValueError(
            f"{path} is not closed: after merging equal vertices it has "
            f"{' and '.join(parts)}. Close the vessel ends and fill holes (3D Slicer: "
            "Surface Toolbox, Fill holes; Meshmixer: Inspector), then export again."
        )
    n = len(vertices)
    link = coo_matrix((np.ones(len(edges)), edges.T), shape=(n, n))
    count, label = connected_components(link, directed=False)
    if count > 1:
        sizes = np.sort(np.bincount(label[faces[:, 0]], minlength=count))[::-1]
        shown = ", ".join(str(size) for size in sizes[:6])
        raise ValueError(
            f"{path} has {count} separate parts (of {shown} triangles); one connected "
            "lumen is needed. Keep the largest island (3D Slicer: Segment Editor, "
            "Islands) and export again."
        )


def _better_unit(size, units):
    raw = size / UNITS[units]
    fits = [u for u, s in UNITS.items() if SIZE[0] <= raw * s <= SIZE[1]]
    if fits:
        return f"Pass units={' or '.join(repr(u) for u in fits)}."
    return "Check the unit in which the mesh was exported."


def _read_markup(path):
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise ValueError(
            f"{path} is not JSON: {error}. Save the curve again in 3D Slicer as "
            ".mrk.json."
        ) from error
    try:
        markup = max(content["markups"], key=lambda m: len(m["controlPoints"]))
        given = [p["position"] for p in markup["controlPoints"]]
        points = np.asarray(given, dtype=np.float64).reshape(-1, 3)
        system = markup.get("coordinateSystem", "LPS")
        units = markup.get("coordinateUnits", "mm")
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise ValueError(
            f"{path} is no 3D Slicer curve ({type(error).__name__}: {error}); expected "
            "markups[0].controlPoints[i].position with three numbers each."
        ) from error
    scale = metres_per(units if isinstance(units, str) else "mm")
    points = points * frame_sign(system) * scale
    radii = None
    for entry in markup.get("measurements") or []:
        values = entry.get("controlPointValues")
        if entry.get("name") == "Radius" and values is not None:
            values = np.asarray(values, dtype=np.float64).reshape(-1)
            if len(values) == len(points):
                radii = values * scale
    return points, radii


def _read_table(path):
    text = path.read_text(encoding="utf-8-sig")
    try:
        dialect = csv.Sniffer().sniff(text[:2000], delimiters=",;\t ")
        rows = list(csv.reader(text.splitlines(), dialect, skipinitialspace=True))
    except csv.Error:
        rows = [line.split(",") for line in text.splitlines()]
    rows = [[cell for cell in row if cell.strip()] for row in rows]
    rows = [row for row in rows if row]
    try:
        [float(cell) for cell in rows[0]]
    except (ValueError, IndexError):
        rows = rows[1:]  # a line of headings
    try:
        table = np.array([[float(cell) for cell in row] for row in rows])
    except ValueError as error:
        raise ValueError(
            f"{path} is no table of numbers ({error}); give x,y,z[,radius] per line."
        ) from error
    if table.ndim != 2 or table.shape[1] not in (3, 4):
        raise ValueError(
            f"{path} has a table of shape {table.shape}; give x,y,z[,radius] per line."
        )
    return table[:, :3], (table[:, 3] if table.shape[1] == 4 else None)
