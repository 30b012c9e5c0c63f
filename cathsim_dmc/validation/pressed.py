"""Devices pressed on a wall and pushed along it: depth, forces, repeated steps."""

from collections.abc import Iterator

import mujoco
import numpy as np

from cathsim_dmc import suite
from cathsim_dmc.entities import contact
from cathsim_dmc.entities.chain import MAX_PUSH_FORCE, MAX_PUSH_SPEED
from cathsim_dmc.physics import forces
from cathsim_dmc.tasks.config import CONTROL_TIMESTEP
from cathsim_dmc.validation.checks import Check
from cathsim_dmc.validation.rig import bare, in_tube, slider

# N, on a mass of a gram, about the effective mass of a link of the pair at a contact.
LOADS = (0.01, 0.03, 0.1, 0.3, 1.0, 3.0, MAX_PUSH_FORCE)
_MASS = 1e-3  # kg
_SETTLING, _WATCHED = 1200, 300  # physics steps, before and during the measurement
RIPPLE = 1e-3  # mm, of the depth under a dead load
DEPTH = 0.3  # mm, 99th percentile, as in the soak test

# In a tube of 4 mm radius, a link of 7 mm jams across the lumen as the tip folds, and
# bears up to four times the push, because links are rigid.
JAM_TUBE = 0.275, 5e-3  # m, length and radius
_JAMMED = 2.0  # s, of pushing beyond the time for the full stroke
_END = 1.0  # s, last part, which is evaluated

# Devices pushed at full speed.
TASKS = ("type1_lcca", "femoral_type1_lcca_pair")
REPEATED = 0.5  # % of the control steps
DEEPEST = 0.6  # mm
HARDEST = 5.0  # N
_PUSHES = 200  # control steps of an episode, straight or with the tip curled
_CURLS = ((0.0, 0.0), (-0.17, 0.44))


def pressed(
    load: float,
    solref: tuple[float, ...] = contact.CONTACT_SOLREF,
    solimp: tuple[float, ...] = contact.CONTACT_SOLIMP,
) -> tuple[float, float]:
    """Presses a mass on a plane with a load, N, with integrator and step of the tasks.

    Returns:
        Mean depth, and its peak-to-peak range, m.
    """
    spec = bare()
    spec.option.cone = mujoco.mjtCone.mjCONE_PYRAMIDAL
    spec.option.gravity = (0.0, 0.0, -load / _MASS)
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=(1, 1, 1))
    ball = {"size": (1e-3, 0, 0), "mass": _MASS, "priority": 1}
    slider(spec, (0, 0, 1), (0, 0, 1e-3), **ball, solref=solref, solimp=solimp)
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, _SETTLING)
    depth = np.empty(_WATCHED)
    for step in range(_WATCHED):
        mujoco.mj_step(model, data)
        depth[step] = -data.qpos[0]
    return float(depth.mean()), float(np.ptp(depth))


def jam(pair: tuple[str, str]) -> tuple[float, float, float, float]:
    """Pushes guidewire and catheter into a dead end until their drives slip.

    Returns:
        Push force at the end, N; 99th percentile over physics steps of the deepest
        penetration, m; minimum and maximum of the largest contact force, N.
    """
    environment = in_tube(JAM_TUBE, devices=pair, random=1, observation="tracking")
    task = environment.task
    way = task.scene.catheter.stroke / (MAX_PUSH_SPEED * CONTROL_TIMESTEP)
    rows = []
    for _ in range(round(way + _JAMMED / CONTROL_TIMESTEP)):
        environment.step(np.array([1.0, 0.0, 1.0, 0.0]))
        contacts = forces.Contacts.from_sensor(task.stepper.contact_rows[0])
        both = contacts.penetration, contacts.magnitude
        rows.append([each.max(-1, initial=0.0) for each in both])
    push = float(task.readings.push_force)
    environment.close()
    depth, force = np.hstack(rows[-round(_END / CONTROL_TIMESTEP) :])
    deep = float(np.percentile(depth, 99))
    return push, deep, float(force.min()), float(force.max())


def checks(pair: tuple[str, str]) -> Iterator[Check]:
    """Checks of a pressed mass and of a jammed pair, guidewire and catheter by name."""
    depths, ripples = np.transpose([pressed(load) for load in LOADS])
    name = f"device pressed on a wall by {LOADS[0]:g} to {LOADS[-1]:g} N: "
    name += "ripple of the depth"
    note = f"depth {1e3 * depths[0]:.2f} to {1e3 * depths[-1]:.2f} mm"
    yield Check.at_most(name, 1e3 * ripples.max(), RIPPLE, "mm", note)
    push, deep, least, largest = jam(pair)
    name = "pair jammed in a dead end: 99th percentile of the penetration"
    note = f"pushed with {push:.1f} N, largest contact {least:.2f} to {largest:.2f} N"
    yield Check.at_most(name, 1e3 * deep, DEPTH, "mm", note)


def push_checks() -> Iterator[Check]:
    """Checks of full pushes of the devices of `TASKS`, tips straight and curled."""
    for task in TASKS:
        environment = suite.load(suite.DOMAIN, task, {"random": 0, "goal_radius": 1e-6})
        play = environment.task
        data, catheter = environment.physics.data.ptr, play.scene.catheter
        links, contacts, force, depth = 0, 0, 0.0, []
        for curl in _CURLS:
            environment.reset()
            wall = environment.physics.model.ptr.geom("wall").id
            action = np.zeros(environment.action_spec().shape)
            motors = len(catheter.tip_motors)
            action[:motors] = np.resize(curl, motors)
            action[list(catheter.translations)] = 1.0
            for _ in range(_PUSHES):
                environment.step(action)
                found = forces.Contacts.from_sensor(play.stepper.contact_rows[0])
                depth.append(found.penetration.max(-1, initial=0.0))
                force = max(force, float(found.magnitude.max(initial=0.0)))
                geoms = data.contact.geom
                geoms = geoms[(geoms == wall).any(axis=1)]
                contacts += len(geoms)
                links += len(np.unique(geoms)) - bool(len(geoms))
        again = 100 * float(play.stepper.repeated.sum()) / (len(_CURLS) * _PUSHES)
        environment.close()
        each = f"{contacts / max(links, 1):.2f} contacts for each link that has one"
        deep = 1e3 * np.concatenate(depth)
        usual = f"99th percentile {np.percentile(deep[deep > 0.0], 99):.3f} mm"
        name = f"{task}, full push: "
        yield Check.at_most(
            f"{name}control steps done again", again, REPEATED, "%", each
        )
        yield Check.at_most(
            f"{name}deepest penetration", deep.max(), DEEPEST, "mm", usual
        )
        yield Check.at_most(f"{name}largest contact", force, HARDEST, "N")
