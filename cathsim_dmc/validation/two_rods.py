"""Coaxial devices against two rods with a common shape, each with its own twist.

The reference shares only the data of the devices with the model, no code.
"""

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import mujoco
import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from cathsim_dmc.entities import posture, stack_memory
from cathsim_dmc.entities.chain import MAX_PUSH_SPEED
from cathsim_dmc.entities.device import Device
from cathsim_dmc.entities.device_stack import DeviceStack
from cathsim_dmc.laws import sliding as laws
from cathsim_dmc.physics import chain_fields, sliding
from cathsim_dmc.physics.stepper import CONTROL_TIMESTEP
from cathsim_dmc.validation import theory
from cathsim_dmc.validation.checks import Check
from cathsim_dmc.validation.rig import Rig, half_circle, in_tube

_FINE = 0.5e-3  # m, length of a piece of the reference
BEND_RADIUS = 0.04  # m, of the half circle in which the pairs are held
_HELD = 1e6  # kg·m², armature that fixes a hinge
_STEP = 1e-3  # m, step of the derivative of the energy by sliding
# Devices from the innermost outwards, distances of their ends from the chain's end (m),
# rotations of their bases (rad), and length beyond the half circle (m), whose end is a
# joint.
CASES = (
    (("wire_035_glide", "berenstein_5f"), (0.10, 0.0), (0.8, -0.5), 0.07),
    (("wire_035_amplatz", "diagnostic_5f_simmons"), (0.0, 0.09), (0.5, 0.3), 0.07),
    (("wire_035_glide", "vertebral_5f"), (0.0, 0.08), (-0.6, 0.9), 0.07),
)
TIP_BOUND = 1.0  # % of the length
ROTATION_BOUND = 3.0  # °
WORKING = ("wire_035_glide", "diagnostic_5f_simmons")
# Unconstrained devices, and distances of their ends from the chain's end (m).
SLIDES = (
    (("wire_035_glide", "berenstein_5f"), (0.0155, 0.0)),
    (("wire_035_glide", "berenstein_5f"), (0.0, 0.018)),
    (WORKING, (0.0065, 0.0)),
    (WORKING, (0.0, 0.025)),
)
SLIDE_TURN = 0.6  # rad, of the base of the outer device
RESISTANCE_BOUND = 5.0  # %
WITHDRAWN = 0.02  # m, by which the wire is withdrawn at each of `SPEEDS`
SPEEDS = (1e-3, 5e-4)  # m/s
_WIDE = 0.275, 0.07  # m, length and radius of a tube that nothing touches


class Rods(NamedTuple):
    """Equilibrium of K devices."""

    rotation: np.ndarray  # (K,), rotations of the ends of the devices, rad
    end: np.ndarray  # (3,), end of the chain from its base, m
    energy: float = np.nan  # energy of the reference, J
    force: np.ndarray = np.zeros(0)  # (K,), axial forces on simulated bases, N


def reference(
    devices: Sequence[Device],
    gaps: ArrayLike,
    rotation: Sequence[float],
    length: float,
    held: np.ndarray | None = None,
) -> Rods:
    """Minimises bending and twist energy of devices that share one shape.

    Args:
        devices: K devices, from the innermost outwards.
        gaps: (K,) distances from their ends to that of the chain, m.
        rotation: (K,) rotations of their bases, rad.
        length: Length of the chain, m.
        held: (n,) complex, prescribed curvatures of the first n pieces, 1/m.
    """
    count = round(length / _FINE)
    places = length - (np.arange(count) + 0.5) * _FINE
    given = np.zeros(0, complex) if held is None else held
    bending, torsion, own = theory.profile(devices, gaps, places)
    free, shape = count - len(given), (len(devices), count)
    # Unknowns are scaled by the roots of the stiffnesses, which conditions the energy.
    scales = np.sqrt(_FINE * np.where(torsion > 0, torsion, 1e-6))
    root = np.sqrt(_FINE * bending.sum(axis=0)[len(given) :])
    base = np.asarray(rotation, float)[:, None]

    def parts(unknowns):
        twist = unknowns[: scales.size].reshape(shape) / scales
        turns = base + np.cumsum(twist, axis=1) * _FINE
        bent = unknowns[scales.size :].reshape(2, free) / root
        return twist, turns, np.concatenate([given, bent[0] + 1j * bent[1]])

    def energy(unknowns):
        twist, turns, curvature = parts(unknowns)
        unloaded = own * np.exp(1j * turns)
        off = bending * (curvature - unloaded)
        value = np.abs(off * (curvature - unloaded)) + torsion * twist**2
        by_turn = -np.real(off.conj() * 1j * unloaded) * _FINE
        by_twist = by_turn[:, ::-1].cumsum(axis=1)[:, ::-1] * _FINE
        by_twist += torsion * twist * _FINE
        by_bend = off.sum(axis=0)[len(given) :] * _FINE / root
        slope = [(by_twist / scales).ravel(), np.real(by_bend), np.imag(by_bend)]
        return 1e6 * value.sum() * _FINE / 2, 1e6 * np.concatenate(slope)

    start = np.zeros(scales.size + 2 * free)
    limits = {"maxiter": 5000, "maxfun": 5000, "ftol": 1e-15, "gtol": 1e-9}
    found = minimize(energy, start, jac=True, method="L-BFGS-B", options=limits)
    _, turns, curvature = parts(found.x)
    last = [turns[k, torsion[k] > 0][-1] for k in range(len(devices))]
    return Rods(np.array(last), _end(curvature), found.fun / 1e6)


def _end(curvature: np.ndarray) -> np.ndarray:
    """End (3,), m, of a curve with complex curvatures (n,), 1/m, without twist."""
    frame, place = Rotation.identity(), np.zeros(3)
    for bend in curvature:
        half = Rotation.from_rotvec(np.array([-bend.imag, bend.real, 0]) * _FINE / 2)
        place = place + (frame * half).apply([0, 0, _FINE])
        frame = frame * half * half
    return place


def simulate(
    names: Sequence[str],
    gaps: Sequence[float],
    rotation: Sequence[float],
    beyond: float | None = None,
    duration: float = 12.0,
) -> Rods:
    """Simulates a chain to rest, free or held along a half circle; see `reference`.

    Args:
        beyond: Free length of chain after the half circle, m; None for a free chain.
        duration: Simulated time, s.
    """
    rig = Rig(names, lumen_friction=0.0)
    rig.compile()
    entity: Any = rig.catheter
    stack = entity.stack
    places = chain_fields.places_of(rig.model, entity)
    hinges = rig.data.qpos[places.qpos : places.qpos + 2 * len(stack.spans)]
    fields = chain_fields.fields_of(lambda name: getattr(rig.model, name))
    if beyond is not None:
        # A straight part, a half circle, and a straight part.
        start = stack.nodes[0] - beyond - np.pi * BEND_RADIUS
        line = np.vstack([[[0, 0, 0]], half_circle(BEND_RADIUS, start, 1999)])
        line = np.vstack([line, line[-1:] - (0, 0, 1)])
        rig.bend(posture.joints_along(rig.lengths, line))
        # Joints up to the end of the half circle are fixed.
        held = 2 * int((stack.nodes[1:-1] > beyond - 1e-6).sum())
        start = int(rig.model.jnt_dofadr[rig.model.joint(f"{rig.name}/bend_x_1").id])
        rig.model.dof_armature[start : start + held] = _HELD
    gap = np.asarray(gaps, float)
    angles = np.tile(np.asarray(rotation, float)[:, None], len(stack.nodes))
    devices, still = sliding.devices_at(entity), np.zeros(len(gap))
    axial, count = np.zeros((len(gap), len(stack.spans))), len(gap) - 1
    lumen = np.zeros((2, count))
    state = laws.State(gap, hinges, angles, lumen[0], lumen[1], 0.0 * still, axial)
    loads = laws.Loads(still, np.zeros(len(rig.lengths)), 0.0, 0.0, 1.0, 1.0)
    memory = stack_memory.settling(stack.tables)
    chain = stack_memory.chain(stack.tables)
    for _ in range(round(duration / CONTROL_TIMESTEP)):
        laws.settle(devices, loads, state, memory, chain)
        chain_fields.write(fields, places, chain, 1.0, 1.0)
        rig.run(CONTROL_TIMESTEP)
    mujoco.mj_kinematics(rig.model, rig.data)
    laws.settle(devices, loads, state, memory, chain)
    end = rig.head_position - rig.joints[0]
    return Rods(angles[:, -1], end, force=axial.sum(axis=-1))


def work(speed: float) -> tuple[float, float]:
    """Withdraws a wire from an unconstrained catheter, without friction and gravity.

    Args:
        speed: Speed of the wire, m/s.

    Returns:
        Work of the drives, and change of the energy by `reference`, J.
    """
    options = {"devices": WORKING, "friction": 0.0, "lumen_friction": 0.0}
    environment = in_tube(_WIDE, observation="tracking", **options)
    environment.physics.model.ptr.opt.gravity[:] = 0.0
    task = environment.task
    for push in [1.0] * 40 + [0.0] * 60:
        environment.step(np.array([push, 0.0, push, 0.0]))
    chain, insertions, pushes = task.scene.catheter, [], []
    for _ in range(round(WITHDRAWN / (speed * CONTROL_TIMESTEP)) + 1):
        state = task.rollout.devices
        insertions.append(state.insertion[0])
        pushes.append(state.push[0])
        environment.step(np.array([-speed / MAX_PUSH_SPEED, 0.0, 0.0, 0.0]))
    environment.close()
    length = float(chain.link_lengths.sum())
    first, last = (
        reference(chain.devices, each.max() - each, (0.0, 0.0), length).energy
        for each in (insertions[0], insertions[-1])
    )
    done = (np.array(pushes[1:]) * np.diff(insertions, axis=0)).sum()
    return float(done), last - first


def in_half_circle(names, gaps, rotation, beyond: float) -> tuple[Rods, Rods, float]:
    """Simulation and reference of devices held in a half circle; their length, m."""
    entity = DeviceStack(names)
    length = float(entity.link_lengths.sum())
    held = np.zeros(round((length - beyond) / _FINE), complex)
    held[-round(np.pi * BEND_RADIUS / _FINE) :] = 1 / BEND_RADIUS
    expected = reference(entity.devices, gaps, rotation, length, held)
    return simulate(names, gaps, rotation, beyond), expected, length


def checks() -> Iterator[Check]:
    """Checks of pairs held in a half circle, and of the axial force of a bend."""
    for case in CASES:
        names, gaps, rotation, beyond = case
        found, expected, length = in_half_circle(names, gaps, rotation, beyond)
        name = f"two rods in half a circle, {' in '.join(names)}"
        off = 100 * float(np.linalg.norm(found.end - expected.end)) / length
        yield Check.at_most(f"{name}, tip", off, TIP_BOUND, "% of its length")
        off = np.degrees(np.abs(found.rotation - expected.rotation).max())
        turned = np.degrees(np.abs(expected.rotation - rotation).max())
        note = f"the bend turns an end by {turned:.0f}°"
        yield Check.at_most(f"{name}, rotation", off, ROTATION_BOUND, "°", note)
    for names, gaps in SLIDES:
        rotation, gap = (0.0, SLIDE_TURN), np.asarray(gaps)
        found, entity = simulate(names, gaps, rotation), DeviceStack(names)
        length, step = float(entity.link_lengths.sum()), _STEP * (gap > 0)
        low, high = (
            reference(entity.devices, gap + side * step, rotation, length).energy
            for side in (-1, 1)
        )
        name = f"axial force of a bend, {' in '.join(names)}, ends "
        name += " and ".join(f"{1e3 * each:.1f}" for each in gaps) + " mm back"
        force, expected = found.force[gap.argmax()], (low - high) / (2 * _STEP)
        yield Check.deviation(name, force, expected, RESISTANCE_BOUND, "N")
    (fast, _), (slow, change) = (work(speed) for speed in SPEEDS)
    done = (SPEEDS[0] * slow - SPEEDS[1] * fast) / (SPEEDS[0] - SPEEDS[1])
    name = f"work of the drives, {' in '.join(WORKING)}, wire withdrawn by 20 mm"
    yield Check.deviation(name, 1e3 * done, 1e3 * change, RESISTANCE_BOUND, "mJ")
