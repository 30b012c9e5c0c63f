"""A moving vessel against its prescribed motion: wall, flow, and carried links."""

from collections.abc import Iterator, Sequence

import mujoco
import numpy as np

from cathsim_dmc.anatomy import Anatomy
from cathsim_dmc.anatomy.motion import (
    PARAMETERS,
    PULSE_PRESSURE,
    Motion,
    course_of,
    distensibility,
)
from cathsim_dmc.entities import contact
from cathsim_dmc.laws.heart import pulse
from cathsim_dmc.physics import adapters, dispatcher
from cathsim_dmc.physics.flow import moving_velocities
from cathsim_dmc.physics.stepper import PHYSICS_TIMESTEP
from cathsim_dmc.validation.checks import Check
from cathsim_dmc.validation.rig import bare, slider

WALL_BOUND = 0.02  # mm
DELAY_BOUND = 1.0  # ms
SLIP_BOUND = 2.0  # %
FRAME_BOUND = 1.0  # %
FLOW_BOUND = 1.0  # %
FLOW_TIMES = (1.2, 2.3)  # s
PLACES = (0.09, 0.13, 0.17)  # m along the tube
RADIUS, _PROBE = 0.01, 5e-4  # m, of the tube and of probe spheres
_PROBES = 40  # places on the wall of a phantom
_HEART, _BREATHING, _SOFT = 5.5e-3, 1.0, 0.02
_GRAVITY, _RIDE = 9.81, 2.0  # m/s²; s, duration of a ride


def parameters(heart: float, breathing: float, soft: float) -> np.ndarray:
    """Parameters (PARAMETERS,) of a motion at 60 beats and 15 breaths a minute."""
    course = [heart, breathing, soft, 1.0, 0.0, 4.6, 0.25, 0.0]
    return np.array([0.0, *course, 0.0, -1.0])


def stirred(lumen, lattice: np.ndarray, friction: float = 0.0) -> mujoco.MjSpec:
    """MuJoCo spec of a moving wall, geom 0, without a device."""
    fixed = {"solref": contact.CONTACT_SOLREF, "solimp": contact.CONTACT_SOLIMP}
    spec = bare(lumen, lattice, friction=(friction, 0, 0), **fixed)
    spec.nuserdata = PARAMETERS
    spec.option.impratio = contact.FRICTION_STIFFNESS
    spec.option.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
    return spec


def begin(model: mujoco.MjModel, course: np.ndarray, bore: int = -1) -> mujoco.MjData:
    """Data of a model whose wall moves with the parameters `course`."""
    data = mujoco.MjData(model)
    law = dispatcher.Law("motion", "contact", adapters.motion, 1)
    places = dispatcher.Places(1, np.zeros(0), wall=0, bore=bore, clock=model.nv - 1)
    data.userdata[1:9] = course[1:9]
    data.userdata[-1] = dispatcher.layout(model, places, [law]).label
    return data


def clearances(
    anatomy: Anatomy, course: np.ndarray, times: Sequence[float], points: np.ndarray
) -> np.ndarray:
    """Distances (T, n), m, of points from a moving wall, measured by probe spheres.

    Args:
        course: parameters of the motion, see `parameters`.
        times: (T,) s.
        points: (n, 3) or (T, n, 3), m; the distance is NaN where it is too large.
    """
    points = np.broadcast_to(points, (len(times), *points.shape[-2:]))
    spec = stirred(anatomy.lumen, anatomy.motion.lattice)
    ball = {"size": (_PROBE, 0, 0), "margin": 2e-3, "conaffinity": 0}
    for _ in range(points.shape[1]):
        slider(spec, np.eye(3), **ball)
    model = spec.compile()
    data, found = begin(model, course), np.full(points.shape[:2], np.nan)
    for time, places, row in zip(times, points, found, strict=True):
        data.time = time
        data.qpos[:] = places.ravel()
        mujoco.mj_fwdPosition(model, data)
        # The wall is geom 0.
        row[data.contact.geom.max(axis=1) - 1] = data.contact.dist + _PROBE
    return found


def diameters(anatomy: Anatomy) -> tuple[float, np.ndarray, np.ndarray]:
    """Diameters at `PLACES` of a straight tube along z over a beat.

    Returns:
        Largest error of a diameter, m; delays (2,) of the pulse between the places, s;
        and expected delays (2,), distance over pulse wave velocity, s.
    """
    course = parameters(0.0, 0.0, _SOFT)
    sides = np.array([[1, 0, 0], [-1, 0, 0]]) * (RADIUS - 1e-3)
    points = np.concatenate([sides + [0, 0, z] for z in PLACES])
    # The motion has its full amplitude from 2 s on.
    times = 2.0 + np.linspace(0.0, 1.0, 251)
    found = clearances(anatomy, course, times.tolist(), points)
    found = 2 * (RADIUS - 1e-3) + found.reshape(len(times), -1, 2).sum(axis=-1)
    growth = _SOFT * distensibility(np.array(RADIUS)) * PULSE_PRESSURE * RADIUS
    grown = [[pulse(t - z / course[6])[0] for z in PLACES] for t in times]
    deviation = np.abs(found - 2 * RADIUS - growth * np.array(grown)).max()
    middle = 2 * RADIUS + 0.5 * growth
    rising = slice(0, 60)  # of the beat
    rises = [np.interp(middle, each, times[rising]) for each in found[rising].T]
    return float(deviation), np.diff(rises), np.diff(PLACES) / course[6]


def wall_place(anatomy: Anatomy) -> float:
    """Largest distance, m, of the measured wall from the prescribed one.

    It is NaN if a probe that should touch the wall is too far from it.
    """
    course, lumen = parameters(_HEART, _BREATHING, _SOFT), anatomy.lumen
    random = np.random.RandomState(0)
    vertices, normals = anatomy.surface.vertices, anatomy.surface.normals
    open_ends = np.array([end.position for end in anatomy.ends])
    far = np.linalg.norm(vertices - open_ends[:, None], axis=-1).min(axis=0)
    chosen = random.choice(np.flatnonzero(far > 0.02), _PROBES, replace=False)
    inwards = -normals[chosen]
    at = vertices[chosen] + 3e-3 * inwards
    # The zero of the field along the normal.
    for _ in range(20):
        at -= lumen(at)[:, None] * inwards
    # Points at the edges of ostia are left out.
    smooth = (lumen.gradient(at + 1e-3 * inwards) * inwards).sum(axis=1) > 0.99
    at, inwards = at[smooth], inwards[smooth]
    times, places = (1.2, 2.3, 3.35), []
    for time in times:
        place, growth = anatomy.motion.to_space(course, time, at)
        beside = anatomy.motion.to_space(course, time, at + 1e-4 * inwards)[0]
        normal = (beside - place) / np.linalg.norm(beside - place, axis=1)[:, None]
        places.append(place + (_PROBE - growth[:, None]) * normal)
    found = clearances(anatomy, course, times, np.array(places))
    return float(np.abs(found - _PROBE).max())


def section_flow(anatomy: Anatomy, time: float) -> float:
    """Flow through a section of a moving straight tube, relative to the prescribed one.

    The velocity relative to space is integrated over the section that
    `Motion.to_space` displaces.
    """
    course = parameters(_HEART, _BREATHING, _SOFT)

    def there(radius, angle):
        ring = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=-1)
        rest = radius[..., None] * ring + [0.0, 0.0, PLACES[1]]
        return anatomy.motion.to_space(course, time, rest)

    grown = RADIUS + float(there(np.zeros(1), np.zeros(1))[1][0])
    places, weights = np.polynomial.legendre.leggauss(32)
    round_ = np.linspace(0, 2 * np.pi, 64, endpoint=False)
    radius, angle = np.meshgrid(grown * (places + 1) / 2, round_)
    step = 1e-4  # m
    along = there(radius + step, angle)[0] - there(radius - step, angle)[0]
    turn = step / radius
    around = there(radius, angle + turn)[0] - there(radius, angle - turn)[0]
    area = np.cross(along, around) / (4 * step * turn[..., None])
    points = there(radius, angle)[0].reshape(-1, 3)
    out = np.zeros((len(points), 8))
    vessels = anatomy.circulation.segments
    now = course_of(course, time)
    moving_velocities(anatomy.motion.lattice, now, points, vessels, out)
    through = (out[:, :3].reshape(area.shape) * area).sum(axis=-1)
    return float((through * weights).sum() * grown / 2 * 2 * np.pi / len(radius))


def rigid_motion(anatomy: Anatomy, way: np.ndarray) -> Motion:
    """Rigid motion of all space along `way` (3,) by the heart alone."""
    low, high = anatomy.lumen.box
    values = np.tile([*way, 0, 0, 0, 0, 0.0], 8)
    return Motion(np.concatenate([low, [np.max(high - low)], [2, 2, 2], values]))


def ride(
    anatomy: Anatomy,
    way: tuple[float, float, float],
    friction: float,
    inertial: bool = False,
) -> tuple[np.ndarray, np.ndarray]:
    """Displacements (T, 3), m, of a link in a rigidly moving tube, and of the tube.

    Args:
        way: Direction of the motion, whose amplitude is `_HEART`.
        friction: Coulomb coefficient.
        inertial: Whether the wall is fixed and the link has an inertial force instead.
    """
    course = parameters(_HEART, 0.0, 0.0)
    motion = rigid_motion(anatomy, np.array(way))
    spec = stirred(anatomy.lumen, motion.lattice, friction)
    capsule = {"size": (1e-3, 2e-3, 0), "mass": 1e-3, "friction": (friction, 0, 0)}
    capsule["type"] = mujoco.mjtGeom.mjGEOM_CAPSULE
    slider(spec, np.eye(3), (RADIUS - 1e-3 - 1e-6, 0, 0.1), **capsule)
    # The clock is that of `physics.motion.add_clock`.
    clock = spec.worldbody.add_body(gravcomp=1, mass=0.1, inertia=(1e-5,) * 3)
    clock.explicitinertial = True
    clock.add_joint(type=mujoco.mjtJoint.mjJNT_SLIDE, axis=(0, 1, 0))
    model = spec.compile()
    data = begin(model, course)
    if inertial:
        data.userdata[:] = 0.0
    times, half = np.arange(0.0, _RIDE, PHYSICS_TIMESTEP), 0.5 * PHYSICS_TIMESTEP
    link = []
    for time in times:
        model.opt.gravity[:] = _GRAVITY, 0, 0
        if inertial:
            # Velocities of the wall are those of the middle of each step.
            gain = course_of(course, time + half).heart_rate
            gain -= course_of(course, time - half).heart_rate
            model.opt.gravity[:] -= gain / PHYSICS_TIMESTEP * np.array(way)
        mujoco.mj_step(model, data)
        link.append(data.qpos[:3].copy())
    wall = [course_of(course, time + PHYSICS_TIMESTEP).heart for time in times]
    return np.array(link), np.outer(wall, way)


def slip(anatomy: Anatomy) -> float:
    """Largest slip of a link that a wall carries along, relative to its motion, %."""
    link, wall = (each[:, 2] for each in ride(anatomy, (0, 0, 1), friction=0.5))
    return float(100 * np.abs(link - wall).max() / np.abs(wall).max())


def frame(anatomy: Anatomy) -> float:
    """Error, %, of motion on a moving wall, against a wall at rest with inertia."""
    way = (0.0, 0.8, 0.6)
    link, wall = ride(anatomy, way, friction=0.005)
    expected = ride(anatomy, way, friction=0.005, inertial=True)[0][:, 1:]
    away = np.abs((link - wall)[:, 1:] - expected).max()
    return float(100 * away / np.ptp(expected, axis=0).max())


def checks(tube: Anatomy, phantom: Anatomy) -> Iterator[Check]:
    """Checks of the motion of a straight tube along z and of a phantom."""
    for time in FLOW_TIMES:
        name = f"flow through a section in motion at {time:g} s"
        yield Check.deviation(name, section_flow(tube, time), 1.0, FLOW_BOUND)
    deviation, delays, expected = diameters(tube)
    name = "diameter of the lumen over the beat at three places, error"
    yield Check.at_most(name, 1e3 * deviation, WALL_BOUND, "mm")
    late = 1e3 * np.abs(delays - expected).max()
    yield Check.at_most("delay of the pulse, error", late, DELAY_BOUND, "ms")
    name = f"place of the wall of {phantom.name} with all motions, error"
    yield Check.at_most(name, 1e3 * wall_place(phantom), WALL_BOUND, "mm")
    name = "slip of a link that the wall carries"
    yield Check.at_most(name, slip(tube), SLIP_BOUND, "%")
    name = "way slid on a moving wall, against a resting one under its inertia"
    yield Check.at_most(name, frame(tube), FRAME_BOUND, "%")
