"""The drive of the base under load: it holds, slips at a stated force, and is exact."""

from collections.abc import Iterator

import numpy as np

from cathsim_dmc.entities.chain import MAX_PUSH_FORCE, MAX_PUSH_SPEED
from cathsim_dmc.physics.drives import hold
from cathsim_dmc.physics.stepper import CONTROL_TIMESTEP
from cathsim_dmc.validation.checks import Check
from cathsim_dmc.validation.rig import Rig

JAM = 3.0  # N
HOLD_BOUND = 0.1  # mm in 10 s
SPEED_BOUND = 1.0  # % of the command
SLIP_BOUND = 2.0  # % of the stated force
_MIDDLE = 0.25  # m, of the stroke


class Driven:
    """A device on its drive, under an axial force at its base."""

    def __init__(self):
        self.rig = rig = Rig(stroke=2 * _MIDDLE)
        rig.compile()
        self._base = rig.model.body(f"{rig.name}/link_0").id
        self._motor = rig.data.actuator(f"{rig.name}/insertion")
        rig.data.joint(f"{rig.name}/insertion").qpos = _MIDDLE
        self.drives = hold(rig.model, rig.data)

    def move(self, duration: float, command: float, force: float) -> float:
        """Moves the base for a time (s), pushed back by a force (N); its way, m."""
        start = self.rig.qpos("insertion")
        for _ in range(round(duration / CONTROL_TIMESTEP)):
            self.drives.follow(np.array([[command]]))
            self._motor.ctrl[0] = command
            self.rig.data.xfrc_applied[self._base, 2] = -force
            self.rig.run(CONTROL_TIMESTEP)
        return self.rig.qpos("insertion") - start


def slip_force() -> float:
    """Least force (N) on a base at rest at which its clamp slips, to 0.5 %."""
    for force in MAX_PUSH_FORCE * np.arange(0.9, 1.1, 0.005):
        driven = Driven()
        driven.move(0.4, 0.0, 0.9 * force)
        driven.move(1.0, 0.0, force)
        if driven.drives.slipped[0, 0] > 0.0:
            return float(force)
    return np.inf


def checks() -> Iterator[Check]:
    """Holds, moves and slips under load."""
    driven = Driven()
    driven.move(0.4, 0.0, 0.0)
    held, name = (
        driven.move(10.0, 0.0, JAM),
        f"drive, command 0, {JAM:g} N for 10 s: way",
    )
    yield Check.at_most(name, 1e3 * abs(held), HOLD_BOUND, "mm")
    driven.move(0.4, 1.0, JAM)
    moved, name = driven.move(1.0, 1.0, JAM), f"drive, full speed against {JAM:g} N"
    yield Check.deviation(name, moved, MAX_PUSH_SPEED, SPEED_BOUND, "m/s")
    name = "drive, force at which the clamp slips"
    yield Check.deviation(name, slip_force(), MAX_PUSH_FORCE, SLIP_BOUND, "N")
