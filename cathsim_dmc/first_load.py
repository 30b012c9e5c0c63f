"""Load of a task without collisions, which compiles all but the collider.

`compiled_ahead` runs this module in a second process.
"""

import contextlib
import sys
from pathlib import Path

import filelock
import numpy as np


def load(task: str) -> None:
    """Loads a task without collisions, resets it and does a control step.

    Args:
        task: Name of a task whose devices stay in the lumen without collisions.
    """
    from cathsim_dmc import compiled_ahead, suite  # late: most second processes end
    from cathsim_dmc.collision import fields

    compiled_ahead.enabled = False
    fields.leave_out_collider()
    environment = suite.load("cathsim", task)
    environment.reset()
    environment.step(np.zeros(environment.action_spec().shape))


def main(task: str, folder: str) -> None:
    """Loads a task, unless another process does so for a folder of the cache."""
    lock = filelock.FileLock(Path(folder, "first_load.lock"), timeout=0)
    with contextlib.suppress(filelock.Timeout), lock:
        load(task)


if __name__ == "__main__":
    main(*sys.argv[1:])
