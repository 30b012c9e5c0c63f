"""A second process that compiles for a first load, beside the process that loads.

Almost half of what a first load compiles is the collider. While this process compiles
it, the second one loads a task without collisions (`first_load`), which compiles the
rest. `compiled_cache` locks each function, so that only one process compiles it.
"""

import atexit
import contextlib
import os
import subprocess
import sys

enabled = True  # False in the second process
_expected: list[str] = []  # at most one
_started: list[subprocess.Popen] = []


def expect(task: str) -> None:
    """Sets the task that a second process loads if this one has to compile."""
    _expected[:] = [task]


def start(folder: str) -> None:
    """Starts the second process, once, if a task is expected and there is a core.

    Args:
        folder: Folder of the cache; of second processes with the same one, one loads.
    """
    alone = (os.cpu_count() or 1) < 2 or not sys.executable
    if alone or not enabled or not _expected or _started:
        return
    command = [sys.executable, "-m", "cathsim_dmc.first_load", *_expected, folder]
    path = os.pathsep.join(one for one in sys.path if isinstance(one, str))
    environment = {**os.environ, "PYTHONPATH": path}
    none = subprocess.DEVNULL
    with contextlib.suppress(OSError):  # this process compiles everything then
        process = subprocess.Popen(
            command, env=environment, stdin=none, stdout=none, stderr=none
        )
        _started.append(process)
        atexit.register(_end)


def _end() -> None:
    for process in _started:
        process.kill()
        process.wait()
