"""Speed, acceleration and overshoot of the drives when the command changes."""

import itertools
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from cathsim_dmc.entities import chain
from cathsim_dmc.physics.stepper import CONTROL_TIMESTEP
from cathsim_dmc.validation.checks import Check
from cathsim_dmc.validation.rig import Rig

SPEED_BOUND, ACCELERATION_BOUND = 1.1, 1.0  # of the limits `LARGEST`
OVERSHOOT_BOUND = {"insertion": 0.05e-3, "rotation": 1e-3}  # m, rad
LOADS = (0.0, 2.0)  # N on the base, against the insertion
# Limits of speed and acceleration of the platforms.
LARGEST = {
    "insertion": (chain.MAX_PUSH_SPEED, chain.MAX_PUSH_ACCELERATION),
    "rotation": (chain.MAX_ROTATION_SPEED, chain.MAX_ROTATION_ACCELERATION),
}
COMMANDS = (0.0, 1.0, 0.0, -1.0, 1.0, 0.0, 0.25, 0.0)
_WHILE = 0.4  # s, duration of each command
_MIDDLE = 0.25  # m, middle of the stroke


class Ride(NamedTuple):
    """Response of a platform to changes of its command."""

    speed: float  # largest speed, relative to the limit
    acceleration: float  # largest mean over a physics step, relative to the limit
    overshoot: float  # past the place at which it stops, m or rad


def ride(joint: str, load: float = 0.0) -> Ride:
    """Starts, stops and reverses a platform.

    Args:
        joint: "insertion" or "rotation".
        load: Axial force against the insertion, N.
    """
    rig = Rig(stroke=2 * _MIDDLE, rotation=True)
    rig.compile()
    rig.hold(_MIDDLE)
    base = rig.model.body(f"{rig.name}/link_0").id
    rig.data.xfrc_applied[base, 2] = -load
    which = ("insertion", "rotation").index(joint)
    dof = rig.model.joint(f"{rig.name}/{joint}").dofadr[0]

    def run(value: float) -> np.ndarray:
        """Positions and speeds (2, T) at the physics steps of a command."""
        rows, command = [], [0.0, 0.0]
        command[which] = value
        for _ in range(round(_WHILE / CONTROL_TIMESTEP)):
            rig.drive(command)
            for _ in range(round(CONTROL_TIMESTEP / rig.model.opt.timestep)):
                rig.step()
                rows.append((rig.qpos(joint), rig.data.qvel[dof]))
        return np.array(rows).T

    run(0.0)
    runs, overshoot = [run(0.0)], 0.0
    for before, value in itertools.pairwise(COMMANDS):
        runs.append(run(value))
        if value == 0.0:
            places = np.sign(before) * runs[-1][0]
            overshoot = max(overshoot, float(places.max() - places[-1]))
    speed = np.hstack(runs)[1]
    steepest = np.abs(np.diff(speed)).max() / rig.model.opt.timestep
    fastest, limit = LARGEST[joint]
    return Ride(
        float(np.abs(speed).max() / fastest), float(steepest / limit), overshoot
    )


def checks() -> Iterator[Check]:
    """Checks of both platforms, and of the insertion under a load."""
    rides = [("insertion", load) for load in LOADS] + [("rotation", 0.0)]
    for joint, load in rides:
        one = ride(joint, load)
        name = f"drive of the {joint}" + (f" against {load:g} N" if load else "")
        name += ", starts, stops and reversals: "
        unit, scale = ("mm", 1e3) if joint == "insertion" else ("rad", 1.0)
        over, bound = scale * one.overshoot, scale * OVERSHOOT_BOUND[joint]
        yield Check.at_most(f"{name}speed over the largest", one.speed, SPEED_BOUND)
        what, most = f"{name}acceleration over the largest", ACCELERATION_BOUND
        yield Check.at_most(what, one.acceleration, most)
        yield Check.at_most(f"{name}overshoot", over, bound, unit)
