"""Load of a task without collisions, which compiles all but the collider.

`compiled_ahead` runs this module in a second process.
"""

import sys

import numpy as np

from cathsim_dmc import compiled_ahead, suite
from cathsim_dmc.collision import fields


def load(task: str) -> None:
    """Loads a task without collisions, resets it and does a control step.

    Args:
        task: Name of a task whose devices stay in the lumen without collisions.
    """
    compiled_ahead.enabled = False
    fields.leave_out_collider()
    environment = suite.load("cathsim", task)
    environment.reset()
    environment.step(np.zeros(environment.action_spec().shape))


if __name__ == "__main__":
    load(sys.argv[1])
