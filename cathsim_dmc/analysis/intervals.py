"""Confidence intervals."""

import numpy as np

BOOTSTRAP_SAMPLES = 10_000


def success_interval(successes: int, trials: int) -> tuple[float, float]:
    """Wilson's 95 % interval of a success rate, as fractions."""
    # Imported late: it takes most of a second.
    from scipy import stats

    interval = stats.binomtest(successes, trials).proportion_ci(method="wilson")
    return float(interval.low), float(interval.high)


def paired_bootstrap(
    first: np.ndarray, second: np.ndarray
) -> tuple[float, tuple[float, float] | None]:
    """Mean of first - second over pairs (n,), with its 95 % percentile interval.

    The interval is None for a single pair, which tells nothing about the spread.
    """
    from scipy import stats

    difference = np.asarray(first, np.float64) - np.asarray(second, np.float64)
    if len(difference) < 2:
        return float(difference.mean()), None
    interval = stats.bootstrap(
        (difference,), np.mean, n_resamples=BOOTSTRAP_SAMPLES, method="percentile",
        random_state=np.random.default_rng(0),
    ).confidence_interval  # fmt: skip
    return float(difference.mean()), (float(interval.low), float(interval.high))
