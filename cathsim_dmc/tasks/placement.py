"""Where device, sheath and robot stand in an anatomy, and where the goal is."""

import dataclasses

import numpy as np

from cathsim_dmc.anatomy import Anatomy, Goal
from cathsim_dmc.entities import arena, devices
from cathsim_dmc.tasks import objectives as objectives
from cathsim_dmc.tasks.variations import START_JITTER

# The steerable tip starts free of the sheath wherever the vessel is straight enough.
_FREE_LENGTH = 0.005  # m of shaft out of the sheath behind the tip
_START_CLEARANCE = 1e-3  # m between the straight device and the wall at the start
_LEAST_START_DEPTH = 0.005  # m
# Way beyond the goal that the stroke leaves for bends, detours and wrong branches.
_SPARE_STROKE = 0.08  # m
_BASE_LENGTH = 0.02  # m of device that never leaves the sheath
_LONGEST_DEVICE = 3.0  # m, the longest wires sold


@dataclasses.dataclass(frozen=True)
class Placement:
    """Poses of the device at the start; world frame, SI units.

    Attributes:
      inlet: (3,), mouth of the sheath in the plane of the inlet.
      quaternion: (4,) wxyz, turns +z into the direction of insertion.
      start_depth: way of the tip past the inlet at zero insertion, m.
      stroke: longest insertion, m.
      working_length: simulated length of the device, m.
    """

    inlet: np.ndarray
    quaternion: np.ndarray
    direction: np.ndarray
    start_depth: float
    stroke: float
    working_length: float

    @property
    def start(self) -> np.ndarray:
        """Position (3,) of the head at zero insertion."""
        return self.inlet + self.start_depth * self.direction

    @property
    def robot(self) -> np.ndarray:
        """Position (3,) of the proximal mouth of the sheath."""
        return self.start - self.working_length * self.direction


def resolve_goal(anatomy: Anatomy, goal: "str | Goal") -> Goal:
    """Returns the goal, by name or as given.

    Raises:
      ValueError: if the anatomy has no such goal, or the goal is outside the lumen.
    """
    if isinstance(goal, str):
        goal = anatomy.goal(goal)
    depth = float(anatomy.depth(goal.position))
    if not depth > 0:
        raise ValueError(
            f"goal {goal.name!r} at {np.round(goal.position, 4).tolist()} m lies "
            f"{-depth * 1e3:.1f} mm outside the lumen of {anatomy.name!r}; give a "
            f"point inside, or one of the goals {', '.join(anatomy.goals)}"
        )
    return goal


def place_device(
    anatomy: Anatomy,
    route_length: float,
    device: devices.Device,
    working_length: float | None = None,
) -> Placement:
    """Puts a device to the inlet of an anatomy.

    Args:
      anatomy: where to.
      route_length: from the inlet to the goal, m.
      device: its tip length decides how far it starts inside.
      working_length: simulated length, m; None for what the route needs.

    Raises:
      ValueError: if `working_length` is shorter than the tip and its start need, or
        longer than any device is.
    """
    inlet = anatomy.inlet
    start_depth = _straight_run(anatomy, device)
    if working_length is None:
        stroke = max(route_length - start_depth, 0.0) + _SPARE_STROKE
        working_length = start_depth + stroke + _BASE_LENGTH
    stroke = working_length - start_depth - _BASE_LENGTH
    least = max(start_depth + _BASE_LENGTH, device.tip_length)
    # Also false for NaN.
    if not least < working_length <= _LONGEST_DEVICE:
        raise ValueError(
            f"working_length is {working_length} m; {device.name!r} needs more than "
            f"{least:.3f} m here to be moved at all, and {_LONGEST_DEVICE:g} m at most"
        )
    return Placement(
        inlet=np.array(inlet.position),
        quaternion=_frame(inlet.direction),
        direction=np.array(inlet.direction),
        start_depth=start_depth,
        stroke=stroke,
        working_length=working_length,
    )


def _straight_run(anatomy: Anatomy, device: devices.Device) -> float:
    """Depth up to which the straight device fits into the lumen, m."""
    inlet = anatomy.inlet
    depths = np.arange(1e-3, device.tip_length + _FREE_LENGTH + 1e-9, 1e-3)
    points = inlet.position + depths[:, None] * inlet.direction
    free = anatomy.depth(points) > device.outer_radius + _START_CLEARANCE
    # The first millimetres lie in the plane of the open end, where depth is small.
    blocked = np.flatnonzero(~free & (depths > _LEAST_START_DEPTH))
    return float(depths[-1] if blocked.size == 0 else depths[blocked[0] - 1])


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
        xyz = np.array(
            [
                matrix[2, 1] - matrix[1, 2],
                matrix[0, 2] - matrix[2, 0],
                matrix[1, 0] - matrix[0, 1],
            ]
        ) / (4 * w)
        return np.concatenate([[w], xyz])
    # Half turn: the axis is the eigenvector of eigenvalue 1.
    values, vectors = np.linalg.eigh((matrix + matrix.T) / 2)
    return np.concatenate([[0.0], vectors[:, np.argmax(values)]])


def start_joints(
    link_lengths: np.ndarray, start_depth: float, displacement: np.ndarray
) -> dict[str, np.ndarray]:
    """Joint positions that displace the tip of the straight device.

    The axial part moves the base, the lateral part bends the first joint out of the
    sheath.

    Args:
      link_lengths: (n,) of the chain, m.
      start_depth: of the tip past the mouth of the sheath, m.
      displacement: (..., 3), m, z along the direction of insertion.

    Returns:
      Joint positions (...) by name, m and rad; all others stay straight.
    """
    beyond = np.cumsum(link_lengths[::-1])[::-1]  # from joint i to the head
    free = np.flatnonzero(beyond[1:] <= start_depth)
    index = int(free[0]) + 1 if free.size else len(link_lengths) - 1
    lever = beyond[index]
    # The base cannot go back behind its start, so the stroke begins 1 mm later.
    return {
        "insertion": np.maximum(START_JITTER + displacement[..., 2], 0.0),
        f"bend_x_{index}": -displacement[..., 1] / lever,
        f"bend_y_{index}": displacement[..., 0] / lever,
    }


def add_cameras(scene: arena.AngiographyArena, anatomy: Anatomy) -> None:
    """Adds the published top view and a view from the side."""
    vertices = anatomy.surface.vertices
    low, high = vertices.min(0), vertices.max(0)
    centre, size = (low + high) / 2, float((high - low).max())
    distance = 2.6 * size
    # Seen from the front, the patient's left is on the right of the image.
    scene.add_camera("top", centre, distance, (1, 0, 0, 0, 0, 1))
    scene.add_camera("side", centre, distance, (0, 1, 0, 0, 0, 1))
