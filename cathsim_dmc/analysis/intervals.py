"""Confidence intervals."""


def success_interval(successes: int, trials: int) -> tuple[float, float]:
    """Wilson's 95 % interval of a success rate, as fractions."""
    # Imported here, as it takes most of a second.
    from scipy import stats

    interval = stats.binomtest(successes, trials).proportion_ci(method="wilson")
    return float(interval.low), float(interval.high)
