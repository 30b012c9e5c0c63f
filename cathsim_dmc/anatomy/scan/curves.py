"""Reading the centrelines drawn in a scan."""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cathsim_dmc.anatomy.scan.units import frame_sign, metres_per

INSIDE = 0.7  # share of a centreline's points that must lie in the lumen


@dataclass(frozen=True)
class ScanCentreline:
    """A centreline as given: points (n, 3) m in LPS."""

    name: str
    path: Path
    points: np.ndarray


_FARTHEST = 10.0  # m
LONGEST = 50e6  # bytes of a file with a centreline


def read_curve(
    path: str | Path, units: str = "mm", frame: str = "LPS"
) -> ScanCentreline:
    """Read a centreline from a 3D Slicer markup (.json) or a table (.csv, .txt).

    A table holds x, y, z per line, in ``units`` and ``frame``, and may hold the radius,
    which is not used; a markup says both itself.

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
    size = path.stat().st_size
    if not 0 < size <= LONGEST:
        raise ValueError(
            f"{path} has {size:,} bytes; a centreline has 1 to {LONGEST:,.0f}. Save "
            "the curve again."
        )
    if path.suffix.lower() == ".json":
        points = _read_markup(path)
    elif path.suffix.lower() in (".csv", ".txt", ".tsv"):
        points = _read_table(path) * frame_sign(frame) * metres_per(units)
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
    if np.abs(points).max() > _FARTHEST:
        raise ValueError(
            f"{path} has points {np.abs(points).max():.3g} m from the origin, but no "
            f"scan is {_FARTHEST:g} m wide; is the unit right?"
        )
    return ScanCentreline(vessel_name(path), path, points[keep])


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


def check_inside(
    curve: ScanCentreline, depth: np.ndarray, mirrored: np.ndarray
) -> np.ndarray:
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
        if any(isinstance(number, bool) for place in given for number in place):
            raise TypeError("true and false are no places")
        system = markup.get("coordinateSystem", "LPS")
        units = markup.get("coordinateUnits", "mm")
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise ValueError(
            f"{path} is no 3D Slicer curve ({type(error).__name__}: {error}); expected "
            "markups[0].controlPoints[i].position with three numbers each."
        ) from error
    scale = metres_per(units if isinstance(units, str) else "mm")
    return points * frame_sign(system) * scale


def _read_table(path):
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except ValueError as error:
        raise ValueError(f"{path} is no text in UTF-8: {error}") from error
    rows = [re.findall(r"[^,;\s]+", line) for line in lines]
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
    return table[:, :3]
