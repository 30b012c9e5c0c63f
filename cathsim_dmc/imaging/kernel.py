"""Shadows of vessels and devices: the compiled loops.

The chord of a ray through a round rod, as a function of the ray's distance from the
axis, is a half ellipse; a uniform disc swept along the projected axis leaves exactly
that profile, whatever the direction. So the shadow of a device is a sum of discs,
and what a pixel receives of a disc is the area the two share, which has a closed
form: nothing is tabulated, and nothing is lost between pixels. The axis of a device is
a smooth curve through its joints.

"""

import math

import numpy as np

from cathsim_dmc.compiled import compiled
from cathsim_dmc.imaging.carm import NEAREST

# Distance of the discs along the projected axis, px. At this distance the ripple of
# a rod thinner than a pixel stays below 0.5 % at every angle.
SPACING = 1.0 / 3.0
# Discs may lie further apart on wide shadows: this fraction of their radius.
RELATIVE_SPACING = 0.1
# Discs wider than this (px) are no device's, but one whose radius is in other units.
WIDEST = 128
# Sub-divisions of the ray spacing to which projected vertices are rounded; edge
# functions are then exact in int64 for images up to 2**18 rays wide.
SUBDIVISIONS = 4096


@compiled
def _left(t: float) -> float:
    """Area of the unit disc on one side of a line, t in [-1, 1]."""
    return 0.5 * math.pi + t * math.sqrt(1.0 - t * t) + math.asin(t)


@compiled
def _below_left(x: float, y: float, left: float, below: float) -> float:
    if x * x + y * y < 1.0:
        return 0.5 * (left + below) + x * y - 0.25 * math.pi
    if x < 0.0:
        return 0.0 if y < 0.0 else left
    return below if y < 0.0 else left + below - math.pi


@compiled
def add_disc(
    image: np.ndarray,
    row: float,
    column: float,
    radius: float,
    weight: float,
    scratch: np.ndarray,
) -> None:
    """Spreads a weight over the pixels that a disc covers, by the area they share.

    Args:
        image: (rows, columns), added to in place; what falls beside it is left out.
        row, column: centre of the disc, px.
        radius: of the disc, px, > 0.
        scratch: (3, columns of the disc or more), overwritten.
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
def _chord(joints: np.ndarray, link: int) -> tuple[float, float, float, float]:
    """A link from its proximal to its distal joint, and its length."""
    x = joints[link + 1, 0] - joints[link, 0]
    y = joints[link + 1, 1] - joints[link, 1]
    z = joints[link + 1, 2] - joints[link, 2]
    return x, y, z, math.sqrt(x * x + y * y + z * z)


@compiled
def _turn(joints: np.ndarray, link: int, other: int) -> tuple[float, float, float]:
    """Tangent less chord of a link where it meets another, times its length.

    The tangent is that of the parabola through the three joints; zero if the other
    link is none, has no length or is not finite.
    """
    if 0 <= other < len(joints) - 1:
        x, y, z, length = _chord(joints, link)
        u, v, w, beside = _chord(joints, other)
        if 0.0 < beside < math.inf:
            share, ratio = length / (length + beside), length / beside
            return (
                share * (u * ratio - x),
                share * (v * ratio - y),
                share * (w * ratio - z),
            )
    return 0.0, 0.0, 0.0


@compiled
def bends(
    joints: np.ndarray, link: int
) -> tuple[float, float, float, float, float, float]:
    """Turns of a link's curve at its two ends, of a parabola where one end is free."""
    a, b, c = _turn(joints, link, link - 1)
    d, e, f = _turn(joints, link, link + 1)
    if a == b == c == 0.0:
        a, b, c = -d, -e, -f
    elif d == e == f == 0.0:
        d, e, f = -a, -b, -c
    return a, b, c, d, e, f


@compiled
def curve(joints: np.ndarray, pieces: int) -> np.ndarray:
    """Smooth curve through joints, a cubic on each link.

    Args:
        joints: (n, 3), finite and apart.

    Returns:
        ((n - 1) * pieces + 1, 3).
    """
    points = np.empty(((len(joints) - 1) * pieces + 1, 3))
    points[-1] = joints[-1]
    for link in range(len(joints) - 1):
        a, b, c, d, e, f = bends(joints, link)
        for piece in range(pieces):
            t = piece / pieces
            row = points[link * pieces + piece]
            sag = t * (1.0 - t)
            behind, before = sag * (1.0 - t), sag * t
            x, y, z, _ = _chord(joints, link)
            row[0] = joints[link, 0] + t * x + behind * a - before * d
            row[1] = joints[link, 1] + t * y + behind * b - before * e
            row[2] = joints[link, 2] + t * z + behind * c - before * f
    return points


@compiled
def add_devices(
    image: np.ndarray,
    camera: np.ndarray,
    radius: np.ndarray,
    focal: float,
    mu: float,
    marker_mu: float,
    marker_length: float,
) -> float:
    """Adds the optical depth of devices to images, each frame on its own.

    Args:
        image: (B, rows, columns), added to in place.
        camera: (B, n, 3), joints in camera coordinates (`CArm.camera`), m.
        radius: (B, n - 1), of each link, m.
        focal: distance of source and detector, px.
        mu: attenuation of the device, 1/m.
        marker_mu: the same of the marker at its tip, 1/m.
        marker_length: of the marker, m.

    Returns:
        Radius of the widest shadow in view, px; those above `WIDEST` are not drawn.
    """
    widest = 0.0
    scratch = np.empty((3, 2 * WIDEST + 2))
    for frame in range(len(image)):
        to_tip = 0.0  # arc length from the tip, m
        for link in range(radius.shape[1] - 1, -1, -1):
            length, wide = _add_link(
                image[frame],
                camera[frame],
                link,
                radius[frame],
                focal,
                mu,
                marker_mu,
                marker_length,
                to_tip,
                scratch,
            )
            to_tip += length
            widest = max(widest, wide)
    return widest


@compiled
def _add_link(
    image, camera, link, radii, focal, mu, marker_mu, marker_length, to_tip, scratch
) -> tuple[float, float]:
    """Adds one link whose distal end is `to_tip` from the tip.

    Returns:
        its length, m, and the radius of its shadow, px, 0 if it is not in view.
    """
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
    if wide > WIDEST:
        return length, wide
    spacing = max(SPACING, RELATIVE_SPACING * wide)
    # A link that runs far out of the image must not take for ever.
    most = 4.0 * (rows + columns) / SPACING
    count = int(min(max(math.ceil(math.hypot(u1 - u0, v1 - v0) / spacing), 1.0), most))
    piece = length / count
    turns = bends(camera, link)
    for step in range(count):
        fraction = (step + 0.5) / count
        # Of the link without its round ends, which are straight.
        t = min(max(fraction * stretch - back, 0.0), 1.0)
        weight = mu
        if marker_length > 0.0:
            distal = to_tip + (1.0 - fraction) * length
            inside = min(max((marker_length - distal) / piece + 0.5, 0.0), 1.0)
            weight += (marker_mu - mu) * inside
        start = x0 + fraction * dx, y0 + fraction * dy, z0 + fraction * dz
        _add_piece(image, start, turns, t, radius, weight, piece, focal, scratch)
    return length, wide


@compiled
def _add_piece(image, chord, turns, t, radius, weight, length, focal, scratch) -> None:
    """Adds a piece of a link, at a place of its chord, as a disc.

    Args:
        turns: of the link's curve, see `bends`; the piece is at `t` of it.
        weight: its attenuation, 1/m.
    """
    rows, columns = image.shape
    x, y, z = chord
    a, b, _, d, e, _ = turns
    sag = t * (1.0 - t)
    behind, before = sag * (1.0 - t), sag * t
    x = x + behind * a - before * d
    y = y + behind * b - before * e  # a bend hardly changes the magnification
    # A pixel sees, at this depth, an area (depth / focal)² across the beam axis
    # and 1 / slant of that across its ray; volume over area is the mean path.
    scale = focal / z
    slant = math.sqrt(x * x + y * y + z * z) / z
    weight *= math.pi * radius**2 * length * slant * scale**2
    row, column = y * scale + 0.5 * (rows - 1), x * scale + 0.5 * (columns - 1)
    add_disc(image, row, column, radius * scale, weight, scratch)


@compiled
def add_surface(
    image: np.ndarray, corners: np.ndarray, inverse: np.ndarray, faces: np.ndarray
) -> None:
    """Adds the depths at which rays leave a surface, less those at which they enter.

    Args:
        image: (rows, columns) of rays, added to in place, m.
        corners: (V, 2) int64, column and row of the vertices times `SUBDIVISIONS`.
        inverse: (V,) of their depth, 1/m.
        faces: (F, 3), counter-clockwise seen from outside.
    """
    rows, columns = image.shape
    for face in range(len(faces)):
        i, j, k = faces[face]
        ax, ay, bx, by = corners[i, 0], corners[i, 1], corners[j, 0], corners[j, 1]
        cx, cy = corners[k, 0], corners[k, 1]
        area = (bx - ax) * (cy - ay) - (cx - ax) * (by - ay)
        if area == 0:
            continue
        # Rows run downwards: a face turned to the detector, where rays leave, is
        # clockwise in its coordinates and so has a negative area.
        sign = 1.0
        if area > 0:
            sign = -1.0
        else:
            bx, by, cx, cy, j, k = cx, cy, bx, by, k, j
        left = max(-(-min(ax, bx, cx) // SUBDIVISIONS), 0)
        right = min(max(ax, bx, cx) // SUBDIVISIONS, columns - 1)
        top = max(-(-min(ay, by, cy) // SUBDIVISIONS), 0)
        bottom = min(max(ay, by, cy) // SUBDIVISIONS, rows - 1)
        for row in range(top, bottom + 1):
            y = row * SUBDIVISIONS
            for column in range(left, right + 1):
                x = column * SUBDIVISIONS
                u = _edge(x, y, bx, by, cx, cy)
                v = _edge(x, y, cx, cy, ax, ay)
                w = _edge(x, y, ax, ay, bx, by)
                if u >= 0 and v >= 0 and w >= 0:
                    # One over depth, not depth, is linear across the image of a plane.
                    over = u * inverse[i] + v * inverse[j] + w * inverse[k]
                    image[row, column] += sign * (float(u + v + w) / over)


@compiled
def _edge(x: int, y: int, ax: int, ay: int, bx: int, by: int) -> int:
    """Edge function of a ray, -1 where it is on the edge and not the triangle's.

    A ray exactly on an edge belongs to the triangle for which the edge points up, or is
    level and points right: each direction wins exactly once.
    """
    dx, dy = bx - ax, by - ay
    value = dx * (y - ay) - dy * (x - ax)
    if value == 0 and not (dy < 0 or (dy == 0 and dx > 0)):
        return -1
    return value


@compiled
def count(
    frame: np.ndarray,
    quanta: float,
    draw: np.ndarray,
    quantiles: np.ndarray,
    skew: np.ndarray,
    out: np.ndarray,
) -> None:
    """Writes a frame of quanta over `quanta`, see `detector.quantum_noise`.

    Args:
        frame: (rows, columns) float32, signal.
        quanta: float32, at signal 1.
        draw: (rows * columns,) uint16, numbers of the quantiles.
        quantiles: normal deviates, float32.
        skew: their terms for skewness, float32.
        out: (rows, columns) float32.
    """
    zero = np.float32(0.0)
    # The skew term and rounding add 1/18 + 1/12 to the variance: taken off here.
    excess = np.float32(5.0 / 36.0)
    rows, columns = frame.shape
    for i in range(rows):
        for j in range(columns):
            k = draw[i * columns + j]
            mean = max(frame[i, j], zero) * quanta
            spread = np.sqrt(max(mean - excess, zero))
            counted = np.rint(mean + spread * quantiles[k] + skew[k])
            out[i, j] = max(counted, zero) / quanta
