"""Rehearsal: loops are compiled when a task is loaded, not in its first episode.

Loops are compiled when they are first called. Where a process finds some that are not
kept on disk, an episode begins, and does a control step, in a copy of the simulations.
"""

from typing import Any

import numpy as np
from numpy.random import RandomState

from cathsim_dmc.tasks.config import NavigationConfig
from cathsim_dmc.tasks.rollout import Rollout


def is_due(config: NavigationConfig) -> bool:
    """Whether loops have been compiled; never with effects of one's own.

    Those may share what they hold with their copies.
    """
    from cathsim_dmc import compiled_cache  # late, as numba takes long

    return compiled_cache.has_compiled() and not config.effects


def rehearse(rollout: Rollout, stepper: Any, num_actions: int) -> None:
    """Begins an episode, and does a control step, of simulations that nobody has.

    Args:
        rollout: Their course.
        stepper: Does their physics steps.
        num_actions: Entries of an action.
    """
    everyone = np.arange(stepper.num_simulations)
    rollout.begin(everyone, [RandomState(0) for _ in everyone])
    stepper.forward_unactuated(everyone)
    rollout.start(everyone)
    rollout.command(np.zeros((len(everyone), num_actions)))
    stepper.run()
    rollout.finish(logs=False)  # nobody has these simulations
