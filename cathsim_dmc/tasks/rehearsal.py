"""Rehearsal: compiles loops when a task is loaded, not in its first episode.

numba compiles a loop at its first call. If a process has compiled one that was not
cached on disk, a copy of the simulations begins an episode and does a control step.
"""

from typing import Any

import numpy as np
from dm_control.composer.variation import Variation
from numpy.random import RandomState

from cathsim_dmc.tasks.config import NavigationConfig
from cathsim_dmc.tasks.rollout import Rollout


def is_due(config: NavigationConfig) -> bool:
    """Whether loops have been compiled; always False with objects of the user.

    Effects may share state with their copies. A Variation may have a state, such as the
    place in a sequence, which would otherwise depend on what has been compiled.
    """
    from cathsim_dmc import compiled_cache  # late, as numba takes long

    ranges = vars(config.randomisation).values()
    varied = any(isinstance(one, Variation) for one in ranges)
    return compiled_cache.has_compiled() and not config.effects and not varied


def rehearse(rollout: Rollout, stepper: Any, num_actions: int) -> None:
    """Begins an episode and does a control step in simulations that are then dropped.

    Args:
        rollout: Rollout of these simulations.
        stepper: Does their physics steps.
        num_actions: Entries of an action.
    """
    # With OpenGL started, the process could not be forked. Cameras compile nothing.
    rollout.views.leave_out_cameras()
    everyone = np.arange(stepper.num_simulations)
    # As composer does before the first episode: this process compiles the readings
    # while `first_load` compiles what follows.
    stepper.forward_unactuated(everyone)
    rollout.start(everyone)
    rollout.begin(everyone, [RandomState(0) for _ in everyone])
    stepper.forward_unactuated(everyone)
    rollout.start(everyone)
    rollout.command(np.zeros((len(everyone), num_actions)))
    stepper.run()
    rollout.finish(logs=False)  # errors of dropped simulations concern nobody
