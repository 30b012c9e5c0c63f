"""Scripted insertions, for convergence and force statistics."""

import dataclasses
import itertools
from typing import Any

import numpy as np

from cathsim_dmc import suite
from cathsim_dmc.anatomy import Anatomy, Goal
from cathsim_dmc.recording.episode import Episode
from cathsim_dmc.recording.recorder import EpisodeRecorder
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


def run(
    script: Script,
    *,
    seed: int = 0,
    anatomy: str | Anatomy = "type1",
    goal: str | Goal = "lcca",
    **options: Any,
) -> Episode:
    """Runs a script until its end or that of the episode.

    Args:
        goal: it sets the stroke of the base.
        **options: further fields of `tasks.navigation.NavigationConfig`.

    Raises:
        RuntimeError: if the simulation diverges.
    """
    kwargs = {"random": seed, "anatomy": anatomy, "goal": goal, **options}
    environment = suite.load(suite.DOMAIN, "navigate", kwargs)
    steps, duration = itertools.count(), round(script.duration / CONTROL_TIMESTEP)
    episode = EpisodeRecorder(environment).record_episode(
        lambda _: script.action(next(steps), environment.task), max_steps=duration
    )
    environment.close()
    if "error" in episode.meta:
        raise RuntimeError(
            f"insertion {script.name!r} with {options} diverged at step {episode.steps}"
        )
    return episode
