"""The posture in which a device waits for its episode to begin."""

import contextlib
import functools
import math
from collections.abc import Callable

import mujoco
import numpy as np

from cathsim_dmc.entities.posture import bends_of, joints_along
from cathsim_dmc.physics.drives import hold
from cathsim_dmc.physics.effects import Episode
from cathsim_dmc.physics.randomisation import START_JITTER
from cathsim_dmc.physics.readings import ModelIndex
from cathsim_dmc.tasks.config import NavigationConfig
from cathsim_dmc.tasks.scene import Scene

_SETTLING_TIME = 2.0  # s, after which the device rests
STARTS_ALONG_ROUTE = 16
# How much deeper a displacement may put the links behind the head into the wall, m.
_PRESSED = 2e-4
# MuJoCo starts anew where a state is no number, and only these tell.
_DIVERGED = [
    int(mujoco.mjtWarning.mjWARN_BADQPOS),
    int(mujoco.mjtWarning.mjWARN_BADQVEL),
    int(mujoco.mjtWarning.mjWARN_BADQACC),
]
_LARGEST_START = 0.5  # share of the way to the goal
START_SPACING = 5e-3  # m, between the postures that a start farther in chooses from
# Displacements that are tried where the whole one presses on the wall.
_SMALLER = tuple(sign * 0.5**half for half in range(1, 6) for sign in (1.0, -1.0))
# By how much the axis of a settled device may stand out of the lumen, m: the pieces of
# the wall stay behind it by less, the device's radius not counted.
_OUTSIDE = 0.5e-3
# Deepest contact that a device at rest makes with a wall that it does not stand in, m.
_DEEPEST = 1.0e-3


class StartPosture:
    """Joint positions of the device at the start of an episode.

    The device is laid along the centreline of the vessel and let go, with motors and
    base at rest, once, on the compiled model without randomisation. An episode starts
    there at rest, the head displaced by what was drawn.
    """

    def __init__(
        self,
        scene: Scene,
        model: mujoco.MjModel,
        index: ModelIndex,
        config: NavigationConfig,
    ):
        """Lets the device settle.

        Args:
            index: Places of the task's quantities in the model.
            config: Says where an episode may begin.

        Raises:
            ValueError: if the device comes to rest outside the lumen or in its wall.
        """
        # The base cannot go back behind its start, so the stroke begins 1 mm later.
        settle = functools.partial(_settle, scene, model, index)
        rest = settle(0.0)
        place = scene.placement
        way = np.linalg.norm(np.diff(place.line, axis=0), axis=-1).sum()
        way -= float(np.sum(scene.catheter.link_lengths)) + START_JITTER
        self._ahead: list[_Posture] = []
        if (along_route := config.start_along_route) is not None:
            low, high = (share * way for share in along_route)
            advances = np.linspace(low, high, STARTS_ALONG_ROUTE)
            self._ahead = _settled(settle, advances)
            if not self._ahead:
                raise ValueError(
                    f"start_along_route is {tuple(along_route)}: "
                    f"{scene.catheter.device.name!r} can be laid nowhere there in "
                    f"{scene.anatomy.name!r}; give smaller shares"
                )
        self._starts = [rest]
        self._scale = 1.0
        if farthest := config.randomisation.farthest_insertion:
            reach = min(farthest, _LARGEST_START * way)
            count = math.ceil(reach / START_SPACING)
            self._starts += _settled(settle, np.linspace(reach / count, reach, count))
            self._scale = reach / farthest

    def write(
        self, qpos: np.ndarray, episode: Episode, random_state: np.random.RandomState
    ) -> None:
        """Writes the start configuration of one simulation.

        A displacement that would press the device on the wall is reversed, then
        halved until it does not.

        Args:
            qpos: (nq,), written in place; joints of other entities are left alone.
            episode: What was drawn for it.
            random_state: Draws where along the route a device lies, which is then not
                displaced.
        """
        if self._ahead:
            number = random_state.randint(len(self._ahead))
            self._ahead[number].write(qpos, np.zeros(3), episode.roll)
            return
        wanted = self._scale * (episode.insertion or 0.0)
        posture = min(self._starts, key=lambda one: abs(one.advance - wanted))
        displacement = posture.clear_of_wall(episode.displacement)
        posture.write(qpos, displacement, episode.roll)


class _Posture:
    """A device at rest, so far advanced (m), and how its joints displace its head."""

    def __init__(
        self,
        scene: Scene,
        model: mujoco.MjModel,
        index: ModelIndex,
        data: mujoco.MjData,
        advance: float,
    ):
        self.advance = advance
        self._bends, self._insertion = index.bends_qpos, index.insertion_qpos
        data.qvel[:] = 0.0
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        self._angles = data.qpos[self._bends].copy()
        self._inserted = float(data.qpos[self._insertion])
        frames = data.xmat[index.links].reshape(-1, 3, 3)
        self._directions = frames[..., 2] @ frames[0]
        self._frame = frames[0].copy()
        lengths = scene.catheter.link_lengths
        beyond = np.cumsum(lengths[::-1])[::-1]  # from joint i to the head
        inside = scene.placement.start_depth + advance
        free = np.flatnonzero(beyond[1:] <= inside)
        self._free = int(free[0]) if free.size else len(lengths) - 2
        jacobian = np.zeros((3, model.nv))
        mujoco.mj_jacSite(model, data, jacobian, None, index.head_site)
        places = [self._insertion, *self._bends[self._free]]
        dofs = [model.jnt_dofadr[model.jnt_qposadr == place].item() for place in places]
        # Joint steps for a displacement in the frame of the inlet.
        self._steps = np.linalg.inv(self._frame.T @ jacobian[:, dofs])
        # The joints that the first free one moves and the head, as far as they move.
        swinging = slice(index.links.start + self._free + 2, index.links.stop)
        self._nodes = np.vstack([data.xpos[swinging], data.site_xpos[index.head_site]])
        ahead = np.append(beyond[self._free + 2 :], 0.0)[:, None]
        self._shares = 1.0 - ahead / beyond[self._free + 1]
        self._anatomy = scene.anatomy
        depth = scene.anatomy.lumen(self._nodes)
        self._least = np.minimum(depth, scene.catheter.device.outer_radius)
        self._least[:-1] -= _PRESSED

    def clear_of_wall(self, displacement: np.ndarray) -> np.ndarray:
        """The displacement (3,), m, reversed or halved where it would press."""
        for factor in (1.0, -1.0, *_SMALLER):
            displaced = self._frame @ (factor * displacement)
            depth = self._anatomy.lumen(self._nodes + self._shares * displaced)
            if (depth >= self._least).all():
                return factor * displacement
        return np.zeros(3)

    def write(
        self, qpos: np.ndarray, displacement: np.ndarray, roll: float | None
    ) -> None:
        """Writes the posture (nq,), the head displaced by (3,) m in the inlet's frame.

        A device that is turned about its axis has other angles and the same shape.
        """
        angles, step = self._angles, self._steps @ displacement
        if roll:
            c, s = np.cos(-roll), np.sin(-roll)
            turn, directions = np.array([[c, -s], [s, c]]), self._directions.copy()
            directions[:, :2] = self._directions[:, :2] @ turn.T
            angles = bends_of(directions)
            step = np.concatenate([step[:1], turn @ step[1:]])
        qpos[self._bends] = angles
        qpos[self._bends[self._free]] += step[1:]
        qpos[self._insertion] = max(self._inserted + step[0], 0.0)


def _settle(
    scene: Scene, model: mujoco.MjModel, index: ModelIndex, advance: float
) -> _Posture:
    """Lays the device along the line, so far advanced (m), and lets it go."""
    data = mujoco.MjData(model)
    at = START_JITTER + advance
    data.qpos[index.insertion_qpos] = at
    data.qpos[index.bends_qpos] = joints_along(
        scene.catheter.link_lengths, scene.placement.line, at
    )
    hold(model, data)
    for _ in range(round(_SETTLING_TIME / model.opt.timestep)):
        mujoco.mj_step(model, data)
    _refuse_outside(scene, model, index, data)
    return _Posture(scene, model, index, data, advance)


def _settled(
    settle: Callable[[float], _Posture], advances: np.ndarray
) -> list[_Posture]:
    """Postures that come to rest, so far advanced (m)."""
    settled = []
    for advance in advances.tolist():
        with contextlib.suppress(ValueError):
            settled.append(settle(advance))
    return settled


def _refuse_outside(
    scene: Scene, model: mujoco.MjModel, index: ModelIndex, data: mujoco.MjData
) -> None:
    """Raises ValueError if a settled device stands outside the lumen or in the wall."""
    nodes = np.vstack([data.xpos[index.links], data.site_xpos[index.head_site]])
    place, anatomy = scene.placement, scene.anatomy
    # Those behind the mouth lie in the sheath, and touch the wall where that does.
    entered = (nodes - place.inlet) @ place.direction > 0.0
    out = -float(anatomy.lumen(nodes[entered]).min(initial=0.0))
    touching = np.isin(data.contact.geom, index.walls).any(axis=-1)
    deepest = -float(data.contact.dist[touching].min(initial=0.0))
    if data.warning.number[_DIVERGED].any():
        found = f"does not come to rest in {anatomy.name!r}"
    elif out > _OUTSIDE or deepest > _DEEPEST:
        found = (
            f"comes to rest {1e3 * max(out, 0.0):.1f} mm outside the lumen of "
            f"{anatomy.name!r} and {1e3 * deepest:.1f} mm deep in its wall (allowed "
            f"are {1e3 * _OUTSIDE:g} and {1e3 * _DEEPEST:g} mm)"
        )
    else:
        return
    raise ValueError(
        f"{scene.catheter.device.name!r} {found} before an episode begins: the sheath "
        f"before its inlet or the first {1e3 * place.start_depth:.0f} mm do not fit; "
        "enter it elsewhere, or take a device with a shorter or softer tip"
    )
