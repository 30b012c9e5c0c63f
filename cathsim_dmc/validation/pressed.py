"""Devices pressed on a wall: whether the contact law keeps them at rest."""

from __future__ import annotations

from typing import NamedTuple

import mujoco
import numpy as np

from cathsim_dmc import suite
from cathsim_dmc.entities import contact
from cathsim_dmc.entities.chain import MAX_PUSH_FORCE, MAX_PUSH_SPEED
from cathsim_dmc.physics import forces
from cathsim_dmc.tasks.config import CONTROL_TIMESTEP, PHYSICS_TIMESTEP
from cathsim_dmc.validation.checks import Check
from cathsim_dmc.validation.sliding import tube

# N, on a gram: about what a link of the pair weighs as a contact feels it.
LOADS = (0.01, 0.03, 0.1, 0.3, 1.0, 3.0, MAX_PUSH_FORCE)
_MASS = 1e-3  # kg
_SETTLING, _WATCHED = 1200, 300  # physics steps
RIPPLE = 1e-3  # mm, of the depth under a dead load
DEPTH = 0.3  # mm, 99th percentile; as in the soak

# Radius of the tube, m. In one of 4 mm, a link of 7 mm wedges across the lumen as the
# tip folds, and bears up to four times the push, because links do not bend.
JAM_RADIUS = 5e-3
_JAMMED = 2.0  # s, of pushing with the stroke used up
_END = 1.0  # s, of it that counts


class Pressed(NamedTuple):
    """A mass under a dead load on a plane."""

    load: float  # N
    depth: float  # mean, m
    ripple: float  # largest depth less the smallest, m


def pressed(
    load: float,
    solref: tuple[float, ...] = contact.CONTACT_SOLREF,
    solimp: tuple[float, ...] = contact.CONTACT_SOLIMP,
) -> Pressed:
    """Presses a mass on a plane, by the integrator and time step of the tasks.

    Args:
        load: N.
        solref: of the contact, MuJoCo's.
    """
    spec = mujoco.MjSpec()
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_DISCRETE
    spec.option.timestep = PHYSICS_TIMESTEP
    spec.option.gravity = (0.0, 0.0, -load / _MASS)
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=(1, 1, 1))
    body = spec.worldbody.add_body(pos=(0, 0, 1e-3))
    body.add_joint(type=mujoco.mjtJoint.mjJNT_SLIDE, axis=(0, 0, 1))
    body.add_geom(
        size=(1e-3, 0, 0), mass=_MASS, priority=1, solref=solref, solimp=solimp
    )
    model = spec.compile()
    data = mujoco.MjData(model)
    depth = np.empty(_WATCHED)
    for _ in range(_SETTLING):
        mujoco.mj_step(model, data)
    for step in range(_WATCHED):
        mujoco.mj_step(model, data)
        depth[step] = -data.qpos[0]
    return Pressed(load, float(depth.mean()), float(np.ptp(depth)))


class Jam(NamedTuple):
    """A pair pushed into the dead end of a tube until its drive gives way."""

    push_force: float  # at the end, N
    penetration: float  # 99th percentile of the deepest contact of a physics step, m
    forces: tuple[float, float]  # least and largest of the largest contact, N


def jam(pair: tuple[str, str]) -> Jam:
    """Pushes both devices at full speed to the end of their stroke, and on.

    Args:
        pair: Names of guidewire and catheter.
    """
    environment = suite.load(
        suite.DOMAIN,
        "navigate",
        {
            "anatomy": tube(bent=False, radius=JAM_RADIUS),
            "goal": "end",
            "goal_radius": 1e-6,
            "devices": pair,
            "random": 1,
            "observation": "tracking",
        },
    )
    environment.reset()
    task = environment.task
    way = task.scene.catheter.stroke / (MAX_PUSH_SPEED * CONTROL_TIMESTEP)
    count = round(way + _JAMMED / CONTROL_TIMESTEP)
    depth, force = [], []
    for _ in range(count):
        environment.step(np.array([1.0, 0.0, 1.0, 0.0]))
        contacts = forces.Contacts.from_sensor(task.contact_rows)
        depth.append(contacts.penetration.max(-1, initial=0.0))
        force.append(contacts.magnitude.max(-1, initial=0.0))
    last = round(_END / CONTROL_TIMESTEP)
    force = np.concatenate(force[-last:])
    found = Jam(
        float(task.readings.push_force),
        float(np.percentile(np.concatenate(depth[-last:]), 99)),
        (float(force.min()), float(force.max())),
    )
    environment.close()
    return found


def checks(pair: tuple[str, str]) -> list[Check]:
    """Presses a mass and jams a pair, and judges both.

    Args:
        pair: Names of guidewire and catheter.
    """
    masses = [pressed(load) for load in LOADS]
    worst = max(masses, key=lambda one: one.ripple)
    jammed = jam(pair)
    least, largest = jammed.forces
    return [
        Check.at_most(
            f"pressed by {LOADS[0]:g} to {LOADS[-1]:g} N: ripple of the depth",
            1e3 * worst.ripple,
            RIPPLE,
            "mm",
            f"depth {1e3 * masses[0].depth:.2f} to {1e3 * masses[-1].depth:.2f} mm",
        ),
        Check.at_most(
            "pair jammed in a dead end: 99th percentile of the penetration",
            1e3 * jammed.penetration,
            DEPTH,
            "mm",
            f"pushed with {jammed.push_force:.1f} N, largest contact "
            f"{least:.2f} to {largest:.2f} N",
        ),
    ]
