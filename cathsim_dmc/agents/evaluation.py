"""Evaluation: fixed seeds, each episode counted once, success with its interval."""

import contextlib
import functools
import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torchrl.envs import EnvBase
from torchrl.envs.utils import step_mdp

from cathsim_dmc import bounds, cluster, files
from cathsim_dmc.agents import evaluation_files, protocols
from cathsim_dmc.agents.contact_log import ContactLog
from cathsim_dmc.agents.episodes import EpisodeOutcome, EpisodeTracker
from cathsim_dmc.agents.policies import (
    PolicyLike,
    load_policy,
    require_actions,
    start_insertions,
    task_and_options,
    view_of,
)
from cathsim_dmc.agents.results import EvaluationResult, versions
from cathsim_dmc.agents.training_log import progress_bar
from cathsim_dmc.policies import Policy
from cathsim_dmc.simulation import environments
from cathsim_dmc.tasks.anatomies import lumens
from cathsim_dmc.tasks.config import EVALUATION_SEED
from cathsim_dmc.tasks.snapshot import Snapshot

# Called after every step with the environment and which episodes (n,) bool have been in
# it, without those whose physics failed.
Observer = Callable[[EnvBase, np.ndarray], None]


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
    simulation_device: str = "cpu",
    out_dir: str | Path | None = None,
    error_dir: str | Path | None = None,
    observer: Observer | None = None,
    start: Snapshot | None = None,
    make_env: environments.EnvFactory = environments.make_env,
    on_cluster: bool = False,
) -> EvaluationResult:
    """Play episodes with a policy in parallel, each with a seed of its own.

    A trained policy acts deterministically (the middle of its distribution) with
    frozen observation statistics. Only the first episode of each environment counts,
    not what follows while others finish.

    Args:
        policy: Policy, or its name, path or function, see `policies.load_policy`.
        task: Name of the task; None takes the one that the policy was trained on.
        episodes: Number of episodes; None for that of the protocol.
        seed: Seed of the first episode; those of the others are larger.
        protocol: Name of the conditions in `protocols.PROTOCOLS`.
        name: Name of the policy for the reports.
        observation: Name or names of observations; None takes the policy's own.
        task_kwargs: Options of the task, which replace those of the policy's training;
            None takes those. `policies.task_and_options` merges both, as the command
            line does. A device among them is used in all episodes.
        num_threads: Number of threads of the simulation; None takes one per core.
        simulation_device: Where the simulations run: "cpu", or "cuda" for MuJoCo Warp
            on a GPU, "cuda:1" on the second one (docs/gpu.md); the policy acts on the
            CPU.
        out_dir: Directory for evaluation.json, written at the end; None writes none.
        error_dir: Directory for files of the last physics errors; None takes errors/ in
            `out_dir`, if that is given.
        observer: Function that is called after every step, before any reset, see
            `Observer`.
        start: Snapshot of running episodes, as many as are played, which continue and
            are counted from there; None for the starts of the task.
        make_env: Function with the arguments of `environments.make_env`; "info" of its
            environment has "success", "physics_error", "path_ratio" and the forces
            `physics.forces.NAMES`, and may have "failed".
        on_cluster: Whether the processes of a Ray cluster play the episodes, in groups
            of `num_threads` processors each (None for one); the observer is then None
            or a `ContactLog`. The result is the same, bit for bit, on processors of
            one kind.

    Raises:
        ValueError: no task is known, episodes < 1, the protocol sets a given option, or
            `start` does not fit, or the cluster has too few processors, or there is no
            such device.
        ImportError: the device needs an extra that is not installed.
        NotImplementedError: the device does not simulate a feature of the task.
        CheckpointError: there is no such checkpoint, or it is damaged.
    """
    bounds.options("task_kwargs", task_kwargs)
    plan = _Plan.of(
        policy, task, episodes, seed, protocol, observation, task_kwargs, start
    )
    place = bounds.option_simulation_device(simulation_device)
    if on_cluster:
        if place:
            raise ValueError(
                "the processes of a cluster simulate on their CPUs; leave out "
                "simulation_device (--simulation-device), or on_cluster (--ray)"
            )
        cluster.connect()
    environments.require_factory(make_env)
    make = functools.partial(make_env, **place)
    target = None
    if out_dir is not None:
        # Checked first: an evaluation that cannot be written would be lost.
        target = files.as_path("out_dir", out_dir) / evaluation_files.FILE
        files.require_file(target, later=True)
        error_dir = error_dir or target.parent / "errors"
    groups = plan.groups(num_threads, error_dir, make, start)
    if on_cluster:
        outcomes = _play_on_cluster(groups, observer)
    else:
        outcomes = [one for group in groups for one in _play(group, observer)]
    result = plan.result(name, outcomes, start, simulation_device)
    if target is not None:
        evaluation_files.write(target, result.to_dict())
    return result


@dataclass(frozen=True)
class _Plan:
    """Arguments of an evaluation, checked and complete.

    Attributes:
        player: The policy.
        task: Name of the task.
        options: Options of the task.
        observation: Name or names of the observations.
        protocol: Name of the conditions.
        parts: Parts of the episodes, each with options of its own.
        lumens: Those of the option `anatomy`, whose files may change.
    """

    player: Policy
    task: str
    options: Mapping[str, Any]
    observation: str | Sequence[str]
    protocol: str
    parts: Sequence[protocols.Part]
    lumens: Sequence[str]

    @classmethod
    def of(
        cls,
        policy: PolicyLike,
        task: str | None,
        episodes: int | None,
        seed: int,
        protocol: str,
        observation: str | Sequence[str] | None,
        task_kwargs: Mapping[str, Any] | None,
        start: Snapshot | None,
    ) -> "_Plan":
        """Checks the arguments of `evaluate` and fills in the defaults."""
        conditions = protocols.get(protocol)
        if start is not None:
            episodes = _started(start, episodes, protocol)
        episodes = conditions.episodes if episodes is None else episodes
        bounds.whole("episodes", episodes, 1, bounds.MOST_SIMULATIONS)
        bounds.seed("seed", seed)
        player = load_policy(policy, seed)
        task, options = task_and_options(player, task, task_kwargs)
        options = options if task_kwargs is None else task_kwargs
        options = conditions.beside(options, task_kwargs or {})
        require_actions(player, task, options)
        observed = observation or player.observation or "internal"
        parts = protocols.parts(conditions, task, options, episodes, seed)
        anatomy = options.get("anatomy")
        found = [] if anatomy is None else lumens(anatomy)
        return cls(player, task, options, observed, protocol, parts, found)

    def groups(
        self,
        num_threads: int | None,
        error_dir: str | Path | None,
        make_env: environments.EnvFactory,
        start: Snapshot | None,
    ) -> list["_Group"]:
        """Returns a group for the episodes of each part."""
        bounds.option_threads(num_threads)
        errors = None if error_dir is None else Path(error_dir).absolute()
        make = functools.partial(make_env, self.task, observation=self.observation)
        varied = bool(protocols.get(self.protocol).task_kwargs)
        return [
            _Group(
                part, range(len(part.seeds)), self.player, varied, make, errors,
                num_threads, torch.get_num_threads(), start,
            )
            for part in self.parts
        ]  # fmt: skip

    def result(
        self,
        name: str | None,
        outcomes: Sequence[EpisodeOutcome],
        start: Snapshot | None,
        simulated_on: str,
    ) -> EvaluationResult:
        """Returns the result of episodes that began at `start`, or from their seeds."""
        trained = getattr(self.player, "checkpoint", None)
        first, count = self.parts[0].task_kwargs, sum(len(p.seeds) for p in self.parts)
        if start is None:
            starts = len({one.start_insertion for one in outcomes} - {None})
            distinct = protocols.distinct(self.task, first, count, starts)
            drawn = [one for part in self.parts for one in part.conditions]
        else:
            distinct, drawn = protocols.distinct_states(start), []
        return EvaluationResult(
            task=self.task,
            policy=name or self.player.name,
            seeds=tuple(seed for part in self.parts for seed in part.seeds),
            episodes=tuple(outcomes),
            settings={
                "protocol": self.protocol,
                "observation": self.observation,
                "task_kwargs": self.options,
                "frames": trained and trained.frames,
                **({"started": start.digest} if start is not None else {}),
                **({"lumens": self.lumens} if self.lumens else {}),
                **({"simulated_on": simulated_on} if simulated_on != "cpu" else {}),
            },
            distinct=distinct,
            conditions=tuple(drawn),
            versions=versions(simulated_on),
        )


@dataclass(frozen=True)
class _Group:
    """Episodes that are played in one batch, some or all of a part.

    Attributes:
        part: Part that the episodes belong to.
        rows: Indices of the episodes in the part.
        player: Policy for all episodes of the part.
        varied: Whether each episode has a seed of its own; otherwise seeds count up.
        make_env: Function of num_envs, num_threads, seed and task_kwargs.
        errors: Folder for physics errors; None writes none.
        num_threads: Number of threads of the simulation; None for one per core.
        torch_threads: Number of threads of torch; rounding depends on it.
        start: State at which the episodes of the part begin; None for their starts.
    """

    part: protocols.Part
    rows: range
    player: Policy
    varied: bool
    make_env: environments.EnvFactory
    errors: Path | None
    num_threads: int | None
    torch_threads: int
    start: Snapshot | None

    def pieces(self, size: int) -> list["_Group"]:
        """Splits the group into groups of at most `size` episodes."""
        starts = self.rows[::size]
        cut = (range(n, min(n + size, self.rows.stop)) for n in starts)
        threads = self.num_threads or 1
        return [replace(self, rows=rows, num_threads=threads) for rows in cut]


def _play(group: _Group, observer: Observer | None) -> list[EpisodeOutcome]:
    seeds = group.part.seeds[group.rows.start : group.rows.stop]
    env = group.make_env(
        num_envs=len(seeds), num_threads=group.num_threads,
        seed=seeds if group.varied else seeds[0], task_kwargs=group.part.task_kwargs,
    )  # fmt: skip
    bounds.instance("the environment of make_env", env, EnvBase)
    if group.errors is not None:
        environments.record_errors(env, group.errors)
    first = group.rows.start
    start = None if group.start is None else group.start[first : group.rows.stop]
    policy = group.player.among(first, len(group.part.seeds))
    with contextlib.closing(env):
        found = _first_episodes(env, policy, observer, start)
    return [replace(outcome, env=first + outcome.env) for outcome in found]


def _play_on_cluster(
    wholes: Sequence[_Group], observer: Observer | None
) -> list[EpisodeOutcome]:
    """Plays groups in pieces, as many as the cluster can run at the same time."""
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


def _play_apart(job: tuple[_Group, bool]) -> tuple[list[EpisodeOutcome], ContactLog]:
    """Plays a group; returns its episodes, and their contacts if these are wanted."""
    (group, wanted), contacts = job, ContactLog()
    torch.set_num_threads(group.torch_threads)
    return _play(group, contacts if wanted else None), contacts


def _started(start: Snapshot, episodes: int | None, protocol: str) -> int:
    """Returns the number of episodes of a snapshot; ValueError for other settings."""
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
    base = getattr(env, "base_env", env)
    if start is not None and base.ended.any():
        over = bounds.shown(np.flatnonzero(base.ended).tolist())
        raise ValueError(
            f"the episodes of start have ended in its simulations {over}; choose "
            "others with start[...], or take the snapshot before their end"
        )
    running, places = begun, start_insertions(env)
    while running.any():
        state = env.maybe_reset(state)
        if begun.any():
            policy.reset(view, begun)
        state["action"] = _checked(policy, policy.act(state), env)
        stepped = env.step(state)
        if observer is not None:
            failed = stepped["next", "info", "physics_error"].reshape(-1).numpy() > 0
            observer(env, running & ~failed)
        for outcome in tracker.add(stepped.unsqueeze(1)):
            began = replace(outcome, start_insertion=places[outcome.env])
            outcomes.setdefault(outcome.env, began)
        begun = stepped["next", "done"].reshape(-1).numpy()
        running = running & ~begun
        state = step_mdp(stepped)
    return tuple(outcomes[number] for number in range(count))


def _checked(policy: Policy, given: Any, env: EnvBase) -> torch.Tensor:
    """Returns actions of a policy as (N, A) float32; ValueError for others."""
    text = f"the policy {policy.name} returned {bounds.shown(given)}, no array"
    with files.refused(ValueError, text, (TypeError, ValueError, RuntimeError)):
        actions = torch.as_tensor(given).to(torch.float32)
    if actions.shape != env.action_spec.shape:
        count, entries = env.action_spec.shape
        raise ValueError(
            f"the policy {policy.name} returned shape {tuple(actions.shape)}; it "
            f"must be ({count}, {entries}), a row for each of the {count} episodes, "
            "which are played in parallel. A function f of one observation is called "
            "for each: lambda many: torch.stack([f(one) for one in many])"
        )
    odd = ~actions.isfinite().all(-1)
    if odd.any():
        rows = bounds.shown(odd.nonzero().ravel().tolist())
        raise ValueError(
            f"the policy {policy.name} returned numbers that are not finite, in the "
            f"rows {rows}"
        )
    return actions
