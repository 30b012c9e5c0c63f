"""Conditions under which policies are evaluated."""

import dataclasses
import itertools
import json
import types
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial import KDTree

from cathsim_dmc import bounds, suite
from cathsim_dmc.physics.randomisation import Draw, Randomisation
from cathsim_dmc.tasks.anatomies import anatomy_name, arch_numbers, is_pool
from cathsim_dmc.tasks.conditions import drawn_in
from cathsim_dmc.tasks.snapshot import Snapshot
from cathsim_dmc.tasks.start import START_SPACING, STARTS_ALONG_ROUTE

# Number of strata of each quantity, and of candidate seeds for each episode.
_STRATA, _CANDIDATES = 10, 20
# Quantities that make episodes distinct, and the step between distinct values.
_STEPS = dict.fromkeys(
    ("friction", "stiffness", "loss", "viscosity", "goal_shift", "roll"), 1e-9
) | {"delay": 1, "start_insertion": START_SPACING}
_COMPARED = _STEPS.keys() - {"start_insertion"}  # as drawn; the rest as it is applied
_NEAR = 2e-3  # m, displacement of the start within which episodes are nearly equal
# Quantities that a start may reduce after the draw; a displacement may be redrawn.
_REDUCED = "displacement", "insertion"


class Protocol(NamedTuple):
    """Conditions of an evaluation.

    Attributes:
        episodes: Number of episodes, unless another one is given.
        task_kwargs: Options of the task, over all others.
        devices: Devices that episodes take in turn where the options name none.
    """

    episodes: int
    task_kwargs: Mapping[str, Any] = types.MappingProxyType({})
    devices: tuple[str, ...] = ()

    def beside(self, options: Mapping[str, Any], given: Mapping[str, Any]) -> dict:
        """Return options without the protocol's own; ValueError if one is given."""
        ranges = Randomisation.make(self.task_kwargs.get("randomisation", False))
        drawn = () if ranges.friction is None else ("friction",)
        own = {*self.task_kwargs, *drawn}
        for name in sorted(own & {*given}):
            raise ValueError(f"{name}: the protocol has its own; leave {name} out")
        return {name: value for name, value in options.items() if name not in own}


VARIED_RANGES = Randomisation(
    friction=(0.02, 0.15), stiffness=(0.7, 1.3), loss=(0.5, 2.0), viscosity=(0.5, 2.0),
    start_radius=0.01, start_insertion=(0.0, 0.06), roll=(-np.pi, np.pi), delay=(0, 3),
    tracking_noise=0.5e-3, view=(-10.0, 10.0), gain=(0.85, 1.15), kerma=(0.5, 2.0),
)  # fmt: skip

PROTOCOLS = {
    # The task unchanged; episodes differ by 1 mm of the start and are nearly equal.
    "published": Protocol(30),
    "varied": Protocol(
        100, {"randomisation": VARIED_RANGES}, ("steerable_5f", "steerable_4f")
    ),
}


class Part(NamedTuple):
    """Episodes that one batch of simulations plays.

    Attributes:
        task_kwargs: Options of the task.
        seeds: Seed of each episode.
        conditions: What is drawn for each episode, JSON-able.
    """

    task_kwargs: Mapping[str, Any]
    seeds: tuple[int, ...]
    conditions: tuple[Mapping[str, Any], ...]


def get(name: str) -> Protocol:
    """Return a protocol by its name; ValueError lists the names."""
    return PROTOCOLS[bounds.choice("protocol", name, PROTOCOLS)]


def parts(
    protocol: Protocol,
    task: str,
    task_kwargs: Mapping[str, Any],
    episodes: int,
    seed: int,
) -> tuple[Part, ...]:
    """Return the episodes of an evaluation, one part for each device.

    Args:
        task_kwargs: Options over the task's own; those of the protocol go over both.
        seed: Smallest seed. Without variation the seeds are consecutive; otherwise they
            are those of `stratified` and take the arches of a pool in turn.
    """
    definition = suite.TASKS.get(task)
    own = {} if definition is None else definition.options
    options = {**own, **task_kwargs, **protocol.task_kwargs}
    ranges = Randomisation.make(options.get("randomisation", False))
    pools = [options]
    if protocol.devices and not (options.get("devices") or options.get("device")):
        pools = [{**options, "device": name} for name in protocol.devices]
    arches = max(len(_drawn_from(definition, options)), 1)
    most = episodes * (len(pools) * _CANDIDATES if protocol.task_kwargs else 1)
    bounds.seeds("seed", seed, most)
    found, played = [], 0
    for number, own in enumerate(pools[:episodes]):
        count = len(range(number, episodes, len(pools)))
        first = seed + number * _CANDIDATES * episodes
        seeds = tuple(range(first, first + count))
        if protocol.task_kwargs:
            wanted = [n % arches for n in range(played, played + count)]
            seeds = stratified(ranges, wanted, first, arches)
        played += count
        pool = _drawn_from(definition, options)
        varied = () if ranges == Randomisation() and len(pool) < 2 else seeds
        drawn = tuple(_conditions(ranges, one, pool, own) for one in varied)
        # Effects are objects, which files cannot hold; the task makes its own.
        kept = {
            name: value
            for name, value in own.items()
            if name != "effects" or name in task_kwargs
        }
        found.append(Part(kept, seeds, drawn))
    return tuple(found)


def _drawn_from(
    definition: suite.TaskDefinition | None, options: Mapping[str, Any]
) -> Sequence[int | str]:
    """Return numbers of arches or names of anatomies that an episode draws one of."""
    if definition is None:
        return ()
    if definition.random_arch:
        return arch_numbers(options)
    given = options.get("anatomy", definition.anatomy)
    return tuple(map(anatomy_name, given)) if is_pool(given) else ()


def _conditions(
    ranges: Randomisation,
    seed: int,
    pool: Sequence[int | str],
    options: Mapping[str, Any],
) -> Mapping[str, Any]:
    number, episode = ranges.draw_in(np.random.RandomState(seed), max(len(pool), 1))
    where = {}
    if len(pool) > 1:
        one = pool[number]
        where = {"arch" if isinstance(one, int) else "anatomy": one}
    values = {
        name + "_drawn" * (name in _REDUCED): np.asarray(value).tolist()
        for name, value in dataclasses.asdict(episode).items()
        if value is not None
    }
    device = options.get("device")
    return {"device": getattr(device, "name", device), **where, **values}


def stratified(
    ranges: Randomisation, wanted: Sequence[int], seed: int, arches: int
) -> tuple[int, ...]:
    """Return seeds whose draws fill the tenths of each range evenly.

    Each episode in turn takes, of 20 candidates, the one whose draws lie in the least
    filled tenths.

    Args:
        wanted: Number of the arch of each episode in its pool.
        seed: Smallest candidate.
        arches: Number of arches in the pool, one of which a seed draws.

    Returns:
        Seeds, in the order of `wanted`.
    """
    # Candidates of each arch, 20 for each of its episodes, with their bins.
    left: dict[int, dict[int, np.ndarray]] = {arch: {} for arch in wanted}
    short = {arch: _CANDIDATES * wanted.count(arch) for arch in left}
    candidates = itertools.count(seed)
    while any(short.values()):
        candidate = next(candidates)
        arch, episode = ranges.draw_in(np.random.RandomState(candidate), arches)
        if short.get(arch):
            left[arch][candidate] = _bins(ranges, episode)
            short[arch] -= 1
    filled, chosen = np.zeros((len(_STEPS), _STRATA), dtype=int), []
    for arch in wanted:
        crowd = {
            candidate: (filled[range(len(bins)), bins] ** 2).sum()
            for candidate, bins in left[arch].items()
        }
        chosen.append(min(crowd, key=crowd.__getitem__))
        bins = left[arch].pop(chosen[-1])
        filled[range(len(bins)), bins] += 1
    return tuple(chosen)


def _bins(ranges: Randomisation, episode: Draw) -> np.ndarray:
    """Return the index of the tenth of its range that each draw lies in."""
    shares = []
    for name in _STEPS:
        chosen = getattr(ranges, name)
        if isinstance(chosen, Sequence) and chosen[1] > chosen[0]:
            drawn = getattr(episode, name.removeprefix("start_"))
            shares.append((drawn - chosen[0]) / (chosen[1] - chosen[0]))
    return np.minimum((np.array(shares) * _STRATA).astype(int), _STRATA - 1)


def distinct(
    task: str, task_kwargs: Mapping[str, Any], episodes: int, starts: int | None = None
) -> bool:
    """Whether all episodes can differ by more than the jitter of the start.

    Differences in noise and C-arm do not count. For tasks outside the suite the answer
    is True.

    Args:
        starts: Number of different insertions at which the episodes began. It counts in
            a task of one anatomy; in others, and with None, those of `start_insertion`
            at steps of 5 mm do.
    """
    definition = suite.TASKS.get(task)
    if definition is None:
        return True
    ranges = Randomisation.make(task_kwargs.get("randomisation", False))
    values = anatomies = max(len(_drawn_from(definition, task_kwargs)), 1)
    for name, step in _STEPS.items():
        if (chosen := getattr(ranges, name)) is not None:
            low, high = chosen if isinstance(chosen, Sequence) else (0.0, 1.0)
            most = 1 + (high - low) // step
            if name == "start_insertion" and starts and anatomies == 1:
                most = starts
            values *= most
    if along := task_kwargs.get("start_along_route"):
        values *= STARTS_ALONG_ROUTE if along[1] > along[0] else 1
    return values >= max(episodes, 2) or (not along and ranges.start_radius > _NEAR)


def distinct_states(start: Snapshot) -> bool:
    """Whether all states of a snapshot differ by more than the jitter of the start.

    Two states differ if their heads are more than 2 mm apart, or if they are of another
    anatomy or have drawn other quantities, apart from noise and C-arm.
    """
    drawn = np.nan_to_num(drawn_in(start, _COMPARED))
    drawn = np.column_stack([drawn, start.arrays["rollout._case_of"]])
    heads = KDTree(start.arrays["rollout.readings.head"])
    one, other = heads.query_pairs(_NEAR, output_type="ndarray").T
    return len(start) > 1 and bool((drawn[one] != drawn[other]).any(axis=1).all())


def count_distinct(conditions: Iterable[Mapping[str, Any]]) -> int:
    """Return how many conditions of episodes differ, by the rule of `distinct`.

    Args:
        conditions: Of each episode, as in `Part.conditions`; with "insertion", m, where
            that of its start is known, which the draw is scaled and rounded to.
    """
    return len({json.dumps(_compared(one), sort_keys=True) for one in conditions})


def _compared(conditions: Mapping[str, Any]) -> dict[str, Any]:
    names = {"device", "arch", "anatomy", *_COMPARED}
    found = {name: conditions.get(name) for name in names}
    drawn = conditions.get("insertion_drawn") or 0.0
    found["insertion"] = conditions.get("insertion", round(drawn / START_SPACING))
    displacement = conditions.get("displacement_drawn") or (0.0,)
    if np.linalg.norm(displacement) > _NEAR:
        found["displacement"] = displacement
    return found
