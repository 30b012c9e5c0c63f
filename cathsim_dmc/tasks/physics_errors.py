"""Physics errors: detection and names."""

import logging

import numpy as np

from cathsim_dmc.anatomy import Anatomy
from cathsim_dmc.tasks.scene import Scene

DIVERGED = "diverged"
ESCAPED = "escaped through the wall"
EXPLODED = "exploding force"

# Control steps between two checks for an escape.
ESCAPE_INTERVAL = 50
# Deeper outside the lumen than this, m, the axis of the device is behind the wall:
# the wall is 4 mm thick, and penetration stays below 1 mm.
_ESCAPE_DEPTH = 2e-3
# Within this way of the plane of the inlet, m, the sheath holds the device.
_MOUTH = 2e-3
# No contact of a device that is pushed with 5 N at most is harder than this, N.
MAX_FORCE = 50.0

_LOG = logging.getLogger(__name__)


def escaped(
    anatomy: Anatomy, centreline: np.ndarray, along: np.ndarray | None = None
) -> np.ndarray:
    """Whether devices have left the lumen.

    Args:
        centreline: (..., n, 3), nodes of the devices, m, world frame.
        along: (3,) unit vector of the sheath, which need not stand as the vessel does;
            None for the inlet's direction.

    Returns:
        (...) bool: some node past the inlet lies more than 2 mm outside the lumen.
    """
    inlet = anatomy.inlet
    along = inlet.direction if along is None else along
    beyond = (centreline - inlet.position) @ along > _MOUTH
    # Farther from the inlet than the sheath reaches, a node may also lie behind the
    # plane of the inlet, in a vessel that turns back.
    aside = np.linalg.norm(centreline - inlet.position, axis=-1) > _MOUTH
    axis = np.cross(centreline - inlet.position, along)
    in_sheath = ~beyond & (np.linalg.norm(axis, axis=-1) < inlet.radius)
    outside = aside & ~in_sheath
    outside[outside] = anatomy.depth(centreline[outside]) < -_ESCAPE_DEPTH
    return outside.any(-1)


class PhysicsMonitor:
    """Watches N simulations for errors of physics."""

    def __init__(self, scene: Scene, num_simulations: int):
        """Starts with no episode running, all in one scene until one begins."""
        self._scenes = [scene] * num_simulations
        self._failed = [False] * num_simulations

    def restart(self, index: int, scene: Scene) -> None:
        """Begins an episode of a simulation in a scene."""
        self._scenes[index], self._failed[index] = scene, False

    def errors(
        self,
        diverged: np.ndarray,
        steps: np.ndarray,
        centreline: np.ndarray,
        peak_force: np.ndarray,
    ) -> tuple[str | None, ...]:
        """Physics errors of the last control step.

        The first error of an episode is logged.

        Args:
            diverged: (N,) bool, MuJoCo warned.
            steps: (N,), control steps of the episodes.
            centreline: (N, n, 3), nodes of the devices, m.
            peak_force: (N,), largest single contact force within the step, N.

        Returns:
            A reason for each simulation, None where nothing did.
        """
        looked = [
            i for i, taken in enumerate(steps.tolist()) if not taken % ESCAPE_INTERVAL
        ]
        wrong = diverged | ~(peak_force <= MAX_FORCE)
        reasons: list[str | None] = [None] * len(self._scenes)
        if not looked and not np.count_nonzero(wrong):
            return tuple(reasons)
        out = np.zeros(len(reasons), dtype=bool)
        if looked:
            out[looked] = self._escaped(looked, centreline)
        for index in np.flatnonzero(wrong | out).tolist():
            reason = ESCAPED if out[index] and not wrong[index] else EXPLODED
            reasons[index] = reason = DIVERGED if diverged[index] else reason
            if not self._failed[index]:
                _LOG.error("%s after %d steps", reason, steps[index])
            self._failed[index] = True
        return tuple(reasons)

    def _escaped(self, looked: list[int], centreline: np.ndarray) -> np.ndarray:
        """Whether some simulations have left the lumen, each its own: (len,) bool."""
        out = np.zeros(len(looked), dtype=bool)
        own = [self._scenes[index] for index in looked]
        for scene in {id(scene): scene for scene in own}.values():
            rows = [row for row, other in enumerate(own) if other is scene]
            nodes = centreline[[looked[row] for row in rows]]
            out[rows] = escaped(scene.anatomy, nodes, scene.placement.direction)
        return out
