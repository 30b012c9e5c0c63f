"""Lumen surface of an import: read, scaled, turned and mended."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import cKDTree

from cathsim_dmc import bounds
from cathsim_dmc.anatomy.parts import Surface
from cathsim_dmc.anatomy.scan import labels as label_maps
from cathsim_dmc.anatomy.scan import mesh
from cathsim_dmc.anatomy.scan.repair import mend
from cathsim_dmc.anatomy.scan.topology import areas, merged, neighbour_means
from cathsim_dmc.anatomy.scan.units import UNITS, file_frame, to_lps, upright
from cathsim_dmc.anatomy.surface import sampled

SIZE = (12e-3, 2.0)  # m across: an intracranial segment, an aorta with arms and legs
WIDTH = (1.0e-3, 35e-3)  # m, 95th percentile of radii: cerebral artery, aneurysm
NO_WIDTH = (0.5e-3, 50e-3)  # m: outside this range a given unit is refused
VOLUME = 2e-3  # m^3, largest lumen that is searched, at 10^9 points per m^3
RARE = {"inch": 0.035}  # rare units of scans, and their relative frequency
POOR = 1e-3  # likelihood below which even the only likely unit is asked for
# Usual scans, to tell units apart: radius as in WIDTH and size, m, deviations of their
# logarithms, and relative frequency.
SCANS = {
    "cerebral arteries": ((1.8e-3, 45e-3), (0.35, 0.6), 1.0),
    "coronary arteries": ((1.8e-3, 90e-3), (0.25, 0.3), 1.0),
    "carotid, limb or access": ((3.5e-3, 120e-3), (0.35, 0.5), 1.0),
    "a child's arch": ((6e-3, 110e-3), (0.35, 0.4), 1.0),
    "arch or pulmonary arteries": ((12e-3, 200e-3), (0.25, 0.35), 1.0),
    "abdominal aorta and iliacs": ((9.5e-3, 260e-3), (0.3, 0.35), 1.0),
    "whole aorta": ((12e-3, 550e-3), (0.2, 0.25), 1.0),
    "arteries of the whole body": ((12e-3, 1.4), (0.15, 0.12), 0.1),
    "aneurysm of the aorta": ((22e-3, 260e-3), (0.35, 0.4), 0.4),
    "a mouse's aorta": ((0.8e-3, 25e-3), (0.25, 0.35), 0.015),
}
# Radii, m: least of a lumen that is imported at its size, and to which narrower ones
# are enlarged, so that the lengths of the import suit them as an adult's aorta.
WIDE, ENLARGED = 8e-3, 12e-3
MOST = 4e-4  # m^3, largest volume after enlargement, which limits the time
SURE = 0.95  # probability above which a unit need not be given
UNLIKELY = 0.003  # probability below which a unit is not named as an alternative
_SAMPLES = 1000
_VERTICES = 20_000  # of the surface used beside those samples, about, at most
_WIDEST = 0.2  # of the size: initial and largest radius of a ball
_AROUND = 0.2  # least mean square of wall directions on their second main axis
_SMOOTH = 1500  # triangles for each smoothing pass
_MOST = 100  # smoothing passes, at most


class Lumen(NamedTuple):
    """A closed surface (m, LPS), its file's unit, and notes on guesses and repairs.

    `scale` is the factor by which the import enlarges it, `frame` that of the file,
    "LPS" or "RAS".
    """

    surface: Surface
    units: str
    notes: tuple[str, ...]
    scale: float
    frame: str


def read_lumen(
    path: str | Path,
    units: str | None = None,
    frame: str | None = None,
    axes: str | ArrayLike | None = None,
    labels: Sequence[int] = (),
    say: Callable[[str], None] = lambda text: None,
) -> Lumen:
    """Read the surface of a lumen and mend it; arguments as of `importer.import_scan`.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if the file holds no such surface; says how to mend it.
    """
    # Checks the options before the file is read.
    to_lps("mm" if units is None else units, "LPS" if frame is None else frame, axes)
    labels = bounds.array("labels", labels, "iu", shape=(-1,)).tolist()
    given, labelled = units, str(path).lower().endswith(mesh.LABEL_MAPS)
    if labelled:
        vertices, faces, notes, units = label_maps.label_surface(path, labels, units)
        frame, vertices = frame or "LPS", vertices @ upright(axes).T
        radius = typical_radius(vertices, faces)
        if radius < WIDTH[0] or radius > WIDTH[1]:
            doubt = (
                f"question: the widest lumen is {2e3 * radius:.3g} mm wide when the "
                f"unit is {units!r}: is it another one (--units)?"
            )
            notes = (*notes, doubt)
    else:
        if len(labels):
            raise ValueError(
                f"label is for label maps (NIfTI, NRRD, MHA); {path} is a surface."
            )
        vertices, faces = mesh.read_triangles(path)
        say(f"mesh: {len(faces):,} triangles read")
        frame, said = _frame(path, frame)
        units, why, radius = guess_units(str(path), vertices, faces, units)
        notes = (why, *said)
        vertices = vertices @ to_lps(units, frame, axes).T
    for note in notes:
        say(f"note: {note}")
    size = float(np.linalg.norm(np.ptp(vertices, axis=0)))
    if not SIZE[0] <= size <= SIZE[1]:
        raise ValueError(
            f"{path} is {size:.3g} m across when its unit is {units!r}, which no "
            f"vessel tree is (allowed {SIZE[0]:g} to {SIZE[1]:g} m){_else(size, units)}"
            f". Check the unit in which it was exported ({notes[0]})."
        )
    scale = enlargement(radius, Surface(vertices - vertices.mean(axis=0), faces).volume)
    with file_frame(to_lps(units, frame, axes), units, scale):
        surface, changed, walled = mend(str(path), scale * vertices, faces)
    if scale != 1.0:
        surface = Surface(surface.vertices / scale, surface.faces)
    if walled and not labelled:
        # The first radius includes the space between the two surfaces of the wall.
        why, radius = _in_wall(str(path), surface, units, given)
        say(f"note: {why}")
        notes = (why, *notes[1:])
        scale = enlargement(radius, surface.volume)
    if surface.volume > VOLUME:
        raise ValueError(
            f"{path} holds {surface.volume * 1e3:.3g} litres when its unit is "
            f"{units!r}, which no lumen does (at most {VOLUME * 1e3:g}). Check the "
            f"unit in which the mesh was exported ({notes[0]})."
        )
    return Lumen(surface, units, (*notes, *changed), scale, frame)


def _in_wall(
    name: str, surface: Surface, units: str, given: str | None
) -> tuple[str, float]:
    """A line on the unit, and the radius (m), of the inner surface of a thick wall.

    ValueError if the likely unit of the lumen is not that of the wall.
    """
    vertices = surface.vertices / UNITS[units]
    likely, why, radius = guess_units(name, vertices, surface.faces, given)
    if likely != units:
        raise ValueError(
            f"{name} may be in several units: {units!r} by its thick wall, {likely!r} "
            f"by its lumen ({why}); pass units={units!r} or {likely!r} (--units)."
        )
    return f"{why}, measured inside its thick wall", radius


def _else(size: float, units: str) -> str:
    """Hint on the units in which an implausible size, m, of `units` is plausible."""
    sizes = {unit: size / UNITS[units] * factor for unit, factor in UNITS.items()}
    fits = [
        f"{size:.3g} m across when it is {unit!r} (--units {unit})"
        for unit, size in sizes.items()
        if SIZE[0] <= size <= SIZE[1] and unit not in RARE
    ]
    return f"; it is {' or '.join(fits)}" if fits else ""


def _frame(path: str | Path, given: str | None) -> tuple[str, list[str]]:
    """Frame of a surface, "LPS" or "RAS", and a note if its file says which.

    ValueError if another one is given.
    """
    said = mesh.stated_frame(path)
    if said is None:
        return given or "LPS", []
    if given not in (None, said):
        raise ValueError(
            f"frame is {given!r}, but the header of {path} says SPACE={said}; leave "
            f"the frame out or give {said!r} (--frame {said})."
        )
    return said, [f"frame: {said}, as the file says"]


def enlargement(radius: float, volume: float) -> float:
    """Enlargement, >= 1, of a lumen with a radius (m) and a volume (m^3)."""
    if not radius < WIDE:
        return 1.0
    most = (MOST / max(abs(volume), 1e-12)) ** (1 / 3)
    return float(max(1.0, min(ENLARGED / radius, most)))


def guess_units(
    name: str, vertices: np.ndarray, faces: np.ndarray, units: str | None
) -> tuple[str, str, float]:
    """Unit, given or guessed, a line on the reason, and radius of the wide part, m.

    The guessed unit makes width and size those of a usual scan, see `SCANS`.
    ValueError if the width is implausible in the unit, or two units are likely.
    """
    found = typical_radius(vertices, faces), np.linalg.norm(np.ptp(vertices, axis=0))
    scaled = {unit: scale * np.array(found) for unit, scale in UNITS.items()}
    usual = [unit for unit, x in scaled.items() if _within(x, WIDTH)]
    odds = {
        unit: RARE.get(unit, 1.0) * _likelihood(x)
        for unit, x in scaled.items()
        if _within(x, NO_WIDTH)
    }
    makes = {
        unit: f"the widest lumen {2e3 * radius:.3g} mm wide and the scan "
        f"{1e3 * size:.4g} mm across"
        for unit, (radius, size) in scaled.items()
    }
    likely = _likely(odds)
    fits = [unit for unit in usual if unit in likely] or usual or likely
    better = (
        f"pass units={' or '.join(map(repr, fits))} (--units)"
        if fits
        else "check the export"
    )
    if np.isnan(found[0]):
        raise ValueError(f"{name} is no tube: too few walls face others; {better}.")
    if units in usual:
        return units, f"unit: {units}, as given", float(scaled[units][0])
    if units is not None:
        why = (
            f"unit: {units}, as given, which makes {makes[units]} (lumens "
            f"{WIDTH[0] * 2e3:g} to {WIDTH[1] * 2e3:g} mm wide are usual); if that is "
            f"wrong, {better}"
        )
        if not NO_WIDTH[0] <= scaled[units][0] <= NO_WIDTH[1]:
            raise ValueError(f"{name}: {why}.")
        return units, why, float(scaled[units][0])
    best, said = _likeliest(name, odds, makes)
    return best, said, float(scaled[best][0])


def _likeliest(
    name: str, odds: Mapping[str, float], makes: Mapping[str, str]
) -> tuple[str, str]:
    """The likeliest unit, and a line that says so; ValueError if none is sure.

    `odds` are relative, `makes` says what each unit makes of the scan.
    """
    if not odds:
        listed = "; ".join(f"{unit} makes {text}" for unit, text in makes.items())
        raise ValueError(
            f"{name} has the size of a vessel tree in no unit: {listed}. The widest "
            f"lumen must be {2e3 * NO_WIDTH[0]:g} to {2e3 * NO_WIDTH[1]:g} mm wide and "
            f"the scan {1e3 * SIZE[0]:g} mm to {SIZE[1]:g} m across: scale it."
        )
    total = max(sum(odds.values()), 1e-30)
    likely = _likely(odds)
    best = max(odds, key=odds.__getitem__)
    sure = odds[best] / total
    listed = "; ".join(f"{unit} makes {makes[unit]}" for unit in likely)
    ask = " or ".join(map(repr, likely))
    if odds[best] < POOR or best in RARE:
        raise ValueError(
            f"{name} fits no usual scan in a usual unit: {listed}; if that is right, "
            f"pass units={ask} (--units)."
        )
    if sure < SURE:
        raise ValueError(
            f"{name} may be in several units: {listed}; pass units={ask} (--units)."
        )
    said = f"unit guessed: {best}, which makes {makes[best]}"
    others = " or ".join(repr(unit) for unit in likely if unit != best)
    doubt = (
        f" ({sure:.0%} sure; else pass units={others}, --units)" if sure < 0.995 else ""
    )
    return best, said + doubt


def _likely(odds: Mapping[str, float]) -> list[str]:
    """Units that are not unlikely, of those with relative odds."""
    total = max(sum(odds.values()), 1e-30)
    return [unit for unit in odds if odds[unit] > UNLIKELY * total]


def _within(seen: np.ndarray, width: tuple[float, float]) -> bool:
    """Whether a radius and a size (2,) m are plausible; `width` limits the radius."""
    return width[0] <= seen[0] <= width[1] and SIZE[0] <= seen[1] <= SIZE[1]


def _likelihood(seen: np.ndarray) -> float:
    """Density of the logarithms of a radius and a size (2,) m among `SCANS`."""
    total = 0.0
    for typical, spread, share in SCANS.values():
        off = np.log(seen / typical) / spread
        total += share * float(np.exp(-0.5 * (off**2).sum())) / np.prod(spread)
    return float(total)


def typical_radius(vertices: np.ndarray, faces: np.ndarray) -> float:
    """Radius (file's unit) of the wide part of a tube-like surface, or nan.

    The 95th percentile, by area, of the largest ball that touches the smoothed surface
    at a place and holds no other part of it (Ma et al., 2012).
    """
    if not areas(vertices, faces).sum() > 0.0:
        return float("nan")
    vertices, faces = _smoothed(vertices, faces)
    points, normals = sampled(Surface(vertices, faces), _SAMPLES)
    some = vertices[:: 1 + len(vertices) // _VERTICES]
    tree = cKDTree(np.concatenate([points, some]))
    most = _WIDEST * float(np.linalg.norm(np.ptp(vertices, axis=0)))
    sides = np.concatenate([normals, -normals])
    points = np.concatenate([points, points])
    radii = _ball(tree, points, sides, most)
    around = tree.query_ball_point(points + radii[:, None] * sides, 1.25 * radii)
    points += radii[:, None] * sides
    enclosed = [
        radius < most and _enclosed(tree.data[near] - middle)
        for radius, middle, near in zip(radii, points, around, strict=True)
    ]
    radii = np.where(enclosed, radii, most).reshape(2, -1).min(axis=0)
    found = radii[radii < most]
    enough = len(found) >= 0.2 * _SAMPLES  # else few points face another wall
    return float(np.percentile(found, 95)) if enough else float("nan")


def _enclosed(away: np.ndarray) -> bool:
    """Whether points (n, 3) surround their origin, as in a tube and not in its wall."""
    away = away / np.linalg.norm(away, axis=1, keepdims=True)
    return np.linalg.eigvalsh(away.T @ away)[1] > _AROUND * len(away)


def _smoothed(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Smooths noise, which would shrink balls; a finer mesh takes more passes."""
    vertices, faces = merged(vertices, faces)
    beside = neighbour_means(faces)
    for _ in range(min(len(faces) // _SMOOTH, _MOST)):
        vertices = 0.5 * (vertices + beside @ vertices)
    return vertices, faces


def _ball(
    tree: cKDTree, points: np.ndarray, normals: np.ndarray, size: float
) -> np.ndarray:
    """Radii (n,) of the balls that touch at ``points`` on the side of ``normals``."""
    radii = np.full(len(points), size)
    active = np.arange(len(points))
    for _ in range(30):
        centre = points[active] + radii[active, None] * normals[active]
        gap, other = tree.query(centre)
        away = points[active] - tree.data[other]
        square = np.vecdot(away, away)
        slope = np.vecdot(normals[active], away)
        # Points next to the place itself do not count: the surface is not smooth.
        steep = slope < -0.35 * np.sqrt(square)
        shrinks = (gap < 0.999 * radii[active]) & steep
        if not shrinks.any():
            break
        active = active[shrinks]
        smaller = -0.5 * square[shrinks] / slope[shrinks]
        radii[active] = np.minimum(smaller, 0.999 * radii[active])
    return radii
