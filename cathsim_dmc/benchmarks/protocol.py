"""The evaluation that every agent is judged by, whatever it was trained with."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from cathsim_dmc import suite
from cathsim_dmc.agents import evaluation
from cathsim_dmc.agents.policies import PolicyLike
from cathsim_dmc.agents.report import ContactLog
from cathsim_dmc.analysis.heatmap import AP_AXES, MARGIN, ForceMap, force_map
from cathsim_dmc.tasks.config import MAX_STEPS

# Options that say what the device, its surroundings and the observations are. All
# others (reward, goal radius, length of an episode, randomisation, starts) may differ
# in training and are the published ones in the evaluation.
_KEPT = frozenset(
    {
        "anatomy",
        "access",
        "goal",
        "device",
        "rotation",
        "friction",
        "shaft_link",
        "torsion_joints",
        "working_length",
        "physics_timestep",
        "fluoroscopy",
        "cameras",
    }
)


@dataclass(frozen=True)
class Judgement:
    """A published evaluation.

    Attributes:
        result: Episodes and their summary.
        contacts: Mean contact force per place; None where every episode has an
            anatomy of its own.
    """

    result: evaluation.EvaluationResult
    contacts: ForceMap | None


def published_options(task_kwargs: Mapping[str, Any]) -> dict[str, Any]:
    """Options of a task for the evaluation of what was trained with others.

    Args:
        task_kwargs: Options of the task in training.

    Returns:
        Those of them that hold for the evaluation too, and the published number of
        control steps. Reward and rule of success are the task's own.
    """
    kept = {name: value for name, value in task_kwargs.items() if name in _KEPT}
    return {**kept, "max_steps": MAX_STEPS}


def judge(
    policy: PolicyLike,
    task: str,
    *,
    observation: str | Sequence[str],
    task_kwargs: Mapping[str, Any],
    episodes: int,
    name: str,
    num_threads: int | None = None,
) -> Judgement:
    """Evaluate a policy over episodes with fixed seeds.

    Args:
        policy: Policy, or what names one, see `agents.load_policy`.
        task: Name of the task.
        observation: Name or names of the observations that it reads.
        task_kwargs: Options of the task, see `published_options`.
        episodes: Number of episodes.
        name: Name of the policy for the reports.
        num_threads: Number of threads of the simulation; None takes one per core.
    """
    log = ContactLog()
    result = evaluation.evaluate(
        policy,
        task,
        episodes,
        name=name,
        observation=observation,
        task_kwargs=task_kwargs,
        num_threads=num_threads,
        observer=log,
    )
    contacts = None
    if not suite.TASKS[task].random_arch:
        scene = suite.make_task(task, **task_kwargs).scene
        outline = scene.anatomy.surface.vertices[:, AP_AXES]
        low, high = outline.min(0) - MARGIN, outline.max(0) + MARGIN
        contacts = force_map(log.positions, log.magnitudes, low, high)
    return Judgement(result, contacts)
