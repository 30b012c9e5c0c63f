"""Shadow of a slender device: its optical depth, frame by frame.

A device is a chain of capsules whose axis is a smooth curve through the joints. The
chord of a ray through a round rod, as a function of the ray's distance from the axis,
is a half ellipse: the profile that a uniform disc leaves when it is swept along the
projected axis. So a shadow is a sum of discs, and a pixel receives of each the area
that the two share. Summed over the image, path length times pixel area is the volume of
the device, wherever it is.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from cathsim_dmc.compiled import compiled
from cathsim_dmc.imaging import materials
from cathsim_dmc.imaging.carm import NEAREST, CArm

# Distance of the discs along the projected axis, px. At this distance the ripple of
# a rod thinner than a pixel stays below 0.5 % at every angle.
_SPACING = 1.0 / 3.0
# Discs may lie further apart on wide shadows: this fraction of their radius.
_RELATIVE_SPACING = 0.1
# Largest radius of a disc, px; a wider one comes from a radius in another unit.
_WIDEST = 128


@dataclass(frozen=True, eq=False)
class Shadow:
    """A device, or one of several coaxial ones, in the beam.

    Attributes:
        points: (..., n, 3) joints from base to tip, world frame, m, n >= 2.
        radius: its radius, m: one number, one per device (...,), or one per link
            (..., n - 1).
        mu: excess attenuation, homogenised over its cross-section, 1/m; with 1, the
            optical depth is the path length, m.
        marker_mu: that of the marker at its tip, 1/m; None for no marker.
        marker_length: of the marker, m, measured back from the tip.
    """

    points: np.ndarray
    radius: ArrayLike
    mu: float = materials.CATHETER
    marker_mu: float | None = materials.MARKER
    marker_length: float = materials.MARKER_LENGTH

    def of(self, rows: np.ndarray) -> "Shadow":
        """The shadows of some frames of a batch; the radius is the same for all."""
        return replace(self, points=self.points[rows])


def device_attenuation(carm: CArm, shadow: Shadow) -> np.ndarray:
    """Optical depth of a device, averaged over each pixel.

    Returns:
        (..., rows, columns) float32, no unit. Overlaps add up; the two ends of the
        chain are round, drawn as a cylinder of the volume of a hemisphere. Links with
        a joint that is not finite or not in front of the source are left out.

    Raises:
        ValueError: if shapes do not match, a radius is not positive, or a shadow is
            wider than 256 pixels.
    """
    points = np.asarray(shadow.points, dtype=np.float64)
    if points.ndim < 2 or points.shape[-1] != 3 or points.shape[-2] < 2:
        raise ValueError(
            f"points of a shadow have shape {points.shape}; give two joints or more, "
            "(..., n, 3), m"
        )
    radius = np.asarray(shadow.radius, dtype=np.float64)
    # Filled, not broadcast: numba would compile the loops again for a broadcast array.
    radii = np.empty((*points.shape[:-2], points.shape[-2] - 1))
    radii[...] = radius if radius.ndim == radii.ndim else radius[..., None]
    if not (radii > 0.0).all():
        raise ValueError(f"the smallest radius is {radii.min():g} m; it must be > 0.")
    marker = shadow.mu, 0.0
    if shadow.marker_mu is not None:
        marker = shadow.marker_mu, shadow.marker_length
    image = np.zeros((*points.shape[:-2], *carm.resolution), dtype=np.float32)
    with np.errstate(invalid="ignore"):  # joints that are not finite
        camera = carm.camera(points)
    widest = _add_devices(
        image.reshape((-1, *carm.resolution)),
        camera.reshape((-1, *points.shape[-2:])),
        radii.reshape(-1, radii.shape[-1]),
        carm.focal_length,
        (float(shadow.mu), float(marker[0]), float(marker[1])),
    )
    if widest > _WIDEST:
        raise ValueError(
            f"a shadow is {widest:.0f} px in radius; at most {_WIDEST} can be "
            "drawn. Lower the resolution or magnification, or check the radius "
            "(metres)."
        )
    return image


@compiled
def _left(t):
    """Area of the unit disc on one side of a line, t in [-1, 1]."""
    return 0.5 * math.pi + t * math.sqrt(1.0 - t * t) + math.asin(t)


@compiled
def _below_left(x, y, left, below):
    if x * x + y * y < 1.0:
        return 0.5 * (left + below) + x * y - 0.25 * math.pi
    if x < 0.0:
        return 0.0 if y < 0.0 else left
    return below if y < 0.0 else left + below - math.pi


@compiled
def add_disc(image, row, column, radius, weight, scratch):
    """Spreads a weight over the pixels that a disc covers, by the area they share.

    Centre and radius in px; parts outside the image are left out. Scratch is (3, n),
    n at least the columns of the disc.
    """
    rows, columns = image.shape
    # Pixel k spans [k - 1/2, k + 1/2].
    top, bottom = math.floor(row - radius + 0.5), math.floor(row + radius + 0.5)
    first, last = math.floor(column - radius + 0.5), math.floor(column + radius + 0.5)
    if bottom < 0 or last < 0 or top >= rows or first >= columns:
        return
    weight /= math.pi
    # Area above the lower edge of a row of pixels, column edge by column edge, is the
    # area above its upper edge and what the row adds.
    width = int(last - first) + 1
    edges, lefts, above = scratch[0], scratch[1], scratch[2]
    for j in range(width):
        above[j] = 0.0
        edges[j] = min((first + j + 0.5 - column) / radius, 1.0)
        lefts[j] = _left(edges[j])
    for i in range(int(top), int(bottom) + 1):
        y = min((i + 0.5 - row) / radius, 1.0)
        below = _left(y)
        before = 0.0
        for j in range(width):
            corner = _below_left(edges[j], y, lefts[j], below)
            added = corner - above[j]
            above[j] = corner
            share = added - before
            before = added
            k = int(first) + j
            if share > 0.0 and 0 <= i < rows and 0 <= k < columns:
                image[i, k] += weight * share


@compiled
def _chord(joints, link):
    """Vector of a link from its proximal to its distal joint, and its length."""
    x = joints[link + 1, 0] - joints[link, 0]
    y = joints[link + 1, 1] - joints[link, 1]
    z = joints[link + 1, 2] - joints[link, 2]
    return x, y, z, math.sqrt(x * x + y * y + z * z)


@compiled
def _turn(joints, link, other):
    """Tangent minus chord of a link at its joint with another, times its length.

    The last value says whether there is another link; if not, the end is free.
    """
    if 0 <= other < len(joints) - 1:
        x, y, z, length = _chord(joints, link)
        u, v, w, beside = _chord(joints, other)
        if 0.0 < beside < math.inf:
            share, ratio = length / (length + beside), length / beside
            u, v, w = u * ratio - x, v * ratio - y, w * ratio - z
            return share * u, share * v, share * w, True
    return 0.0, 0.0, 0.0, False


@compiled
def _bends(joints, link):
    """Turns of a link's curve at its two ends, of a parabola where one end is free."""
    a, b, c, behind = _turn(joints, link, link - 1)
    d, e, f, before = _turn(joints, link, link + 1)
    if not behind:
        a, b, c = -d, -e, -f
    elif not before:
        d, e, f = -a, -b, -c
    return a, b, c, d, e, f


@compiled
def _add_devices(images, cameras, radii, focal, material):
    """Adds devices to images (B, rows, columns); returns the widest radius in view, px.

    Material: attenuation of device and marker, 1/m, and length of the marker, m.
    """
    widest = 0.0
    scratch = np.empty((3, 2 * _WIDEST + 2))
    for frame in range(len(images)):
        image, camera, radius = images[frame], cameras[frame], radii[frame]
        to_tip = 0.0  # arc length from the tip, m
        for link in range(len(radius) - 1, -1, -1):
            part = link, radius, focal, material, to_tip
            length, wide = _add_link(image, camera, part, scratch)
            to_tip += length
            widest = max(widest, wide)
    return widest


@compiled
def _add_link(image, camera, part, scratch):
    """Adds a link; returns its length, m, and radius, px, 0 if it is not in view."""
    link, radii, focal, material, to_tip = part
    rows, columns = image.shape
    radius = radii[link]
    x0, y0, z0 = camera[link]
    dx, dy, dz, length = _chord(camera, link)
    # A link that is not finite cannot be drawn; one without length has no direction.
    if not 0.0 < length < math.inf:
        return 0.0, 0.0
    # The two ends are lengthened by 2/3 radius: the volume of a hemispherical cap.
    cap = 2.0 / 3.0 * radius / length
    back = cap if link == 0 else 0.0
    ahead = cap if link == len(radii) - 1 else 0.0
    x0, y0, z0 = x0 - back * dx, y0 - back * dy, z0 - back * dz
    stretch = 1.0 + back + ahead
    dx, dy, dz, length = dx * stretch, dy * stretch, dz * stretch, length * stretch
    nearest = min(z0, z0 + dz)
    if not nearest > NEAREST:
        return length, 0.0
    # Ends in pixels from the middle of the image.
    wide = radius * focal / nearest
    u0, v0 = x0 * focal / z0, y0 * focal / z0
    u1, v1 = (x0 + dx) * focal / (z0 + dz), (y0 + dy) * focal / (z0 + dz)
    broad, high = 0.5 * columns + wide, 0.5 * rows + wide
    beside = min(u0, u1) >= broad or max(u0, u1) <= -broad
    if beside or min(v0, v1) >= high or max(v0, v1) <= -high:
        return length, 0.0
    if wide > _WIDEST:
        return length, wide
    spacing = max(_SPACING, _RELATIVE_SPACING * wide)
    # Limits the time of a link that runs far out of the image.
    most = 4.0 * (rows + columns) / _SPACING
    count = int(min(max(math.ceil(math.hypot(u1 - u0, v1 - v0) / spacing), 1.0), most))
    piece = length / count
    mu, marker_mu, marker_length = material
    a, b, _, d, e, _ = _bends(camera, link)
    for step in range(count):
        fraction = (step + 0.5) / count
        weight = mu
        if marker_length > 0.0:
            distal = to_tip + (1.0 - fraction) * length
            inside = min(max((marker_length - distal) / piece + 0.5, 0.0), 1.0)
            weight += (marker_mu - mu) * inside
        # Fraction of the link without its round ends, which are straight.
        t = min(max(fraction * stretch - back, 0.0), 1.0)
        sag = t * (1.0 - t)
        behind, before = sag * (1.0 - t), sag * t
        x = x0 + fraction * dx + behind * a - before * d
        y = y0 + fraction * dy + behind * b - before * e
        z = z0 + fraction * dz  # a bend hardly changes the magnification
        # A pixel sees, at this depth, an area (depth / focal)² across the beam axis
        # and 1 / slant of that across its ray; volume over area is the mean path.
        scale = focal / z
        slant = math.sqrt(x * x + y * y + z * z) / z
        weight *= math.pi * radius**2 * piece * slant * scale**2
        row, column = y * scale + 0.5 * (rows - 1), x * scale + 0.5 * (columns - 1)
        add_disc(image, row, column, radius * scale, weight, scratch)
    return length, wide
