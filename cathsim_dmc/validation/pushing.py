"""Devices pushed at full speed: contacts, and control steps that are done again."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from cathsim_dmc import suite
from cathsim_dmc.physics import forces
from cathsim_dmc.validation.checks import Check

TASKS = ("type1_lcca", "femoral_type1_lcca_pair")
REPEATED = 0.5  # %, of the control steps
DEEPEST = 0.6  # mm
HARDEST = 5.0  # N
_STEPS = 200  # control steps of an episode, straight or with the tip curled
_CURLS = ((0.0, 0.0), (-0.17, 0.44))


class Push(NamedTuple):
    """A device pushed at full speed until it jams."""

    task: str
    contacts: float  # with the wall, for each link that has one
    repeated: float  # share of the control steps that were done again
    deep: float  # 99th percentile of the deepest contact of a physics step, m
    deepest: float  # m
    force: float  # largest single contact, N


def push(task: str) -> Push:
    """Pushes the device of a task, its tip straight, then curled."""
    environment = suite.load(suite.DOMAIN, task, {"random": 0, "goal_radius": 1e-6})
    play = environment.task
    data = environment.physics.data.ptr
    catheter = play.scene.catheter
    links, contacts, force, depth = 0, 0, 0.0, []
    for curl in _CURLS:
        environment.reset()
        wall = environment.physics.model.ptr.geom("wall").id
        action = np.zeros(environment.action_spec().shape)
        motors = len(catheter.tip_motors)
        action[:motors] = np.resize(curl, motors)
        action[list(catheter.translations)] = 1.0
        for _ in range(_STEPS):
            environment.step(action)
            found = forces.Contacts.from_sensor(play.contact_rows)
            depth.append(found.penetration.max(-1, initial=0.0))
            force = max(force, float(found.magnitude.max(initial=0.0)))
            geoms = data.contact.geom
            geoms = geoms[(geoms == wall).any(axis=1)]
            contacts += len(geoms)
            links += len(np.unique(geoms)) - bool(len(geoms))
    repeated = play.rollout.repeated.sum() / (len(_CURLS) * _STEPS)
    environment.close()
    deep = np.concatenate(depth)
    deep = deep[deep > 0.0]
    return Push(
        task,
        contacts / max(links, 1),
        float(repeated),
        float(np.percentile(deep, 99)),
        float(deep.max()),
        force,
    )


def checks() -> tuple[list[Check], list[Push]]:
    """Pushes the devices of `TASKS` and judges them."""
    pushed = [push(task) for task in TASKS]
    found = []
    for one in pushed:
        name = f"{one.task}, full push"
        found += [
            Check.at_most(
                f"{name}: control steps done again",
                100 * one.repeated,
                REPEATED,
                "%",
                f"{one.contacts:.2f} contacts for each link that has one",
            ),
            Check.at_most(
                f"{name}: deepest penetration",
                1e3 * one.deepest,
                DEEPEST,
                "mm",
                f"99th percentile {1e3 * one.deep:.3f} mm",
            ),
            Check.at_most(f"{name}: largest contact", one.force, HARDEST, "N"),
        ]
    return found, pushed
