"""Biplane reconstruction: the compiled loops."""

import math

import numpy as np

from cathsim_dmc.compiled import compiled

# Largest number of pixels of a plane that may show the marker.
PEAKS = 16


@compiled
def _sampled(image, row, column):
    """Bilinear value; that of the nearest pixel outside the image."""
    rows, columns = image.shape
    row = min(max(row, 0.0), rows - 1.001)
    column = min(max(column, 0.0), columns - 1.001)
    i, j = int(row), int(column)
    u, v = row - i, column - j
    upper = (1.0 - v) * image[i, j] + v * image[i, j + 1]
    lower = (1.0 - v) * image[i + 1, j] + v * image[i + 1, j + 1]
    return (1.0 - u) * upper + u * lower


@compiled
def _place(matrix, x, y, z):
    """Row, column and depth (m) of a point in a plane."""
    w = matrix[2, 0] * x + matrix[2, 1] * y + matrix[2, 2] * z + matrix[2, 3]
    u = matrix[0, 0] * x + matrix[0, 1] * y + matrix[0, 2] * z + matrix[0, 3]
    v = matrix[1, 0] * x + matrix[1, 1] * y + matrix[1, 2] * z + matrix[1, 3]
    return v / w, u / w, w


@compiled
def depths(points, matrices, walls, focal):
    """Signed distances (P, n) to the outlines of the vessel in P planes, m.

    Walls (P, rows, columns) are those of pixels, > 0 inside, and focal lengths (P,)
    in px.
    """
    found = np.empty((len(walls), len(points)))
    for plane in range(len(walls)):
        for n in range(len(points)):
            x, y, z = points[n]
            row, column, depth = _place(matrices[plane], x, y, z)
            wall = _sampled(walls[plane], row, column)
            found[plane, n] = wall * depth / focal[plane]
    return found


@compiled
def triangulated(matrices, places, point):
    """Writes the point (3,), m, of two pixels; returns the reprojection error, px.

    Args:
        matrices: (2, 3, 4).
        places: (2, 2), row and column of each plane.
    """
    normal, right = np.zeros((3, 3)), np.zeros(3)
    for plane in range(2):
        for axis in range(2):
            line = matrices[plane, 1 - axis] - places[plane, axis] * matrices[plane, 2]
            for i in range(3):
                right[i] -= line[i] * line[3]
                for j in range(3):
                    normal[i, j] += line[i] * line[j]
    point[:] = np.linalg.solve(normal, right)
    worst = 0.0
    for plane in range(2):
        row, column, _ = _place(matrices[plane], point[0], point[1], point[2])
        error = math.hypot(row - places[plane, 0], column - places[plane, 1])
        worst = max(worst, error)
    return worst


@compiled
def _centred(image, row, column, least):
    """Centre of mass of what exceeds `least` in the 3 x 3 pixels around a place."""
    rows, columns = image.shape
    i, j = round(row), round(column)
    total, r, c = 0.0, 0.0, 0.0
    for k in range(max(i - 1, 0), min(i + 2, rows)):
        for m in range(max(j - 1, 0), min(j + 2, columns)):
            weight = max(image[k, m] - least, 0.0)
            total += weight
            r += weight * k
            c += weight * m
    if total <= 0.0:
        return row, column
    return r / total, c / total


@compiled
def _peaks(image, least, found):
    """Writes the highest local maxima (`PEAKS`, 3), value, row, column; counts them."""
    rows, columns = image.shape
    count = 0
    for i in range(1, rows - 1):
        for j in range(1, columns - 1):
            value = image[i, j]
            if value < least or value < image[i - 1 : i + 2, j - 1 : j + 2].max():
                continue
            k = count
            if count == PEAKS:
                k = int(found[:, 0].argmin())
                if found[k, 0] >= value:
                    continue
            else:
                count += 1
            found[k, 0], found[k, 1], found[k, 2] = value, i, j
    return count


@compiled
def _marker(images, matrices, least, widest, point):
    """Writes the marker's place, with rays at most `widest` px apart.

    Returns its optical depth, 0 if there is no marker.
    """
    first, second = np.zeros((PEAKS, 3)), np.zeros((PEAKS, 3))
    counts = _peaks(images[0], least, first), _peaks(images[1], least, second)
    best, places, there = 0.0, np.empty((2, 2)), np.empty(3)
    for i in range(counts[0]):
        for j in range(counts[1]):
            value = min(first[i, 0], second[j, 0])
            if value <= best:
                continue
            places[0] = _centred(images[0], first[i, 1], first[i, 2], 0.5 * value)
            places[1] = _centred(images[1], second[j, 1], second[j, 2], 0.5 * value)
            if triangulated(matrices, places, there) < widest:
                best = value
                point[:] = there
    return best


@compiled
def _line(images, matrices, full, point, direction, way):
    """How well both planes show a device along a direction, 0 to 1."""
    least, total = math.inf, 0.0
    for plane in range(2):
        seen = 0.0
        for part in (0.5, 1.0):
            step = part * way
            x, y = point[0] + step * direction[0], point[1] + step * direction[1]
            z = point[2] + step * direction[2]
            row, column, _ = _place(matrices[plane], x, y, z)
            seen += 0.5 * min(_sampled(images[plane], row, column) / full, 1.0)
        least = min(least, seen)
        total += 0.5 * seen
    return 0.8 * least + 0.2 * total


@compiled
def _next(images, matrices, directions, way, full, point, last, tried):
    """Index of the direction in which the device continues, -1 if there is none."""
    best, chosen = 0.25, -1
    first = (last * last).sum() == 0.0
    for k in range(len(directions)):
        if tried[k]:
            continue
        cosine = 1.0 if first else float((directions[k] * last).sum())
        if cosine < 0.5:
            continue
        score = _line(images, matrices, full, point, directions[k], way)
        score -= 0.5 * (1.0 - cosine)
        if score > best:
            best, chosen = score, k
    return chosen


@compiled
def _outside(image, row, column):
    """Whether a place lies outside an image."""
    rows, columns = image.shape
    return not (-0.5 <= row <= rows - 0.5 and -0.5 <= column <= columns - 0.5)


@compiled
def _follow(images, matrices, directions, way, full, tried, line, widest):
    """Writes points behind the first; returns the number of all; marks `tried`."""
    last, places, there = np.zeros(3), np.empty((2, 2)), np.empty(3)
    none = np.zeros(len(directions), dtype=np.bool_)
    for number in range(1, len(line)):
        left_out = tried if number == 1 else none
        before = line[number - 1]
        k = _next(images, matrices, directions, way, full, before, last, left_out)
        if k < 0:
            return number
        direction = directions[k]
        if number == 1:
            for other in range(len(directions)):
                if (directions[other] * direction).sum() > 0.7:
                    tried[other] = True
        ahead = before + way * direction
        for plane in range(2):
            row, column, _ = _place(matrices[plane], ahead[0], ahead[1], ahead[2])
            if _outside(images[plane], row, column):
                return number
            places[plane] = _centred(images[plane], row, column, 0.1 * full)
        # Where the device covers several pixels, only the part across counts.
        if triangulated(matrices, places, there) < widest:
            shift = there - ahead
            ahead = there - (shift * direction).sum() * direction
        last = ahead - before
        last /= math.sqrt((last * last).sum())
        line[number] = before + way * last
    return len(line)


@compiled
def trace(images, matrices, directions, way, full, enough, line, widest):
    """Follows a device from the marker at its tip back to where it is lost.

    Args:
        images: (2, rows, columns), optical depths; `full` where the shaft crosses.
        matrices: (2, 3, 4), see `CArm.matrix`.
        directions: (D, 3), unit vectors all around.
        enough: number of points with which no other first direction is tried.
        line: (P, 3), written: the marker, then points every `way` (m) behind it, m.
        widest: px, by which rays of both planes may miss each other.

    Returns:
        Number of points found, 0 without a marker.
    """
    if _marker(images, matrices, 1.3 * full, widest, line[0]) == 0.0:
        return 0
    best, tried = 1, np.zeros(len(directions), dtype=np.bool_)
    other = line.copy()
    for _ in range(5):
        count = _follow(images, matrices, directions, way, full, tried, other, widest)
        if count > best:
            best = count
            line[:count] = other[:count]
        if best >= enough or count == 1:
            break
    return best


@compiled
def carried(frame, line, direction):
    """Axes (3, 3) in columns, carried along a device without turning about it.

    Args:
        frame: (3, 3) at its proximal end, z towards the tip.
        line: (P, 3) from the tip backwards, m.
        direction: (3,) of the tip, a unit vector.
    """
    now, tangent = frame.copy(), np.empty(3)
    for number in range(len(line) - 1, -1, -1):
        if number > 0:
            tangent[:] = line[number - 1] - line[number]
            tangent /= math.sqrt((tangent * tangent).sum())
        else:
            tangent[:] = direction
        # Rodrigues' formula for the least turn that brings z to the tangent.
        # z is normalised, because any error would double at every point.
        z = now[:, 2] / math.sqrt((now[:, 2] ** 2).sum())
        cosine = (z * tangent).sum()
        if cosine < -0.999:
            continue
        axis = np.cross(z, tangent)
        for column in range(3):
            vector = now[:, column].copy()
            along = (axis * vector).sum() / (1.0 + cosine)
            now[:, column] = cosine * vector + np.cross(axis, vector) + along * axis
    return now
