"""Curves moved to the middle of a lumen."""

import numpy as np
from scipy.ndimage import gaussian_filter1d

from cathsim_dmc.anatomy.centreline import across, arc_lengths, distinct, interpolate
from cathsim_dmc.anatomy.surface_depth import SurfaceDepth

STEP = 1e-3  # m, spacing of the centrelines that result
SMOOTH = 0.6  # radii, standard deviation of the smoothing along a centreline
REACH = 0.5e-3  # m, to both sides of a curve, at which the depth is compared
NARROW = 1.5e-3  # m, radius below which smoothing would cut bends
ROUNDS = 32  # of centring; together they move a curve by up to 5 mm
RAYS = 24  # across a vessel, for the radius of its section
# Depths, m, up to which a radius is that of the ball, and from which of the section.
BALL, SECTION = 1.5e-3, 3e-3
SLIT = 1.25  # largest radius of a section, in radii of the ball


def resample(points: np.ndarray) -> np.ndarray:
    """Points of a polyline (n, 3) m at equal distances of about `STEP`."""
    points = distinct(points)
    s = arc_lengths(points)
    t = np.linspace(0.0, s[-1], max(2, int(round(s[-1] / STEP)) + 1))
    return interpolate(t, s, points)


def centred(
    field: SurfaceDepth, curve: np.ndarray, *, fixed_start: bool = False
) -> np.ndarray:
    """Move a curve (n, 3), m, sideways towards the middle of the lumen.

    Each round steps along the gradient of the depth across the curve, by decreasing
    steps, and smooths.
    """
    points = curve.copy()
    for turn in range(ROUNDS):
        share = 1.0 - turn / ROUNDS
        sides = across(points)
        offsets = REACH * np.concatenate([sides, -sides], axis=1)
        around = field(points[:, None] + offsets) / (2.0 * REACH)
        uphill = np.einsum("ns,nsd->nd", around[:, :2] - around[:, 2:], sides)
        move = 0.3e-3 * share * uphill
        smooth = gaussian_filter1d(points, 1.0, axis=0, mode="nearest")
        # Smoothing fades with the step: a constant one would cut tight bends.
        mixed = points + move + 0.6 * share * (smooth - points)
        mixed[-1] = points[-1] + move[-1]
        mixed[0] = points[0] if fixed_start else points[0] + move[0]
        points = mixed
        if turn % 10 == 9:
            points = resample(points)
    return resample(_smoothed(points, field(points)))


def section_radii(field: SurfaceDepth, points: np.ndarray) -> np.ndarray:
    """Radii (n,) m of the lumen along a curve (n, 3) in its middle.

    For a wide vessel it is the median distance to the wall over `RAYS` directions
    across the curve, which neither an ostium in the wall nor an eccentric curve
    changes; for a narrow vessel it is the radius of the largest ball.
    """
    ball = field(points)
    angle = 2.0 * np.pi * np.arange(RAYS) / RAYS
    turn = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    rays = np.einsum("rs,nsd->nrd", turn, across(points))
    reach = np.repeat(ball[:, None], RAYS, axis=1)
    # A ball with the radius of the depth holds no wall. SLIT bounds rays into ostia.
    for _ in range(4):
        depth = field(points[:, None] + reach[..., None] * rays)
        reach = np.minimum(reach + np.maximum(depth, 0.0), SLIT * ball[:, None])
    share = np.clip((ball - BALL) / (SECTION - BALL), 0.0, 1.0)
    return ball + share * (np.median(reach, axis=1) - ball)


def _smoothed(points: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """Smooth a curve over about half the lumen's radius, its ends kept.

    The depth is flat near the middle of a wide vessel and does not fix the curve there.
    """
    width = np.clip(SMOOTH * (depth - NARROW) / STEP, 0.0, 12.0)
    pad = min(len(points) - 1, 40)
    padded = np.pad(points, ((pad, pad), (0, 0)), mode="reflect", reflect_type="odd")
    levels = np.array([0.0, 1.0, 2.0, 4.0, 8.0, 12.0])
    bank = np.stack([points, *(_gauss(padded, x)[pad:-pad] for x in levels[1:])])
    at = np.interp(width, levels, np.arange(len(levels)))
    low = np.minimum(at.astype(int), len(levels) - 2)
    rest = (at - low)[:, None]
    row = np.arange(len(points))
    return (1.0 - rest) * bank[low, row] + rest * bank[low + 1, row]


def _gauss(points: np.ndarray, sigma: float) -> np.ndarray:
    """Bias-corrected Gaussian smoothing; keeps bends up to their third derivative."""
    once = gaussian_filter1d(points, sigma, axis=0, mode="nearest")
    return 2.0 * once - gaussian_filter1d(once, sigma, axis=0, mode="nearest")
