"""A moving vessel against what is prescribed: where its wall is, what it carries."""

from __future__ import annotations

from typing import NamedTuple

import mujoco
import numpy as np

from cathsim_dmc.anatomy import Anatomy
from cathsim_dmc.anatomy.motion import PULSE_PRESSURE, Motion, distensibility
from cathsim_dmc.collision import fields
from cathsim_dmc.entities.contact import (
    CONTACT_SOLIMP,
    CONTACT_SOLREF,
    FRICTION_STIFFNESS,
)
from cathsim_dmc.physics.stepper import PHYSICS_TIMESTEP
from cathsim_dmc.validation.checks import Check

WALL_BOUND = 0.02  # mm
DELAY_BOUND = 1.0  # ms
SLIP_BOUND = 2.0  # %
FRAME_BOUND = 1.0  # %
PLACES = (0.09, 0.13, 0.17)  # m along the tube
RADIUS, _PROBE = 0.01, 5e-4  # m
_HEART, _BREATHING, _SOFT = 5.5e-3, 1.0, 0.02
_GRAVITY = 9.81


def parameters(heart: float, breathing: float, soft: float) -> np.ndarray:
    """Parameters of a motion at 60 beats and 15 breaths a minute, of geom 0."""
    from cathsim_dmc.anatomy.motion_loops import MARK

    course = [heart, breathing, soft, 1.0, 0.0, 4.6, 0.25, 0.0]
    return np.array([MARK, *course, 0.0, -1.0])


def stirred(lumen, lattice: np.ndarray, friction: float = 0.0) -> mujoco.MjSpec:
    """A model of a moving wall alone, geom 0."""
    from cathsim_dmc.anatomy.motion_loops import PARAMETERS
    from cathsim_dmc.collision import carrying

    carrying.install()
    wall = fields.carrier(lumen, lattice)
    spec = mujoco.MjSpec()
    spec.nuser_geom, spec.nuserdata = 4, 3 + PARAMETERS
    option = spec.option
    option.integrator = mujoco.mjtIntegrator.mjINT_DISCRETE
    option.timestep, option.gravity = PHYSICS_TIMESTEP, (0, 0, 0)
    option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    option.impratio = FRICTION_STIFFNESS
    option.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
    spec.worldbody.add_geom(
        type=mujoco.mjtGeom.mjGEOM_BOX,
        pos=wall["pos"],
        size=wall["size"],
        userdata=wall["user"],
        friction=(friction, 0, 0),
        solref=CONTACT_SOLREF,
        solimp=CONTACT_SOLIMP,
    )
    return spec


def begin(model: mujoco.MjModel, course: np.ndarray) -> mujoco.MjData:
    """Data of a model whose wall moves by parameters."""
    data = mujoco.MjData(model)
    data.userdata[1] = len(course)
    data.userdata[2 : 2 + len(course)] = course
    return data


class Probes:
    """Small spheres that measure how far a moving wall is away."""

    def __init__(self, anatomy: Anatomy, course: np.ndarray, count: int):
        """Takes the anatomy, its motion's parameters, and how many places to look."""
        spec = stirred(anatomy.lumen, anatomy.motion.lattice)
        for _ in range(count):
            body = spec.worldbody.add_body()
            for axis in np.eye(3):
                body.add_joint(type=mujoco.mjtJoint.mjJNT_SLIDE, axis=axis)
            ball = mujoco.mjtGeom.mjGEOM_SPHERE
            body.add_geom(type=ball, size=(_PROBE, 0, 0), margin=2e-3, conaffinity=0)
        self._model = spec.compile()
        self._data = begin(self._model, course)

    def clearances(self, points: np.ndarray, time: float) -> np.ndarray:
        """Distances (n,) m of points (n, 3) from the wall; NaN where too far."""
        self._data.time = time
        self._data.qpos[:] = points.ravel()
        mujoco.mj_fwdPosition(self._model, self._data)
        found = np.full(len(points), np.nan)
        for contact in self._data.contact[: self._data.ncon]:
            found[contact.geom2 - 1 if contact.geom1 == 0 else contact.geom1 - 1] = (
                contact.dist + _PROBE
            )
        return found


class Beat(NamedTuple):
    """Diameters of a tube over a beat.

    Attributes:
        deviation: largest difference from what is prescribed, m.
        delays: (2,) of the pulse between the places, s.
        expected: (2,) distance over pulse wave velocity, s.
    """

    deviation: float
    delays: np.ndarray
    expected: np.ndarray


def diameters(anatomy: Anatomy) -> Beat:
    """Diameters at `PLACES` of a straight tube along z over a beat."""
    from cathsim_dmc.anatomy.motion_loops import pulse

    course = parameters(0.0, 0.0, _SOFT)
    sides = np.array([[1, 0, 0], [-1, 0, 0]]) * (RADIUS - 1e-3)
    points = np.concatenate([sides + [0, 0, z] for z in PLACES])
    probes = Probes(anatomy, course, len(points))
    # From 2 s on all of it moves.
    times = 2.0 + np.linspace(0.0, 1.0, 251)
    apart = 2 * (RADIUS - 1e-3)
    found = np.array([probes.clearances(points, time) for time in times])
    found = apart + found.reshape(len(times), -1, 2).sum(axis=-1)
    growth = _SOFT * distensibility(np.array(RADIUS)) * PULSE_PRESSURE * RADIUS
    expected = [
        [2 * RADIUS + growth * pulse(t - z / course[6])[0] for z in PLACES]
        for t in times
    ]
    middle = 2 * RADIUS + 0.5 * growth
    rising = slice(0, 60)  # of the beat
    rises = [np.interp(middle, found[rising, n], times[rising]) for n in range(3)]
    way = np.diff(PLACES) / course[6]
    deviation = np.abs(found - np.array(expected)).max()
    return Beat(float(deviation), np.diff(rises), way)


def wall_place(anatomy: Anatomy, number: int = 40) -> float:
    """Largest distance of the wall from where all motions put it, m.

    Points of the wall at rest are moved, and looked for by the collisions of probes.
    """
    course = parameters(_HEART, _BREATHING, _SOFT)
    random, lumen = np.random.RandomState(0), anatomy.lumen
    vertices, normals = anatomy.surface.vertices, anatomy.surface.normals
    open_ends = [end.position for end in anatomy.ends]
    far = np.min(
        [np.linalg.norm(vertices - place, axis=1) for place in open_ends], axis=0
    )
    chosen = random.choice(np.flatnonzero(far > 0.02), number, replace=False)
    at = vertices[chosen] - 3e-3 * normals[chosen]
    # Where the field has its wall along the normal.
    for _ in range(20):
        at += lumen(at)[:, None] * normals[chosen]
    inwards = -normals[chosen]
    # Away from the edges of ostia.
    smooth = (lumen.gradient(at + 1e-3 * inwards) * inwards).sum(axis=1) > 0.99
    at, inwards = at[smooth], inwards[smooth]
    probes = Probes(anatomy, course, len(at))
    worst = 0.0
    for time in (1.2, 2.3, 3.35):
        place, growth = anatomy.motion.to_space(course, time, at)
        beside = anatomy.motion.to_space(course, time, at + 1e-4 * inwards)[0]
        normal = (beside - place) / np.linalg.norm(beside - place, axis=1)[:, None]
        place = place - growth[:, None] * normal
        found = probes.clearances(place + _PROBE * normal, time)
        worst = max(worst, float(np.nanmax(np.abs(found - _PROBE))))
    return worst


def rigid_motion(anatomy: Anatomy, way: np.ndarray) -> Motion:
    """All of space moved along (3) by the heart alone."""
    low, high = anatomy.lumen.box
    values = np.tile([*way, 0, 0, 0, 0, 0.0], 8)
    return Motion(np.concatenate([low, [np.max(high - low)], [2, 2, 2], values]))


class Ride(NamedTuple):
    """A free link in a tube, over time.

    Attributes:
        link: (T, 3), its ways, m.
        wall: (T, 3), those of the wall, m.
    """

    link: np.ndarray
    wall: np.ndarray


def ride(
    anatomy: Anatomy,
    way: tuple[float, float, float],
    friction: float,
    inertial: bool = False,
    seconds: float = 2.0,
) -> Ride:
    """Lets a link lie in a tube whose wall moves rigidly.

    Args:
        anatomy: A straight tube along z.
        way: Direction of the motion, of `_HEART` in a beat.
        friction: Coulomb coefficient.
        inertial: Whether the wall rests instead, and all feel its acceleration.
        seconds: Time.
    """
    from cathsim_dmc.anatomy.motion_loops import courses

    course = parameters(_HEART, 0.0, 0.0)
    motion = rigid_motion(anatomy, np.array(way))
    spec = stirred(anatomy.lumen, motion.lattice, friction)
    body = spec.worldbody.add_body(pos=(RADIUS - 1e-3 - 1e-6, 0, 0.1))
    for axis in np.eye(3):
        body.add_joint(type=mujoco.mjtJoint.mjJNT_SLIDE, axis=axis)
    body.add_geom(
        type=mujoco.mjtGeom.mjGEOM_CAPSULE,
        size=(1e-3, 2e-3, 0),
        mass=1e-3,
        friction=(friction, 0, 0),
    )
    clock = spec.worldbody.add_body(gravcomp=1, mass=0.1, inertia=(1e-5,) * 3)
    clock.explicitinertial = True
    clock.add_joint(type=mujoco.mjtJoint.mjJNT_SLIDE, axis=(0, 1, 0))
    model = spec.compile()
    data = begin(model, course)
    if inertial:
        data.userdata[2:] = 0.0
    count = round(seconds / PHYSICS_TIMESTEP)
    link, wall = np.empty((2, count, 3))
    for step in range(count):
        time = step * PHYSICS_TIMESTEP
        model.opt.gravity[:] = _GRAVITY, 0, 0
        if inertial:
            # The wall's velocities are those in the middle of each step.
            step_half = 0.5 * PHYSICS_TIMESTEP
            after = courses(course, time + step_half)[3]
            rate = (after - courses(course, time - step_half)[3]) / PHYSICS_TIMESTEP
            model.opt.gravity[:] -= rate * np.array(way)
        mujoco.mj_step(model, data)
        link[step] = data.qpos[:3]
        wall[step] = courses(course, time + PHYSICS_TIMESTEP)[0] * np.array(way)
    return Ride(link, wall)


def slip(anatomy: Anatomy) -> float:
    """Way of a link along a wall that carries it, over the wall's, %."""
    found = ride(anatomy, (0, 0, 1), friction=0.5)
    away = np.abs(found.link[:, 2] - found.wall[:, 2]).max()
    return float(100 * away / np.abs(found.wall[:, 2]).max())


def frame(anatomy: Anatomy) -> float:
    """Motion seen from a moving wall against that under its inertia at rest, %."""
    way = (0.0, 0.8, 0.6)
    moving = ride(anatomy, way, friction=0.005)
    resting = ride(anatomy, way, friction=0.005, inertial=True)
    relative = (moving.link - moving.wall)[:, 1:]
    expected = resting.link[:, 1:]
    away = np.abs(relative - expected).max()
    return float(100 * away / np.ptp(expected, axis=0).max())


def checks(tube: Anatomy, phantom: Anatomy) -> list[Check]:
    """Checks of a straight tube along z, and of a phantom."""
    beat = diameters(tube)
    late = np.abs(beat.delays - beat.expected).max()
    return [
        Check.at_most(
            "lumen's diameter over the beat at three places",
            1e3 * beat.deviation,
            WALL_BOUND,
            "mm",
        ),
        Check.at_most("delay of the pulse", 1e3 * late, DELAY_BOUND, "ms"),
        Check.at_most(
            f"wall of {phantom.name} with all motions",
            1e3 * wall_place(phantom),
            WALL_BOUND,
            "mm",
        ),
        Check.at_most(
            "slip of a link that the wall carries", slip(tube), SLIP_BOUND, "%"
        ),
        Check.at_most(
            "sliding in a moving wall's frame, and at rest under its inertia",
            frame(tube),
            FRAME_BOUND,
            "%",
        ),
    ]
