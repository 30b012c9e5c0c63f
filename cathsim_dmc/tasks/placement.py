"""Placement of device, sheath and robot in an anatomy, and of the goal."""

import dataclasses
import math
from collections.abc import Sequence

import mujoco
import numpy as np

from cathsim_dmc import bounds
from cathsim_dmc.anatomy import Anatomy, Goal
from cathsim_dmc.anatomy.reach import least_ahead, unreachable
from cathsim_dmc.entities import devices
from cathsim_dmc.entities.sheath import CLEARANCE
from cathsim_dmc.physics.randomisation import START_JITTER
from cathsim_dmc.tasks.config import WORKING_LENGTHS

# The steerable tip starts free of the sheath wherever the way to the first branching
# is long enough.
_FREE_LENGTH = 0.005  # m of shaft out of the sheath behind the tip
# Largest start depth, as a fraction of the distance to the first branching, the end of
# the vessel and the goal, so that all of them lie ahead.
_LARGEST_SHARE = 0.5
# Stroke beyond the goal, for detours and wrong branches: half a turn along the outer
# wall of an arch of 14 mm radius is 41 mm longer than its centreline. The insertion of
# the expert at the goal is 4 to 33 mm less than the length of the route.
_SPARE_STROKE = 0.04  # m
_BASE_LENGTH = 0.02  # m of device that never leaves the sheath
# Length of the device that observations show, see `common_chain`. A task simulates only
# those of its distal links that can leave the sheath.
COMMON_LENGTH = 0.34  # m
_LINE_SPACING = 1e-3  # m
# Least distance of the sheath's axis from any lumen, m, with a play of the device of at
# most `CLEARANCE`: the wall is 5 mm thick. Nearer to the inlet than `_NEAR_INLET` the
# sheath touches the inlet's own wall.
_CLEAR_OF_LUMEN = 5.5e-3  # m
_NEAR_INLET = 0.015  # m
# Distance from the plane of the inlet within which the sheath holds the device, m.
_MOUTH = 2e-3
# Tilts of the sheath that are tried where the straight one crosses a vessel; the first
# 40 arches of the set "test" need 17.5 degrees at most.
_TILT_STEP, _LARGEST_TILT = np.radians(2.5), np.radians(30.0)
_AZIMUTH_STEP = np.radians(15.0)


@dataclasses.dataclass(frozen=True, eq=False)
class Placement:
    """Poses of the device at the start; world frame, SI units.

    Attributes:
        inlet: (3,), mouth of the sheath in the plane of the inlet.
        direction: (3,), unit vector of insertion at the inlet, see `sheath_direction`.
        quaternion: (4,) wxyz, turns +z into the direction of insertion.
        start_depth: distance of the tip past the inlet at zero insertion, m.
        stroke: longest insertion, m.
        working_length: simulated length of the device, m.
        line: (k, 3), m, frame of the base at zero insertion: path of the device from
            its base through the sheath, then along the vessel's centreline.
    """

    inlet: np.ndarray
    quaternion: np.ndarray
    direction: np.ndarray
    start_depth: float
    stroke: float
    working_length: float
    line: np.ndarray

    @property
    def start(self) -> np.ndarray:
        """Position (3,) that the head of the straight device has at zero insertion."""
        return self.inlet + self.start_depth * self.direction

    @property
    def robot(self) -> np.ndarray:
        """Position (3,) of the proximal mouth of the sheath, and of the base."""
        return self.start - self.working_length * self.direction


def resolve_goal(anatomy: Anatomy, goal: "str | Goal | Sequence[float]") -> Goal:
    """Returns a goal given by name, as a `Goal`, or as a position (3,).

    The position has unit and frame of the anatomy's file, see `Anatomy.goal_at`.
    ValueError if it is outside the lumen, or a device would start past it.
    """
    allowed = f"one of {', '.join(anatomy.goals)}, a Goal, or a position (x, y, z)"
    if isinstance(goal, str):
        if goal not in anatomy.goals:
            bounds.refuse("goal", goal, allowed)
        goal = anatomy.goals[goal]
    elif not isinstance(goal, Goal):
        try:
            goal = bounds.vector("goal", goal, 3)
        except ValueError:
            several = "; several goals need a list of as many anatomies"
            bounds.refuse("goal", goal, allowed + several)
        goal = anatomy.goal_at(goal)
        alone = dataclasses.replace(anatomy, goals={goal.name: goal})
        # The farthest that the head starts past the inlet where the goal is near.
        start = _LARGEST_SHARE * least_ahead(anatomy.inlet) + START_JITTER
        for where in unreachable(alone, start + _LINE_SPACING):
            raise ValueError(
                f"goal {goal.name}: {where}, where a device starts; give a place "
                "farther in, or import with another inlet"
            )
    anatomy.check_goal(goal)
    return goal


def place_device(
    anatomy: Anatomy,
    goal: Goal,
    device: devices.Device,
    working_length: float | None = None,
    farthest_shift: float = 0.0,
    play: float = 0.0,
) -> Placement:
    """Places a device at the inlet of an anatomy.

    Args:
        goal: Goal that the device must be able to reach.
        device: Device; the length of its tip limits the start depth.
        working_length: Simulated length, m; None for what the goal needs.
        farthest_shift: Largest shift of the goal past its place, m.
        play: Radial clearance of the device in the sheath, m.

    Raises:
        ValueError: if `working_length` is too short for the tip and the start depth, or
            longer than any device, or if with this play, but not with less, the device
            would touch a vessel beside the sheath.
    """
    inlet = anatomy.inlet
    route = anatomy.route(goal, farthest_shift)
    way = min(_way_to_branching(anatomy), anatomy.route(goal).length)
    start_depth = min(
        device.tip_length + _FREE_LENGTH,
        _LARGEST_SHARE * max(way, least_ahead(inlet)),
    )
    if working_length is None:
        needed = max(route.length, start_depth) + _SPARE_STROKE + _BASE_LENGTH
        working_length = _whole_links(needed, device)
    stroke = working_length - start_depth - _BASE_LENGTH
    least = max(start_depth + _BASE_LENGTH, device.tip_length)
    # Also false for NaN.
    if not least < working_length <= WORKING_LENGTHS[1]:
        raise ValueError(
            f"working_length is {working_length} m; {device.name!r} needs more than "
            f"{least:.3f} m here to be moved at all, and {WORKING_LENGTHS[1]:g} m at "
            "most"
        )
    direction = _checked_direction(anatomy, play)
    quaternion = _frame(direction)
    outside = np.array([0.0, 0.0, working_length - start_depth])
    # Longer than the inserted part of the device, whose links are chords of the line.
    ahead = np.arange(0.0, route.length, _LINE_SPACING)
    inside = (route.at(ahead).position - inlet.position) @ matrix_of(quaternion)
    # The first point of the route is the inlet; the sheath ends there, straight.
    line = np.vstack([np.zeros(3), inside - inside[0] + outside])
    return Placement(
        inlet=np.array(inlet.position),
        quaternion=quaternion,
        direction=direction,
        start_depth=start_depth,
        stroke=stroke,
        working_length=working_length,
        line=line,
    )


def _checked_direction(anatomy: Anatomy, play: float) -> np.ndarray:
    """Direction (3,) of insertion; ValueError if it is the play that leaves none."""
    direction = sheath_direction(anatomy, play)
    if direction is not None:
        return direction
    if play > CLEARANCE and sheath_direction(anatomy) is not None:
        raise ValueError(
            f"sheath_clearance is {play:g} m, with which the device would touch a "
            f"vessel of {anatomy.name!r} beside the sheath; give {CLEARANCE:g} m, or "
            "None for a sheath that holds the device"
        )
    # `start.StartPosture` refuses a device that stands in a wall.
    return np.array(anatomy.inlet.direction)


def _whole_links(length: float, device: devices.Device) -> float:
    """Rounds a length, m, up to whole links of the common chain."""
    common = devices.Discretisation(max(COMMON_LENGTH, 2 * device.tip_length))
    link = common.link_lengths(device)[0]
    count = math.ceil(round((length - device.tip_length) / link, 6))
    return device.tip_length + max(count, 1) * link


def sheath_direction(anatomy: Anatomy, play: float = 0.0) -> np.ndarray | None:
    """Direction (3,) of insertion that keeps the sheath outside all vessels.

    It is the inlet's own direction if a straight sheath fits behind the inlet. If a
    vessel crosses that line, as where the aorta bends back on itself, the sheath is
    tilted about its mouth by the smallest angle that clears it.

    Args:
        play: Radial clearance of the device in the sheath, m.

    Returns:
        Unit vector, world frame; None if the sheath crosses a vessel at every tilt up
        to 30 degrees.
    """
    inlet = anatomy.inlet
    along = np.asarray(inlet.direction, dtype=float)
    least = _CLEAR_OF_LUMEN + max(play - CLEARANCE, 0.0)
    if _clear(anatomy, along[None], least)[0]:
        return along
    x, y, _ = matrix_of(_frame(along)).T
    turns = np.arange(0.0, 2 * np.pi, _AZIMUTH_STEP)
    around = np.cos(turns)[:, None] * x + np.sin(turns)[:, None] * y
    for tilt in np.arange(_TILT_STEP, _LARGEST_TILT + 1e-9, _TILT_STEP):
        directions = np.cos(tilt) * along + np.sin(tilt) * around
        clear = _clear(anatomy, directions, least)
        if clear.any():
            return directions[clear.argmax()]
    return None


def _clear(anatomy: Anatomy, directions: np.ndarray, least: float) -> np.ndarray:
    """Whether (k,) sheaths in directions (k, 3) stay `least` m away from all lumens."""
    behind = np.arange(_NEAR_INLET, COMMON_LENGTH, _LINE_SPACING)
    lines = anatomy.inlet.position - behind[:, None] * directions[:, None]
    depth = anatomy.lumen(lines.reshape(-1, 3)).reshape(len(directions), -1)
    return np.asarray((depth < -least).all(-1))


def _way_to_branching(anatomy: Anatomy) -> float:
    """Distance from the inlet to the nearest branching or end of its vessel, m."""
    tree, inlet = anatomy.tree, anatomy.inlet
    vessel = tree.vessel(inlet.vessel)
    start = float(vessel.centreline.project(inlet.position).arc_length)
    length = vessel.centreline.length
    places = [length if start < length / 2 else vessel.ostium]
    for child in tree.vessels.values():
        if child.parent == vessel.name:
            ostium = child.mouth.position
            places.append(float(vessel.centreline.project(ostium).arc_length))
    return min(abs(place - start) for place in places)


def matrix_of(quaternion: np.ndarray) -> np.ndarray:
    """Rotation matrix (3, 3) of a quaternion (4,), wxyz."""
    matrix = np.empty(9)
    mujoco.mju_quat2Mat(matrix, quaternion)
    return matrix.reshape(3, 3)


def _frame(direction: np.ndarray) -> np.ndarray:
    """Quaternion wxyz that turns +z into a direction and keeps +y posterior."""
    z = direction / np.linalg.norm(direction)
    posterior = np.array([0.0, 1.0, 0.0])
    if abs(z @ posterior) > 0.99:
        posterior = np.array([0.0, 0.0, -1.0])
    x = np.cross(posterior, z)
    x /= np.linalg.norm(x)
    matrix = np.stack([x, np.cross(z, x), z], axis=-1)
    w = np.sqrt(max(0.0, 1 + np.trace(matrix))) / 2
    if w > 1e-6:
        skew = matrix - matrix.T
        return np.array(
            [w, *(np.array([skew[2, 1], skew[0, 2], skew[1, 0]]) / (4 * w))]
        )
    # Half turn: the axis is the eigenvector of eigenvalue 1.
    values, vectors = np.linalg.eigh((matrix + matrix.T) / 2)
    return np.concatenate([[0.0], vectors[:, np.argmax(values)]])


def past_sheath(anatomy: Anatomy, nodes: np.ndarray, along: np.ndarray) -> np.ndarray:
    """Finds the nodes (..., n, 3) of devices, m, world frame, that are past the sheath.

    Args:
        along: (3,) unit vector of the sheath, which may be tilted against the inlet.

    Returns:
        (..., n) bool: False in the sheath and within 2 mm of its mouth.
    """
    inlet = anatomy.inlet
    way = nodes - inlet.position
    # Beside the sheath, a node may also lie behind the plane of the inlet, in a vessel
    # that turns back.
    before = way @ along <= _MOUTH
    beside = np.linalg.norm(np.cross(way, along), axis=-1) >= inlet.radius
    return (np.linalg.norm(way, axis=-1) > _MOUTH) & (~before | beside)
