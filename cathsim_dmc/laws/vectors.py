"""Vectors of three numbers and rotation matrices of nine, row by row."""

import math

from cathsim_dmc.compiled import inlined


@inlined
def length(vector):
    """Euclidean norm."""
    return math.sqrt(vector[0] ** 2 + vector[1] ** 2 + vector[2] ** 2)


@inlined
def dot(one, other):
    """Scalar product."""
    return one[0] * other[0] + one[1] * other[1] + one[2] * other[2]


@inlined
def cross(one, other):
    """Vector product (3)."""
    return (
        one[1] * other[2] - one[2] * other[1],
        one[2] * other[0] - one[0] * other[2],
        one[0] * other[1] - one[1] * other[0],
    )


@inlined
def unit(vector):
    """Unit vector (3) in the direction of a vector that is not zero."""
    norm = length(vector)
    return (vector[0] / norm, vector[1] / norm, vector[2] / norm)


@inlined
def along(start, direction, t):
    """Point (3) on a line: start + t direction."""
    return (
        start[0] + t * direction[0],
        start[1] + t * direction[1],
        start[2] + t * direction[2],
    )


@inlined
def into(frame, vector):
    """Components (3) of a vector in a frame whose axes are the columns of a matrix."""
    return (
        frame[0] * vector[0] + frame[3] * vector[1] + frame[6] * vector[2],
        frame[1] * vector[0] + frame[4] * vector[1] + frame[7] * vector[2],
        frame[2] * vector[0] + frame[5] * vector[1] + frame[8] * vector[2],
    )


@inlined
def opposite(frame, vector):
    """Negated vector (3) in the world, from its components in a frame (see `into`)."""
    return (
        0.0 - frame[0] * vector[0] - frame[1] * vector[1] - frame[2] * vector[2],
        0.0 - frame[3] * vector[0] - frame[4] * vector[1] - frame[5] * vector[2],
        0.0 - frame[6] * vector[0] - frame[7] * vector[1] - frame[8] * vector[2],
    )
