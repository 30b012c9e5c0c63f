"""Directions from the pre-shaped ends of coaxial devices to points ahead.

A pre-shaped end leads to one side of its device. How to turn it depends on the
direction in the frame of the link proximal to that end, and on its rotation.
"""

import dataclasses
from typing import Self

import numpy as np

from cathsim_dmc.entities import posture
from cathsim_dmc.entities.chain import Chain
from cathsim_dmc.entities.device_stack import DeviceStack
from cathsim_dmc.physics.device_points import gaps_of
from cathsim_dmc.physics.readings import Readings


@dataclasses.dataclass(frozen=True, eq=False)
class CoaxialEnds:
    """Where the shaped ends of K devices begin on their common chain of L links.

    Attributes:
        shaped: (K,), length of the pre-shaped end of each device, m.
        nodes: (L + 1,), distances of the link ends from the end of the chain, m.
    """

    shaped: np.ndarray
    nodes: np.ndarray

    @classmethod
    def of(cls, chain: Chain) -> Self:
        """Returns the shaped ends of a `DeviceStack`."""
        assert isinstance(chain, DeviceStack)
        shapes = [[arc.length for arc in one.tip_shape] for one in chain.devices]
        return cls(np.array([sum(one) for one in shapes]), chain.stack.nodes)

    def directions(
        self, readings: Readings, insertion: np.ndarray, targets: np.ndarray
    ) -> np.ndarray:
        """Vectors (N, K, 3), m, to targets, in the frames proximal to the shaped ends.

        Args:
            readings: State of the N chains.
            insertion: (N, K), insertions of the devices, m.
            targets: (N, K, 3), m, world frame.
        """
        behind_first = gaps_of(insertion)
        rows, last = np.arange(len(insertion)), len(self.nodes) - 2
        frames, ways = [readings.head_frame], np.empty(targets.shape)
        for k in range(behind_first.shape[1]):
            behind = behind_first[:, k] + self.shaped[k]
            link = np.maximum((self.nodes[:-1] > behind[:, None]).sum(axis=1) - 1, 0)
            while len(frames) <= last - link.min():
                frames.append(before(frames[-1], readings.joint_positions, len(frames)))
            frame = np.stack(frames)[last - link, rows]
            way = targets[:, k] - readings.centreline[rows, link]
            ways[:, k] = np.einsum("nij,ni->nj", frame, way)
        return ways


def before(frame: np.ndarray, joints: np.ndarray, number: int) -> np.ndarray:
    """Frames (N, 3, 3) of the links proximal to given ones.

    Args:
        frame: (N, 3, 3), frames of the links, axes in columns.
        joints: (N, J), joint positions of the chains.
        number: Number of these links from the distal end, beginning with 1.
    """
    place = joints.shape[1] // 2 - number  # of the joint; two slides precede it
    for axis in (1, 0) if posture.x_first(place) else (0, 1):
        frame = turned(frame, axis, -joints[:, -2 * number + axis])
    return frame


def turned(frame: np.ndarray, axis: int, angle: np.ndarray) -> np.ndarray:
    """Frame (..., 3, 3) turned by an angle (...) about its own axis 0, 1 or 2."""
    first, second = (axis + 1) % 3, (axis + 2) % 3
    cosine, sine = np.cos(angle)[..., None], np.sin(angle)[..., None]
    turned = np.array(frame)
    turned[..., first] = cosine * frame[..., first] + sine * frame[..., second]
    turned[..., second] = cosine * frame[..., second] - sine * frame[..., first]
    return turned


def sides(ways: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """Entries (N, K, 5) of the observation for vectors of `CoaxialEnds.directions`.

    Args:
        ways: (N, K, 3), the vectors.
        rotation: (N, K), rotations of the ends, rad.

    Returns:
        Cosine and sine of the rotation, then x, y and z of the unit vector in the frame
        turned with the end.
    """
    ways = ways / np.maximum(np.linalg.norm(ways, axis=-1, keepdims=True), 1e-9)
    cosine, sine = np.cos(rotation), np.sin(rotation)
    along = cosine * ways[..., 0] + sine * ways[..., 1]
    across = cosine * ways[..., 1] - sine * ways[..., 0]
    return np.stack([cosine, sine, along, across, ways[..., 2]], axis=-1)


def turns(ways: np.ndarray, rotation: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Remaining rotations (N, K) of the ends to vectors, and bend angles (N, K), rad.

    Args:
        ways: (N, K, 3), vectors of `CoaxialEnds.directions`.
        rotation: (N, K), rotations of the ends, rad.

    Returns:
        Azimuth of each vector about the axis of the device minus the rotation of the
        end, and angle between the vector and this axis.
    """
    x, y, z = np.moveaxis(ways, -1, 0)
    return np.arctan2(y, x) - rotation, np.arctan2(np.hypot(x, y), z)


def wrapped(angle: np.ndarray) -> np.ndarray:
    """Angles (...) between -pi and pi, rad."""
    return np.angle(np.exp(1j * angle))
