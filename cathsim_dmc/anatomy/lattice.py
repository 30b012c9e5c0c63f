"""Points of a regular lattice inside a lumen."""

from collections.abc import Callable

import numpy as np

MARGIN = 4e-3  # m, by which the box of a field exceeds the lumen
# Points along the edges of the blocks that are looked at first, and of their parts.
_BLOCKS = ((8, 2), (2, 1))
# An interpolated depth may change by a little more than 1 m per m.
_SLOPE = 1.2


def inside(
    depth: Callable[[np.ndarray], np.ndarray],
    low: np.ndarray,
    shape: np.ndarray,
    spacing: float,
    above: float = 0.0,
) -> tuple[np.ndarray, np.ndarray]:
    """Lattice points deeper than a depth; only blocks near the lumen are evaluated.

    Args:
        depth: signed depth (n,) m of points (n, 3) m in the lumen, > 0 inside.
        low: (3,) m, the first point.
        shape: (3,) numbers of points.
        spacing: m.
        above: m, smallest depth.

    Returns:
        (ijk (n, 3) int64, depth (n,) m).
    """
    size = _BLOCKS[0][0]
    ijk = size * np.argwhere(np.ones(-(-np.asarray(shape) // size), bool))
    for size, part in _BLOCKS:
        half = 0.5 * (size - 1) * spacing
        near = depth(low + spacing * ijk + half) > above - _SLOPE * np.sqrt(3) * half
        cells = part * np.argwhere(np.ones((size // part,) * 3, bool))
        ijk = (ijk[near][:, None] + cells).reshape(-1, 3)
    ijk = ijk[(ijk < shape).all(-1)]
    found = depth(low + spacing * ijk)
    return ijk[found > above], found[found > above]
