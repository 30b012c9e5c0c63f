"""Heatmaps of contact forces, projected along y (phantoms: from the front)."""

import os
from dataclasses import dataclass

import numpy as np

from cathsim_dmc import bounds
from cathsim_dmc.anatomy.parts import Surface
from cathsim_dmc.files import atomic_path, require_file

# m; about the diameter of the device. Smaller cells would separate the contacts of one
# place.
CELL = 2e-3
# Margin around the vessel in the picture, m.
MARGIN = 5e-3
# Columns of the antero-posterior projection: x (lateral, patient left on the right
# of the picture, as the reader faces the patient) and z (up).
AP_AXES = (0, 2)
_PICTURE_HEIGHT_IN, _COLOUR_BAR_IN = 7.0, 1.6
_LEAST_WIDTH_IN, _LARGEST_WIDTH_IN = 4.0, 14.0
_DPI = 150


@dataclass(frozen=True, eq=False)
class ForceMap:
    """Mean contact force per cell of the AP projection.

    Attributes:
        x_edges: (nx+1,) edges of the columns, metres.
        z_edges: (nz+1,) edges of the rows, metres.
        mean: (nz, nx) mean magnitude of the contacts in a cell, newtons; NaN where
            there was no contact.
        count: (nz, nx) int64 number of contacts.
        outside: Number of contacts beyond the map, which it leaves out.
    """

    x_edges: np.ndarray
    z_edges: np.ndarray
    mean: np.ndarray
    count: np.ndarray
    outside: int


def force_map(
    position: np.ndarray,
    force: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    cell: float = CELL,
) -> ForceMap:
    """Average contact forces over the cells of the AP projection.

    The mean is over contacts, not over time, as in the published heatmaps: a single
    contact gives a cell as much weight as permanent contact.

    Args:
        position: (K, 3) places of contact, world frame, metres.
        force: (K,) magnitudes, newtons.
        low: (2,) lower corner (x, z) of the map, metres.
        high: (2,) upper corner; the map grows to whole cells.
        cell: Side of a cell, metres.

    Raises:
        ValueError: if an array has another shape, or a contact is farther than 10 m
            from the origin, as in millimetres.
    """
    position = bounds.array("position", position, shape=(-1, 3))
    force = bounds.array("force", force, shape=(len(position),))
    farthest = float(np.abs(position).max(initial=0.0))
    bounds.number("farthest coordinate of position", farthest, 0.0, bounds.FAR, "m")
    low, high = np.asarray(low, np.float64), np.asarray(high, np.float64)
    shape = np.maximum(np.ceil((high - low) / cell - 1e-9).astype(int), 1)
    # One more half cell, dropped afterwards, excludes points on the far edges.
    edges = [
        low[k] + cell * np.append(np.arange(n + 1), n + 0.5)
        for k, n in enumerate(shape)
    ]
    x, z = position[:, AP_AXES].T
    count = np.histogram2d(z, x, edges[::-1])[0][:-1, :-1].astype(np.int64)
    total = np.histogram2d(z, x, edges[::-1], weights=force)[0][:-1, :-1]
    mean = np.where(count > 0, total / np.maximum(count, 1), np.nan)
    outside = len(force) - int(count.sum())
    return ForceMap(edges[0][:-1], edges[1][:-1], mean, count, outside)


def heatmap(
    position: np.ndarray,
    force: np.ndarray,
    surface: Surface,
    path: str | os.PathLike[str],
    title: str = "",
    upright: bool = True,
) -> ForceMap:
    """Draw the mean of contact forces over the vessel, as a PNG.

    Args:
        position: (K, 3) places of contact, world frame, m.
        force: (K,) magnitudes, N.
        surface: The vessel.
        path: Target, ``*.png``; written atomically.
        title: Title of the picture.
        upright: Whether +x is the patient's left and +z the head.

    Returns:
        The drawn map.

    Raises:
        ValueError: as `force_map`; if `surface` is no `Surface`, or `path` no .png.
        OSError: if `path` cannot be written.
    """
    from matplotlib.collections import PolyCollection
    from matplotlib.figure import Figure

    bounds.instance("surface", surface, Surface)
    if require_file(path).suffix != ".png":
        raise ValueError(f"the map is to be written to {path}; give a .png file")
    outline = surface.vertices[:, AP_AXES]
    field = force_map(position, force, outline.min(0) - MARGIN, outline.max(0) + MARGIN)
    x_mm, z_mm = 1e3 * field.x_edges, 1e3 * field.z_edges
    width = _PICTURE_HEIGHT_IN * np.ptp(x_mm) / np.ptp(z_mm) + _COLOUR_BAR_IN
    size = np.clip(width, _LEAST_WIDTH_IN, _LARGEST_WIDTH_IN), _PICTURE_HEIGHT_IN
    figure = Figure(figsize=size, layout="constrained")
    axes = figure.add_subplot()
    triangles = list(1e3 * outline[surface.faces])
    # All triangles are drawn twice, dark and wide, then light on top: the silhouette
    # keeps a dark rim.
    for colour, rim in (("0.45", 2.2), ("0.9", 0.6)):
        look = {"facecolors": colour, "edgecolors": colour, "lw": rim}
        axes.add_collection(PolyCollection(triangles, **look))
    image = axes.pcolormesh(
        x_mm, z_mm, 1e3 * np.ma.masked_invalid(field.mean), cmap="inferno_r", zorder=3,
        # A map without force still needs a scale.
        vmin=0.0, vmax=1e3 * np.nanmax(field.mean) if field.count.any() else 1.0,
    )  # fmt: skip
    bar = figure.colorbar(image, ax=axes, shrink=0.8)
    bar.set_label("mean contact force at the ends of control steps, mN")
    axes.set(xlim=x_mm[[0, -1]], ylim=z_mm[[0, -1]], aspect="equal")
    left, head = (" (patient left →)", " (head ↑)") if upright else ("", "")
    axes.set(xlabel=f"x, mm{left}", ylabel=f"z, mm{head}")
    axes.set_title(title, fontsize=11)
    with atomic_path(path, ".png") as temporary:
        figure.savefig(temporary, format="png", dpi=_DPI)
    return field
