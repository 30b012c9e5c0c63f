"""Devices pushed at full speed: contacts, and control steps that are done again."""

from collections.abc import Iterator

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


def push(task: str) -> dict[str, float]:
    """Pushes the device of a task, its tip straight, then curled.

    Returns:
        "contacts" with the wall for each link that has one; share of the control steps
        that were done again ("repeated"); 99th percentile ("deep") and largest
        ("deepest") of the deepest contact of a physics step, m; largest "force" of a
        contact, N.
    """
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
    return {
        "contacts": contacts / max(links, 1),
        "repeated": float(repeated),
        "deep": float(np.percentile(deep, 99)),
        "deepest": float(deep.max()),
        "force": force,
    }


def checks(pushed: list[dict]) -> Iterator[Check]:
    """Pushes the devices of `TASKS`; what `push` finds is put into `pushed`."""
    for task in TASKS:
        one, name = push(task), f"{task}, full push"
        pushed.append({"task": task, **one})
        note = f"{one['contacts']:.2f} contacts for each link that has one"
        again = f"{name}: control steps done again"
        yield Check.at_most(again, 100 * one["repeated"], REPEATED, "%", note)
        deep, note = 1e3 * one["deepest"], f"99th percentile {1e3 * one['deep']:.3f} mm"
        yield Check.at_most(f"{name}: deepest penetration", deep, DEEPEST, "mm", note)
        yield Check.at_most(f"{name}: largest contact", one["force"], HARDEST, "N")
