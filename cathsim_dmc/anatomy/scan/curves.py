"""Reading the centrelines drawn in a scan."""

import json
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from cathsim_dmc import bounds
from cathsim_dmc.anatomy.centreline import distinct
from cathsim_dmc.anatomy.scan import vtk_files
from cathsim_dmc.anatomy.scan.mesh import parsed
from cathsim_dmc.anatomy.scan.naming import ROOT, TRUNK
from cathsim_dmc.anatomy.scan.units import to_lps, upright
from cathsim_dmc.anatomy.surface_depth import SurfaceDepth

_FRAMES = {"1": "LPS", "0": "RAS"}  # of older versions of 3D Slicer
INSIDE = 0.7  # share of a centreline's points that must lie in the lumen


def read_curves(
    paths: Sequence[str | Path], units: str, frame: str, axes: str | ArrayLike | None
) -> dict[str, np.ndarray]:
    """Points (n, 3) m, LPS, of drawn centrelines, by the names of their vessels.

    `read_file` reads the files; several lines of one file are numbered. `axes` are
    those of `units.upright`. ValueError if a file holds no centreline, or if a name
    occurs twice or is that of a root.
    """
    listed = isinstance(paths, Sequence) and not isinstance(paths, str | bytes)
    if not listed or not all(isinstance(path, str | Path) for path in paths):
        raise ValueError(
            f"centreline_paths is {paths!r}; give a list of files, one per branch (3D "
            "Slicer .mrk.json or .csv), or none to have them computed."
        )
    curves: dict[str, np.ndarray] = {}
    for path in paths:
        found = read_file(path, units, frame)
        stem = vessel_name(path)
        if not stem:
            raise ValueError(
                f"{path} is not called after a vessel; rename the file, in the letters "
                "a to z and digits, such as centreline-lcca.mrk.json."
            )
        for number, points in enumerate(found, 1):
            name = stem if len(found) == 1 else f"{stem}_{number}"
            if name in curves or name in (ROOT, TRUNK):
                raise ValueError(
                    f"{path} gives the vessel name {name!r}, which is taken (names: "
                    f"{', '.join([ROOT, TRUNK, *curves])}); rename the file."
                )
            curves[name] = points @ upright(axes).T
    return curves


def read_file(path: str | Path, units: str, frame: str) -> list[np.ndarray]:
    """Centrelines (n_i, 3) m, LPS, of a file: all lines of a VTK file, else one."""
    path = Path(path)
    if path.suffix.lower() not in (".vtp", ".vtk"):
        return [read_curve(path, units, frame)]
    if not path.is_file():
        raise FileNotFoundError(f"no centreline file {path}; give VMTK's centrelines.")
    found = parsed(path, path.suffix[1:].lower(), vtk_files.lines, "vtp")
    if not found:
        raise ValueError(f"{path} holds no lines; give centrelines, as VMTK's.")
    matrix = to_lps(units, frame)
    return [_distinct(path, points @ matrix.T) for points in found]


def read_curve(path: str | Path, units: str = "mm", frame: str = "LPS") -> np.ndarray:
    """Points (n, 3) m, LPS, of a 3D Slicer markup (.json) or a table (.csv, .txt).

    A table holds x, y, z per line, in ``units`` and ``frame``, and may hold the radius,
    which is ignored. FileNotFoundError without a file, ValueError without a curve.
    """
    path = Path(path)
    kind = path.suffix.lower()
    what = (
        "3D Slicer markup (.mrk.json), a table x,y,z[,radius] (.csv, .tsv, .txt) or "
        "VMTK's centrelines (.vtp)"
    )
    if not path.is_file():
        raise FileNotFoundError(f"no centreline file {path}; give a {what}.")
    if kind not in (".json", ".csv", ".txt", ".tsv"):
        raise ValueError(f"{path} has the ending {path.suffix!r}; give a {what}.")
    try:
        text = path.read_text(encoding="utf-8-sig")
        points = _markup(text) if kind == ".json" else _table(text, units, frame)
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise ValueError(
            f"{path} is no {what} ({type(error).__name__}: {error}). Save the curve "
            "again."
        ) from error
    return _distinct(path, points)


def _distinct(path: Path, points: np.ndarray) -> np.ndarray:
    """Points (n, 3) without consecutive repetitions; ValueError if no curve is left."""
    kept = distinct(points)
    if len(kept) < 2 or not np.isfinite(points).all():
        raise ValueError(
            f"{path} holds {len(kept)} distinct points; a centreline needs at least "
            "2, all finite."
        )
    return kept


def vessel_name(path: str | Path) -> str:
    """Name of the vessel in a file: centreline-LCCA.mrk.json is "lcca"."""
    stem = re.sub(r"(\.mrk)?\.[A-Za-z]+$", "", Path(path).name).lower()
    stem = re.sub(r"^cent(er|re)[ _-]?line([ _-]*curve)?[ _-]*", "", stem)
    return re.sub(r"[^a-z0-9]+", "_", stem).strip("_")


def inside_part(name: str, curve: np.ndarray, measure: SurfaceDepth) -> np.ndarray:
    """Points (k, 3) m of a curve (n, 3) m, LPS, inside the lumen, wider end first."""
    depth = measure(curve)
    inside = depth > 0.0
    if inside.mean() < INSIDE:
        hint = (
            "Draw it in the segment the mesh was made from, and check that both have "
            "the same unit (units=...) and origin"
        )
        if (measure(curve * (-1.0, -1.0, 1.0)) > 0.0).mean() >= INSIDE:
            hint = (
                "With x and y negated it lies inside: one of the two is in RAS; pass "
                "mesh_frame='RAS' (--frame RAS) or correct coordinateSystem in the "
                "markup"
            )
        raise ValueError(
            f"only {inside.mean():.0%} of the centreline lies in the lumen (at least "
            f"{INSIDE:.0%} of {name!r} must). {hint}."
        )
    curve, depth = curve[inside], depth[inside]
    part = max(1, len(curve) // 8)
    turned = depth[-part:].max() > 1.1 * depth[:part].max()
    return curve[::-1] if turned else curve


def _markup(text: str) -> np.ndarray:
    markup = max(json.loads(text)["markups"], key=lambda m: len(m["controlPoints"]))
    placed = [
        point["position"]
        for point in markup["controlPoints"]
        if point.get("positionStatus", "defined") == "defined"
    ]
    points = np.array(placed, dtype=float).reshape(-1, 3)
    units = markup.get("coordinateUnits", "mm")
    system = str(markup.get("coordinateSystem", "LPS"))
    frame = _FRAMES.get(system, system)
    return points @ to_lps(units if isinstance(units, str) else "mm", frame).T


def _table(text: str, units: str, frame: str) -> np.ndarray:
    lines = [line.strip().lstrip("#").strip() for line in text.splitlines()]
    lines = [line for line in lines if line]
    names = lines.pop(0) if lines and re.match("[\"'A-Za-z]", lines[0]) else ""
    table = _numbers(lines)
    columns, frame = _columns(names, table.shape[1], frame)
    return table[:, columns] @ to_lps(units, frame).T


def _numbers(lines: list[str]) -> np.ndarray:
    """Table (n, k) of lines of numbers; with ";" or tabs, commas may be decimal."""
    text = "\n".join(lines)
    if re.search(r"[;\t]", text) and "." not in text:
        lines = [re.sub(r"(?<=\d),(?=\d)", ".", line) for line in lines]
    rows = [re.findall(r"[^,;\s\"]+", line) for line in lines]
    counts = {len(row) for row in rows}
    if len(counts) != 1:
        raise ValueError(
            f"its lines have {' or '.join(map(str, sorted(counts)))} columns"
            if counts
            else "it holds no numbers"
        )
    return np.array(rows, dtype=float)


# Headings of columns, {} for an axis: "X (mm)", ParaView's "Points:0".
_HEADINGS = {
    "xyz": r"(.*[^a-z]|p)?{}([^a-z].*)?",
    "012": r"(.*[^a-z])?(points|coordinates)[^a-z0-9]*{}",
    "ras": "{}",
    "lps": "{}",
}


def _columns(names: str, count: int, frame: str) -> tuple[list[int], str]:
    """Indices of the columns x, y and z among `count`, and their frame.

    The headings, if any, name the columns; R, A, S or L, P, S also give the frame.
    """
    if not names:
        if count not in (3, 4):
            raise ValueError(
                f"{count} columns without headings; give x,y,z[,radius] or a first "
                "line that names them, and ';' between decimal commas"
            )
        return [0, 1, 2], frame
    mark = next((mark for mark in ";\t," if mark in names), None)
    heads = [head.strip(" \"'").lower() for head in names.split(mark)]
    for axes, form in _HEADINGS.items():
        found = [
            [k for k, head in enumerate(heads) if re.fullmatch(form.format(one), head)]
            for one in axes
        ]
        if len(heads) == count and all(len(columns) == 1 for columns in found):
            own = axes.upper() if axes in ("ras", "lps") else frame
            return [k for (k,) in found], own
    if count == 3 or (count == 4 and heads[-1].startswith("r")):
        return [0, 1, 2], frame
    raise ValueError(
        f"of {count} columns, {bounds.shown(', '.join(heads))}, none are called x, y "
        "and z; name three of them so"
    )
