"""The forces of a state as one readable object."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from cathsim_dmc.physics.forces import PEAK_NOTE
from cathsim_dmc.recording.recorder import begun_task_of

# Contacts below this, N, are left out: a table in mN would show them as 0.00. A link
# within 0.1 mm of the wall has a contact without force.
LEAST_FORCE = 5e-6


@dataclass(frozen=True, eq=False, repr=False)
class ForceReadout:
    """Contacts and forces at the end of a control step; newtons, world frame (LPS).

    Contacts, `wall_sum` and `wall_max` are those of the last physics step. Means are
    over the physics steps of the control step; peaks are the largest of any physics
    step, and depend on its length.

    Attributes:
        position: (K, 3) places of contact with the wall, m, where the force reaches
            `LEAST_FORCE`.
        force: (K, 3) force of the device on the wall.
        magnitude: (K,) its norm, normal force and friction together.
        penetration: (K,) depth of the device in the wall, m.
        wall_sum: Sum of the magnitudes.
        wall_max: Largest magnitude.
        wall_peak_sum: Largest sum within the control step.
        wall_peak_max: Largest magnitude within the control step.
        wall_mean_sum: Sum, mean over the control step.
        wall_mean_max: Largest magnitude, mean over the control step.
        push_force: Force at the base, positive when it pushes the device forward.
        push_torque: Torque of the base on the device about its axis, N·m.
        load_cell: (3,) force of the phantom on its support.
    """

    position: np.ndarray
    force: np.ndarray
    magnitude: np.ndarray
    penetration: np.ndarray
    wall_sum: float
    wall_max: float
    wall_peak_sum: float
    wall_peak_max: float
    wall_mean_sum: float
    wall_mean_max: float
    push_force: float
    push_torque: float
    load_cell: np.ndarray

    def __len__(self) -> int:
        """Number of contacts K."""
        return len(self.magnitude)

    def __repr__(self) -> str:
        """A table of the contacts and a line of the other forces."""
        shown = self.wall_sum, self.wall_max, self.wall_mean_sum, self.wall_mean_max
        shown += self.wall_peak_max, self.push_force
        total, largest, *means, peak, push = (f"{1e3 * one:.2f} mN" for one in shown)
        cell = ", ".join(f"{1e3 * force:.1f}" for force in self.load_cell)
        lines = [
            f"{len(self)} contact{'s' * (len(self) != 1)} with the wall: sum {total}, "
            f"largest {largest}",
            f"mean over the step: sum {means[0]}, largest {means[1]}; peak {peak}*",
            f"push {push}, load cell ({cell}) mN",
        ]
        if len(self):
            lines.append("     position, mm          force on the wall, mN")
        for place, force in zip(1e3 * self.position, 1e3 * self.force, strict=True):
            (x, y, z), (u, v, w) = place, force
            lines.append(f"  {x:6.1f} {y:6.1f} {z:6.1f}  {u:8.2f} {v:8.2f} {w:8.2f}")
        return "\n".join([*lines, f"* {PEAK_NOTE}"])


def forces(env: Any) -> ForceReadout:
    """Contacts and forces of an environment's present state.

    Args:
        env: What `cathsim_dmc.suite.load` returns, after a reset.

    Raises:
        TypeError: if it is no environment of this package.
        RuntimeError: if no episode has begun, or within a control step, whose sums and
            means are known at its end only.
    """
    task = begun_task_of(env)
    readings = task.readings  # measures the start, if nothing has done so
    if task.rollout.half_done.any():
        raise RuntimeError(
            "a control step has begun and not ended, so its forces are not known; call "
            "forces(env) after env.step(action). In a hook of composer, "
            "env.task.contacts(physics) has the contacts of the present physics step"
        )
    contacts = task.contacts(env.physics)
    there = contacts.present & (contacts.magnitude >= LEAST_FORCE)
    return ForceReadout(
        contacts.position[there],
        contacts.force[there],
        contacts.magnitude[there],
        contacts.penetration[there],
        *map(float, task.wall_force),
        push_force=float(readings.push_force),
        push_torque=float(readings.push_torque),
        load_cell=np.array(readings.load_cell),
    )
