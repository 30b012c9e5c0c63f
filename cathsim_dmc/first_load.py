"""Load of a task without collisions, which compiles all but the collider.

`compiled_ahead` runs this module in a second process.
"""

import contextlib
import sys
from pathlib import Path

import filelock
import numpy as np

from cathsim_dmc.compiled import compile_first


def load(task: str) -> None:
    """Loads a task without collisions, resets it and does a control step.

    For coaxial devices, `settle` takes as long to compile as the collider; this process
    compiles it first, and leaves what is called before it to the other process.

    Args:
        task: Name of a task whose devices stay in the lumen without collisions.
    """
    from cathsim_dmc import compiled_ahead, suite  # late: most second processes end
    from cathsim_dmc.collision import loops, moving, native
    from cathsim_dmc.physics import adapters

    compiled_ahead.enabled = False
    loops.of_link.left_out = moving.of_link.left_out = True
    made = suite.make_task(task)
    if made.scene.catheter.coaxial:
        native.Callback.left_out = True
        compile_first(adapters.settle)
    environment = suite.environment(made)
    environment.reset()
    environment.step(np.zeros(environment.action_spec().shape))


def main(task: str, folder: str) -> None:
    """Loads a task, unless another process does so for a folder of the cache."""
    lock = filelock.FileLock(Path(folder, "first_load.lock"), timeout=0)
    with contextlib.suppress(filelock.Timeout), lock:
        load(task)


if __name__ == "__main__":
    main(task=sys.argv[1], folder=sys.argv[2])
