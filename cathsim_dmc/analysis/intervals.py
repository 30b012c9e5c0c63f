"""Confidence intervals."""

from collections.abc import Sequence

import numpy as np


def success_interval(successes: int, trials: int) -> tuple[float, float]:
    """Wilson's 95 % interval of a success rate, as fractions."""
    # Imported late: it takes most of a second.
    from scipy import stats

    interval = stats.binomtest(successes, trials).proportion_ci(method="wilson")
    return float(interval.low), float(interval.high)


def interquartile_mean(
    scores: Sequence[Sequence[float]], resamples: int = 10_000, seed: int = 0
) -> tuple[float, tuple[float, float] | None]:
    """Mean of the middle half of all runs, with its 95 % interval over seeds.

    As in Agarwal et al. (2021), "Deep reinforcement learning at the edge of the
    statistical precipice": the runs of every task are resampled on their own
    (stratified bootstrap, percentile interval).

    Args:
        scores: Scores of the runs (seeds) of each task; their numbers may differ.
        resamples: Number of bootstrap samples.
        seed: Seed of the bootstrap.

    Returns:
        The mean, and its interval: None unless every task has two runs at least.

    Raises:
        ValueError: there is no task, or one without a run.
    """
    from scipy import stats

    tasks = [np.asarray(runs, dtype=np.float64) for runs in scores]
    if not tasks or not all(len(runs) for runs in tasks):
        raise ValueError(f"every task needs a run; given are {scores!r}")
    mean = float(stats.trim_mean(np.concatenate(tasks), 0.25))
    if min(len(runs) for runs in tasks) < 2:
        return mean, None
    random = np.random.default_rng(seed)
    drawn = [
        runs[random.integers(len(runs), size=(resamples, len(runs)))] for runs in tasks
    ]
    means = stats.trim_mean(np.concatenate(drawn, axis=1), 0.25, axis=1)
    low, high = np.percentile(means, (2.5, 97.5))
    return mean, (float(low), float(high))
