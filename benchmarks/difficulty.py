"""Difficulty of the registered tasks: success of policies without learning.

    python benchmarks/difficulty.py --out runs/difficulty.json
    python benchmarks/difficulty.py --task type1_bca --policy push --seeds 5 --json

Four policies play the same seeds of every task: a straight push, random actions, a
push with a random fixed curl of the tip, and the scripted expert. A task that a
straight push solves measures nothing but force; one that the expert cannot solve may
be unsolvable. Push and curls are cut off when the device is stuck (2 s without 0.5 mm
of insertion), and like random actions after 500 control steps.
"""

import collections
import dataclasses
import functools
import json as json_
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from cathsim_dmc import files, policies, suite
from cathsim_dmc.analysis.force_statistics import EpisodeForces, ForceTracker
from cathsim_dmc.analysis.intervals import success_interval
from cathsim_dmc.cli.options import BAD_INPUT, say, show
from cathsim_dmc.simulation import episodes
from cathsim_dmc.simulation.batch import BatchSimulation
from cathsim_dmc.tasks.config import EVALUATION_SEED
from cathsim_dmc.tasks.step import Step
from cathsim_dmc.validation.checks import Check, Report

# How an episode can end.
SUCCESS, TIME, CUT = "success", "out of time", "cut"
STUCK, ERROR = "stuck", "physics error"
ENDS = (SUCCESS, TIME, CUT, STUCK, ERROR)

# Least success of the expert, and largest success of a straight push on tasks that
# require steering, %.
LEAST_EXPERT = 95.0
MOST_PUSH = 10.0


@dataclasses.dataclass(frozen=True)
class Limit:
    """Limits at which an episode without progress is cut off; None for no limit.

    Attributes:
        steps: Control steps after which the episode ends.
        stuck_steps: Control steps without growth of the insertion after which it ends.
        growth: Least growth of the insertion, m, of a device that still slides.
    """

    steps: int | None = None
    stuck_steps: int | None = None
    growth: float = 0.5e-3


# A device that a constant command has not moved for 2 s is at rest. Random actions keep
# the device within a few centimetres of its start.
_BLIND = Limit(steps=500, stuck_steps=50)
LIMITS: Mapping[str, Limit] = {
    "push": _BLIND,
    "random": Limit(steps=500),
    "random_curl": _BLIND,
    "expert": Limit(),
}


@dataclasses.dataclass(frozen=True)
class Trial:
    """Episodes of one policy on one task, in the order of their seeds.

    Attributes:
        ends: End of each episode, one of `ENDS`.
        steps: Number of control steps of each episode.
        forces: Wall forces of each episode.
    """

    ends: tuple[str, ...]
    steps: tuple[int, ...]
    forces: tuple[EpisodeForces, ...]

    @property
    def successes(self) -> int:
        """Number of episodes that reached the goal."""
        return self.ends.count(SUCCESS)

    def summary(self) -> dict[str, Any]:
        """Statistics over the episodes, as JSON values.

        Forces in N, see `EpisodeForces`: "mean_force", "max_force" and "peak_force" are
        averaged over the episodes, "largest_force" is the largest "max_force" of all.
        """
        count = len(self.ends)
        names = ("mean_force", "max_force", "peak_force")
        figures = {name: [getattr(one, name) for one in self.forces] for name in names}
        low, high = success_interval(self.successes, count)
        return {
            "episodes": count,
            "successes": self.successes,
            "success": self.successes / count,
            "success_ci95": [low, high],
            "ends": dict(collections.Counter(self.ends)),
            "steps": float(np.mean(self.steps)),
            **{name: float(np.mean(values)) for name, values in figures.items()},
            "largest_force": float(np.max(figures["max_force"])),
        }


class _Slides:
    """Control steps since the devices of N simulations last advanced."""

    def __init__(self, insertion: np.ndarray, growth: float):
        self._best = insertion.copy()
        self._growth = growth
        self.steps = np.zeros(len(insertion), dtype=int)

    def add(self, insertion: np.ndarray) -> None:
        grown = insertion > self._best + self._growth
        self._best = np.where(grown, insertion, self._best)
        self.steps = np.where(grown, 0, self.steps + 1)


def play(
    simulation: BatchSimulation,
    policy: policies.Policy,
    seed: int,
    limit: Limit | None = None,
) -> Trial:
    """Plays one episode in each simulation of a batch.

    Args:
        simulation: Simulations, which are seeded and reset.
        policy: Policy that plays all simulations.
        seed: Seed of the first simulation; the others count up.
        limit: Limits of the episodes; None if only the task ends them.
    """
    limit = limit or Limit()
    count = simulation.num_simulations
    simulation.seed(seed)
    view = policies.View(simulation)
    tracker, slides = ForceTracker(count), None
    ends: dict[int, str] = {}
    lengths, forces = [0] * count, {}
    begin = functools.partial(policy.reset, view)
    turns = episodes.play(simulation, policy.act, begin)
    for number, (action, step, running) in enumerate(turns):
        if action is None:
            slides = _Slides(step.readings.insertion, limit.growth)
            continue
        tracker.add(step.wall_force, step.physics_error)
        slides.add(step.readings.insertion)
        for index, end in _ends(step, number, slides.steps, limit).items():
            if running[index]:
                ends[index], lengths[index] = end, number
                forces[index] = tracker.finish(index)
                running[index] = False
    everyone = range(count)
    return Trial(
        tuple(ends[i] for i in everyone),
        tuple(lengths),
        tuple(forces[i] for i in everyone),
    )


def _ends(step: Step, number: int, resting: np.ndarray, limit: Limit) -> dict[int, str]:
    """Ends of the episodes that end with this control step, by simulation."""
    found = {}
    for index in range(len(step.terminated)):
        if step.outcome.success[index]:
            found[index] = SUCCESS
        elif step.errors[index] is not None:
            found[index] = ERROR
        elif step.truncated[index]:
            found[index] = TIME
        elif limit.stuck_steps is not None and resting[index] >= limit.stuck_steps:
            found[index] = STUCK
        elif limit.steps is not None and number >= limit.steps:
            found[index] = CUT
    return found


def playable() -> tuple[str, ...]:
    """Names of the registered tasks with an anatomy and a goal."""
    return tuple(
        name
        for name, definition in suite.TASKS.items()
        if definition.anatomy is not None or definition.random_arch
    )


def tasks() -> tuple[str, ...]:
    """Tasks that are played by default; those of coaxial devices only when named."""
    return tuple(
        name for name in playable() if "devices" not in suite.TASKS[name].options
    )


# Femoral tasks whose goal a straight device enters: the LSA of the measured phantoms
# leaves the outer curve of the arch, along which the device slides. This holds for all
# positions of the sheath in the descending aorta and tilts up to 20 degrees
# (docs/difficulty.md).
FIRST_ON_THE_WAY = ("femoral_type1_lsa", "femoral_type2_lsa")


def asks_for_steering(task: str) -> bool:
    """Whether a straight push must not solve a registered task.

    It may if the goal is the first branch on the path of a straight device: the BCA,
    which continues the ascending aorta, and `FIRST_ON_THE_WAY`. In these tasks the
    force distinguishes a good cannulation from a bad one.
    """
    definition = suite.TASKS[task]
    if task in FIRST_ON_THE_WAY:
        return False
    return definition.access == "descending" or definition.goal == "lcca"


def difficulty(
    names: Sequence[str] | None = None,
    seeds: int = 30,
    first_seed: int = 0,
    *,
    players: Sequence[str] | None = None,
    num_threads: int = 0,
    say: Callable[[str], None] = lambda text: None,
    keep: Callable[[Report], None] = lambda report: None,
) -> Report:
    """Plays the policies of `LIMITS` on tasks and judges the tasks.

    Args:
        names: Names out of `playable()`; None for those of `tasks()`.
        seeds: Number of episodes of each policy on each task.
        first_seed: Seed of the first episode; the others count up.
        players: Names of policies in `LIMITS`; None for all.
        num_threads: Number of threads of the simulation, 0 for one per core.
        say: Called with lines on the progress.
        keep: Called with the report so far after every task.

    Raises:
        ValueError: if a task or policy is unknown or named twice, or seeds < 1.
    """
    names = tasks() if names is None else tuple(names)
    players = tuple(LIMITS) if players is None else tuple(players)
    _refuse("tasks", names, playable())
    _refuse("policies", players, tuple(LIMITS))
    if seeds < 1:
        raise ValueError(f"seeds is {seeds}; at least 1")
    checks: list[Check] = []
    found: dict[str, dict[str, Any]] = {}

    def report() -> Report:
        return Report(
            "difficulty of the tasks",
            tuple(checks),
            {
                "seeds": seeds,
                "first_seed": first_seed,
                "limits": {key: dataclasses.asdict(x) for key, x in LIMITS.items()},
                "tasks": dict(found),
            },
        )

    for name in names:
        trials = _trials(name, players, seeds, first_seed, num_threads, say)
        found[name] = {policy: trial.summary() for policy, trial in trials.items()}
        checks += _checks(name, trials)
        keep(report())
    return report()


def _refuse(what: str, given: Sequence[str], known: Sequence[str]) -> None:
    """Raises ValueError for names that would fail after hours of work."""
    if not given or set(given) - set(known) or len(set(given)) < len(given):
        raise ValueError(
            f"{what} are {list(given)}; give each once, out of {', '.join(known)}"
        )


def _trials(
    name: str,
    players: Sequence[str],
    seeds: int,
    first_seed: int,
    num_threads: int,
    say: Callable[[str], None],
) -> dict[str, Trial]:
    """Trials of the policies on one task; the expert needs a device that it steers."""
    # The cheapest observation; none of the policies uses it.
    task = suite.make_task(name, observation="tracking")
    simulation = BatchSimulation(task, seeds, num_threads=num_threads)
    trials = {}
    for policy in players:
        steered = task.scene.catheter.coaxial or task.scene.catheter.device.steerable
        if policy == "expert" and not steered:
            continue
        player = policies.make_policy(policy, first_seed)
        trials[policy] = trial = play(simulation, player, first_seed, LIMITS[policy])
        say(f"{name}, {policy}: {trial.successes} of {seeds}")
    return trials


def _checks(name: str, trials: Mapping[str, Trial]) -> list[Check]:
    def percent(trial: Trial) -> float:
        return 100.0 * trial.successes / len(trial.ends)

    checks = []
    if "push" in trials and asks_for_steering(name):
        push = trials["push"]
        checks.append(
            Check.at_most(
                f"{name}, straight push", percent(push), MOST_PUSH, "%", _note(push)
            )
        )
    if "expert" in trials:
        expert = trials["expert"]
        checks.append(
            Check.at_least(
                f"{name}, expert", percent(expert), LEAST_EXPERT, "%", _note(expert)
            )
        )
    return checks


def _note(trial: Trial) -> str:
    found = trial.summary()
    low, high = (100 * bound for bound in found["success_ci95"])
    return (
        f"{found['successes']} of {found['episodes']} ({low:.0f}–{high:.0f} %), "
        f"{found['steps']:.0f} steps; {1e3 * found['mean_force']:.1f} mN mean, "
        f"{1e3 * found['largest_force']:.0f} mN largest"
    )


def main(
    task: tyro.conf.UseAppendAction[list[str]] = [],  # noqa: B006
    policy: tyro.conf.UseAppendAction[list[str]] = [],  # noqa: B006
    seeds: int = 30,
    seed: int = EVALUATION_SEED,
    threads: int = 0,
    out: Path | None = None,
    json: bool = False,
) -> int:
    """Play straight push, random actions, random curls and the expert on every task.

    Args:
        task: Task of `cathsim list`, repeated for several; by default all of a
            steerable device but `navigate`.
        policy: Policy of the four, repeated for several; all by default.
        seeds: Number of episodes of each policy on each task.
        seed: Seed of the first episode; the others count up.
        threads: Number of threads of the simulation, 0 for one per core.
        out: Path of a file for the report as JSON, written after every task.
        json: Whether to print one JSON object and nothing else.
    """

    def keep(report: Report) -> None:
        if out is not None:
            files.write_text(out, json_.dumps(report.as_dict(), indent=2) + "\n")

    try:
        if out is not None:
            files.require_file(out)
        report = difficulty(
            task or None,
            seeds,
            seed,
            players=policy or None,
            num_threads=threads,
            say=say,
            keep=keep,
        )
    except (ValueError, OSError) as error:
        print(f"difficulty: {error}", file=sys.stderr)
        return BAD_INPUT
    return show(report, json)


if __name__ == "__main__":
    sys.exit(tyro.cli(main))
