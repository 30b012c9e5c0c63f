"""Motion of an anatomy with heart and breathing, as displacements of space.

A point x in space corresponds to the point X = x - u(x, t) of the anatomy at rest, with
u = a(t) H(x) + b(t) B(x); the radius grows by g(x) p(t - s/c): docs/vessel_model.md.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import softmax

from cathsim_dmc.anatomy.centreline import Array, VesselTree, as_rows, interpolate
from cathsim_dmc.anatomy.circulation import Circulation
from cathsim_dmc.anatomy.parts import End, Surface
from cathsim_dmc.laws.motion import (
    VALUES,
    WARP,
    Course,
    MotionParameters,
    course_at,
    to_rest,
    to_space,
)

_STEP = 6e-3  # m, of the lattice
_SMOOTH = 25e-3  # m, standard deviation of the Gaussian average over segments
_ACROSS = 2e-3  # m, over which the radius changes from vessel to vessel
_FADE = 60e-3  # m from an open end, over which displacements rise from zero
_HEART_REACH = 50e-3  # m along the aorta, over which the heart's motion fades
_HEART_WAY = np.array([0.3, -0.3, -0.9]) / np.sqrt(0.99)  # unit vector, LPS
# Breathing: amplitudes of ascending aorta, BCA, LSA and descending aorta, m (Sailer
# 2015), and +1 where medial is to the left.
_BREATHING = np.array([8.9e-3, 12.0e-3, 11.1e-3, 4.9e-3])
_MEDIAL = np.array([1.0, 1.0, -1.0, -1.0])
_INSPIRATION = (0.33, -0.47, -0.82)  # medial, posterior, superior
PULSE_PRESSURE = 5.33  # kPa, 40 mmHg
# Length of the parameters of a motion in a recording. Entries 1 to 8 are
# `laws.motion.MotionParameters`; the others are unused.
PARAMETERS = 11
STEEPEST = 0.6  # largest norm of a displacement gradient; at 1 space folds


@dataclass(frozen=True, eq=False)
class Motion:
    """Displacements of space around an anatomy, on a lattice.

    `lattice` is (7 + 8 a b c,) float64: origin (3) and step, m, shape (a, b, c), and at
    each point the values that `laws.motion.VALUES` describes.
    """

    lattice: Array

    @classmethod
    def of(
        cls,
        box: tuple[Array, Array],
        tree: VesselTree,
        ends: Sequence[End],
        blood: Circulation,
    ) -> "Motion":
        """Motion of an anatomy whose field has the corners `box` (3,), (3,), m."""
        low, high = box
        heart, breath = _along_aorta(blood, tree)
        shape = np.ceil((high - low) / _STEP).astype(int) + 1
        points = low + _STEP * np.argwhere(np.ones(shape, bool))
        parts = [
            _values(part, ends, blood, heart, breath)
            for part in np.array_split(points, 32)
        ]
        values = np.concatenate(parts).ravel()
        return cls(np.concatenate([low, [_STEP], shape, values]))

    def check(self, name: str, heart: float, breathing: float) -> None:
        """ValueError if the amplitudes of heart (m) and breathing fold space."""
        shape = self.lattice[4:7].astype(int)
        values = self.lattice[7:].reshape((*shape, 8))
        steepest = 0.0
        for share in (0.0, 1.0):
            u = share * heart * values[..., :3] + breathing * values[..., 3:6]
            slopes = np.stack([np.gradient(u, _STEP, axis=k) for k in range(3)], -1)
            steepest = max(steepest, np.linalg.norm(slopes, 2, axis=(-2, -1)).max())
        if steepest > STEEPEST:
            raise ValueError(
                f"vessel motion: heart {1e3 * heart:g} mm and breathing {breathing:g} "
                f"fold {name!r}: give smaller amplitudes"
            )

    def to_rest(self, parameters: Array, time: float, points: Array) -> Array:
        """Points at rest (..., 3), m, of points in space (..., 3), m, at a time, s."""
        out, course = np.empty((points.size // 3, 3)), course_of(parameters, time)
        to_rest(self.lattice, course, as_rows(points), scratch(), out)
        return out.reshape(points.shape)

    def to_space(
        self, parameters: Array, time: float, points: Array
    ) -> tuple[Array, Array]:
        """Points in space (..., 3), m, of points at rest, and growth of radii (...)."""
        flat = as_rows(points)
        out, growth = np.empty_like(flat), np.empty(len(flat))
        course = course_of(parameters, time)
        to_space(self.lattice, course, flat, scratch(), out, growth)
        return out.reshape(points.shape), growth.reshape(points.shape[:-1])

    def surface(self, parameters: Array, time: float, rest: Surface) -> Surface:
        """Surface of the lumen at a time, s, from that at rest."""
        places, growth = self.to_space(parameters, time, rest.vertices)
        return Surface(places + growth[:, None] * rest.normals, rest.faces)


def scratch() -> Array:
    """Work array of `laws.motion.to_rest` and `to_space`."""
    return np.empty((VALUES + WARP // 4, 4))


def course_of(parameters: Array, time: float) -> Course:
    """Motion at a time, s, from parameters (PARAMETERS,)."""
    return course_at(MotionParameters._make(parameters[1:9].tolist()), time)


def distensibility(radius: Array) -> Array:
    """Area distensibility (n,) relative to that of a wide artery, by radii (n,), m.

    From Eh/r = 3e6 exp(-13.5 r) + 3.37e5 g/s²/cm, r in cm (Mynard, in pwdb).
    """
    return 3.37e5 / (3e6 * np.exp(-1350.0 * radius) + 3.37e5)


def _values(
    points: Array, ends: Sequence[End], blood: Circulation, heart: Array, breath: Array
) -> Array:
    """Values (n, 8) of the lattice at points (n, 3), m."""
    middles, radii = blood.ends.mean(axis=1), blood.radii.mean(axis=1)
    ways = blood.ways.mean(axis=1)
    distance = np.linalg.norm(points[:, None] - middles, axis=-1)
    weight = softmax(-0.5 * (distance / _SMOOTH) ** 2, axis=1)
    across = softmax((radii - distance) / _ACROSS, axis=1)
    radius = across @ radii
    growth = 0.5 * PULSE_PRESSURE * distensibility(radius) * radius
    begun = np.ones(len(points))
    for end in ends:
        if end.open:
            away = np.linalg.norm(points - end.position, axis=-1) - end.radius
            share = np.clip(away / _FADE, 0.0, 1.0)
            begun *= share**2 * (3.0 - 2.0 * share)
    columns = [weight @ heart, weight @ breath, growth[:, None]]
    moving = [begun[:, None] * each for each in columns]
    return np.hstack([*moving, across @ ways[:, None]])


def _along_aorta(blood: Circulation, tree: VesselTree) -> tuple[Array, Array]:
    """Displacements (S, 3), (S, 3) of the segments, m, by heart and breathing at 1."""
    ways = blood.ways.mean(axis=1)
    root, names = tree.root, list(tree.vessels)
    length = root.centreline.length
    begins: dict[str | None, float | None] = {}
    for name, vessel in tree.vessels.items():
        top = vessel.parent == root.name
        begins[name] = blood.courses[name].begin if top else begins.get(vessel.parent)
    ostia = [begin for begin in begins.values() if begin is not None]
    first, last = min(ostia, default=length / 2), max(ostia, default=length / 2)
    found = [begins[names[number]] for number in blood.vessel]
    place = np.where([one is None for one in found], ways, np.array(found, float))
    fading = np.exp(-0.5 * (place / _HEART_REACH) ** 2)
    sites = [first / 2, first, last, max(length, last + 1e-3)]
    medial, posterior, superior = _INSPIRATION
    unit = np.array([(medial * sign, posterior, superior) for sign in _MEDIAL])
    unit *= (_BREATHING / np.linalg.norm(unit, axis=1))[:, None]
    breath = interpolate(place, np.array(sites), unit)
    return fading[:, None] * _HEART_WAY, breath
