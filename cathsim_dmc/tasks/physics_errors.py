"""Physics errors: detection, names, and dumps that replay them."""

import contextlib
import dataclasses
import io
import json
import logging
import os
import tempfile
import uuid
from collections.abc import Callable, Iterator, Sequence
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

# Control steps between two checks for an escape.
ESCAPE_INTERVAL = 50
# Deeper outside the lumen than this, m, the axis of the device is behind the wall:
# the wall is 4 mm thick, and penetration stays below 1 mm.
_ESCAPE_DEPTH = 2e-3
# Within this way of the plane of the inlet, m, the sheath holds the device.
_MOUTH = 2e-3
# No contact of a device that is pushed with 5 N at most is harder than this, N.
MAX_FORCE = 50.0

# Control steps that a dump replays, five published episodes; 1.7 MB of actions.
LONGEST_REPLAY = 10_000
# Dumps that stay in a folder; a new one removes the oldest.
KEPT_DUMPS = 8
FOLDER_VARIABLE = "CATHSIM_DUMP_DIR"

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


@dataclasses.dataclass
class _Watched:
    """What replays the episode of one simulation.

    Attributes:
      scene: Scene whose lumen the device must not leave.
      episode: What was drawn; None before the first episode.
      state: (nstate,), MuJoCo's mjSTATE_INTEGRATION at the start of the episode; None
        before its first control step.
      steps: Control steps of the episode.
      actions: Bytes of the actions so far, float64; None once they replay nothing,
        since the episode is dumped or longer than `LONGEST_REPLAY`.
    """

    scene: Scene
    episode: Episode | None = None
    state: np.ndarray | None = None
    steps: int = 0
    actions: bytearray | None = dataclasses.field(default_factory=bytearray)


class PhysicsMonitor:
    """Watches N simulations for errors of physics, and keeps what replays them."""

    def __init__(self, scene: Scene, num_simulations: int, task: dict):
        """Starts with no episode running.

        Args:
          scene: Scene of all simulations until an episode begins in another one.
          num_simulations: N.
          task: JSON-able description of the task for the dumps.
        """
        self._watched = [_Watched(scene) for _ in range(num_simulations)]
        self._task = task

    def restart(self, index: int, scene: Scene, episode: Episode) -> None:
        """Forgets the episode of a simulation; the next one is in a scene."""
        self._watched[index] = _Watched(scene, episode)

    def before_step(
        self, read_states: Callable[[], np.ndarray], actions: np.ndarray
    ) -> None:
        """Keeps the start of each episode, and the actions.

        Args:
          read_states: Reads the states (N, nstate), mjSTATE_INTEGRATION; called only
            when an episode begins.
          actions: (N, A) float64.
        """
        # Plain Python: numpy takes longer over the one simulation of an environment.
        states, rows, size = None, actions.tobytes(), actions[0].nbytes
        for index, watched in enumerate(self._watched):
            if not watched.steps:
                states = read_states() if states is None else states
                watched.state = states[index].copy()
            watched.steps += 1
            if watched.steps > LONGEST_REPLAY:
                watched.actions = None
            if watched.actions is not None:
                watched.actions += rows[index * size : (index + 1) * size]

    def errors(
        self,
        diverged: Sequence[bool] | np.ndarray,
        centreline: np.ndarray,
        peak_force: np.ndarray,
    ) -> list[str | None]:
        """What went wrong in the control step that has just ended; logs and dumps it.

        The first error of an episode is dumped; stepping on adds none.

        Args:
          diverged: (N,), MuJoCo warned.
          centreline: (N, n, 3), nodes of the devices, m.
          peak_force: (N,), largest single contact force within the step, N.

        Returns:
          A reason for each simulation, None where nothing did.
        """
        looked = [
            index
            for index, watched in enumerate(self._watched)
            if not watched.steps % ESCAPE_INTERVAL
        ]
        wrong = [
            warned or not force <= MAX_FORCE
            for warned, force in zip(diverged, peak_force.tolist(), strict=True)
        ]
        reasons: list[str | None] = [None] * len(self._watched)
        if not looked and not any(wrong):
            return reasons
        out = np.zeros(len(reasons), dtype=bool)
        if looked:
            out[looked] = self._escaped(looked, centreline)
        for index in np.flatnonzero(wrong | out).tolist():
            reason = ESCAPED if out[index] and not wrong[index] else EXPLODED
            reasons[index] = reason = DIVERGED if diverged[index] else reason
            self._dump(reason, self._watched[index])
        return reasons

    def _dump(self, reason: str, watched: _Watched):
        """Dumps an episode once, if it is not too long to replay."""
        if watched.actions is None:
            if watched.steps > LONGEST_REPLAY:
                _LOG.error("%s after more steps than a dump holds", reason)
            return
        actions, watched.actions = watched.actions, None
        try:
            dump(
                reason,
                task={"anatomy": watched.scene.anatomy.name, **self._task},
                # Kept before the step that went wrong.
                episode=cast(Episode, watched.episode),
                state=cast(np.ndarray, watched.state),
                actions=np.frombuffer(actions).reshape(watched.steps, -1),
            )
        except OSError as error:
            # A full disk must not end the other simulations.
            _LOG.error("%s; what would replay it is lost: %s", reason, error)

    def _escaped(self, looked: list[int], centreline: np.ndarray) -> np.ndarray:
        """Whether some simulations have left the lumen, each its own: (len,) bool."""
        out = np.zeros(len(looked), dtype=bool)
        own = [self._watched[index].scene for index in looked]
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
      directory: folder for the last `KEPT_DUMPS` dumps; None for that which the
        environment variable `CATHSIM_DUMP_DIR` names, or `cathsim-errors` in the
        system's temporary folder.

    Returns:
      The .npz file.
    """
    temporary = Path(tempfile.gettempdir(), "cathsim-errors")
    directory = Path(directory or os.environ.get(FOLDER_VARIABLE) or temporary)
    directory.mkdir(parents=True, exist_ok=True)
    meta = json.dumps(
        {"format": _FORMAT, "reason": reason, "task": task, "drawn": episode.motion}
    )
    path = directory / f"cathsim-error-{uuid.uuid4().hex[:12]}.npz"
    buffer = io.BytesIO()
    np.savez(buffer, meta=np.array(meta), state=state, actions=actions)
    files.write_bytes(path, buffer.getvalue())
    others = [one for one in directory.glob("cathsim-error-*.npz") if one != path]
    with contextlib.suppress(OSError):  # another process removes them too
        others.sort(key=lambda one: one.stat().st_mtime_ns)
        for oldest in others[: 1 - KEPT_DUMPS]:
            oldest.unlink()
    _LOG.error(
        "%s after %d steps of %s; replay it with "
        "cathsim_dmc.tasks.physics_errors.load(%r)",
        reason,
        len(actions),
        task.get("goal", "an episode"),
        str(path),
    )
    return path


@contextlib.contextmanager
def dumps_in(directory: Path) -> Iterator[None]:
    """Sends dumps to a folder, also from the processes that are started meanwhile.

    A folder that `CATHSIM_DUMP_DIR` names already stays.
    """
    if os.environ.get(FOLDER_VARIABLE):
        yield
        return
    os.environ[FOLDER_VARIABLE] = str(directory.absolute())
    try:
        yield
    finally:
        del os.environ[FOLDER_VARIABLE]


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
