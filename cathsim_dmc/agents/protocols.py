"""Conditions under which policies are evaluated."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from cathsim_dmc import suite
from cathsim_dmc.entities import devices
from cathsim_dmc.physics.randomisation import START_JITTER, Episode, Randomisation

# Strata of each quantity, and candidates for each episode to fill them from.
_STRATA, _CANDIDATES = 10, 20
_STRATIFIED = (
    "friction", "stiffness", "loss", "viscosity", "roll", "delay", "start_insertion",
)  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Protocol:
    """Conditions of an evaluation.

    Attributes:
        text: One sentence for `--help` and reports.
        episodes: Number of episodes, unless another one is asked for.
        task_kwargs: Options of the task, over all others.
        devices: Steerable devices that episodes take in turn, in place of the task's.
    """

    text: str
    episodes: int
    task_kwargs: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    devices: tuple[str, ...] = ()


VARIED_RANGES = Randomisation(
    friction=(0.02, 0.15),
    stiffness=(0.7, 1.3),
    loss=(0.5, 2.0),
    viscosity=(0.5, 2.0),
    start_radius=0.01,
    start_insertion=(0.0, 0.06),
    roll=(-np.pi, np.pi),
    delay=(0, 3),
    tracking_noise=0.5e-3,
    view=(-10.0, 10.0),
    gain=(0.85, 1.15),
    kerma=(0.5, 2.0),
)

PROTOCOLS = {
    "published": Protocol(
        "The task as it is; episodes differ by 1 mm of the start, so they are nearly "
        "one.",
        30,
    ),
    "varied": Protocol(
        "Start within 60 mm and 10 mm off the line, any roll, another friction, "
        "stiffness, loss, viscosity, delay and device in each episode, noise on "
        "tracked points and in images.",
        100,
        {"randomisation": VARIED_RANGES},
        ("steerable_5f", "steerable_4f"),
    ),
}


@dataclasses.dataclass(frozen=True)
class Part:
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
    if name not in PROTOCOLS:
        raise ValueError(f"no protocol {name!r}; there are {', '.join(PROTOCOLS)}")
    return PROTOCOLS[name]


def parts(
    protocol: Protocol,
    task: str,
    task_kwargs: Mapping[str, Any],
    episodes: int,
    seed: int,
) -> tuple[Part, ...]:
    """The episodes of an evaluation, those of each device together.

    Args:
        protocol: Conditions.
        task: Name of the task.
        task_kwargs: Options of the task, which the protocol changes.
        episodes: Number of episodes.
        seed: The seeds lie at or above it: one after the other without variation, and
            otherwise those that fill every tenth of each range alike.
    """
    options = {**task_kwargs, **protocol.task_kwargs}
    ranges = Randomisation.make(options.get("randomisation", False))
    pools = _pools(protocol, task, options)
    found = []
    for number, own in enumerate(pools):
        count = len(range(number, episodes, len(pools)))
        if not count:
            continue
        first = seed + number * _CANDIDATES * episodes
        seeds = tuple(range(first, first + count))
        if protocol.task_kwargs:
            seeds = stratified(ranges, count, first, random_arch(task))
        found.append(Part(own, seeds, _conditions(ranges, seeds, task, own)))
    return tuple(found)


def _pools(
    protocol: Protocol, task: str, options: dict[str, Any]
) -> list[dict[str, Any]]:
    preset = suite.TASKS[task].options if task in suite.TASKS else {}
    coaxial = options.get("devices", preset.get("devices"))
    own = options.get("device", "steerable_5f")
    if coaxial or own not in devices.DEVICES or own not in protocol.devices:
        return [options]
    return [{**options, "device": name} for name in protocol.devices]


def random_arch(task: str) -> bool:
    """Whether each episode of a task draws an anatomy."""
    return task in suite.TASKS and suite.TASKS[task].random_arch


def _drawn(ranges: Randomisation, seed: int, pool: bool) -> Episode:
    """What an episode of that seed draws, after its anatomy."""
    source = np.random.RandomState(seed)
    if pool:
        source.randint(2)
    return ranges.draw(source)


def _conditions(
    ranges: Randomisation, seeds: Sequence[int], task: str, options: Mapping[str, Any]
) -> tuple[Mapping[str, Any], ...]:
    if ranges == Randomisation():
        return ()
    device = options.get("device")
    drawn = [_drawn(ranges, seed, random_arch(task)) for seed in seeds]
    return tuple(
        {
            "device": device,
            **{
                name: value.tolist() if isinstance(value, np.ndarray) else value
                for name, value in dataclasses.asdict(one).items()
                if value is not None
            },
        }
        for one in drawn
    )


def stratified(
    ranges: Randomisation, count: int, seed: int, pool: bool
) -> tuple[int, ...]:
    """Seeds whose draws fill every tenth of each range alike.

    Of 20 candidates an episode, those are taken one after the other whose draws lie
    where the fewest are.

    Args:
        ranges: What is drawn.
        count: Number of seeds.
        seed: The candidates begin there.
        pool: Whether an anatomy is drawn before.

    Returns:
        Seeds (count,), ascending.
    """
    candidates = np.arange(seed, seed + _CANDIDATES * count)
    shares = np.array([_shares(ranges, int(c), pool) for c in candidates])
    bins = np.minimum((shares * _STRATA).astype(int), _STRATA - 1)
    columns = np.arange(bins.shape[1])
    filled = np.zeros((len(columns), _STRATA), dtype=int)
    free = np.ones(len(candidates), dtype=bool)
    for _ in range(count):
        crowd = (filled[columns, bins] ** 2).sum(axis=1)
        chosen = int(np.where(free, crowd, np.iinfo(int).max).argmin())
        free[chosen] = False
        filled[columns, bins[chosen]] += 1
    return tuple(candidates[~free].tolist())


def _shares(ranges: Randomisation, seed: int, pool: bool) -> list[float]:
    """Where in their ranges the draws of a seed lie, from 0 to 1."""
    episode, shares = _drawn(ranges, seed, pool), []
    for name in _STRATIFIED:
        chosen = getattr(ranges, name)
        if isinstance(chosen, Sequence) and chosen[1] > chosen[0]:
            drawn = getattr(episode, name.removeprefix("start_"))
            shares.append((drawn - chosen[0]) / (chosen[1] - chosen[0]))
    return shares


def distinct(task: str, task_kwargs: Mapping[str, Any]) -> bool:
    """Whether episodes differ by more than the published jitter of the start.

    Tasks outside the suite are taken to.
    """
    if task not in suite.TASKS:
        return True
    ranges = Randomisation.make(task_kwargs.get("randomisation", False))
    wide = dataclasses.replace(ranges, start_radius=START_JITTER) != Randomisation()
    along = task_kwargs.get("start_along_route") is not None
    return wide or along or random_arch(task) or ranges.start_radius > 2e-3
