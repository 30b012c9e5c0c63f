"""`cathsim export`."""

import difflib
from pathlib import Path
from typing import Annotated, Literal

from tyro import conf

# torchrl goes before dm_control.
from cathsim_dmc import agents  # isort: skip

from cathsim_dmc import bounds, suite
from cathsim_dmc.agents.onnx_export import write_onnx
from cathsim_dmc.cli.options import Modules
from cathsim_dmc.cli.task_options import TaskOptions, task_kind
from cathsim_dmc.policies import POLICIES
from cathsim_dmc.simulation.mjcf import write_mjcf
from cathsim_dmc.tasks.config import EVALUATION_SEED

_WHAT = (
    "Task of `cathsim list`, for its scene; or a policy, for its network: directory of "
    "a run or checkpoint, or pretrained:NAME."
)


def export(
    what: Annotated[str, conf.Positional, conf.arg(help=_WHAT)],
    /,
    out: Path,
    task: str | None = None,
    seed: int | None = None,
    wall: Literal["merged", "prisms", "coacd"] = "merged",
    modules: Modules = (),
    *,
    options: Annotated[TaskOptions, conf.arg(name="", constructor=task_kind())],
) -> int:
    """Write a task's scene as MJCF, or a trained policy as ONNX, for other programs.

    A policy (extra `onnx`) comes with a card and with a self-test that needs numpy and
    onnxruntime alone: python OUT/selftest.py (docs/robots.md).

    Args:
        out: Directory to write, which must not exist. Of a task: scene.xml with the
            start of an episode as a keyframe, and task.json; a compliant or moving wall
            is written as rigid and at rest. Of a policy: policy.onnx, card.json,
            selftest.npz and selftest.py.
        task: Task of the episode of a policy's self-test; by default the policy's.
        seed: Seed of the episode; by default 0, for a policy 1,000,000.
        wall: Pieces of a task's wall, see `cathsim phantom export --help`.
        options: Options of the task.
    """
    if what in suite.TASKS:
        if task is not None:
            raise ValueError(f"{what} is a task already; leave --task out")
        written = write_mjcf(
            what, out, seed=seed or 0, wall=wall, task_kwargs=options.given
        )
    else:
        if ":" not in what and what not in POLICIES and not Path(what).exists():
            like = ", ".join(difflib.get_close_matches(what, suite.TASKS, 3))
            bounds.refuse(
                "what",
                what,
                f"a task of `cathsim list`{like and ', such as '}{like}, the directory "
                f"of a run or checkpoint, or pretrained:NAME",
            )
        if wall != "merged":
            raise ValueError(f"the policy {what} has no wall; leave --wall out")
        seed = EVALUATION_SEED if seed is None else seed
        player = agents.load_policy(what, scripted=False)
        written = write_onnx(
            player, out, task=task, task_kwargs=options.given, seed=seed
        )
    print(written)
    return 0
