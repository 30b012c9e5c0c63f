"""Evaluation: fixed seeds, each episode counted once, intervals beside every mean."""

import contextlib
import functools
import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torchrl.envs import EnvBase
from torchrl.envs.utils import step_mdp

from cathsim_dmc import bounds, cluster, files
from cathsim_dmc.agents import protocols
from cathsim_dmc.agents.contact_log import ContactLog
from cathsim_dmc.agents.episodes import EpisodeOutcome, EpisodeTracker
from cathsim_dmc.agents.policies import (
    PolicyLike,
    load_policy,
    task_and_options,
    view_of,
)
from cathsim_dmc.agents.training_log import progress_bar
from cathsim_dmc.analysis.force_statistics import QUANTITIES, STATISTICS
from cathsim_dmc.analysis.intervals import success_interval
from cathsim_dmc.policies import Policy
from cathsim_dmc.simulation import environments
from cathsim_dmc.tasks.snapshot import Snapshot

EnvFactory = Callable[..., EnvBase]
# Called after every step with the environment and which episodes (n,) bool still run.
Observer = Callable[[EnvBase, np.ndarray], None]

EVALUATION_SEED = 1_000_000  # apart from the seeds of training

# Largest sums of the force on the wall up to which success is called safe, N.
SAFE_FORCES = (0.5, 1.0, 2.0)


@dataclass(frozen=True)
class EvaluationResult:
    """Episodes of one policy on one task.

    Attributes:
        task: Name of the task.
        policy: Name of the policy.
        seeds: Seed of each episode.
        episodes: Episodes in the order of their seeds.
        settings: Protocol, observation, further task_kwargs, frames of a checkpoint.
        distinct: Whether all episodes can differ by more than the jitter of the start.
            If not, no interval over them is given.
        conditions: What was drawn for each episode; empty without randomisation.
    """

    task: str
    policy: str
    seeds: tuple[int, ...]
    episodes: tuple[EpisodeOutcome, ...]
    settings: Mapping[str, Any]
    distinct: bool = True
    conditions: tuple[Mapping[str, Any], ...] = ()

    def values(self, name: str) -> np.ndarray:
        """A figure of every episode, float64 (episodes,); NaN where unknown.

        Args:
            name: Name of an attribute of `EpisodeOutcome`, with dots for what lies
                deeper, such as "reward" or "forces.peak_sum.maximum".
        """

        def value(outcome: Any) -> Any:
            for part in name.split("."):
                outcome = None if outcome is None else getattr(outcome, part)
            return outcome

        return np.array([value(e) for e in self.episodes], dtype=np.float64)

    def mean_sd(self, name: str) -> tuple[float | None, float | None]:
        """Mean and sample standard deviation over the episodes; None if unknown."""
        values = self.values(name)
        values = values[~np.isnan(values)]
        if not len(values):
            return None, None
        deviation = float(values.std(ddof=1)) if len(values) > 1 else 0.0
        return float(values.mean()), deviation

    @property
    def successes(self) -> int:
        """Episodes that reached the goal."""
        return sum(episode.success for episode in self.episodes)

    def safe_success(self, limit: float) -> float:
        """Share of episodes that reach the goal with little force on the wall.

        Args:
            limit: The sum of the magnitudes over all contacts stays at or below it in
                every physics step, N.

        Returns:
            As a fraction; an episode whose force is not known is not safe.
        """
        safe = self.values("forces.peak_sum.maximum") <= limit
        return float(np.mean((self.values("success") > 0) & safe))

    def summary(self) -> dict[str, Any]:
        """Means with deviations over the episodes, success rate with its interval.

        The interval is None where the episodes are not distinct. Forces in N, by
        quantity and statistic as docs/forces.md defines them.
        """
        count, successes = len(self.episodes), self.successes
        interval = list(success_interval(successes, count)) if self.distinct else None
        result: dict[str, Any] = {"episodes": count}
        for name in ("reward", "length", "path_ratio"):
            result[name], result[f"{name}_sd"] = self.mean_sd(name)
        result["forces"] = {quantity: {} for quantity in QUANTITIES}
        for quantity, name in itertools.product(QUANTITIES, STATISTICS):
            mean, deviation = self.mean_sd(f"forces.{quantity}.{name}")
            result["forces"][quantity][name] = {"mean": mean, "sd": deviation}
        result["physics_errors"] = sum(e.physics_error for e in self.episodes)
        result |= {"success": successes / count, "success_ci95": interval}
        result["safe_success"] = {
            f"{limit:g} N": self.safe_success(limit) for limit in SAFE_FORCES
        }
        return result

    def to_dict(self) -> dict[str, Any]:
        """JSON-able: identity, summary and every episode."""
        drawn = [{"conditions": dict(one)} for one in self.conditions]
        drawn = drawn or [{}] * len(self.seeds)
        played = zip(self.seeds, self.episodes, drawn, strict=True)
        episodes = [
            {"seed": seed, **asdict(episode), **conditions}
            for seed, episode, conditions in played
        ]
        return {
            "task": self.task,
            "policy": self.policy,
            "seed": self.seeds[0],
            "settings": dict(self.settings),
            "distinct": self.distinct,
            "summary": self.summary(),
            "episodes": episodes,
        }


def evaluate(
    policy: PolicyLike,
    task: str | None = None,
    episodes: int | None = None,
    seed: int = EVALUATION_SEED,
    *,
    protocol: str = "published",
    name: str | None = None,
    observation: str | Sequence[str] | None = None,
    task_kwargs: Mapping[str, Any] | None = None,
    num_threads: int | None = None,
    out_dir: str | Path | None = None,
    observer: Observer | None = None,
    start: Snapshot | None = None,
    make_env: EnvFactory = environments.make_env,
    on_cluster: bool = False,
) -> EvaluationResult:
    """Play episodes with a policy, each with a seed of its own, all side by side.

    A trained policy acts deterministically (the middle of its distribution) with
    frozen observation statistics. What an environment does after its episode, while
    others finish, is not counted.

    Args:
        policy: Policy, or what names one, see `policies.load_policy`.
        task: Name of the task; None takes the one that the policy was trained on.
        episodes: Number of episodes; None for that of the protocol.
        seed: Seed of the first episode; the others lie above it.
        protocol: Name of the conditions in `protocols.PROTOCOLS`.
        name: Name of the policy for the reports.
        observation: Name or names of observations; None takes the policy's own.
        task_kwargs: Further options of the task; None takes those that the policy was
            trained with. A device among them is played in all episodes.
        num_threads: Number of threads of the simulation; None takes one per core.
        out_dir: Directory for evaluation.json and, in errors/, the last physics errors;
            None writes none.
        observer: Function that is called after every step, before any reset.
        start: State in the middle of as many episodes, which are played on and counted
            from there; None for the starts of the task.
        make_env: Function with the arguments of `environments.make_env`; "info" of its
            environment has "success", "physics_error", "path_ratio" and the forces
            `physics.forces.NAMES`.
        on_cluster: Whether the processes of a Ray cluster play the episodes, in groups
            of `num_threads` processors each (None for one); the observer is then None
            or a `ContactLog`. The result is the same, bit for bit, on processors of
            one kind.

    Raises:
        ValueError: no task is known, episodes < 1, the protocol sets a given option, or
            `start` does not fit, or the cluster has too few processors.
        CheckpointError: there is no such checkpoint, or it is damaged.
    """
    conditions = protocols.get(protocol)
    if start is not None:
        episodes = _started(start, episodes, protocol)
    episodes = conditions.episodes if episodes is None else episodes
    bounds.whole("episodes", episodes, 1, bounds.MOST_SIMULATIONS)
    bounds.seed("seed", seed)
    if num_threads is not None:
        bounds.whole("num_threads (--threads)", num_threads, 1, bounds.MOST_THREADS)
    player = load_policy(policy, seed)
    task, options = task_and_options(player, task, task_kwargs)
    options = options if task_kwargs is None else task_kwargs
    options = conditions.beside(options, task_kwargs or {})
    observed = observation or player.observation or "internal"
    parts = protocols.parts(conditions, task, options, episodes, seed)
    if on_cluster:
        cluster.connect()
    if out_dir is not None:
        # Now: an evaluation that cannot be written would be lost.
        files.require_folder(out_dir, make=True)
    errors = None if out_dir is None else Path(out_dir).absolute() / "errors"
    wholes = [
        _Group(
            part, range(len(part.seeds)), player, bool(conditions.task_kwargs),
            functools.partial(_recorded, make_env, errors, task, observation=observed),
            num_threads, torch.get_num_threads(), start,
        )
        for part in parts
    ]  # fmt: skip
    outcomes: list[EpisodeOutcome] = []
    if on_cluster:
        outcomes += _play_on_cluster(wholes, observer)
    else:
        for group in wholes:
            outcomes += _play(group, observer)
    trained = getattr(player, "checkpoint", None)
    result = EvaluationResult(
        task,
        name or player.name,
        tuple(seed for part in parts for seed in part.seeds),
        tuple(outcomes),
        {
            "protocol": protocol, "observation": observed, "task_kwargs": options,
            "frames": trained and trained.frames,
        },
        start is not None or protocols.distinct(task, parts[0].task_kwargs, episodes),
        tuple(drawn for part in parts for drawn in part.conditions),
    )  # fmt: skip
    if out_dir is not None:
        files.write_json(Path(out_dir) / "evaluation.json", result.to_dict())
    return result


@dataclass(frozen=True)
class _Group:
    """Episodes that are played side by side, some of those of a part or all.

    Attributes:
        part: Where they are from.
        rows: Their numbers in it.
        player: The policy of all its episodes.
        varied: Whether each has a seed of its own, in place of those that count up.
        make_env: Function of num_envs, num_threads, seed and task_kwargs.
        num_threads: Number of threads of the simulation; None for one per core.
        torch_threads: Number of threads of torch, which rounding depends on.
        start: State at which the episodes of the part begin; None for their starts.
    """

    part: protocols.Part
    rows: range
    player: Policy
    varied: bool
    make_env: EnvFactory
    num_threads: int | None
    torch_threads: int
    start: Snapshot | None

    def pieces(self, size: int) -> list["_Group"]:
        """Groups of so many of its episodes each, or of fewer."""
        starts = self.rows[::size]
        cut = (range(n, min(n + size, self.rows.stop)) for n in starts)
        threads = self.num_threads or 1
        return [replace(self, rows=rows, num_threads=threads) for rows in cut]


def _recorded(make_env: EnvFactory, folder: Path | None, *args, **kwargs) -> EnvBase:
    """An environment that writes physics errors to a folder, None for none."""
    env = make_env(*args, **kwargs)
    if folder is not None:
        environments.record_errors(env, folder)
    return env


def _play(group: _Group, observer: Observer | None) -> list[EpisodeOutcome]:
    seeds = group.part.seeds[group.rows.start : group.rows.stop]
    env = group.make_env(
        num_envs=len(seeds), num_threads=group.num_threads,
        seed=seeds if group.varied else seeds[0], task_kwargs=group.part.task_kwargs,
    )  # fmt: skip
    first = group.rows.start
    start = None if group.start is None else group.start[first : group.rows.stop]
    policy = group.player.among(first, len(group.part.seeds))
    with contextlib.closing(env):
        found = _first_episodes(env, policy, observer, start)
    return [replace(outcome, env=first + outcome.env) for outcome in found]


def _play_on_cluster(
    wholes: Sequence[_Group], observer: Observer | None
) -> list[EpisodeOutcome]:
    """Plays groups in pieces, one for each place of the cluster."""
    if not isinstance(observer, ContactLog | None):
        raise ValueError("on a cluster the observer must be a ContactLog or None")
    each = wholes[0].num_threads or 1
    total = sum(len(group.rows) for group in wholes)
    size = math.ceil(total / max(cluster.room(each), 1))
    pieces = [group.pieces(size) for group in wholes]
    jobs = [(piece, observer is not None) for own in pieces for piece in own]
    found: dict[int, tuple[list[EpisodeOutcome], ContactLog]] = {}
    with progress_bar(wholes[0].player.name, " groups", total=len(jobs)) as bar:
        for number, result in cluster.over(_play_apart, jobs, each):
            found[number] = result
            bar.update()
    outcomes, ordered = [], (found[number] for number in range(len(jobs)))
    for own in pieces:
        results = list(itertools.islice(ordered, len(own)))
        outcomes += [outcome for played, _ in results for outcome in played]
        if observer is not None:
            observer.join([log for _, log in results])
    return outcomes


def _play_apart(job: tuple[_Group, bool]) -> tuple[list[EpisodeOutcome], "ContactLog"]:
    """The episodes of a group, and their contacts if these are wanted."""
    (group, wanted), contacts = job, ContactLog()
    torch.set_num_threads(group.torch_threads)
    return _play(group, contacts if wanted else None), contacts


def _started(start: Snapshot, episodes: int | None, protocol: str) -> int:
    """Number of episodes that begin at a snapshot; ValueError for other settings."""
    if protocol != "published":
        raise ValueError(
            f"start has the conditions of its episodes, so the protocol {protocol!r} "
            "cannot draw them; leave it out"
        )
    if episodes not in (None, len(start)):
        raise ValueError(
            f"episodes is {bounds.shown(episodes)}, but start is of {len(start)} "
            "simulations; leave episodes out, or choose some with snapshot[...]"
        )
    return len(start)


@torch.no_grad()
def _first_episodes(
    env: EnvBase, policy: Policy, observer: Observer | None, start: Snapshot | None
) -> tuple[EpisodeOutcome, ...]:
    (count,) = env.batch_size
    view, tracker = view_of(env), EpisodeTracker(count)
    outcomes: dict[int, EpisodeOutcome] = {}
    begun = np.ones(count, dtype=bool)
    state = env.reset() if start is None else env.reset(snapshot=start)
    running = begun
    while running.any():
        state = env.maybe_reset(state)
        if begun.any():
            policy.reset(view, begun)
        state["action"] = _checked(policy, policy.act(state), env)
        stepped = env.step(state)
        if observer is not None:
            observer(env, running)
        for outcome in tracker.add(stepped.unsqueeze(1)):
            outcomes.setdefault(outcome.env, outcome)
        begun = stepped["next", "done"].reshape(-1).numpy()
        running = running & ~begun
        state = step_mdp(stepped)
    return tuple(outcomes[number] for number in range(count))


def _checked(policy: Policy, given: Any, env: EnvBase) -> torch.Tensor:
    """Actions (N, A) float32 of a policy; ValueError for those of another shape."""
    actions = torch.as_tensor(given).to(torch.float32)
    if actions.shape != env.action_spec.shape:
        count, entries = env.action_spec.shape
        raise ValueError(
            f"the policy {policy.name} answered with shape {tuple(actions.shape)}; it "
            f"must be ({count}, {entries}), a row for each of the {count} episodes, "
            "which are played side by side. A function f of one observation is called "
            "for each: lambda many: torch.stack([f(one) for one in many])"
        )
    return actions
