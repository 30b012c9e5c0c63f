"""A lumen as an import uses it: read, scaled, turned and mended."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import cKDTree

from cathsim_dmc.anatomy.parts import Surface
from cathsim_dmc.anatomy.scan import mesh
from cathsim_dmc.anatomy.scan.repair import mend
from cathsim_dmc.anatomy.scan.topology import areas
from cathsim_dmc.anatomy.scan.units import UNITS, to_lps, upright
from cathsim_dmc.anatomy.surface import sampled

SIZE = (15e-3, 2.5)  # m across: an intracranial segment, an aorta with arms and legs
WIDTH = (1.2e-3, 35e-3)  # m, 95th percentile of radii: cerebral artery, aneurysm
TYPICAL = 7e-3  # m, that radius where two units are possible
_SAMPLES = 1000


class Lumen(NamedTuple):
    """A closed surface (m, LPS), its file's unit, and what was guessed and mended."""

    surface: Surface
    units: str
    notes: tuple[str, ...]


def read_lumen(
    path: str | Path,
    units: str | None = None,
    frame: str = "LPS",
    axes: str | ArrayLike | None = None,
    labels: Sequence[int] = (),
    say: Callable[[str], None] = lambda text: None,
) -> Lumen:
    """Read the surface of a lumen and mend it; arguments as of `importer.import_scan`.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is no such surface; says how to mend it.
    """
    to_lps("mm" if units is None else units, frame, axes)  # before anything is read
    if str(path).lower().endswith(mesh.LABEL_MAPS):
        vertices, faces, why = mesh.label_surface(path, labels)
        units, vertices = "mm", vertices @ upright(axes).T
    else:
        if len(labels):
            raise ValueError(
                f"label is for label maps (NIfTI, NRRD); {path} is a surface."
            )
        vertices, faces = mesh.read_triangles(path)
        say(f"mesh: {len(faces):,} triangles read")
        units, why = guess_units(str(path), vertices, faces, units)
        vertices = vertices @ to_lps(units, frame, axes).T
    size = float(np.linalg.norm(np.ptp(vertices, axis=0)))
    if not SIZE[0] <= size <= SIZE[1]:
        raise ValueError(
            f"{path} is {size:.3g} m across when its unit is {units!r}, which no "
            f"vessel tree is (allowed {SIZE[0]:g} to {SIZE[1]:g} m). Check the unit in "
            f"which the mesh was exported ({why})."
        )
    surface, changed = mend(str(path), vertices, faces)
    return Lumen(surface, units, (why, *changed))


def guess_units(
    name: str, vertices: np.ndarray, faces: np.ndarray, units: str | None
) -> tuple[str, str]:
    """The unit given, or in which a lumen has a plausible width, and a line on why."""
    width = typical_radius(vertices, faces)
    fits = [u for u, s in UNITS.items() if WIDTH[0] <= width * s <= WIDTH[1]]
    if not fits and (units is None or np.isnan(width)):
        raise ValueError(
            f"{name}: the lumen's radius is {width:.3g} units of the file, which no "
            f"vessel has in {', '.join(UNITS)} (allowed {WIDTH[0] * 1e3:g} to "
            f"{WIDTH[1] * 1e3:g} mm; nan: it is no tube); check the export."
        )
    best = units or min(fits, key=lambda u: abs(np.log(width * UNITS[u] / TYPICAL)))
    wide = width * UNITS[best] * 2e3
    if units in fits:
        return best, f"unit: {best}, as given"
    if units is None:
        others = [u for u in fits if u != best]
        doubt = f"; {others[0]} is possible too: pass units" if others else ""
        said = f"unit guessed: {best}, which makes the widest lumen {wide:.1f} mm wide"
        return best, said + doubt
    better = f"pass units={' or '.join(map(repr, fits))}" if fits else "check it"
    return best, (
        f"unit: {best}, as given, which makes the widest lumen {wide:.3g} mm wide "
        f"({WIDTH[0] * 2e3:g} to {WIDTH[1] * 2e3:g} mm are usual); if that is wrong, "
        + better
    )


def typical_radius(vertices: np.ndarray, faces: np.ndarray) -> float:
    """Radius (file's unit) of the wide part of a tube-like surface, or nan.

    The 95th percentile, by area, of the largest ball that touches the surface at a
    place and holds no other part of it (Ma et al., 2012).
    """
    if not areas(vertices, faces).sum() > 0.0:
        return float("nan")
    points, normals = sampled(Surface(vertices, faces), _SAMPLES)
    tree = cKDTree(np.concatenate([points, vertices[np.unique(faces)]]))
    size = float(np.linalg.norm(np.ptp(vertices, axis=0)))
    radii = np.minimum(*(_ball(tree, points, s * normals, size) for s in (1.0, -1.0)))
    found = radii[radii < 0.4 * size]
    enough = len(found) >= 0.2 * _SAMPLES  # else hardly any place faces another one
    return float(np.percentile(found, 95)) if enough else float("nan")


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
        square = np.vecdot(away, away)
        slope = np.vecdot(normals[active], away)
        # Points beside the place itself say nothing: the surface is not smooth.
        steep = slope < -0.35 * np.sqrt(square)
        shrinks = (gap < 0.999 * radii[active]) & steep
        if not shrinks.any():
            break
        active = active[shrinks]
        smaller = -0.5 * square[shrinks] / slope[shrinks]
        radii[active] = np.minimum(smaller, 0.999 * radii[active])
    return radii
