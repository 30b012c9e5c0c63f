"""Coaxial devices, living vessels and X-ray settings in the `meta` of an episode."""

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from cathsim_dmc.anatomy.centreline import arc_lengths
from cathsim_dmc.anatomy.motion import Motion
from cathsim_dmc.anatomy.parts import Surface
from cathsim_dmc.imaging.angiograph import Deviation
from cathsim_dmc.imaging.device import Shadow
from cathsim_dmc.imaging.options import FluoroscopyOptions
from cathsim_dmc.physics.device_points import device_points
from cathsim_dmc.recording.episode import Episode
from cathsim_dmc.recording.geometry import along

# Series over the states of each device in ``meta['devices']``.
DEVICE_SERIES = ("insertion", "rotation", "tip_rotation")
# Figures over the states in ``meta['vessel']``: name, factor and label of a plot.
VESSEL_SERIES = {
    "heart_phase": (1.0, "phase of the heart"),
    "breath_phase": (1.0, "phase of breathing"),
    "blood_speed": (1.0, "blood at the head, m/s"),
    "indentation": (1e3, "indentation, mm"),
    "wall_work": (1e6, "work on the wall, µJ"),
}
MESH_EVERY = 4  # states between the surfaces of a moving vessel in a recording


@dataclass(frozen=True, eq=False)
class CoaxialRecord:
    """K devices from the innermost outwards, over T+1 states."""

    names: tuple[str, ...]  # kind of each device, such as "guidewire"
    radii: np.ndarray  # (K,), outer radius, metres
    insertion: np.ndarray  # (T+1, K), of the devices' ends, metres
    rotation: np.ndarray  # (T+1, K), of the rotary units, radians
    tip_rotation: np.ndarray  # (T+1, K), of the devices' ends, radians

    @classmethod
    def of(cls, episode: Episode) -> "CoaxialRecord | None":
        """Reads the devices of an episode; None if it has a single device."""
        if not (devices := episode.meta.get("devices")):
            return None
        series = {
            name: np.array([one[name] for one in devices], np.float64).T
            for name in ("radius", *DEVICE_SERIES)
        }
        names = tuple(one["name"] for one in devices)
        return cls(names, radii=series.pop("radius"), **series)

    @property
    def gaps(self) -> np.ndarray:
        """Distance (T+1, K) from each device's end to the chain's end, metres."""
        return self.insertion.max(axis=1, keepdims=True) - self.insertion

    def ends(self, line: np.ndarray) -> np.ndarray:
        """Returns the devices' ends (T+1, K, 3) on a chain (T+1, L+1, 3), metres."""
        pairs = zip(line, self.gaps, strict=True)
        return np.array([along(points[::-1], gaps) for points, gaps in pairs])

    def outermost(self, line: np.ndarray) -> np.ndarray:
        """Returns the number (T+1, L) of the outermost device at each link's middle."""
        lengths = np.linalg.norm(np.diff(line, axis=1), axis=-1)
        middle = np.cumsum(lengths[:, ::-1], axis=1)[:, ::-1] - lengths / 2
        number = np.zeros(middle.shape, int)  # the leading device has no gap
        for k in range(len(self.names)):
            number[middle >= self.gaps[:, k, None]] = k
        return number


def device_meta(chain: Any, rows: dict[str, np.ndarray]) -> list[dict[str, Any]]:
    """Returns ``meta['devices']`` from the arrays (T+1, K) of ``DEVICE_SERIES``."""
    return [
        {
            "name": name,
            "device": device.name,
            "radius": device.outer_radius,
            **{series: rows[series][:, k].tolist() for series in DEVICE_SERIES},
        }
        for k, (name, device) in enumerate(
            zip(chain.device_names, chain.devices, strict=True)
        )
    ]


@dataclass(frozen=True, eq=False)
class VesselRecord:
    """A vessel over T+1 states."""

    # (T+1,) by names of `VESSEL_SERIES`; (T+1, 3), world frame, "goal" (m) and
    # "blood_velocity" at the head (m/s); "time" (T+1,) and "parameters" of the motion.
    series: dict[str, np.ndarray]
    motion: Motion | None  # None for a vessel at rest

    @classmethod
    def of(cls, episode: Episode) -> "VesselRecord | None":
        """Reads the vessel of an episode; None if it is rigid and its blood rests."""
        if not (meta := episode.meta.get("vessel")):
            return None
        given = {name: np.array(values, np.float64) for name, values in meta.items()}
        given.setdefault("time", episode.time)
        return cls(given, Motion(given["lattice"]) if meta["lattice"] else None)

    def surface(self, rest: Surface, state: int) -> Surface:
        """Returns the surface of the lumen in a state, from its surface at rest."""
        if self.motion is None:
            return rest
        time = float(self.series["time"][state])
        return self.motion.surface(self.series["parameters"], time, rest)


def vessel_state(task: Any) -> dict[str, Any]:
    """Returns the recorded quantities of a vessel; empty if it and its blood rest."""
    vessel, moving = task.rollout.vessel, task.rollout.moving
    if vessel is None:
        return {}
    return {
        **{name: float(value[0]) for name, value in vessel.info().items()},
        "blood_velocity": vessel.blood_velocity[0].tolist(),
        "goal": task.rollout.goal.reshape(3).tolist(),
        **({} if moving is None else {"time": moving.warp(0)[2]}),
    }


@dataclass(frozen=True, eq=False)
class XRayRecord:
    """Fluoroscopy of an episode: its options, the machine, the devices."""

    options: FluoroscopyOptions  # of the task
    deviation: Deviation  # of the machine in this episode
    devices: list[dict[str, Any]]  # fields of `Shadow` of each, innermost first

    @classmethod
    def of(cls, episode: Episode) -> "XRayRecord":
        """Reads the record of an episode, with defaults for missing values."""
        kept, coaxial = episode.meta.get("x_ray", {}), CoaxialRecord.of(episode)
        radii = episode.radii[:1] if coaxial is None else coaxial.radii
        return cls(
            FluoroscopyOptions(**kept.get("options", {})),
            Deviation(**kept.get("deviation", {})),
            kept.get("devices", [{"radius": radius} for radius in radii.tolist()]),
        )

    def shadows(self, episode: Episode, states: slice) -> list[Shadow]:
        """Returns the shadows of the devices in some states, innermost first."""
        line, coaxial = np.array(episode.catheter[states]), CoaxialRecord.of(episode)
        gaps = np.zeros((len(line), 1)) if coaxial is None else coaxial.gaps[states]
        nodes = arc_lengths(line[0, ::-1])[::-1].copy()
        points = device_points(line, gaps, nodes)
        return [Shadow(points[:, k], **each) for k, each in enumerate(self.devices)]


def x_ray_meta(task: Any) -> dict[str, Any]:
    """Returns ``meta['x_ray']``, see `XRayRecord`."""
    shadows = [vars(shadow).items() for shadow in task.rollout.shadows]
    return {
        "options": asdict(task.rollout.case().fluoroscopy),
        "deviation": asdict(task.rollout.deviations[0]),
        "devices": [{k: v for k, v in one if k != "points"} for one in shadows],
    }
