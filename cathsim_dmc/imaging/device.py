"""Shadow of a slender device: path length or optical depth, frame by frame.

A device is a polyline with a radius: a chain of capsules. Its shadow is drawn with
sub-pixel accuracy even when it is thinner than a pixel, and keeps its weight: summed
over the image, thickness times pixel area is the volume of the device, wherever it
moves and however it turns.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from cathsim_dmc.imaging import kernel
from cathsim_dmc.imaging.carm import NEAREST, CArm

# Distance of the discs along the projected axis, px. At this distance the ripple of
# a rod thinner than a pixel stays below 0.5 % at every angle.
_SPACING = 1.0 / 3.0
# Discs may lie further apart on wide shadows: this fraction of their radius.
_RELATIVE_SPACING = 0.1
# Frames drawn at once: their sums fit the processor's cache.
_CHUNK = 16


def device_thickness(
    carm: CArm,
    points: ArrayLike,
    radius: ArrayLike,
) -> np.ndarray:
    """Path length through a device, averaged over each pixel.

    Args:
        carm: the view.
        points: (..., n, 3) joints of the device from its base to its tip, world
            frame, m, n >= 2.
        radius: its radius, m: one number, one per device (...,), or one per link
            (..., n - 1).

    Returns:
        (..., rows, columns) float32, m. Overlaps add up; the two ends of the chain
        are round, drawn as a cylinder of the volume of a hemisphere. Links with a
        joint that is not finite or not in front of the source are left out.

    Raises:
        ValueError: if shapes do not match, a radius is not positive, or a shadow is
            wider than 256 pixels.
    """
    return device_attenuation(carm, points, radius, mu=1.0)


def device_attenuation(
    carm: CArm,
    points: ArrayLike,
    radius: ArrayLike,
    mu: float,
    marker_mu: float | None = None,
    marker_length: float = 0.0,
) -> np.ndarray:
    """Optical depth of a device with a marker at its tip, averaged over each pixel.

    Args:
        carm, points, radius: as in `device_thickness`.
        mu: attenuation of the device, homogenised over its cross-section, 1/m.
        marker_mu: attenuation of the marker, 1/m; None for a device without one.
        marker_length: length of the marker, m, measured back from the tip.

    Returns:
        (..., rows, columns) float32, no unit.

    Raises:
        ValueError: as in `device_thickness`.
    """
    points, radius, batch = _chain(points, radius)
    if marker_mu is None:
        marker_mu, marker_length = mu, 0.0
    image = np.empty((len(points), *carm.resolution), dtype=np.float32)
    for start in range(0, len(points), _CHUNK):
        part = slice(start, start + _CHUNK)
        image[part] = _drawn(
            carm, points[part], radius[part], mu, marker_mu, marker_length
        )
    return image.reshape(*batch, *carm.resolution)


def _chain(points: ArrayLike, radius: ArrayLike):
    """Points (B, n, 3), radii (B, n - 1) and the batch shape."""
    points = np.asarray(points, dtype=np.float64)
    if points.ndim < 2 or points.shape[-1] != 3 or points.shape[-2] < 2:
        raise ValueError(
            f"points have shape {points.shape}; give (..., n, 3) with n >= 2."
        )
    batch, links = points.shape[:-2], points.shape[-2] - 1
    radius = np.asarray(radius, dtype=np.float64)
    per_link = radius.ndim == points.ndim - 1
    try:
        radius = np.broadcast_to(
            radius if per_link else radius[..., None], (*batch, links)
        )
    except ValueError:
        raise ValueError(
            f"radius has shape {radius.shape}; for points {points.shape} give one "
            f"number, {batch} or {(*batch, links)}."
        ) from None
    if not (radius > 0.0).all():
        raise ValueError(f"the smallest radius is {radius.min():g} m; it must be > 0.")
    return points.reshape(-1, links + 1, 3), radius.reshape(-1, links), batch


def _drawn(carm, points, radius, mu, marker_mu, marker_length) -> np.ndarray:
    """Optical depth (B, rows, columns) float64 of B chains."""
    with np.errstate(invalid="ignore"):  # joints that are not finite
        camera = np.stack(carm.camera(points), axis=-1)
    tail, head = camera[:, :-1], camera[:, 1:]
    along = head - tail
    # Written out: np.linalg.norm and matmul need not round alike for all shapes.
    length = np.sqrt(along[..., 0] ** 2 + along[..., 1] ** 2 + along[..., 2] ** 2)
    tail, head, along, length = _with_caps(tail, head, along, length, radius)
    # Arc length from the distal end of each link to the tip.
    to_tip = np.cumsum(length[:, ::-1], axis=1)[:, ::-1] - length

    frames, links = length.shape
    rows, columns = carm.resolution
    focal = carm.focal_length
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        wide = radius * focal / np.minimum(tail[..., 2], head[..., 2])
        start = tail[..., :2] * (focal / tail[..., 2:])
        stop = head[..., :2] * (focal / head[..., 2:])
        half = np.array([0.5 * columns, 0.5 * rows]) + wide[..., None]
        seen = (
            (tail[..., 2] > NEAREST)
            & (head[..., 2] > NEAREST)
            & (length > 0.0)
            & (np.minimum(start, stop) < half).all(axis=-1)
            & (np.maximum(start, stop) > -half).all(axis=-1)
        )
    # NaN and infinity compare false above or make the length not finite.
    seen &= np.isfinite(length)
    link = np.flatnonzero(seen)
    image = np.zeros((frames, rows, columns))
    if not len(link):
        return image

    tail, along = tail.reshape(-1, 3)[link], along.reshape(-1, 3)[link]
    radius, length = radius.reshape(-1)[link], length.reshape(-1)[link]
    shift = (stop - start).reshape(-1, 2)[link]
    wide = wide.reshape(-1)[link]
    if wide.max() > kernel.WIDEST:
        raise ValueError(
            f"a shadow is {wide.max():.0f} px in radius; at most {kernel.WIDEST} can "
            "be drawn. Lower the resolution or magnification, or check the radius "
            "(metres)."
        )
    spacing = np.maximum(_SPACING, _RELATIVE_SPACING * wide)
    count = np.ceil(np.sqrt(shift[:, 0] ** 2 + shift[:, 1] ** 2) / spacing)
    # A link that runs far out of the image must not fill the memory.
    most = 4.0 * (rows + columns) / _SPACING
    count = np.minimum(np.maximum(count, 1.0), most).astype(np.int64)

    # One row per disc.
    of = np.repeat(np.arange(len(link)), count)
    step = np.arange(len(of)) - np.repeat(np.cumsum(count) - count, count)
    fraction = (step + 0.5) / count[of]
    right, down, depth = (tail[of, i] + fraction * along[of, i] for i in range(3))
    piece = (length / count)[of]
    weight = np.full(len(of), float(mu))
    if marker_length > 0.0:
        distal = to_tip.reshape(-1)[link][of] + (1.0 - fraction) * length[of]
        inside = (marker_length - distal) / piece + 0.5
        inside = np.minimum(np.maximum(inside, 0.0), 1.0)
        weight += (marker_mu - mu) * inside
    # A pixel sees, at this depth, an area (depth / focal)² across the beam axis and
    # 1 / slant of that across its ray; volume over area is the mean path length.
    slant = np.sqrt(right**2 + down**2 + depth**2) / depth
    weight *= np.pi * radius[of] ** 2 * piece * slant * (focal / depth) ** 2
    scale = focal / depth
    _add_discs(
        image,
        link[of] // links,
        down * scale + 0.5 * (rows - 1),
        right * scale + 0.5 * (columns - 1),
        radius[of] * scale,
        weight,
    )
    return image


def _with_caps(tail, head, along, length, radius):
    """Lengthen both ends by 2/3 radius: the volume of a hemispherical cap."""
    tail, head, along, length = tail.copy(), head.copy(), along.copy(), length.copy()
    for i, end, side in ((0, tail, -1.0), (-1, head, 1.0)):
        # A link without length has no direction and gets no cap. (Plain comparisons
        # and not np.nan_to_num or np.clip, which take longer than the rest.)
        reached = np.where(length[:, i] > 0.0, length[:, i], np.inf)
        unit = along[:, i] / reached[:, None]
        cap = 2.0 / 3.0 * radius[:, i]
        end[:, i] += side * cap[:, None] * unit
    for i in (0, -1):
        along[:, i] = head[:, i] - tail[:, i]
        length[:, i] = np.sqrt(
            along[:, i, 0] ** 2 + along[:, i, 1] ** 2 + along[:, i, 2] ** 2
        )
    return tail, head, along, length


def _add_discs(image, frame, row, column, radius, weight) -> None:
    """Add to `image` (B, rows, columns) the pixel shares of discs (n,), in place."""
    frames, rows, columns = image.shape
    near_row, near_column = np.floor(row + 0.5), np.floor(column + 0.5)
    reach = kernel.reach(radius)
    for side in range(int(reach.min()), int(reach.max()) + 1):
        # Discs whose centre is further out than this cannot touch the image.
        use = np.flatnonzero(
            (reach == side)
            & (near_row >= -side)
            & (near_row < rows + side)
            & (near_column >= -side)
            & (near_column < columns + side)
        )
        if not len(use):
            continue
        table = kernel.table(side)
        r, c = near_row[use], near_column[use]
        shares = table.shares[table.rows(radius[use], row[use] - r, column[use] - c)]
        shares *= weight[use, None].astype(np.float32)

        # Collected on an image with a border, so that no disc needs clipping.
        border = 2 * side
        high, broad = rows + 2 * border, columns + 2 * border
        first = (frame[use] * high + r.astype(np.int64) + side) * broad
        first += c.astype(np.int64) + side
        k = np.arange(2 * side + 1)
        pixel = first[:, None] + (k[:, None] * broad + k).ravel()
        total = np.bincount(
            pixel.ravel(), weights=shares.ravel(), minlength=frames * high * broad
        ).reshape(frames, high, broad)
        image += total[:, border : border + rows, border : border + columns]
