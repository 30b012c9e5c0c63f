"""The evaluation that every agent is judged by, whatever it was trained with."""

import dataclasses
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from cathsim_dmc import suite
from cathsim_dmc.agents import evaluation
from cathsim_dmc.agents.checkpoint import Checkpoint
from cathsim_dmc.agents.policies import TrainedPolicy
from cathsim_dmc.agents.report import ContactLog
from cathsim_dmc.analysis.heatmap import AP_AXES, MARGIN, ForceMap, force_map
from cathsim_dmc.anatomy.arch.arch import arch_set, build_seed
from cathsim_dmc.benchmarks.grid import EPISODES, Cell
from cathsim_dmc.tasks.config import MAX_STEPS
from cathsim_dmc.tasks.placement import sheath_direction

# Options that say what the device, its surroundings and the observations are. All
# others (reward, goal radius, length of an episode, randomisation, starts) may differ
# in training and are the published ones in the evaluation.
_KEPT = frozenset(
    {
        *("anatomy", "access", "goal", "device", "rotation", "friction"),
        *("shaft_link", "torsion_joints", "working_length", "physics_timestep"),
        *("fluoroscopy", "cameras"),
    }
)


@dataclass(frozen=True)
class Judgement:
    """A published evaluation.

    Attributes:
        result: Episodes and their summary.
        contacts: Mean contact force per place; None where every episode has an
            anatomy of its own.
        groups: Kind of arch of each episode; None where all have the same anatomy.
    """

    result: evaluation.EvaluationResult
    contacts: ForceMap | None = None
    groups: tuple[str, ...] | None = None


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


def judge_cell(cell: Cell, checkpoint: Checkpoint) -> Judgement:
    """Evaluate the policy of a cell as its row says."""
    task = cell.evaluation.get("task", cell.task)
    options = published_options(checkpoint.config.task_kwargs)
    options |= cell.evaluation.get("task_kwargs", {})
    arches = cell.evaluation.get("each_arch")
    if arches is not None:
        return judge_each_arch(checkpoint, task, arches, options, cell.name)
    episodes = cell.evaluation.get("episodes", EPISODES)
    return judge(checkpoint, task, options, episodes, cell.name)


def judge(
    checkpoint: Checkpoint,
    task: str,
    task_kwargs: Mapping[str, Any],
    episodes: int,
    name: str,
    num_threads: int | None = None,
) -> Judgement:
    """Evaluate a policy over episodes with fixed seeds.

    Args:
        checkpoint: Checkpoint of the policy.
        task: Name of the task.
        task_kwargs: Options of the task, see `published_options`.
        episodes: Number of episodes.
        name: Name of the policy for the reports.
        num_threads: Number of threads of the simulation; None takes one per core.
    """
    log = ContactLog()
    result = evaluation.evaluate(
        checkpoint,
        task,
        episodes,
        name=name,
        task_kwargs=task_kwargs,
        num_threads=num_threads,
        observer=log,
    )
    if suite.TASKS[task].random_arch:
        return Judgement(result)
    scene = suite.make_task(task, **task_kwargs).scene
    outline = scene.anatomy.surface.vertices[:, AP_AXES]
    low, high = outline.min(0) - MARGIN, outline.max(0) + MARGIN
    return Judgement(result, force_map(log.positions, log.magnitudes, low, high))


def judge_each_arch(
    checkpoint: Checkpoint,
    task: str,
    arches: str,
    task_kwargs: Mapping[str, Any],
    name: str,
    numbers: Iterable[int] | None = None,
) -> Judgement:
    """Evaluate a policy in every arch of a set, one episode each.

    Arches before whose inlet no sheath fits are passed over.

    Args:
        checkpoint: Checkpoint of the policy.
        task: Name of a task with random arches.
        arches: Name of the set, such as "test".
        task_kwargs: Options of the task, see `published_options`.
        name: Name of the policy for the reports.
        numbers: Numbers of the arches in the set; None for all.

    Raises:
        ValueError: the task has no random arches, there is no such set, or none of
            its arches can be entered.
    """
    definition = suite.TASKS[task]
    if not definition.random_arch:
        raise ValueError(f"{task} has one anatomy; give a task with random arches")
    seeds, player = arch_set(arches), TrainedPolicy(checkpoint)
    played: list[evaluation.EvaluationResult] = []
    groups: list[str] = []
    for number in range(len(seeds)) if numbers is None else numbers:
        anatomy = build_seed(seeds[number], access=definition.access)
        if sheath_direction(anatomy) is None:
            continue
        one = evaluation.evaluate(
            player,
            task,
            1,
            evaluation.EVALUATION_SEED + number,
            name=name,
            task_kwargs={**task_kwargs, "arches": arches, "pool": 1, "first": number},
            num_threads=1,
        )
        played.append(one)
        groups.append(f"type {seeds[number].arch_type}")
    if not played:
        raise ValueError(f"no device can enter any of the arches {arches!r}")
    options = {**task_kwargs, "arches": arches, "pool": 1}
    whole = dataclasses.replace(
        played[0],
        episodes=tuple(one.episodes[0] for one in played),
        settings={**played[0].settings, "task_kwargs": options},
    )
    return Judgement(whole, groups=tuple(groups))
