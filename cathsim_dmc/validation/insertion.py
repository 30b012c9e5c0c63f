"""Scripted insertions in an arch, for convergence and for force statistics."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from cathsim_dmc import suite
from cathsim_dmc.tasks import objectives as objectives
from cathsim_dmc.tasks.config import CONTROL_TIMESTEP


@dataclasses.dataclass(frozen=True)
class Script:
    """An insertion that depends on nothing but the time.

    Attributes:
        name: where it leads in the type-I arch.
        speed: of the base, share of its full speed.
        curl: commands in [-1, 1] of all tip motors about x and about y, reached in
            `CURL_TIME`.
        duration: s.
    """

    name: str
    speed: float
    curl: tuple[float, float]
    duration: float

    def action(self, step: int, size: int) -> np.ndarray:
        """Action (size,) of a control step."""
        action = np.zeros(size)
        ramp = min(1.0, (step + 1) * CONTROL_TIMESTEP / CURL_TIME)
        action[0:20:2], action[1:20:2] = ramp * np.array(self.curl)[:, None]
        action[20] = self.speed
        return action


CURL_TIME = 2.0  # s
# Over the arch along its wall, into the first branch, into the last one.
SCRIPTS = (
    Script("over the arch", 0.5, (0.3, 0.0), 8.0),
    Script("into the BCA", 0.5, (0.0, 0.0), 6.4),
    Script("into the LSA", 0.5, (-0.3, 0.0), 7.2),
)


@dataclasses.dataclass(frozen=True)
class Insertion:
    """What an insertion measured at T control steps.

    Attributes:
        head: (T, 3), m.
        wall_force: (T,), sum of the magnitudes of all contacts, N.
        peak: (T,), largest single contact of any substep, N.
        resultant: (T,), magnitude of the force on the phantom's load cell, N.
        contact_forces: (K,), magnitudes of the single contacts of all steps, N.
        penetration: (T,), largest, m.
        links: number of links of the device.
        success: whether the goal was reached.
    """

    head: np.ndarray
    wall_force: np.ndarray
    peak: np.ndarray
    resultant: np.ndarray
    contact_forces: np.ndarray
    penetration: np.ndarray
    links: int
    success: bool


def run(
    script: Script,
    *,
    seed: int = 0,
    phantom: str = "type1",
    goal: str = "lcca",
    goal_radius: float = 1e-5,
    **options: Any,
) -> Insertion:
    """Runs a script.

    Args:
        script: what to do.
        seed: of the displaced start.
        phantom: name of an arch.
        goal: it sets the stroke of the base; reaching it ends the run.
        goal_radius: m; tiny by default, so that the script runs to its end.
        **options: further fields of `tasks.navigation.NavigationConfig`.

    Raises:
        RuntimeError: if the simulation diverges.
    """
    environment = suite.load(
        "cathsim",
        "navigate",
        task_kwargs={
            "random": seed,
            "anatomy": phantom,
            "goal": goal,
            "goal_radius": goal_radius,
            **options,
        },
    )
    task = environment.task
    environment.reset()
    rows: list[tuple] = []
    single: list[np.ndarray] = []
    size = len(task.scene.catheter.actuators)
    for step in range(round(script.duration / CONTROL_TIMESTEP)):
        timestep = environment.step(script.action(step, size))
        if environment.physics.data.ptr.warning.number.any():
            raise RuntimeError(
                f"insertion {script.name!r} with {options} diverged at step {step}"
            )
        contacts = task.contacts(environment.physics)
        single.append(contacts.magnitude[contacts.present])
        rows.append(
            (
                task.readings.head,
                task.wall_force.sum,
                task.wall_force.peak_max,
                np.linalg.norm(task.readings.load_cell),
                contacts.penetration.max(initial=0.0),
            )
        )
        if timestep.last():
            break
    head, wall_force, peak, resultant, penetration = map(
        np.array, zip(*rows, strict=True)
    )
    return Insertion(
        head=head,
        wall_force=wall_force,
        peak=peak,
        resultant=resultant,
        contact_forces=np.concatenate(single),
        penetration=penetration,
        links=len(task.scene.catheter.links),
        success=task.termination == "success",
    )
