"""Commands run even if `MUJOCO_GL` names an OpenGL library that is missing."""

import importlib
import os
import sys
import traceback
from types import ModuleType

from cathsim_dmc.cli.options import say

_BACK_ENDS = ("egl", "glfw", "osmesa")
_LOADERS = ("OpenGL.", "dm_control._render.", "glfw.", "mujoco.")


def import_command(module: str, arguments: list[str]) -> ModuleType:
    """Imports the module of a command; restarts the process if OpenGL fails to load.

    MuJoCo loads OpenGL at import, but commands draw with it only if a task observes
    `rgb` or `depth`, which is refused then. Modules that have been imported in part
    cannot be imported again, so the process starts anew without it.
    """
    try:
        return importlib.import_module(module)
    except Exception as error:  # PyOpenGL fails in many ways
        chosen = os.environ.get("MUJOCO_GL", "").lower().strip()
        if chosen not in _BACK_ENDS or not _of_opengl(error):
            raise
        say(
            f"cathsim: MUJOCO_GL={chosen}, but it cannot be loaded here "
            f"({type(error).__name__}: {error}); continuing with MUJOCO_GL=disable"
        )
        again = [sys.executable, "-m", "cathsim_dmc.cli", *arguments]
        os.execve(sys.executable, again, {**os.environ, "MUJOCO_GL": "disable"})


def _of_opengl(error: Exception) -> bool:
    frames = traceback.walk_tb(error.__traceback__)
    names = [str(frame.f_globals.get("__name__")) for frame, _ in frames]
    return any(f"{name}.".startswith(_LOADERS) for name in names)
