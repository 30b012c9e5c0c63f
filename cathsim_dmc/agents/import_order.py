"""Refuses an order of imports that crashes the interpreter.

With MUJOCO_GL=egl or osmesa, loading dm_control before torchrl ends in a segmentation
fault inside triton. The other order is safe, and so is any order without OpenGL.
"""

import os
import sys

if (
    os.environ.get("MUJOCO_GL") in ("egl", "osmesa")
    and "dm_control.mujoco" in sys.modules
    and "torchrl" not in sys.modules
):
    raise ImportError(
        f"MUJOCO_GL={os.environ['MUJOCO_GL']} and dm_control was imported before "
        "torchrl, which crashes; import torchrl or cathsim_dmc.agents first, or set "
        "MUJOCO_GL=disable"
    )
