"""Conditions under which policies are evaluated."""

import dataclasses
import itertools
import types
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from cathsim_dmc import bounds, suite
from cathsim_dmc.physics.randomisation import Draw, Randomisation
from cathsim_dmc.tasks.anatomies import arch_numbers
from cathsim_dmc.tasks.start import START_SPACING, STARTS_ALONG_ROUTE

# Strata of each quantity, and candidates for each episode to fill them from.
_STRATA, _CANDIDATES = 10, 20
# What makes episodes distinct, and the step between its values.
_STEPS = dict.fromkeys(
    ("friction", "stiffness", "loss", "viscosity", "goal_shift", "roll"), 1e-9
) | {"delay": 1, "start_insertion": START_SPACING}
# What a start may have less of than drawn; a displacement may be drawn anew.
_REDUCED = "displacement", "insertion"


class Protocol(NamedTuple):
    """Conditions of an evaluation.

    Attributes:
        episodes: Number of episodes, unless another one is asked for.
        task_kwargs: Options of the task, over all others.
        devices: Devices that episodes take in turn where the options name none.
    """

    episodes: int
    task_kwargs: Mapping[str, Any] = types.MappingProxyType({})
    devices: tuple[str, ...] = ()

    def beside(self, options: Mapping[str, Any], given: Mapping[str, Any]) -> dict:
        """Options but those of the protocol; ValueError if one of these is given."""
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
    # The task as it is; episodes differ by 1 mm of the start, so they are nearly one.
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
    """The protocol of a name; ValueError lists those that there are."""
    return PROTOCOLS[bounds.choice("protocol", name, PROTOCOLS)]


def parts(
    protocol: Protocol,
    task: str,
    task_kwargs: Mapping[str, Any],
    episodes: int,
    seed: int,
) -> tuple[Part, ...]:
    """The episodes of an evaluation, those of each device together.

    Args:
        task_kwargs: Options over the task's own; those of the protocol go over both.
        seed: The seeds lie at or above it: one after the other without variation, and
            otherwise those that fill every tenth of each range alike and take the
            arches of a pool in turn.
    """
    definition = suite.TASKS.get(task)
    own = {} if definition is None else definition.options
    options = {**own, **task_kwargs, **protocol.task_kwargs}
    ranges = Randomisation.make(options.get("randomisation", False))
    pools = [options]
    if protocol.devices and not (options.get("devices") or options.get("device")):
        pools = [{**options, "device": name} for name in protocol.devices]
    drawn_from = definition is not None and definition.random_arch
    arches = len(arch_numbers(options)) if drawn_from else 1
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
        varied = () if ranges == Randomisation() else seeds
        drawn = tuple(_conditions(ranges, one, arches, own) for one in varied)
        # Objects would not go into the files of an episode; the task has its own.
        kept = {
            name: value
            for name, value in own.items()
            if name != "effects" or name in task_kwargs
        }
        found.append(Part(kept, seeds, drawn))
    return tuple(found)


def _conditions(
    ranges: Randomisation, seed: int, arches: int, options: Mapping[str, Any]
) -> Mapping[str, Any]:
    arch, episode = ranges.draw_in(np.random.RandomState(seed), arches)
    where = {"arch": arch_numbers(options)[arch]} if arches > 1 else {}
    values = {
        name + "_drawn" * (name in _REDUCED): np.asarray(value).tolist()
        for name, value in dataclasses.asdict(episode).items()
        if value is not None
    }
    return {"device": options.get("device"), **where, **values}


def stratified(
    ranges: Randomisation, wanted: Sequence[int], seed: int, arches: int
) -> tuple[int, ...]:
    """Seeds whose draws fill every tenth of each range alike.

    For each episode in turn, that of 20 candidates is taken whose draws lie where the
    fewest are.

    Args:
        wanted: Number of the arch of each episode in its pool.
        seed: The candidates begin there.
        arches: Number of arches in the pool, one of which a seed draws.

    Returns:
        Seeds, in the order of `wanted`.
    """
    # Candidates of each arch, as many as its episodes may choose from, and their bins.
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
    """Which tenths of their ranges the draws lie in."""
    shares = []
    for name in _STEPS:
        chosen = getattr(ranges, name)
        if isinstance(chosen, Sequence) and chosen[1] > chosen[0]:
            drawn = getattr(episode, name.removeprefix("start_"))
            shares.append((drawn - chosen[0]) / (chosen[1] - chosen[0]))
    return np.minimum((np.array(shares) * _STRATA).astype(int), _STRATA - 1)


def distinct(task: str, task_kwargs: Mapping[str, Any], episodes: int) -> bool:
    """Whether so many episodes can all differ by more than the jitter of the start.

    Noise and the C-arm do not count. Tasks outside the suite are taken to.
    """
    definition = suite.TASKS.get(task)
    if definition is None:
        return True
    ranges = Randomisation.make(task_kwargs.get("randomisation", False))
    values = len(arch_numbers(task_kwargs)) if definition.random_arch else 1
    for name, step in _STEPS.items():
        if (chosen := getattr(ranges, name)) is not None:
            low, high = chosen if isinstance(chosen, Sequence) else (0.0, 1.0)
            values *= 1 + (high - low) // step
    if along := task_kwargs.get("start_along_route"):
        values *= STARTS_ALONG_ROUTE if along[1] > along[0] else 1
    return values >= max(episodes, 2) or (not along and ranges.start_radius > 2e-3)
