"""Force statistics, success rates and path lengths of recorded episodes.

The conventions are those of the published evaluation: every contact of the device
with the wall gives one sample f = sqrt(fx^2 + fy^2 + fz^2) per control step; an
episode has the mean and the maximum of its samples; an evaluation has the mean and
the standard deviation of these over its episodes.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtri

from cathsim_dmc.recording.episode import Episode

CONFIDENCE = 0.95


def magnitude(force: np.ndarray) -> np.ndarray:
    """Return |f| (...,) of forces (..., 3), in the unit of the forces."""
    return np.linalg.norm(np.asarray(force, dtype=np.float64), axis=-1)


@dataclass(frozen=True, eq=False)
class StepForces:
    """Contact forces per control step, newtons.

    Attributes:
        total: (T,) sum of magnitudes over the contacts of a step, 0 without any.
        largest: (T,) largest magnitude of a step, 0 without any contact.
        contacts: (T,) int64 number of contacts.
    """

    total: np.ndarray
    largest: np.ndarray
    contacts: np.ndarray


def step_forces(
    contact_step: np.ndarray, contact_force: np.ndarray, steps: int
) -> StepForces:
    """Reduce ragged contacts to one row per control step.

    Args:
        contact_step: (K,) integer step of every contact, in any order.
        contact_force: (K, 3) newtons.
        steps: Number of steps T.

    Raises:
        ValueError: if a contact names a step outside [0, T).
    """
    contact_step = np.asarray(contact_step, dtype=np.int64)
    size = magnitude(np.reshape(contact_force, (-1, 3)))
    if contact_step.shape != size.shape:
        raise ValueError(
            f"contact_step has shape {contact_step.shape}, the forces make "
            f"{size.shape} contacts"
        )
    if size.size and not 0 <= contact_step.min() <= contact_step.max() < steps:
        raise ValueError(
            f"contact_step must lie in [0, {steps}), got {contact_step.min()} to "
            f"{contact_step.max()}"
        )
    largest = np.zeros(steps)
    np.maximum.at(largest, contact_step, size)
    return StepForces(
        total=np.bincount(contact_step, size, minlength=steps),
        largest=largest,
        contacts=np.bincount(contact_step, minlength=steps),
    )


def path_length(points: np.ndarray) -> np.ndarray:
    """Return the length (...,) of polylines (..., n, 3), in the unit of the points."""
    points = np.asarray(points, dtype=np.float64)
    return np.linalg.norm(np.diff(points, axis=-2), axis=-1).sum(axis=-1)


def path_ratio(head: np.ndarray, route_length: float) -> np.ndarray:
    """Return travelled path of the head over the length of the route, dimensionless.

    It is 1 for a head that follows the centreline, less where it cuts corners or has
    not arrived, more where it wanders or goes back and forth.

    Args:
        head: (..., T+1, 3) positions of the head, metres.
        route_length: Length of the centreline from the first position of the head to
            the goal, metres.

    Raises:
        ValueError: if the route has no length.
    """
    if not route_length > 0:
        raise ValueError(f"route_length must be positive, got {route_length}")
    return path_length(head) / route_length


def wilson_interval(
    successes: int, trials: int, confidence: float = CONFIDENCE
) -> tuple[float, float]:
    """Return the Wilson score interval of a success probability, as fractions.

    Wilson, J. Am. Stat. Assoc. 22 (1927) 209-212. It stays inside [0, 1] and does
    not collapse to a point at 0 or ``trials`` successes.

    Raises:
        ValueError: if there are no trials, more successes than trials, or the
            confidence is not inside (0, 1).
    """
    if trials < 1 or not 0 <= successes <= trials:
        raise ValueError(
            "need at least one trial and 0 <= successes <= trials, got "
            f"{successes} of {trials}"
        )
    if not 0 < confidence < 1:
        raise ValueError(f"confidence must lie inside (0, 1), got {confidence}")
    z = float(ndtri(0.5 + confidence / 2))
    share = successes / trials
    middle = share + z * z / (2 * trials)
    half = z * math.sqrt(share * (1 - share) / trials + z * z / (4 * trials * trials))
    scale = 1 + z * z / trials
    # The bound at no or only successes is exact; rounding would leave it by 1e-17.
    low = 0.0 if successes == 0 else max(0.0, (middle - half) / scale)
    high = 1.0 if successes == trials else min(1.0, (middle + half) / scale)
    return low, high


@dataclass(frozen=True)
class EpisodeStatistics:
    """One episode in numbers; forces in newtons, lengths in metres.

    Attributes:
        steps: Control steps.
        reward: Sum of the rewards.
        success: Whether the task counted it as a success.
        contacts: Number of contact samples.
        f_mean: Mean magnitude over all contact samples, 0 without contact.
        f_max: Largest magnitude of a contact sample, 0 without contact.
        step_mean: Mean over all steps of the wall force sum; steps without contact
            count as 0.
        step_max: Largest wall force sum of a step.
        peak_max: Largest single contact of any physics step, which a sample per
            control step can miss, or None if it was not recorded.
        contact_share: Fraction of the steps that have contact.
        push_max: Largest magnitude of the push force.
        path: Travelled path of the head.
        path_ratio: ``path`` over the length of the route, or None without a route.
    """

    steps: int
    reward: float
    success: bool
    contacts: int
    f_mean: float
    f_max: float
    step_mean: float
    step_max: float
    peak_max: float | None
    contact_share: float
    push_max: float
    path: float
    path_ratio: float | None


def episode_statistics(
    episode: Episode, route_length: float | None = None
) -> EpisodeStatistics:
    """Return the statistics of one episode.

    Args:
        episode: The record.
        route_length: Length of the centreline from the start of the head to the
            goal in metres, for the path ratio.
    """
    size = magnitude(episode.contact_force)
    steps = step_forces(episode.contact_step, episode.contact_force, episode.steps)
    peaks = episode.meta.get("wall_force_peak_max")
    ratio = None
    if route_length is not None:
        ratio = float(path_ratio(episode.head, route_length))
    return EpisodeStatistics(
        steps=episode.steps,
        reward=float(episode.reward.sum()),
        success=episode.success,
        contacts=int(size.size),
        f_mean=_mean(size),
        f_max=float(size.max(initial=0.0)),
        step_mean=_mean(steps.total),
        step_max=float(steps.total.max(initial=0.0)),
        peak_max=None if peaks is None else max(peaks, default=0.0),
        contact_share=_mean(steps.contacts > 0),
        push_max=float(np.abs(episode.push_force).max(initial=0.0)),
        path=float(path_length(episode.head)),
        path_ratio=ratio,
    )


@dataclass(frozen=True)
class Spread:
    """Mean and sample standard deviation (n - 1) of ``count`` values.

    The standard deviation is None for fewer than two values.
    """

    mean: float
    sd: float | None
    count: int

    @classmethod
    def of(cls, values: Iterable[float]) -> Spread:
        """Summarise some values.

        Raises:
            ValueError: if there are none.
        """
        array = np.array(list(values), dtype=np.float64)
        if not array.size:
            raise ValueError("no values to summarise")
        sd = float(array.std(ddof=1)) if array.size > 1 else None
        return cls(float(array.mean()), sd, int(array.size))

    def __str__(self) -> str:
        return f"{self.mean:.4g}" + ("" if self.sd is None else f" ± {self.sd:.4g}")


@dataclass(frozen=True)
class EvaluationStatistics:
    """Several episodes in numbers; forces in newtons, lengths in metres.

    Attributes:
        episodes: Number of episodes.
        successes: Number of successes.
        success_rate: Fraction of successes.
        success_interval: Wilson interval of the success rate at ``CONFIDENCE``.
        reward: Over episodes, of the sum of the rewards.
        f_mean: Over episodes, of the mean contact force.
        f_max: Over episodes, of the largest contact force.
        step_mean: Over episodes, of the mean wall force sum per step.
        step_max: Over episodes, of the largest wall force sum of a step.
        steps: Over episodes, of the number of steps.
        path_ratio: Over successful episodes, or None without a route or a success:
            a head that stops half way has a short path, but not a good one.
    """

    episodes: int
    successes: int
    success_rate: float
    success_interval: tuple[float, float]
    reward: Spread
    f_mean: Spread
    f_max: Spread
    step_mean: Spread
    step_max: Spread
    steps: Spread
    path_ratio: Spread | None

    def as_dict(self) -> dict:
        """Return nested plain values that JSON can hold."""
        plain = dataclasses.asdict(self)
        plain["success_interval"] = list(self.success_interval)
        return plain


def evaluation_statistics(
    episodes: Sequence[EpisodeStatistics], confidence: float = CONFIDENCE
) -> EvaluationStatistics:
    """Aggregate episodes, each counting once however long it is.

    Raises:
        ValueError: if there are no episodes.
    """
    if not episodes:
        raise ValueError("no episodes to aggregate")
    successes = sum(e.success for e in episodes)
    ratios = [e.path_ratio for e in episodes if e.success and e.path_ratio is not None]
    over = {
        name: Spread.of(getattr(e, name) for e in episodes)
        for name in ("reward", "f_mean", "f_max", "step_mean", "step_max", "steps")
    }
    return EvaluationStatistics(
        episodes=len(episodes),
        successes=successes,
        success_rate=successes / len(episodes),
        success_interval=wilson_interval(successes, len(episodes), confidence),
        path_ratio=Spread.of(ratios) if ratios else None,
        **over,
    )


def force_samples(episodes: Iterable[Episode]) -> np.ndarray:
    """Return the magnitudes (n,) of all contact samples of all episodes, newtons."""
    samples = [magnitude(e.contact_force) for e in episodes]
    return np.concatenate([np.zeros(0), *samples])


def _mean(values: np.ndarray) -> float:
    return float(values.mean()) if values.size else 0.0
