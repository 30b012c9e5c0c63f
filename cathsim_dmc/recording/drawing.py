"""Inputs of a recording beside the episode, checked against it."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from cathsim_dmc.anatomy.parts import Surface
from cathsim_dmc.recording.episode import Episode
from cathsim_dmc.recording.scene import BodyGeom

# 5F diagnostic catheter, 1.67 mm outer diameter; used when the record has no radii.
CATHETER_RADIUS = 0.835e-3


@dataclass(frozen=True, eq=False)
class Drawing:
    """Checked inputs of a recording; lengths in metres, world frame.

    Attributes:
        surface: Lumen surface of the vessel.
        geoms: Primitives that the body poses of the episode move.
        radii: (L,) radii of the links of the catheter.
        goal: Position (3,) and radius, or None.
        frames: (T+1, H, W, P) uint8 fluoroscopy of P = 1 or 2 planes, or None.
    """

    surface: Surface
    geoms: tuple[BodyGeom, ...]
    radii: np.ndarray
    goal: tuple[np.ndarray, float] | None
    frames: np.ndarray | None

    @classmethod
    def of(
        cls,
        episode: Episode,
        surface: Surface,
        *,
        robot_geoms: Iterable[BodyGeom] = (),
        fluoroscopy: np.ndarray | None = None,
    ) -> "Drawing":
        """Check the arguments of ``write_rrd``; ValueError on what does not fit."""
        if fluoroscopy is not None:
            shape = np.shape(fluoroscopy)
            fits = len(shape) == 4 and shape[0] == episode.steps + 1
            if not fits or shape[-1] not in (1, 2) or fluoroscopy.dtype != np.uint8:
                raise ValueError(
                    f"fluoroscopy must be uint8 of shape ({episode.steps + 1}, H, W, "
                    f"1), or 2 for two planes; got {fluoroscopy.dtype} of {shape}"
                )
        if not len(surface.vertices):
            raise ValueError("a surface needs vertices")
        geoms, goal = tuple(robot_geoms), None
        if "goal_position" in episode.meta:
            place = np.array(episode.meta["goal_position"], np.float64)
            goal = place, float(episode.meta["goal_radius"])
        return cls(surface, geoms, link_radii(episode), goal, fluoroscopy)


def goal_distance(episode: Episode) -> np.ndarray | None:
    """Return the distance to the goal (T+1,) in metres, or None if not recorded."""
    distance = episode.meta.get("distance")
    return None if distance is None else np.array(distance, np.float64)


def link_radii(episode: Episode) -> np.ndarray:
    """Radii (L,) of the links in metres, from ``meta['catheter_radius']`` if there."""
    given = episode.meta.get("catheter_radius", CATHETER_RADIUS)
    return np.broadcast_to(np.float64(given), (episode.catheter.shape[1] - 1,))
