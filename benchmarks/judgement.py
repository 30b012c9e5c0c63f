"""The published evaluation of a trained policy, as JSON."""

import dataclasses
import subprocess
import time
from importlib.metadata import version
from pathlib import Path

# torchrl must be imported before dm_control.
from cathsim_dmc.agents.evaluation import EVALUATION_SEED, ContactLog, evaluate  # isort: skip

import numpy as np

from cathsim_dmc import suite
from cathsim_dmc.analysis.force_statistics import FIGURES
from cathsim_dmc.analysis.heatmap import AP_AXES, MARGIN, ForceMap, force_map
from cathsim_dmc.anatomy.arch.arch import arch_set, build_seed
from cathsim_dmc.tasks.config import MAX_STEPS
from cathsim_dmc.tasks.placement import sheath_direction

EPISODES = 30  # published
_DIGITS = 6  # significant digits of a number in a list
# Options of the device, its surroundings and the observations. All others (reward, goal
# radius, length of an episode, randomisation, starts) may differ in training; the
# evaluation uses the published ones.
_KEPT = frozenset(
    {
        *("anatomy", "access", "goal", "device", "rotation", "friction"),
        *("shaft_link", "working_length", "physics_timestep"),
        *("fluoroscopy", "vessel"),
    }
)
_EPISODE = ("reward", "length", "success", "physics_error", "path_ratio")
_PACKAGES = ("mujoco", "dm-control", "torch", "torchrl", "tensordict", "numpy", "scipy")


def published_options(task_kwargs):
    """Options of a task for the published evaluation, from those of a training.

    Reward and criterion of success are the task's, the number of steps is the published
    one.
    """
    kept = {name: value for name, value in task_kwargs.items() if name in _KEPT}
    return {**kept, "max_steps": MAX_STEPS}


def judge(policy, task, task_kwargs, episodes=EPISODES, name=None, num_threads=None):
    """Evaluate a policy; return the result and the map of its contact forces.

    The map is None if each episode has another anatomy.
    """
    log = ContactLog()
    found = evaluate(
        policy, task, episodes, name=name, task_kwargs=task_kwargs, observer=log,
        num_threads=num_threads,
    )  # fmt: skip
    if suite.TASKS[task].random_arch:
        return found, None
    surface = suite.make_task(task, **task_kwargs).scene.anatomy.surface
    outline = surface.vertices[:, AP_AXES]
    low, high = outline.min(0) - MARGIN, outline.max(0) + MARGIN
    return found, force_map(*log.contacts(), low, high)


def judge_each_arch(policy, task, task_kwargs, arches, name=None):
    """Evaluate a policy in every arch of a set, one episode each.

    Arches without room for a sheath at the inlet are left out.

    Args:
        policy: Policy, as in `evaluation.evaluate`.
        task: Name of a task with random arches.
        task_kwargs: Options of the task.
        arches: Name of the set, such as "test".
        name: Name of the policy for the reports.

    Returns:
        The result, and the kind of arch of each episode.
    """
    played, groups = [], []
    options = {**task_kwargs, "arches": arches, "pool": 1}
    for number, seed in enumerate(arch_set(arches)):
        anatomy = build_seed(seed, access=suite.TASKS[task].access)
        if sheath_direction(anatomy) is None:
            continue
        one = evaluate(
            policy,
            task,
            1,
            EVALUATION_SEED + number,
            name=name,
            task_kwargs={**options, "first": number},
            num_threads=1,
        )
        played.append(one)
        groups.append(f"type {seed.arch_type}")
    if not played:
        raise ValueError(f"no device can enter any of the arches {arches!r}")
    whole = dataclasses.replace(
        played[0],
        seeds=tuple(one.seeds[0] for one in played),
        episodes=tuple(one.episodes[0] for one in played),
        settings={**played[0].settings, "task_kwargs": options},
    )
    return whole, groups


def evaluation(policy, task, task_kwargs, arches, episodes, name, num_threads=None):
    """The evaluation of a policy as JSON values; in every arch of a set if given."""
    began, contacts, groups = time.monotonic(), None, None
    if arches is None:
        found, contacts = judge(policy, task, task_kwargs, episodes, name, num_threads)
    else:
        found, groups = judge_each_arch(policy, task, task_kwargs, arches, name)
    return {
        "task": found.task,
        "seed": found.seeds[0],
        "settings": dict(found.settings),
        "seconds": round(time.monotonic() - began, 1),
        "summary": found.summary(),
        "episodes": episode_figures(found),
        "groups": groups,
        "force_map": None if contacts is None else map_values(contacts),
    }


def episode_figures(found):
    """Measures of every episode of an `EvaluationResult`, in the order of the seeds."""
    names = {name: name for name in _EPISODE} | {f: f"forces.{f}" for f in FIGURES}
    return {
        name: numbers(
            None if np.isnan(v) else float(v) for v in found.values(attribute)
        )
        for name, attribute in names.items()
    }


def map_values(contacts):
    """A force map as JSON values: cells with contacts only, row by row from below."""
    index = np.flatnonzero(contacts.count)
    return {
        "x": [float(contacts.x_edges[0]), float(contacts.x_edges[-1])],
        "z": [float(contacts.z_edges[0]), float(contacts.z_edges[-1])],
        "shape": list(contacts.count.shape),
        "index": index.tolist(),
        "mean": numbers(map(float, contacts.mean.ravel()[index])),
        "count": contacts.count.ravel()[index].tolist(),
        "outside": contacts.outside,
    }


def map_from_values(values):
    """The inverse of `map_values`."""
    rows, columns = values["shape"]
    mean, count = np.full((rows, columns), np.nan), np.zeros((rows, columns), np.int64)
    mean.flat[values["index"]] = values["mean"]
    count.flat[values["index"]] = values["count"]
    return ForceMap(
        x_edges=np.linspace(*values["x"], columns + 1),
        z_edges=np.linspace(*values["z"], rows + 1),
        mean=mean,
        count=count,
        outside=values["outside"],
    )


def numbers(values):
    """Numbers rounded for a file; whole ones as integers."""
    return [
        v if v is None else int(v) if v == int(v) else float(f"{v:.{_DIGITS}g}")
        for v in values
    ]


def versions():
    """Versions of this package and of packages that results depend on."""
    return {name: version(name) for name in ("cathsim-dmc", *_PACKAGES)}


def commit():
    """Commit of the source tree, with "+" if files differ; None outside of git."""
    head = ["describe", "--always", "--abbrev=40", "--exclude=*", "--dirty=+"]
    git = ["git", "-C", str(Path(__file__).parent), *head]
    done = subprocess.run(git, capture_output=True, text=True, check=False)
    return done.stdout.strip() or None
