"""Errors of physics: found, named and kept for replay, never clipped away."""

import io
import json
import logging
import os
import tempfile
import uuid
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, cast

import numpy as np

from cathsim_dmc import bounds, files
from cathsim_dmc.anatomy import Anatomy
from cathsim_dmc.physics.randomisation import Episode
from cathsim_dmc.tasks.scene import Scene

DIVERGED = "diverged"
ESCAPED = "escaped through the wall"
EXPLODED = "exploding force"

# Control steps between two looks for an escape; a device that has left the lumen does
# not find back within two seconds.
ESCAPE_INTERVAL = 50
# Deeper outside the lumen than this, m, the axis of the device is behind the wall:
# the wall is 4 mm thick, and penetration stays below 1 mm.
_ESCAPE_DEPTH = 2e-3
# Within this way of the plane of the inlet, m, the sheath holds the device.
_MOUTH = 2e-3
# No contact of a device that is pushed with 5 N at most is harder than this, N.
MAX_FORCE = 50.0

_FORMAT = 2
_LARGEST = 2_000_000_000  # bytes of a dump, unpacked
_LOG = logging.getLogger(__name__)


def escaped(
    anatomy: Anatomy, centreline: np.ndarray, along: np.ndarray | None = None
) -> np.ndarray:
    """Whether devices have left the lumen.

    Args:
      anatomy: whose lumen, and whose inlet.
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
    """Watches N simulations for errors of physics, and keeps what replays them."""

    def __init__(self, scene: Scene, num_simulations: int, task: dict):
        """Starts with no episode running.

        Args:
          scene: Scene whose lumen the devices must not leave, until an episode begins
            in another one.
          num_simulations: N.
          task: JSON-able description of the task for the dumps.
        """
        self._scenes = [scene] * num_simulations
        self._task = task
        self._states: list[np.ndarray | None] = [None] * num_simulations
        self._fresh = set(range(num_simulations))  # whose state is not kept yet
        self._episodes: list[Episode | None] = [None] * num_simulations
        # Actions (N, A) of all, and where in them the episode of each begins.
        self._actions: list[np.ndarray] = []
        self._first = [0] * num_simulations

    def restart(self, index: int, scene: Scene, episode: Episode) -> None:
        """Forgets the episode of a simulation; the next one is in a scene."""
        self._scenes[index] = scene
        self._episodes[index] = episode
        self._fresh.add(index)
        self._first[index] = len(self._actions)
        if unused := min(self._first):
            del self._actions[:unused]
            self._first = [first - unused for first in self._first]

    def before_step(
        self, read_states: Callable[[], np.ndarray], actions: np.ndarray
    ) -> None:
        """Keeps the start of each episode, and the actions.

        Args:
          read_states: Reads the states (N, nstate), mjSTATE_INTEGRATION; called only
            when an episode begins.
          actions: (N, A), which nobody changes afterwards.
        """
        if self._fresh:
            states = read_states()
            for index in self._fresh:
                self._states[index] = states[index].copy()
            self._fresh.clear()
        self._actions.append(actions)

    def errors(
        self,
        diverged: Sequence[bool] | np.ndarray,
        centreline: np.ndarray,
        peak_force: np.ndarray,
    ) -> list[str | None]:
        """What went wrong in the control step that has just ended; logs and dumps it.

        Args:
          diverged: (N,), MuJoCo warned.
          centreline: (N, n, 3), nodes of the devices, m.
          peak_force: (N,), largest single contact force within the step, N.

        Returns:
          A reason for each simulation, None where nothing did.
        """
        # Plain Python: numpy takes longer over the one simulation of an environment,
        # and no longer over many.
        taken = len(self._actions)
        looked = [
            index
            for index, first in enumerate(self._first)
            if not (taken - first) % ESCAPE_INTERVAL
        ]
        wrong = [
            warned or not force <= MAX_FORCE
            for warned, force in zip(diverged, peak_force.tolist(), strict=True)
        ]
        reasons: list[str | None] = [None] * len(self._first)
        if not looked and not any(wrong):
            return reasons
        out = np.zeros(len(reasons), dtype=bool)
        if looked:
            out[looked] = self._escaped(looked, centreline)
        for index in np.flatnonzero(wrong | out).tolist():
            reason = ESCAPED if out[index] and not wrong[index] else EXPLODED
            reasons[index] = reason = DIVERGED if diverged[index] else reason
            try:
                dump(
                    reason,
                    task={"anatomy": self._scenes[index].anatomy.name, **self._task},
                    # Kept before the step that went wrong.
                    episode=cast(Episode, self._episodes[index]),
                    state=cast(np.ndarray, self._states[index]),
                    actions=np.array(
                        [one[index] for one in self._actions[self._first[index] :]]
                    ),
                )
            except OSError as error:
                # A full disk must not end the other simulations.
                _LOG.error("%s; what would replay it is lost: %s", reason, error)
        return reasons

    def _escaped(self, looked: list[int], centreline: np.ndarray) -> np.ndarray:
        """Whether some simulations have left the lumen, each its own: (len,) bool."""
        out = np.zeros(len(looked), dtype=bool)
        own = [self._scenes[index] for index in looked]
        for scene in {id(scene): scene for scene in own}.values():
            rows = [row for row, other in enumerate(own) if other is scene]
            nodes = centreline[[looked[row] for row in rows]]
            out[rows] = escaped(scene.anatomy, nodes, scene.placement.direction)
        return out


def dump(
    reason: str,
    *,
    task: dict[str, Any],
    episode: Episode,
    state: np.ndarray,
    actions: np.ndarray,
    directory: str | Path | None = None,
) -> Path:
    """Writes what replays an episode that ended in an error, and logs where.

    Args:
      reason: what went wrong.
      task: JSON-able description of the task.
      episode: What was drawn for it.
      state: (nstate,), MuJoCo's mjSTATE_INTEGRATION at the start of the episode.
      actions: (T, A) up to and with the one that failed.
      directory: where to; `CATHSIM_DUMP_DIR` or the system's temporary directory by
        default.

    Returns:
      The .npz file.
    """
    directory = Path(
        directory or os.environ.get("CATHSIM_DUMP_DIR") or tempfile.gettempdir()
    )
    directory.mkdir(parents=True, exist_ok=True)
    meta = json.dumps(
        {"format": _FORMAT, "reason": reason, "task": task, "drawn": episode.motion}
    )
    path = directory / f"cathsim-error-{uuid.uuid4().hex[:12]}.npz"
    buffer = io.BytesIO()
    np.savez(buffer, meta=np.array(meta), state=state, actions=actions)
    files.write_bytes(path, buffer.getvalue())
    _LOG.error(
        "%s after %d steps of %s; replay it with "
        "cathsim_dmc.tasks.physics_errors.load(%r)",
        reason,
        len(actions),
        task.get("goal", "an episode"),
        str(path),
    )
    return path


def load(path: str | Path) -> tuple[dict[str, Any], np.ndarray, np.ndarray]:
    """Reads a dump: description, start state (nstate,) and actions (T, A).

    What was drawn for the episode is `drawn` in the description:
    `Rollout.take(0, Episode.from_motion(meta["drawn"]))` gives it to a task that was
    made with the same options.

    Raises:
      ValueError: if the file is no dump of this format.
    """
    try:
        held = files.read_arrays(Path(path), _LARGEST, ("meta", "state", "actions"))
        meta = json.loads(str(held["meta"]))
        state = bounds.array("state", held["state"])
        actions = bounds.array("actions", held["actions"])
        if (state.ndim, actions.ndim) != (1, 2):
            raise ValueError(f"state is {state.shape}, actions are {actions.shape}")
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path} is no dump of an episode: {error}") from error
    if not isinstance(meta, dict) or repr(meta.get("format")) != repr(_FORMAT):
        raise ValueError(
            f"{path} is no dump of an episode of format {_FORMAT}, which this version "
            "reads"
        )
    for name, kind in (("reason", str), ("task", dict), ("drawn", dict)):
        if not isinstance(meta.get(name), kind):
            raise ValueError(
                f"{path} is no dump of an episode: {name} is "
                f"{bounds.shown(meta.get(name))}; it must be a {kind.__name__}"
            )
    try:
        Episode.from_motion(meta["drawn"])
    except ValueError as error:
        raise ValueError(f"{path} is no dump of an episode: {error}") from error
    return meta, state, actions
