"""Physics errors: detection, names, and dumps that replay them."""

import contextlib
import dataclasses
import logging
import os
import tempfile
import uuid
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np

from cathsim_dmc.anatomy import Anatomy
from cathsim_dmc.tasks.scene import Scene
from cathsim_dmc.tasks.snapshot import Snapshot

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

# Arrays of a dump beside those of a snapshot.
_ACTIONS, _REASON = "dump.actions", "dump.reason"
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


@dataclasses.dataclass
class _Watched:
    """What replays the episode of one simulation.

    Attributes:
        scene: Scene whose lumen the device must not leave.
        start: The state before the first control step, None until then: a snapshot of
            some simulations, and which of them.
        steps: Control steps since then.
        actions: Bytes of the actions so far, float64; None once they replay nothing,
            since the episode is dumped or longer than `LONGEST_REPLAY`.
    """

    scene: Scene
    start: tuple[Snapshot, int] | None = None
    steps: int = 0
    actions: bytearray | None = dataclasses.field(default_factory=bytearray)


class PhysicsMonitor:
    """Watches N simulations for errors of physics, and keeps what replays them."""

    def __init__(self, scene: Scene, num_simulations: int):
        """Starts with no episode running, all in one scene until one begins."""
        self._watched = [_Watched(scene) for _ in range(num_simulations)]

    def restart(self, index: int, scene: Scene) -> None:
        """Forgets the episode of a simulation; the next one is in a scene."""
        self._watched[index] = _Watched(scene)

    def before_step(
        self, take: Callable[[np.ndarray], Snapshot], actions: np.ndarray
    ) -> None:
        """Keeps the start of each episode, and the actions.

        Args:
            take: Takes a snapshot of some simulations, by their numbers.
            actions: (N, A) float64.
        """
        # Plain Python: numpy takes longer over the one simulation of an environment.
        fresh = [i for i, watched in enumerate(self._watched) if watched.start is None]
        if fresh:
            snapshot = take(np.array(fresh))
            for row, index in enumerate(fresh):
                self._watched[index].start = snapshot, row
        rows, size = actions.tobytes(), actions[0].nbytes
        for index, watched in enumerate(self._watched):
            watched.steps += 1
            if watched.steps > LONGEST_REPLAY:
                watched.actions = None
            if watched.actions is not None:
                watched.actions += rows[index * size : (index + 1) * size]

    def errors(
        self,
        diverged: Sequence[bool] | np.ndarray,
        steps: np.ndarray,
        centreline: np.ndarray,
        peak_force: np.ndarray,
    ) -> tuple[str | None, ...]:
        """What went wrong in the control step that has just ended; logs and dumps it.

        The first error of an episode is dumped; stepping on adds none.

        Args:
            diverged: (N,), MuJoCo warned.
            steps: (N,), control steps of the episodes.
            centreline: (N, n, 3), nodes of the devices, m.
            peak_force: (N,), largest single contact force within the step, N.

        Returns:
            A reason for each simulation, None where nothing did.
        """
        looked = [
            i for i, taken in enumerate(steps.tolist()) if not taken % ESCAPE_INTERVAL
        ]
        wrong = [
            warned or not force <= MAX_FORCE
            for warned, force in zip(diverged, peak_force.tolist(), strict=True)
        ]
        reasons: list[str | None] = [None] * len(self._watched)
        if not looked and not any(wrong):
            return tuple(reasons)
        out = np.zeros(len(reasons), dtype=bool)
        if looked:
            out[looked] = self._escaped(looked, centreline)
        for index in np.flatnonzero(wrong | out).tolist():
            reason = ESCAPED if out[index] and not wrong[index] else EXPLODED
            reasons[index] = reason = DIVERGED if diverged[index] else reason
            self._dump(reason, self._watched[index])
        return tuple(reasons)

    def _dump(self, reason: str, watched: _Watched):
        """Dumps an episode once, if it is not too long to replay."""
        if watched.actions is None or watched.start is None:
            if watched.steps > LONGEST_REPLAY:
                _LOG.error("%s after more steps than a dump holds", reason)
            return
        actions, watched.actions = watched.actions, None
        snapshot, row = watched.start
        try:
            dump(
                reason,
                snapshot[row : row + 1],
                np.frombuffer(actions).reshape(watched.steps, -1),
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
    start: Snapshot,
    actions: np.ndarray,
    directory: str | Path | None = None,
) -> Path:
    """Writes what replays an episode that ended in an error, and logs where.

    Args:
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
    path = directory / f"cathsim-error-{uuid.uuid4().hex[:12]}.npz"
    more = {_ACTIONS: actions[None], _REASON: np.array([reason])}
    Snapshot(start.task, {**start.arrays, **more}).save(path)
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
        start.task.get("goal", "an episode"),
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


def load(path: str | Path) -> tuple[str, Snapshot, np.ndarray]:
    """Reads a dump: the reason, the start of the episode and actions (T, A).

    `environment.restore(start)` puts an environment of the same task there.

    Raises:
        ValueError: if the file is no dump.
    """
    held = Snapshot.load(path)
    arrays = dict(held.arrays)
    if _ACTIONS not in arrays or _REASON not in arrays:
        raise ValueError(f"{path} is a snapshot, but no dump of an episode")
    actions, reason = arrays.pop(_ACTIONS)[0], str(arrays.pop(_REASON)[0])
    return reason, Snapshot(held.task, arrays), actions
