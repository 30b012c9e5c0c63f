"""Forces in drawings: colours, scales and text; points of a polyline."""

import numpy as np

from cathsim_dmc.anatomy.centreline import arc_lengths, interpolate

# Top of the colour scale, newtons. Published in-contact forces lie mostly within
# 0-0.2 N with outliers above 0.4 N, so ordinary contacts use half the scale.
FORCE_COLOUR_MAX = 0.4

# Tops of the scale, newtons, for episodes with weaker forces.
_FORCE_SCALES = (0.02, 0.05, 0.1, 0.2, FORCE_COLOUR_MAX)

# Pale yellow over orange to dark red; monotone in lightness, so it survives
# greyscale printing and the common colour deficiencies.
_FORCE_COLOURS = np.array(
    [[255, 240, 150], [253, 170, 70], [225, 65, 40], [120, 0, 45]], dtype=np.float64
)


def force_colours(
    magnitude: np.ndarray, largest: float = FORCE_COLOUR_MAX
) -> np.ndarray:
    """Return RGB colours (..., 3) uint8 of forces (...,), N, from 0 to ``largest``."""
    stops = np.linspace(0.0, largest, len(_FORCE_COLOURS))
    mixed = interpolate(magnitude, stops, _FORCE_COLOURS)
    return np.round(mixed).astype(np.uint8)


def force_scale(magnitude: np.ndarray) -> float:
    """Return the top of a scale for forces (...,), N, at most ``FORCE_COLOUR_MAX``."""
    largest = float(np.max(magnitude, initial=0.0))
    return next((top for top in _FORCE_SCALES if largest <= top), FORCE_COLOUR_MAX)


def along(points: np.ndarray, way: np.ndarray) -> np.ndarray:
    """Return points (m, 3) of a polyline (n, 3) at arc lengths (m,), metres."""
    return interpolate(way, arc_lengths(points), points)


def force_text(newtons: float) -> str:
    """Return a force in three digits: millinewtons below 1 N, newtons from there."""
    # From 0.9995 N on, three digits of millinewtons would be 1e+03.
    return f"{newtons:.3g} N" if newtons >= 0.9995 else f"{1e3 * newtons:.3g} mN"
