"""Random draws of anatomical measures."""

import numpy as np

# Draws stop at `_CUT` standard deviations; what is left has `_CUT_DEVIATION` of one.
_CUT, _CUT_DEVIATION = 2.2, 0.9162

Random = np.random.RandomState | np.random.Generator


def uniform(source: Random, ends: tuple[float, float]) -> float:
    """A draw between two ends."""
    return source.uniform(ends[0], ends[1])


def normal(source: Random, spread: tuple[float, float] = (0.0, 1.0)) -> float:
    """A draw of a mean and deviation, cut off at 2.2 deviations."""
    mean, deviation = spread
    # Again, not clipped, or the bounds would be likely values.
    while True:
        z = float(source.normal())
        if abs(z) <= _CUT:
            return mean + deviation * (z / _CUT_DEVIATION)
