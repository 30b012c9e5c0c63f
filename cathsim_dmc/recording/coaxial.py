"""Coaxial devices of a recorded episode: their ends, and the outermost on each link.

A record holds one chain of links; what the devices in it did stands in ``meta``.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from cathsim_dmc.recording.episode import Episode
from cathsim_dmc.recording.geometry import along

# Of one device in ``meta['devices']``: series over the states.
SERIES = ("insertion", "rotation", "tip_rotation")


@dataclass(frozen=True, eq=False)
class CoaxialRecord:
    """K devices from the innermost outwards, over T+1 states.

    Attributes:
        names: What each device is to an operator.
        radii: (K,), outer radius, metres.
        insertion: (T+1, K), of the devices' ends, metres.
        rotation: (T+1, K), of the rotary units, radians.
        tip_rotation: (T+1, K), of the devices' ends, radians.
    """

    names: tuple[str, ...]
    radii: np.ndarray
    insertion: np.ndarray
    rotation: np.ndarray
    tip_rotation: np.ndarray

    @classmethod
    def of(cls, episode: Episode) -> "CoaxialRecord | None":
        """Reads the devices of an episode; None if it has a single device."""
        devices = episode.meta.get("devices")
        if not devices:
            return None
        columns = (
            np.array([one[name] for one in devices], np.float64).T
            for name in ("radius", *SERIES)
        )
        return cls(tuple(one["name"] for one in devices), *columns)

    @property
    def gaps(self) -> np.ndarray:
        """Way (T+1, K) from the end of each device to that of the chain, metres."""
        return self.insertion.max(axis=1, keepdims=True) - self.insertion

    def ends(self, line: np.ndarray) -> np.ndarray:
        """Ends (T+1, K, 3) of the devices on a chain.

        Args:
            line: (T+1, L+1, 3), joints from proximal to distal, then the head.
        """
        pairs = zip(line, self.gaps, strict=True)
        return np.array([along(points[::-1], gaps) for points, gaps in pairs])

    def outermost(self, line: np.ndarray) -> np.ndarray:
        """Number (T+1, L) of the outermost device in the middle of each link.

        Args:
            line: (T+1, L+1, 3), joints from proximal to distal, then the head.
        """
        lengths = np.linalg.norm(np.diff(line, axis=1), axis=-1)
        beyond = np.cumsum(lengths[:, ::-1], axis=1)[:, ::-1]
        middle = beyond - lengths / 2
        number = np.broadcast_to(self.gaps.argmin(axis=1)[:, None], middle.shape).copy()
        for k in range(len(self.names)):
            number[middle >= self.gaps[:, k, None]] = k
        return number


def device_meta(task: Any, rows: dict[str, np.ndarray]) -> list[dict[str, Any]]:
    """What ``meta['devices']`` holds.

    Args:
        rows: ``SERIES`` by name, (T+1, K).
    """
    chain = task.scene.catheter
    return [
        {
            "name": name,
            "device": device.name,
            "radius": device.outer_radius,
            **{series: rows[series][:, k].tolist() for series in SERIES},
        }
        for k, (name, device) in enumerate(
            zip(chain.device_names, chain.devices, strict=True)
        )
    ]
