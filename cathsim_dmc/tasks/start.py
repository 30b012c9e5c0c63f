"""The posture in which a device waits for its episode to begin."""

import contextlib
import functools
import math
from collections.abc import Callable
from typing import NamedTuple

import mujoco
import numpy as np

from cathsim_dmc.entities.posture import bends_of, joints_along, nodes_of
from cathsim_dmc.laws.field import FREE
from cathsim_dmc.physics import forces
from cathsim_dmc.physics.drives import hold
from cathsim_dmc.physics.effects import Draw
from cathsim_dmc.physics.held import Held
from cathsim_dmc.physics.randomisation import START_JITTER, start_displacement
from cathsim_dmc.physics.readings import ModelIndex
from cathsim_dmc.tasks.config import NavigationConfig
from cathsim_dmc.tasks.placement import past_sheath
from cathsim_dmc.tasks.scene import AROUND_SHEATH, Scene

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
# Deepest place of a displaced device in the wall of the sheath, m. From 2 mm on, the
# shaft stands in the rim of the hole by which the sheath comes in, and throws the tip.
_DEEPEST_IN_SHEATH = AROUND_SHEATH - 0.1e-3
# A base that moves so many times as far as the head, or a head that misses its place by
# so much of the displacement: the Jacobian is nearly singular, or the stroke ends.
_LARGEST_SLIDE, _LARGEST_MISS = 4.0, 0.9
_DRAWS = 20  # of a displacement, until the posture stands free
_SAMPLES = 0.5e-3  # m, between places of a posture whose depth is looked up
_GUIDED = 0.02  # m of the shaft in the sheath that a displacement may turn


class _Joints(NamedTuple):
    """Insertion, m, and angles (n - 1, 2) of the bending hinges of a device, rad."""

    insertion: float
    bends: np.ndarray


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
        settle = functools.partial(_settle, scene, model, index, _Shape(scene))
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
        self._starts, self._scale = [rest], 1.0
        self._radius = config.randomisation.start_radius
        if farthest := config.randomisation.farthest_insertion:
            reach = min(farthest, _LARGEST_START * way)
            count = math.ceil(reach / START_SPACING)
            self._starts += _settled(settle, np.linspace(reach / count, reach, count))
            self._scale = reach / farthest

    def write(
        self, qpos: np.ndarray, episode: Draw, random_state: np.random.RandomState
    ) -> None:
        """Writes the start configuration of one simulation.

        A displacement that would press the device on the wall is reversed, then
        halved until it does not. Where the posture then stands in a wall or misses its
        place, another displacement is drawn.

        Args:
            qpos: (nq,), written in place; joints of other entities are left alone.
            episode: What was drawn for it.
            random_state: Draws where along the route a device lies, which is then not
                displaced, and further displacements.
        """
        if self._ahead:
            number = random_state.randint(len(self._ahead))
            posture = self._ahead[number]
            posture.write(qpos, posture.joints(np.zeros(3), episode.roll))
            return
        wanted = self._scale * (episode.insertion or 0.0)
        posture = min(self._starts, key=lambda one: abs(one.advance - wanted))
        displacement = episode.displacement
        for _ in range(_DRAWS):
            asked = posture.clear_of_wall(displacement)
            joints = posture.joints(asked, episode.roll)
            if posture.stands_free(asked, joints, episode.roll):
                break
            displacement = start_displacement(random_state, self._radius)
        else:
            joints = posture.joints(np.zeros(3), episode.roll)
        posture.write(qpos, joints)


class _Posture:
    """A device at rest, so far advanced (m), and how its joints displace its head."""

    def __init__(
        self,
        scene: Scene,
        model: mujoco.MjModel,
        index: ModelIndex,
        shape: "_Shape",
        data: mujoco.MjData,
        advance: float,
    ):
        self.advance, self._shape = advance, shape
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
        self._steps = np.zeros((3, 3))
        with contextlib.suppress(np.linalg.LinAlgError):
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
        resting = shape.points(_Joints(self._inserted, self._angles))
        self._head, deepest = resting[-1], shape.depths(resting) + _PRESSED
        self._deepest = np.maximum(deepest, (forces.DEEPEST, _DEEPEST_IN_SHEATH))

    def clear_of_wall(self, displacement: np.ndarray) -> np.ndarray:
        """The displacement (3,), m, reversed or halved where it would press."""
        for factor in (1.0, -1.0, *_SMALLER):
            displaced = self._frame @ (factor * displacement)
            depth = self._anatomy.lumen(self._nodes + self._shares * displaced)
            if (depth >= self._least).all():
                return factor * displacement
        return np.zeros(3)

    def joints(self, displacement: np.ndarray, roll: float | None) -> _Joints:
        """Joints that displace the head by (3,) m in the inlet's frame.

        They are exact for small displacements. A device that is turned about its axis
        has other angles and the same shape.
        """
        angles, step = self._angles.copy(), self._steps @ displacement
        if roll:
            c, s = np.cos(-roll), np.sin(-roll)
            turn, directions = np.array([[c, -s], [s, c]]), self._directions.copy()
            directions[:, :2] = self._directions[:, :2] @ turn.T
            angles = bends_of(directions)
            step = np.concatenate([step[:1], turn @ step[1:]])
        angles[self._free] += step[1:]
        return _Joints(max(self._inserted + step[0], 0.0), angles)

    def stands_free(
        self, displacement: np.ndarray, joints: _Joints, roll: float | None
    ) -> bool:
        """Whether joints displace the head as asked, and the device is in no wall."""
        size = np.linalg.norm(displacement)
        slide = abs(joints.insertion - self._inserted)
        points = self._shape.points(joints, roll or 0.0)
        miss = points[-1] - self._head - self._frame @ displacement
        if size and not (
            slide <= _LARGEST_SLIDE * size
            and np.linalg.norm(miss) <= _LARGEST_MISS * size
        ):
            return False
        return bool((self._shape.depths(points) <= self._deepest).all())

    def write(self, qpos: np.ndarray, joints: _Joints) -> None:
        """Writes joints into the configuration (nq,)."""
        qpos[self._insertion], qpos[self._bends] = joints


class _Shape:
    """Places of a device with given joints, and how deep it stands in walls there."""

    def __init__(self, scene: Scene):
        """Takes the device, the field of the vessel and the bore of the sheath."""
        place, lengths = scene.placement, scene.catheter.link_lengths
        self._lengths, self._inlet = lengths, place.inlet
        self._base = place.start_depth - float(np.sum(lengths))
        self._frame = np.empty(9)
        mujoco.mju_quat2Mat(self._frame, place.quaternion)
        self._frame = self._frame.reshape(3, 3)
        counts = np.ceil(lengths / _SAMPLES).astype(int)
        shares = [np.arange(count) / count for count in counts]
        self._links = np.repeat(np.arange(len(lengths)), counts)
        self._shares = np.concatenate(shares)[:, None]
        self._radius = scene.catheter.device.outer_radius
        self._bore, self._lumen = scene.sheath.bore_radius, scene.anatomy.lumen
        self._hole = self._bore + AROUND_SHEATH
        self._walled = self._lumen.with_hole(self._hole)

    def points(self, joints: _Joints, roll: float = 0.0) -> np.ndarray:
        """Points (m, 3) m of the axis in the world, the head last.

        Args:
            joints: Of the device.
            roll: Of the base about its axis, rad.
        """
        nodes = nodes_of(self._lengths, joints.bends)
        c, s = np.cos(roll), np.sin(roll)
        turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        nodes = nodes @ turn.T + (0.0, 0.0, self._base + joints.insertion)
        along = np.diff(nodes, axis=0)[self._links]
        points = np.vstack([nodes[self._links] + self._shares * along, nodes[-1:]])
        return self._inlet + points @ self._frame.T

    def depths(self, points: np.ndarray) -> np.ndarray:
        """Depths (2,) m in the walls of vessel and sheath at the deepest of points."""
        local = (points - self._inlet) @ self._frame
        near = local[:, 2] > -_GUIDED
        points, (x, y, level) = points[near], local[near].T
        clear, guided = self._walled(points, free=True), level <= 0.0
        bore = self._bore - np.hypot(x[guided], y[guided])
        # A vessel may bend back beside the sheath.
        inside = self._lumen(points[guided])
        bore = np.where(inside > 0.0, np.maximum(bore, inside), bore)
        # What lies outside, beside the sheath, is free to the physics.
        outside = (clear >= FREE) & (level > self._hole)
        clear[outside] = self._lumen(points[outside])
        return self._radius - np.array([clear.min(), bore.min(initial=np.inf)])


def _settle(
    scene: Scene,
    model: mujoco.MjModel,
    index: ModelIndex,
    shape: _Shape,
    advance: float,
) -> _Posture:
    """Lays the device along the line, so far advanced (m), and lets it go."""
    data = mujoco.MjData(model)
    at = START_JITTER + advance
    data.qpos[index.insertion_qpos] = at
    data.qpos[index.bends_qpos] = joints_along(
        scene.catheter.link_lengths, scene.placement.line, at
    )
    hold(model, data)
    depth = scene.placement.start_depth
    with contextlib.ExitStack() as stack:
        if not scene.sheath.touches:
            held = Held(model, scene.catheter, index.bends_qpos, depth)
            stack.enter_context(held.at(model, at))
        for _ in range(round(_SETTLING_TIME / model.opt.timestep)):
            mujoco.mj_step(model, data)
    _refuse_outside(scene, model, index, data)
    return _Posture(scene, model, index, shape, data, advance)


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
    entered = past_sheath(anatomy, nodes, place.direction)
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
