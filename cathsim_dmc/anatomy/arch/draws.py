"""Random draws of anatomical measures."""

import numpy as np

# A standard normal truncated at `_CUT` has the standard deviation `_CUT_DEVIATION`.
_CUT, _CUT_DEVIATION = 2.2, 0.9162

Random = np.random.RandomState | np.random.Generator


def uniform(source: Random, ends: tuple[float, float]) -> float:
    """Uniform draw between two ends (low, high)."""
    return source.uniform(ends[0], ends[1])


def normal(source: Random, spread: tuple[float, float] = (0.0, 1.0)) -> float:
    """Truncated normal draw (mean, standard deviation), within 2.4 deviations."""
    mean, deviation = spread
    # Redrawn, not clipped: clipping would make the bounds likely values.
    while True:
        z = float(source.normal())
        if abs(z) <= _CUT:
            return mean + deviation * (z / _CUT_DEVIATION)
