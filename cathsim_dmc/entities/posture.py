"""Joint angles that lay a chain of links along a line."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

# Largest angle between the first link, which has no hinge, and the line, rad.
_LARGEST_START_ANGLE = 1e-3


def joints_along(
    link_lengths: ArrayLike, line: ArrayLike, advance: float = 0.0
) -> NDArray[np.float64]:
    """Angles of the bending hinges that place every node of a chain on a line.

    Torsion hinges are at 0. The rows are the positions of `Chain.bends` in order.

    Args:
        link_lengths: (n,) lengths of the links from proximal to distal, m.
        line: points (k, 3) of the line, m, from the proximal end of link 0 at zero
            insertion, in its frame; straight along +z over at least `advance` and the
            length of link 0.
        advance: insertion of the chain, m: arc length from the first point of the line.

    Returns:
        (n - 1, 2) float64, rad: about x and about y of joints 1 to n - 1.

    Raises:
        ValueError: if the line is too short, or does not begin along +z.
    """
    lengths = np.asarray(link_lengths, np.float64)
    nodes = _nodes(lengths, np.asarray(line, np.float64), advance)
    return bends_of(np.diff(nodes, axis=0) / lengths[:, None])


def x_first(joint: int) -> bool:
    """Whether a joint, numbered from 1, bends about x before y.

    Two hinges twist by about θxθy/2, with the sign of their order. The order alternates
    from joint to joint, so the twists of neighbours cancel.
    """
    return joint % 2 == 1


def bends_of(directions: NDArray[np.float64]) -> NDArray[np.float64]:
    """Angles of the bending hinges of a chain whose links point in given directions.

    Args:
        directions: unit vectors (n, 3) of the links in the frame of link 0; the first
            is +z.

    Returns:
        (n - 1, 2) float64, rad: about x and about y of joints 1 to n - 1.

    Raises:
        ValueError: if the first link does not point along +z.
    """
    start = float(np.arccos(np.clip(directions[0, 2], -1.0, 1.0)))
    if start > _LARGEST_START_ANGLE:
        raise ValueError(
            f"link 0 points {np.degrees(start):.2f}° away from +z, but it has no "
            "hinge; begin the line with a straight piece along +z, as long as link 0 "
            "and `advance` together"
        )
    frame = np.eye(3)
    angles = np.empty((len(directions) - 1, 2))
    for index, direction in enumerate(directions[1:]):
        x, y, z = frame.T @ direction
        if x_first(index + 1):
            about_x, about_y = np.arctan2(-y, z), np.arcsin(np.clip(x, -1.0, 1.0))
            frame = frame @ _turn_x(about_x) @ _turn_y(about_y)
        else:
            about_x, about_y = np.arcsin(np.clip(-y, -1.0, 1.0)), np.arctan2(x, z)
            frame = frame @ _turn_y(about_y) @ _turn_x(about_x)
        angles[index] = about_x, about_y
    return angles


def nodes_of(link_lengths: ArrayLike, bends: ArrayLike) -> NDArray[np.float64]:
    """Nodes of a chain with given angles of its bending hinges.

    Torsion hinges are at 0.

    Args:
        link_lengths: (n,) lengths of the links from proximal to distal, m.
        bends: (n - 1, 2) angles about x and about y of joints 1 to n - 1, rad.

    Returns:
        (n + 1, 3) float64, m, frame of link 0: proximal ends of the links and the
        distal end of the last one.
    """
    lengths, angles = np.asarray(link_lengths), np.asarray(bends)
    turns = _turns(angles)
    frame, directions = np.eye(3), np.empty((len(lengths), 3))
    directions[0] = frame[:, 2]
    for index, turn in enumerate(turns, 1):
        frame = frame @ turn
        directions[index] = frame[:, 2]
    nodes = np.zeros((len(lengths) + 1, 3))
    np.cumsum(directions * lengths[:, None], axis=0, out=nodes[1:])
    return nodes


def _turns(angles: np.ndarray) -> np.ndarray:
    """Rotations (n - 1, 3, 3) of joints 1 to n - 1 with angles (n - 1, 2) rad."""
    (cx, cy), (sx, sy) = np.cos(angles).T, np.sin(angles).T
    zero = np.zeros_like(cx)
    # About x and then about the turned y, and the other way round.
    first_x = [cy, zero, sy, sx * sy, cx, -sx * cy, -cx * sy, sx, cx * cy]
    first_y = [cy, sx * sy, cx * sy, zero, cx, -sx, -sy, sx * cy, cx * cy]
    order = [x_first(joint) for joint in range(1, len(angles) + 1)]
    chosen = np.where(order, np.array(first_x), np.array(first_y))
    return chosen.T.reshape(-1, 3, 3)


def _nodes(lengths: np.ndarray, points: np.ndarray, advance: float) -> np.ndarray:
    """Nodes (n + 1, 3) on the line, a link length apart."""
    steps = np.linalg.norm(np.diff(points, axis=0), axis=-1)
    arc = np.concatenate([[0.0], np.cumsum(steps)])
    if not 0 <= advance < arc[-1]:
        raise ValueError(
            f"advance is {advance} m; it must be from 0 to the line's {arc[-1]:.4f} m"
        )
    piece = int(np.searchsorted(arc, advance, "right")) - 1
    share = (advance - arc[piece]) / steps[piece]
    nodes = [points[piece] + share * (points[piece + 1] - points[piece])]
    for number, length in enumerate(lengths):
        centre = nodes[-1]
        # First point of the line after the last node at least one link away.
        beyond = np.linalg.norm(points[piece + 1 :] - centre, axis=-1) >= length
        if not beyond.any():
            raise ValueError(
                f"the line is {1e3 * arc[-1]:.1f} mm long and ends before link "
                f"{number} of {len(lengths)}; the chain needs "
                f"{1e3 * (advance + lengths.sum()):.1f} mm"
            )
        following = piece + int(np.argmax(beyond))
        begin = centre if following == piece else points[following]
        # Where this segment leaves a sphere around the last node.
        along, offset = points[following + 1] - begin, begin - centre
        a, b, c = along @ along, along @ offset, offset @ offset - length**2
        nodes.append(begin + (-b + np.sqrt(b * b - a * c)) / a * along)
        piece = following
    return np.array(nodes)


def _turn_x(angle: float) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[1, 0, 0], [0, c, -s], [0, s, c]])


def _turn_y(angle: float) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
