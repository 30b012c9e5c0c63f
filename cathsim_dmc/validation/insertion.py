"""Scripted insertions, for convergence and force statistics."""

import dataclasses
import itertools
from typing import Any, NamedTuple

import numpy as np

from cathsim_dmc import suite
from cathsim_dmc.anatomy import Anatomy, Goal
from cathsim_dmc.simulation.episodes import ComposerSimulation, play
from cathsim_dmc.tasks.config import CONTROL_TIMESTEP

CURL_TIME = 2.0  # s


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

    def action(self, step: int, task: Any) -> np.ndarray:
        """Action (A,) of a control step of a task."""
        catheter, action = task.scene.catheter, np.zeros(task.num_actions)
        ramp = min(1.0, (step + 1) * CONTROL_TIMESTEP / CURL_TIME)
        motors = len(catheter.tip_motors)
        action[0:motors:2], action[1:motors:2] = ramp * np.array(self.curl)[:, None]
        action[list(catheter.translations)] = self.speed
        return action


# Over the arch along its wall, into the first branch, into the last one.
SCRIPTS = (
    Script("over the arch", 0.5, (0.3, 0.0), 8.0),
    Script("into the BCA", 0.5, (0.0, 0.0), 6.4),
    Script("into the LSA", 0.5, (-0.3, 0.0), 7.2),
)


class Insertion(NamedTuple):
    """Measurements of an insertion at T control steps."""

    head: np.ndarray  # (T, 3), m
    wall_force: np.ndarray  # (T,), sum of the magnitudes of all contacts, N
    peak: np.ndarray  # (T,), largest single contact of any physics step, N
    contact_forces: np.ndarray  # (K,), single contacts of all steps, N
    penetration: np.ndarray  # (T,), largest, m
    links: int  # of the device
    success: bool  # whether the goal was reached


def run(
    script: Script,
    *,
    seed: int = 0,
    anatomy: str | Anatomy = "type1",
    goal: str | Goal = "lcca",
    **options: Any,
) -> Insertion:
    """Runs a script until its end or that of the episode.

    Args:
        goal: it sets the stroke of the base.
        **options: further fields of `tasks.navigation.NavigationConfig`.

    Raises:
        RuntimeError: if the simulation diverges.
    """
    kwargs = {"random": seed, "anatomy": anatomy, "goal": goal, **options}
    environment = suite.load(suite.DOMAIN, "navigate", kwargs)
    task = environment.task
    steps = round(script.duration / CONTROL_TIMESTEP)
    actions = (script.action(step, task) for step in range(steps))
    turns = play(ComposerSimulation(environment), lambda timestep: next(actions))
    rows: list[tuple] = []
    single: list[np.ndarray] = []
    for _ in itertools.islice(turns, 1, None):
        if environment.physics.data.ptr.warning.number.any():
            raise RuntimeError(
                f"insertion {script.name!r} with {options} diverged at step {len(rows)}"
            )
        contacts = task.contacts(environment.physics)
        single.append(contacts.magnitude[contacts.present])
        rows.append(
            (
                task.readings.head,
                task.wall_force.sum,
                task.wall_force.peak_max,
                contacts.penetration.max(initial=0.0),
            )
        )
    head, wall_force, peak, penetration = map(np.array, zip(*rows, strict=True))
    environment.close()
    return Insertion(
        head,
        wall_force,
        peak,
        np.concatenate(single),
        penetration,
        len(task.scene.catheter.links),
        task.termination == "success",
    )
