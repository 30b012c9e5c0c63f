"""Joints of two hinges: their bend and twist, and the springs of an isotropic joint.

A joint bends by a complex angle, bend_y - i bend_x for small ones, in frames that do
not twist along the chain (docs/pair_model.md). The order of its hinges alternates from
joint to joint (`posture.x_first`): x is first where the joint's index is even.
"""

import math
from typing import Any, NamedTuple

from cathsim_dmc.compiled import compiled

# Largest bend that is divided exactly between two hinges, rad.
_LARGEST_BEND = 1.2
# Step of the central differences, rad.
_STEP = 1e-5


@compiled
def unit(angle):
    """exp(i angle)."""
    return complex(math.cos(angle), math.sin(angle))


@compiled
def _hinges(bend, first):
    """Angles of the hinges x and y for a bend; the first of them is x (0) or y (1)."""
    angle = abs(bend)
    if angle == 0.0:
        return 0.0, 0.0
    taken = min(angle, _LARGEST_BEND)
    along, across = math.cos(taken), math.sin(taken) / angle
    x, y = across * bend.real, across * bend.imag
    scale = angle / taken
    if first == 0:
        return scale * math.atan2(-y, along), scale * math.asin(x)
    return scale * math.asin(-y), scale * math.atan2(x, along)


@compiled
def _twist(x, y, first):
    """Angle by which two hinges turn the distal link about its axis, rad."""
    sines = math.sin(x / 2) * math.sin(y / 2)
    cosines = math.cos(x / 2) * math.cos(y / 2)
    return 2 * math.atan2(sines if first == 0 else -sines, cosines)


@compiled
def _bend(x, y, first):
    """Complex angle by which two hinges bend a joint, the inverse of `_hinges`."""
    if first == 0:
        way = complex(math.sin(y), -math.sin(x) * math.cos(y))
    else:
        way = complex(math.sin(y) * math.cos(x), -math.sin(x))
    sine = abs(way)
    if sine == 0.0:
        return way
    return way * (math.atan2(sine, math.cos(x) * math.cos(y)) / sine)


@compiled
def _difference(x, y, first, dx, dy):
    """Central difference of `_bend` by x or y; the step of the other one is 0."""
    ahead, behind = _bend(x + dx, y + dy, first), _bend(x - dx, y - dy, first)
    return (ahead - behind) / (2 * (dx + dy))


@compiled
def _twist_rates(x, y, first):
    twist = _twist(x, y, first)
    if twist == 0.0:
        sign = 1.0 if first == 0 else -1.0
        return sign * math.tan(y / 2), sign * math.tan(x / 2)
    return math.sin(twist) / math.sin(x), math.sin(twist) / math.sin(y)


class Bends(NamedTuple):
    """Bends of the J joints of a chain.

    Attributes:
        bends: (J,) complex, in frames that do not twist, rad.
        twists: (J,), of the links before the joints, rad.
    """

    bends: Any
    twists: Any


@compiled
def bent(angles, out):
    """Writes the bends of the joints, and the twists of the links before them.

    Args:
        angles: (2 J,), positions of the hinges in the order of the chain, rad.
        out: `Bends`.
    """
    twist = 0.0
    for j in range(len(angles) // 2):
        first = j % 2
        x, y = angles[2 * j + first], angles[2 * j + 1 - first]
        out.bends[j], out.twists[j] = _bend(x, y, first) * unit(twist), twist
        twist += _twist(x, y, first)


@compiled
def unloaded_hinges(shape, free):
    """Writes the angles (J, 2) of the hinges about x and y of the unloaded chain, rad.

    Args:
        shape: (J,) complex, rest angles of the joints, rad.
        free: (J, 2).
    """
    twist = 0.0
    for j in range(len(shape)):
        x, y = _hinges(shape[j] * unit(-twist), j % 2)
        free[j, 0], free[j, 1] = x, y
        twist += _twist(x, y, j % 2)


@compiled
def free_hinges(shape, compliance, angles, scratch, free):
    """Writes the rest angles that make the hinges of a bent chain isotropic joints.

    The angles of two hinges in series measure a bend differently in each direction, and
    the hinges twist. At angles θ, springs with the rest angles θ - C ∂E/∂θ have the
    torques of the isotropic energy E = Σ|β_j - ΣR_k e_k|²/2C_j. The bend β_j depends on
    the hinges of joint j and on the twist of the joints before it.

    Args:
        shape: (J,) complex or float64, rest angles of the joints, rad.
        compliance: (J,), rad/(N·m).
        angles: (2 J,), positions of the hinges in the order of the chain, rad.
        scratch: `Bends`.
        free: (J, 2), written: about x and about y, rad.
    """
    joints = len(shape)
    bent(angles, scratch)
    bends, twists = scratch.bends, scratch.twists
    for j in range(joints):
        first = j % 2
        x, y = angles[2 * j + first], angles[2 * j + 1 - first]
        over_x = _difference(x, y, first, _STEP, 0.0)
        over_y = _difference(x, y, first, 0.0, _STEP)
        pull = (complex(shape[j]) - bends[j]) * unit(-twists[j])
        free[j, 0] = x + (over_x.conjugate() * pull).real
        free[j, 1] = y + (over_y.conjugate() * pull).real
    # Torsional moment of all joints beyond: derivative of the energy by the twist.
    moment = 0.0
    for j in range(joints - 1, -1, -1):
        first = j % 2
        x, y = angles[2 * j + first], angles[2 * j + 1 - first]
        turn = _twist_rates(x, y, first)
        for axis in range(2):
            free[j, axis] -= compliance[j] * moment * turn[axis]
        rest = complex(shape[j]).conjugate()
        moment -= (rest * 1j * bends[j]).real / compliance[j]


@compiled
def steered(commands, angles, scratch, turned):
    """Turns motor commands from untwisted frames into the frames of the links.

    Args:
        commands: (N, 2 M), about x and y of the last M joints of each of N chains.
        angles: (N, 2 J), positions of the hinges in the order of the chains, rad.
        scratch: `Bends`.
        turned: (N, 2 M), written; may be `commands`.
    """
    motors, twists = commands.shape[1] // 2, scratch.twists
    for i in range(len(commands)):
        bent(angles[i], scratch)
        for m in range(motors):
            torque = complex(commands[i, 2 * m], commands[i, 2 * m + 1])
            torque *= unit(-twists[len(twists) - motors + m])
            turned[i, 2 * m], turned[i, 2 * m + 1] = torque.real, torque.imag
