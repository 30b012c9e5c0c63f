"""Views of a vessel with the fewest ambiguous places.

The visual hull of two outlines also has places outside the vessel, as between branches
that lie side by side in both views. The hull of many views has few such places, so a
place is ambiguous if it is outside that hull and inside that of the pair.
"""

import itertools
from dataclasses import replace

import numpy as np
from scipy.ndimage import distance_transform_edt as distances

from cathsim_dmc.anatomy.parts import Surface
from cathsim_dmc.imaging.carm import CArm
from cathsim_dmc.imaging.options import FluoroscopyOptions, is_best
from cathsim_dmc.imaging.thickness import surface_thickness

# Primary and secondary angles that are tried, degrees: what a gantry reaches freely.
PRIMARY, SECONDARY = range(-60, 91, 15), (-20, 0, 20)
# Least and largest angle between the beams of a pair, degrees.
_BETWEEN = (55.0, 125.0)
_SPACING = 3e-3  # m, of the places that are counted
_INSIDE, _OUTSIDE = 0.5e-3, -1.5e-3  # m, from the outlines

Angles = tuple[float, float]


def best_views(
    surface: Surface, arm: CArm, known: tuple[CArm, ...] = ()
) -> list[Angles]:
    """Angles of the views with the fewest ambiguous places, degrees.

    Args:
        surface: Surface of the lumen, world frame, m.
        arm: C-arm with the isocentre and the distances of the views.
        known: The two C-arms of a pair, to find a third view; empty to find the pair.

    Returns:
        (primary, secondary) of the pair, or of the third view alone.
    """
    angles = list(itertools.product(PRIMARY, SECONDARY))
    arms = [replace(arm, primary=p, secondary=s) for p, s in np.deg2rad(angles)]
    low, high = surface.vertices.min(axis=0), surface.vertices.max(axis=0)
    axes = [np.arange(a, b, _SPACING) for a, b in zip(low, high, strict=True)]
    places = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    depths = np.stack([_depths(surface, one, places) for one in (*arms, *known)])
    shown = depths[:, depths.min(axis=0) < _OUTSIDE] > _INSIDE
    if known:
        left = shown[: len(arms)] & shown[len(arms) :].all(axis=0)
        return [angles[int(left.sum(axis=1).argmin())]]
    beams = np.stack([one.axes[2] for one in arms])
    between = np.rad2deg(np.arccos(np.clip(beams @ beams.T, -1.0, 1.0)))
    pairs = [
        (int((shown[i] & shown[k]).sum()), i, k)
        for i, k in itertools.combinations(range(len(arms)), 2)
        if _BETWEEN[0] <= between[i, k] <= _BETWEEN[1]
    ]
    _, first, second = min(pairs)
    return [angles[first], angles[second]]


def settled(surface: Surface, options: FluoroscopyOptions) -> FluoroscopyOptions:
    """The options with angles in place of "best"."""
    vertices = surface.vertices
    if is_best(options.view):
        first, second = best_views(surface, options.carms(vertices)[0])
        options = replace(options, view=first, biplane=second)
    if is_best(options.third):
        known = options.carms(vertices)
        options = replace(options, third=best_views(surface, known[0], known)[0])
    return options


def _depths(surface: Surface, arm: CArm, places: np.ndarray) -> np.ndarray:
    """Signed distances (n,) of places (n, 3) from an outline, + inside, m."""
    inside = surface_thickness(arm, surface, 1) > 0.0
    wall = np.where(inside, distances(inside) - 0.5, 0.5 - distances(~inside))
    pixels, depth = arm.project(places)
    column, row = np.nan_to_num(pixels, nan=-1.0).round().astype(int).T
    rows, columns = arm.resolution
    seen = wall[row.clip(0, rows - 1), column.clip(0, columns - 1)]
    return seen * depth / arm.focal_length
