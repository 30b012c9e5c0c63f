"""Where the device presses on the wall, seen from the front."""

from __future__ import annotations

import os
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from cathsim_dmc import bounds
from cathsim_dmc.files import atomic_path
from cathsim_dmc.recording.episode import Episode
from cathsim_dmc.recording.geometry import surface_arrays

SUFFIX = ".png"
# Cells of 2 mm: about the diameter of the device, below which neighbouring contacts
# of one place would be told apart.
CELL = 2e-3
# Margin around the vessel in the picture.
MARGIN = 5e-3
# Columns of the antero-posterior projection: x (lateral, patient left on the right
# of the picture, as the reader faces the patient) and z (up).
AP_AXES = (0, 2)
_PICTURE_HEIGHT_IN, _PICTURE_WIDTH_RANGE_IN, _COLOUR_BAR_IN = 7.0, (4.0, 14.0), 1.6
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

    The mean is over contacts, not over time: a place that is touched once counts as
    one that is touched always, as in the published heatmaps.

    Args:
        position: (K, 3) places of contact, world frame, metres.
        force: (K,) magnitudes, newtons.
        low: (2,) lower corner (x, z) of the map, metres.
        high: (2,) upper corner; the map grows to whole cells.
        cell: Side of a cell, metres.
    """
    position = np.asarray(position, dtype=np.float64).reshape(-1, 3)
    force = np.asarray(force, dtype=np.float64)
    low, high = np.asarray(low, np.float64), np.asarray(high, np.float64)
    shape = np.maximum(np.ceil((high - low) / cell - 1e-9).astype(int), 1)
    # Half a cell more keeps what lies on the far edges out of the map.
    edges = [
        low[k] + cell * np.append(np.arange(n + 1), n + 0.5)
        for k, n in enumerate(shape)
    ]
    x, z = position[:, AP_AXES].T
    count = np.histogram2d(z, x, edges[::-1])[0][:-1, :-1].astype(np.int64)
    total = np.histogram2d(z, x, edges[::-1], weights=force)[0][:-1, :-1]
    mean = np.full(count.shape, np.nan)
    np.divide(total, count, out=mean, where=count > 0)
    outside = len(force) - int(count.sum())
    return ForceMap(edges[0][:-1], edges[1][:-1], mean, count, outside)


def heatmap(
    episodes: Iterable[Episode],
    surface: Any,
    path: str | os.PathLike[str],
    **options: Any,
) -> ForceMap:
    """Draw the mean contact force of some episodes over the vessel, as a PNG.

    Args:
        episodes: All evaluation episodes; one without contact adds nothing.
        surface: The vessel, ``(vertices, faces)`` or an object with these, metres.
        path: Target, ``*.png``; appears whole or not at all.

    Raises:
        ValueError: if there are no episodes, or ``force_limit`` is not positive.
    """
    episodes = list(episodes)
    if not episodes:
        raise ValueError("a heatmap needs at least one episode")
    position = np.concatenate([e.contact_position for e in episodes])
    force = np.concatenate([np.linalg.norm(e.contact_force, axis=-1) for e in episodes])
    tasks = ", ".join(sorted({e.task for e in episodes}))
    title = f"{tasks}\nepisodes {len(episodes)}, contacts {len(force)}"
    options.setdefault("title", title)
    return contact_heatmap(position, force, surface, path, **options)


def contact_heatmap(
    position: np.ndarray,
    force: np.ndarray,
    surface: Any,
    path: str | os.PathLike[str],
    *,
    cell: float = CELL,
    force_limit: float | None = None,
    title: str = "",
) -> ForceMap:
    """Draw contact forces (K,) in N at positions (K, 3), m, see `heatmap`.

    Args:
        position: World frame.
        path: Target, ``*.png``.
        cell: Side of a cell of the map, metres.
        force_limit: Top of the colour scale in newtons, to compare pictures; by
            default the largest mean of the map.
    """
    bounds.number("cell", cell, positive=True)
    if force_limit is not None:
        bounds.number("force_limit", force_limit, positive=True)
    vertices, faces = surface_arrays(surface)
    outline = vertices[:, AP_AXES]
    field = force_map(
        position, force, outline.min(0) - MARGIN, outline.max(0) + MARGIN, cell
    )
    figure = _figure(field, outline, faces, force_limit, title)
    with atomic_path(path, SUFFIX) as temporary:
        figure.savefig(temporary, format="png", dpi=_DPI)
    return field


def _figure(
    field: ForceMap,
    outline: np.ndarray,
    faces: np.ndarray,
    force_limit: float | None,
    title: str,
) -> Any:
    """Build the picture with matplotlib's objects, which leave pyplot alone."""
    from matplotlib.collections import PolyCollection
    from matplotlib.figure import Figure

    x_mm, z_mm = 1e3 * field.x_edges, 1e3 * field.z_edges
    width = _PICTURE_HEIGHT_IN * np.ptp(x_mm) / np.ptp(z_mm) + _COLOUR_BAR_IN
    size = np.clip(width, *_PICTURE_WIDTH_RANGE_IN), _PICTURE_HEIGHT_IN
    figure = Figure(figsize=size, layout="constrained")
    axes = figure.add_subplot()
    triangles = list(1e3 * outline[faces])
    # All triangles twice: dark and wide, then light on top, which leaves a dark rim
    # around the silhouette without computing it.
    for colour, rim in (("0.45", 2.2), ("0.9", 0.6)):
        look = {"facecolors": colour, "edgecolors": colour, "lw": rim}
        axes.add_collection(PolyCollection(triangles, **look))
    largest = float(np.nanmax(field.mean)) if field.count.any() else 0.0
    top = largest if force_limit is None else force_limit
    image = axes.pcolormesh(
        x_mm, z_mm, 1e3 * np.ma.masked_invalid(field.mean), cmap="inferno_r", zorder=3,
        # A map without force still needs a scale.
        vmin=0.0, vmax=1e3 * top if top > 0 else 1.0,
    )  # fmt: skip
    extend = "max" if largest > top else "neither"
    bar = figure.colorbar(image, ax=axes, extend=extend, shrink=0.8)
    bar.set_label("mean contact force, mN")
    axes.set(xlim=x_mm[[0, -1]], ylim=z_mm[[0, -1]], aspect="equal")
    axes.set(xlabel="x, mm (patient left →)", ylabel="z, mm (head ↑)")
    axes.set_title(title, fontsize=11)
    return figure
