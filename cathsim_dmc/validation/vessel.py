"""Flow, compliant wall and moving wall against closed forms."""

import itertools
from collections.abc import Iterator, Sequence

import mujoco
import numpy as np
from scipy.integrate import solve_bvp
from scipy.optimize import brentq

from cathsim_dmc import suite
from cathsim_dmc.anatomy import phantoms
from cathsim_dmc.anatomy.anatomy import Anatomy
from cathsim_dmc.entities import devices
from cathsim_dmc.entities.arena import BLOOD_DENSITY
from cathsim_dmc.laws.blood import Blood, beat
from cathsim_dmc.laws.compliance import Material, reference, stiffness
from cathsim_dmc.laws.parameters import total
from cathsim_dmc.laws.planes import MOST
from cathsim_dmc.physics import adapters, dispatcher
from cathsim_dmc.physics.blood import BLOOD_VISCOSITY, StillBlood
from cathsim_dmc.physics.effects import views
from cathsim_dmc.physics.flow import EXPONENT, velocities
from cathsim_dmc.physics.wall import COMPLIANT, SOLIMP
from cathsim_dmc.simulation.batch import BatchSimulation
from cathsim_dmc.validation import damping, motion
from cathsim_dmc.validation.checks import Check, Report
from cathsim_dmc.validation.damping import LINK, drag
from cathsim_dmc.validation.rig import bare, slider, tube

ANATOMIES = ("type1", "type2", "bovine")
FLOW_BOUND = 2.0  # %
VOLUME_BOUND = 1e-9  # of the inflow
PROFILE_BOUND = 1e-6  # of the mean velocity
CROSS_FLOWS = (0.1, 0.4)  # m/s
FORCES = (1e-4, 5e-3)  # N, on a free link
RADII, MODULI = (4.4e-3, 0.014), (0.45e6, 2e6)  # m, Pa
SLOPE_BOUND = 5.0  # %


def cantilever(speed: float) -> tuple[float, float]:
    """Deflection (m) of a cantilever's end in a cross-flow (m/s), and expected one.

    The expected elastica has the normal load ½ρ d C_d(Re) u² per length, where u is the
    velocity of the blood normal to its axis.
    """
    blood = StillBlood()
    rig = damping.cantilever(blood)
    one = rig.device
    blood.world.parameters.velocity[0] = [speed, 0.0, 0.0]
    rig.settle()
    length = float(rig.sections[0].sum())
    bending, diameter = one.shaft.bending_stiffness, 2 * one.outer_radius

    def change(s, state):
        # State: angle from the axis at rest, moment / EI, shear, tension, deflection.
        angle, curvature, shear, tension, _ = state
        pull = -drag(speed * np.cos(angle), diameter) - tension * curvature
        bend, along = -shear / bending, shear * curvature
        return np.stack([curvature, bend, pull, along, np.sin(angle)])

    def ends(first, last):
        return np.array([*first[[0, 4]], *last[1:4]])

    s = np.linspace(0.0, length, 60)
    solved = solve_bvp(change, ends, s, np.zeros((5, len(s))), tol=1e-8)
    return float(rig.head_position[0]), float(solved.y[4, -1])


def terminal_velocity(force: float) -> tuple[float, float]:
    """Velocity (m/s) of a free link under a lateral force (N), and expected one."""
    radius = devices.get("steerable_5f").outer_radius
    sizes = {"links": 1, "joints": 0}
    spec = bare()
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.nuserdata = total(Blood, sizes) + 1
    body, capsule = spec.worldbody.add_body(), mujoco.mjtGeom.mjGEOM_CAPSULE
    body.add_freejoint()
    body.add_geom(type=capsule, size=(radius, LINK / 2, 0), density=BLOOD_DENSITY)
    model = spec.compile()
    data = mujoco.MjData(model)
    law = dispatcher.Law("drag", "passive", adapters.blood, 0)
    places = dispatcher.Places(1, np.zeros(1))
    data.userdata[-1] = dispatcher.layout(model, places, [law]).label
    blood = views(Blood, data.userdata[None], sizes)
    blood.density[:], blood.viscosity[:] = BLOOD_DENSITY, BLOOD_VISCOSITY
    data.xfrc_applied[1, 0] = force
    mujoco.mj_step(model, data, 2000)
    expected = brentq(lambda u: LINK * drag(u, 2 * radius) - force, 1e-6, 10.0)
    return float(data.qvel[0]), float(expected)


def volume_defect(anatomy: Anatomy) -> float:
    """Largest flow lost at a junction at any phase, relative to the largest inflow."""
    circulation, tree = anatomy.circulation, anatomy.tree
    beats = np.array([beat(phase) for phase in np.linspace(0.0, 1.0, 101)])
    lost = []
    for course in circulation.courses.values():
        for place, taken in course.branches:
            before, after = course.share(np.array([place - 1e-9, place + 1e-9]))
            lost.append(np.abs((before - after - taken) * beats).max())
    for name, vessel in tree.vessels.items():
        if vessel.parent is not None:
            branches = circulation.courses[vessel.parent].branches[:, 1]
            entering = circulation.courses[name].share(np.zeros(1))[0]
            lost.append(np.abs(branches - entering).min())
    entering = circulation.courses[tree.root.name].share(np.full(1, -1.0))[0]
    leaving = sum(course.outlet for course in circulation.courses.values())
    return float(np.max([*lost, abs(entering - 1), abs(leaving - 1)]))


def profile() -> tuple[float, float]:
    """Error of the velocity profile in a tube over the mean; flow over the inflow."""
    radius = 0.01
    circulation = tube(0.2, radius).circulation
    places, weights = np.polynomial.legendre.leggauss(64)
    r = radius * (places + 1) / 2
    points = np.stack([r, 0 * r, 0.1 + 0 * r], axis=-1)
    out = np.empty((len(r), 5))
    velocities(points, np.zeros(len(r)), circulation.segments, out)
    mean, n = 1 / (np.pi * radius**2), EXPONENT
    expected = mean * (n + 2) / n * (1 - (r / radius) ** n)
    flow = (out[:, 2] * 2 * np.pi * r * weights).sum() * radius / 2
    return float(np.abs(out[:, 2] - expected).max() / mean), float(flow)


def indentation(
    kind: str, radius: float, modulus: float, loads: Sequence[float] | np.ndarray
) -> np.ndarray:
    """Penetration depths (n,), m, of a "sphere" or "capsule" under loads (n,), N.

    It lies along a tube with a radius, m, and a wall of 1.5 mm with a modulus, Pa.
    """
    spec = bare(tube(0.2, radius).lumen)
    spec.nuserdata = MOST + 1
    half = LINK / 2 if kind == "capsule" else 0.0
    body = {"size": (1e-3, half, 0), "mass": 1e-3, "priority": 1}
    body["type"] = getattr(mujoco.mjtGeom, f"mjGEOM_{kind.upper()}")
    geom = slider(spec, (1, 0, 0), (radius - 1e-3 - 1e-4, 0, 0.1), **body)
    model, spring = spec.compile(), stiffness(radius, Material(modulus, 1.5e-3, 1.0))
    solref = reference(spring, model.body_invweight0[1, 0], COMPLIANT)
    model.geom_solref[geom.id], model.geom_solimp[geom.id] = solref, SOLIMP
    law = dispatcher.Law("wall", "contact", adapters.compliance, 0)
    places = dispatcher.Places(1, np.array([geom.id]), wall=0)
    layout = dispatcher.layout(model, places, [law])
    depths = []
    for load in loads:
        data = mujoco.MjData(model)
        data.xfrc_applied[1, 0], data.userdata[-1] = load, layout.label
        mujoco.mj_step(model, data, 1500)
        depths.append(data.qpos[0] - 1e-4)
    return np.array(depths)


def stiffened(factor: float) -> float:
    """Largest difference of a joint position between a rigid and a stiffened wall."""
    found = []
    for vessel in ("rigid", {"wall": {"modulus": factor * MODULI[0]}}):
        batch = BatchSimulation(suite.make_task("simple1_bca", vessel=vessel), 1)
        batch.reset()
        action = np.zeros((1, batch.num_actions))
        action[:, [0, -1]] = 1.0
        for _ in range(50):
            batch.step(action)
        found.append(batch.batch.qpos.copy())
    return float(np.abs(found[0] - found[1]).max())


def _checks() -> Iterator[Check]:
    for speed in CROSS_FLOWS:
        name = f"deflection of a cantilever of 0.2 m in a cross-flow of {speed:g} m/s"
        bent, elastica = cantilever(speed)
        yield Check.deviation(name, 1e3 * bent, 1e3 * elastica, FLOW_BOUND, "mm")
    for force in FORCES:
        name = f"terminal velocity of a free link under {1e3 * force:g} mN"
        speed, expected = terminal_velocity(force)
        yield Check.deviation(name, speed, expected, FLOW_BOUND, "m/s")
    for name in ANATOMIES:
        lost, name = volume_defect(phantoms.load(name)), f"the junctions of {name}"
        yield Check.at_most(f"volume lost at {name}", lost, VOLUME_BOUND)
    deviation, flow = profile()
    name = "velocity across a tube, deviation from the profile over the mean"
    yield Check.at_most(name, deviation, PROFILE_BOUND)
    yield Check.deviation(
        "flow through a section, integral of the profile", flow, 1.0, 1e-6
    )
    # A capsule along the tube has a contact at each end.
    shapes = (("sphere", 1), ("capsule", 2))
    for (kind, ends), radius, modulus in itertools.product(shapes, RADII, MODULI):
        expected = ends * stiffness(radius, Material(modulus, 1.5e-3, 1.0))
        loads = expected * np.array([2e-4, 6e-4])
        slope = np.ptp(loads) / np.ptp(indentation(kind, radius, modulus, loads))
        name = f"{kind} on the wall of a tube of {1e3 * radius:g} mm, "
        name += f"{1e-6 * modulus:g} MPa: stiffness"
        yield Check.deviation(name, slope, expected, SLOPE_BOUND, "N/m")
    name = "joint positions after a push, wall of 1,000 times the modulus to rigid wall"
    yield Check.at_most(name, stiffened(1000.0), 0.0, "rad")
    yield from motion.checks(tube(0.2, motion.RADIUS), phantoms.load("type1"))


def validate_vessel() -> Report:
    """Runs every check of the option `vessel`: flow, compliant and moving wall."""
    return Report("vessel", list(_checks()))
