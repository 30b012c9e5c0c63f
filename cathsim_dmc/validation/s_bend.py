"""Push force of a device that has stopped in an S-bend, and its loss by creep.

The reference is an independent elastica in the same tube with sliding contacts.
"""

import itertools
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from scipy.optimize import root

from cathsim_dmc.entities import devices
from cathsim_dmc.entities.arena import SOLVER_TOLERANCE
from cathsim_dmc.entities.chain import MAX_PUSH_SPEED
from cathsim_dmc.physics.forces import Contacts
from cathsim_dmc.physics.stepper import CONTROL_TIMESTEP
from cathsim_dmc.tasks.config import NavigationConfig
from cathsim_dmc.validation.checks import Check
from cathsim_dmc.validation.rig import STRICT, Rig, uniform

SPEEDS, FRICTIONS = (0.01, 0.04), (0.037, 0.1)  # m/s; Coulomb
STOPPED_BOUND = 5.0  # % of the push force
WALL_BOUND = 5.0  # % of the sum of the forces on the wall
CREEP_BOUND = 5.0  # % of the push force, in `_HELD`
BEND, ANGLE, TUBE = 0.04, np.pi / 3, 3e-3  # m, rad, m
# Longer links have a wrong push force in a bend without friction.
LINK = 5e-3  # m
# m: distance of the head before the bend; travel of the base, after which the head is
# in the second arc; length of rod behind the bend.
_BEFORE, _PUSH, _BEHIND = 0.01, 0.056, 0.03
_RESTING, _HELD = 1.0, 1.0  # s, from the stop to rest, and from there to the end
# Last part of a rest over which the push force is averaged, s: single steps scatter by
# some %, and even a change of the speed by 1e-8 of it changes them.
_READ = 0.4
_PIECE = 1e-3  # m, length of a piece of the reference
# Stiffness of the wall of the reference, N/m for each piece, raised in steps.
_WALLS = (0.5, 5.0, 50.0, 500.0)
# Findings: travels of the base, m, without friction; speeds beside the first of
# `SPEEDS`, m/s; time of rest, s.
_TRAVELS = np.linspace(0.036, _PUSH, 11)
_BESIDE = (0.0098, 0.0099, 0.0101, 0.0102)
_LONG = 8.0


class _Line:
    """Axis of an S-bend in the plane of x and z, between straight ends."""

    def __init__(self, start: float):
        """Begins the bend at z = start, m."""
        c, s = 1 - np.cos(ANGLE), np.sin(ANGLE)
        corners = BEND * np.array([[0, 0], [c, s], [2 * c, 2 * s]]) + (0.0, start)
        self._start, self._middle, self._end = corners
        self._centres = self._start + (BEND, 0.0), self._end - (BEND, 0.0)

    def nearest(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Offsets (...), m, to the right of points (..., 2), m; tangents (..., 2)."""
        across = points - self._middle
        second = across[..., 0] * np.sin(ANGLE) + across[..., 1] * np.cos(ANGLE) > 0
        straight = np.where(second, self._end[0], 0.0)
        offset, tangent = points[..., 0] - straight, np.zeros_like(points)
        tangent[..., 1] = 1.0
        first = ~second & (points[..., 1] > self._start[1])
        second &= points[..., 1] < self._end[1]
        for centre, side, chosen in zip(
            self._centres, (1, -1), (first, second), strict=True
        ):
            way = points[chosen] - centre
            radius = np.linalg.norm(way, axis=-1)
            offset[chosen] = side * (BEND - radius)
            tangent[chosen] = side * way[..., ::-1] * (1, -1) / radius[..., None]
        return offset, tangent


class Stopped(NamedTuple):
    """Forces of a device in an S-bend, N."""

    moving: float  # in the last control step of the push
    stopped: float  # mean at rest
    held: float  # mean some time later
    expected: float  # push force of the reference
    wall: float  # sum over all contacts at rest
    expected_wall: float  # the same of the reference


def stopped(
    speed: float,
    friction: float,
    later: float = 0.0,
    tolerance: float = SOLVER_TOLERANCE,
    link: float = LINK,
    travel: float = _PUSH,
) -> Stopped:
    """Pushes a device into an S-bend, stops it, and waits.

    Args:
        speed: Speed of the base, m/s.
        friction: Coulomb coefficient.
        later: Time from rest to the last reading, s.
        tolerance: Tolerance of the solver.
        link: Length of the links, m.
        travel: Travel of the base before the stop, m.
    """
    device = uniform(link)
    length = _BEHIND + travel + device.tip_length
    fine = devices.Discretisation(length, link)
    rig = Rig(device, fine, stroke=travel + 0.01, friction=friction)
    rig.arena.mjcf_model.option.tolerance = tolerance
    line = _Line(_BEFORE)

    def depth(blocks: np.ndarray, points: np.ndarray) -> np.ndarray:
        places = blocks[:, None, :] + points
        offset, _ = line.nearest(places[..., ::2])
        return TUBE - np.hypot(offset, places[..., 1])

    low, high = (-TUBE, -TUBE, -length), (0.05, TUBE, 0.1)
    rig.add_wall(depth, low, high, friction)
    rig.compile()
    rig.hold(0.0)

    def push(command: float, duration: float) -> float:
        """Push force, N, in the last control step; at rest its mean over `_READ`."""
        found = [0.0]
        for _ in range(round(duration / CONTROL_TIMESTEP)):
            rig.drive([command])
            rig.run(CONTROL_TIMESTEP)
            found.append(float(rig.sensor(f"{rig.name}/push_force")[2]))
        last = 1 if command else round(_READ / CONTROL_TIMESTEP)
        return float(np.mean(found[-last:]))

    moving = push(speed / MAX_PUSH_SPEED, travel / speed)
    rest = push(0.0, _RESTING)
    contacts = Contacts.from_sensor(rig.sensor("wall_contacts"))
    expected, expected_wall = _reference(rig, line, friction)
    wall, held = float(contacts.magnitude.sum()), push(0.0, later)
    return Stopped(moving, rest, held, expected, wall, expected_wall)


def _reference(rig: Rig, line: _Line, friction: float) -> tuple[float, float]:
    """Axial and wall force, N, of a uniform rod that slides at the place of the device.

    Pieces of length h have angles θ, and forces f act on their distal ends. For each
    angle the virtual work vanishes: EI θ'' h balances h (cos θ, -sin θ)·Σf, the sum
    over the ends of this piece and those beyond it.
    """
    lengths, stiffness, _ = rig.sections
    base = rig.lengths[0] / 2 - rig.lengths.sum() + rig.qpos("insertion")
    count = round(float(lengths.sum()) / _PIECE)
    piece, gap = lengths.sum() / count, TUBE - rig.device.outer_radius
    spring = np.full(count, 2.0)
    spring[-1] = 1.0
    bends = np.diag(spring) - np.diag(np.ones(count - 1), 1)
    bends = stiffness[0] / piece * (bends - np.diag(np.ones(count - 1), -1))
    later = np.maximum.outer(np.arange(count), np.arange(count))

    def balance(angles: np.ndarray, wall: float):
        """Moments (n,), their Jacobian (n, n) on a flat wall, Σf (2,) and Σ|f|."""
        steps = piece * np.stack([np.sin(angles), np.cos(angles)], axis=-1)
        across = steps[:, ::-1] * (1, -1)
        offset, tangent = line.nearest(np.cumsum(steps, axis=0) + (0.0, base))
        outwards = np.sign(offset)[:, None] * tangent[:, ::-1] * (1, -1)
        acting = -outwards - friction * tangent
        deep = np.maximum(np.abs(offset) - gap, 0.0)[:, None]
        force = np.cumsum((wall * deep * acting)[::-1], axis=0)[::-1]
        slope = wall * (deep > 0)[..., None] * acting[..., None] * outwards[:, None]
        slope = np.cumsum(slope[::-1], axis=0)[::-1]
        moments = bends @ angles - (across * force).sum(axis=1)
        rates = bends - np.einsum("ia,ikab,kb->ik", across, slope[later], across)
        rates += np.diag((steps * force).sum(axis=1))
        loads = wall * deep.sum() * np.hypot(1.0, friction)
        return 1e6 * moments, 1e6 * rates, force[0], loads

    angles = np.zeros(count)
    for wall in _WALLS:
        found = root(
            lambda x, wall=wall: balance(x, wall)[:2], angles, method="lm", jac=True
        )
        if not np.abs(found.fun).max() < 1e-4:
            raise RuntimeError(f"the rod of the reference: {found.message}")
        angles = found.x
    _, _, force, loads = balance(angles, _WALLS[-1])
    return -float(force[1]), float(loads)


def _push(one: Stopped, friction: float, speed: float, solved: str = "") -> Check:
    name = f"S-bend, friction {friction:g}{solved}: push after a stop "
    name += f"from {1e3 * speed:g} mm/s"
    note = f"{1e3 * one.stopped:.2f} mN, {1e3 * one.moving:.2f} mN moving, "
    note += f"expected {1e3 * one.expected:.2f} mN"
    return Check.deviation(name, one.stopped, one.expected, STOPPED_BOUND, "N", note)


def checks() -> Iterator[Check]:
    """Checks of push forces after a stop, and of creep in the last case."""
    for friction, speed in itertools.product(FRICTIONS, SPEEDS):
        strict = stopped(speed, friction, tolerance=STRICT)
        yield _push(strict, friction, speed, ", strict solver")
        creeps = friction == FRICTIONS[-1] and speed == SPEEDS[-1]
        one = stopped(speed, friction, _HELD if creeps else 0.0)
        yield _push(one, friction, speed)
        name = f"S-bend, friction {friction:g}, links of {1e3 * LINK:g} mm, "
        name += f"stopped from {1e3 * speed:g} mm/s: force on the wall"
        yield Check.deviation(name, one.wall, one.expected_wall, WALL_BOUND, "N")
        if creeps:
            name = f"S-bend: change of the push by creep in {_HELD:g} s"
            note = f"{1e3 * one.stopped:.2f} mN, then {1e3 * one.held:.2f} mN"
            yield Check.deviation(name, one.held, one.stopped, CREEP_BOUND, "N", note)


def _off(one: Stopped) -> float:
    """Deviation (%) of the push force at rest from that of the reference."""
    return 100 * (one.stopped / one.expected - 1)


def findings() -> dict[str, dict[str, float]]:
    """Push forces of long links, of stops at neighbouring speeds and of long rests.

    Deviations in %, without friction the largest of several travels; forces in mN.
    """
    free = {
        f"links of {1e3 * link:g} mm": max(
            abs(_off(stopped(SPEEDS[-1], 0.0, link=link, travel=float(travel))))
            for travel in _TRAVELS
        )
        for link in (LINK, NavigationConfig().shaft_link)
    }
    beside = {
        f"{1e3 * speed:g} mm/s": _off(stopped(speed, FRICTIONS[0])) for speed in _BESIDE
    }
    held = stopped(SPEEDS[-1], FRICTIONS[-1], _LONG)
    name = "push in an S-bend"
    return {
        f"{name} without friction, largest deviation, %": free,
        f"{name} after a stop, friction {FRICTIONS[0]:g}, deviation, %": beside,
        f"{name} at rest, friction {FRICTIONS[-1]:g}, mN": {
            "at once": 1e3 * held.stopped,
            f"after {_LONG:g} s": 1e3 * held.held,
        },
    }
