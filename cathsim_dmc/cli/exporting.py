"""`cathsim export`."""

from pathlib import Path
from typing import Annotated, Literal

from tyro import conf

from cathsim_dmc.cli.options import Task
from cathsim_dmc.cli.task_options import TaskOptions, task_kind
from cathsim_dmc.simulation.mjcf import write_mjcf


def export(
    task: Task,
    /,
    out: Path,
    seed: int = 0,
    wall: Literal["merged", "prisms", "coacd"] = "merged",
    *,
    options: Annotated[TaskOptions, conf.arg(name="", constructor=task_kind())],
) -> int:
    """Write the scene of a task as MJCF with convex wall pieces, for other programs.

    Args:
        out: Directory to write, which must not exist: scene.xml with the start of an
            episode as a keyframe, and task.json.
        seed: Seed of the episode.
        wall: Pieces of the wall, see `cathsim phantom export --help`.
        options: Options of the task.
    """
    print(write_mjcf(task, out, seed=seed, wall=wall, task_kwargs=options.given))
    return 0
