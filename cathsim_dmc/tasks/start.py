"""Start posture of a device."""

import contextlib
import copy
import math
from typing import NamedTuple

import mujoco
import numpy as np

from cathsim_dmc.entities.posture import bends_of, joints_along
from cathsim_dmc.physics import forces
from cathsim_dmc.physics.drives import hold
from cathsim_dmc.physics.effects import Draw
from cathsim_dmc.physics.held import Held
from cathsim_dmc.physics.randomisation import (
    START_JITTER,
    rolled,
    start_displacement,
)
from cathsim_dmc.physics.readings import ModelIndex
from cathsim_dmc.tasks.config import NavigationConfig
from cathsim_dmc.tasks.placement import past_sheath
from cathsim_dmc.tasks.scene import AROUND_SHEATH, Scene
from cathsim_dmc.tasks.start_shape import Joints, Shape, about_z

# Times after which the device rests, s: laid along a line, and turned by a roll.
_SETTLING_TIME, _TURNING_TIME = 2.0, 0.4
STARTS_ALONG_ROUTE = 16
# Largest increase of the depth in the wall of the links behind a displaced head, m.
_PRESSED = 2e-4
# MuJoCo resets a simulation whose state is not finite; only these warnings show it.
_DIVERGED = [
    int(mujoco.mjtWarning.mjWARN_BADQPOS),
    int(mujoco.mjtWarning.mjWARN_BADQVEL),
    int(mujoco.mjtWarning.mjWARN_BADQACC),
]
_LARGEST_START = 0.5  # share of the way to the goal
START_SPACING = 5e-3  # m, between the start postures of `start_insertion`
# Factors of a displacement that are tried if the whole one presses on the wall.
_SMALLER = tuple(sign * 0.5**half for half in range(1, 6) for sign in (1.0, -1.0))
# Largest distance of a settled device's axis outside the lumen, m.
_OUTSIDE = 0.5e-3
# Largest penetration depth of a device at rest, m.
_DEEPEST = 1.0e-3
# Largest depth of a displaced device in the wall of the sheath, m. From 2 mm on, the
# shaft penetrates the rim of the hole for the sheath, and that contact throws the tip.
_DEEPEST_IN_SHEATH = AROUND_SHEATH - 0.1e-3
# Largest slide of the base and largest miss of the head, relative to the displacement.
# Beyond them the Jacobian is nearly singular, or the stroke ends.
_LARGEST_SLIDE, _LARGEST_MISS = 4.0, 0.9
_DRAWS = 20  # of a displacement at most, until the posture penetrates no wall


class Started(NamedTuple):
    """Where an episode starts, relative to the task's own start.

    Attributes:
        insertion: Further insertion, m.
        displacement: (3,) of the head, frame of the inlet, m.
    """

    insertion: float
    displacement: np.ndarray


class StartPosture:
    """Joint positions of the device at the start of an episode.

    The device is laid along the centreline of the vessel and settles once, with motors
    and base at rest, on the compiled model without randomisation. An episode starts in
    the settled posture, at rest, with the head displaced as drawn. With a drawn roll, a
    shaped device settles once more, with its base rolled and without twist; others, and
    one that fits nowhere with this roll, keep their posture.
    """

    def __init__(
        self,
        scene: Scene,
        model: mujoco.MjModel,
        index: ModelIndex,
        config: NavigationConfig,
    ):
        """Settles the device.

        Args:
            index: Indices of the task's quantities in the model.
            config: Options, which set where an episode may begin.

        Raises:
            ValueError: if the device does not come to rest, or outside the lumen or in
                its wall, or nowhere in the range `start_along_route`.
        """
        shaped = any(device.tip_shape for device in scene.catheter.devices)
        rolls = shaped and config.randomisation.roll is not None
        if rolls:
            model = copy.copy(model)  # the simulation changes its model in episodes
        settle = _Settling(scene, model, index)
        self._settling = settle if rolls else None
        rest = settle.on_line(0.0)
        place = scene.placement
        way = np.linalg.norm(np.diff(place.line, axis=0), axis=-1).sum()
        way -= float(np.sum(scene.catheter.link_lengths)) + START_JITTER
        self._ahead: list[_Posture] = []
        if (along_route := config.start_along_route) is not None:
            low, high = (share * way for share in along_route)
            advances = np.linspace(low, high, STARTS_ALONG_ROUTE)
            self._ahead = settle.on_lines(advances)
            if not self._ahead:
                raise ValueError(
                    f"start_along_route is {tuple(along_route)}: "
                    f"{scene.catheter.device.name!r} fits nowhere there in "
                    f"{scene.anatomy.name!r}; give smaller fractions"
                )
        self._starts, self._scale = [rest], 1.0
        self._radius = config.randomisation.start_radius
        if farthest := config.randomisation.farthest_insertion:
            reach = min(farthest, _LARGEST_START * way)
            count = math.ceil(reach / START_SPACING)
            self._starts += settle.on_lines(np.linspace(reach / count, reach, count))
            self._scale = reach / farthest

    def write(
        self, qpos: np.ndarray, episode: Draw, random_state: np.random.RandomState
    ) -> Started:
        """Writes the start configuration of one simulation; returns where it starts.

        A displacement that would press the device on the wall is reversed, then
        halved until it does not. If the posture then penetrates a wall or misses its
        place, another displacement is drawn; after 20 draws there is none.

        Args:
            qpos: (nq,), written in place; joints of other entities are left alone.
            episode: Values drawn for the episode.
            random_state: Draws the start along the route, which has no displacement,
                and further displacements.
        """
        if self._ahead:
            number = random_state.randint(len(self._ahead))
            posture = self._rolled(self._ahead[number], episode.roll)
            posture.write(qpos, posture.joints(np.zeros(3), episode.roll))
            return Started(posture.advance, np.zeros(3))
        wanted = self._scale * (episode.insertion or 0.0)
        posture = min(self._starts, key=lambda one: abs(one.advance - wanted))
        posture = self._rolled(posture, episode.roll)
        displacement = episode.displacement
        for _ in range(_DRAWS):
            asked = posture.clear_of_wall(displacement)
            joints = posture.joints(asked, episode.roll)
            points = posture.points(joints, episode.roll)
            if posture.stands_free(asked, joints, points):
                break
            displacement = start_displacement(random_state, self._radius)
        else:
            joints = posture.joints(np.zeros(3), episode.roll)
            points = posture.points(joints, episode.roll)
        posture.write(qpos, joints)
        return Started(posture.advance, posture.displacement(points[-1]))

    def _rolled(self, posture: "_Posture", roll: float | None) -> "_Posture":
        """The posture at rest with a roll, rad; `posture` if that fits nowhere."""
        if self._settling and roll:
            with contextlib.suppress(ValueError):
                return self._settling.rolled(posture, roll)
        return posture


class _Posture:
    """A device at rest, and the Jacobian that displaces its head.

    Attributes:
        advance: Insertion beyond the task's own start, m.
        roll: Roll of the base with which the device has settled, rad.
    """

    def __init__(
        self,
        scene: Scene,
        model: mujoco.MjModel,
        index: ModelIndex,
        shape: Shape,
        data: mujoco.MjData,
        advance: float,
        roll: float,
    ):
        self.advance, self.roll, self._shape = advance, roll, shape
        self._bends, self._insertion = index.bends_qpos, index.insertion_qpos
        data.qvel[:] = 0.0
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        self._angles = data.qpos[self._bends].copy()
        self._inserted = float(data.qpos[self._insertion])
        frames = data.xmat[index.links].reshape(-1, 3, 3)
        self._directions = frames[..., 2] @ frames[0]
        self._frame = frames[0] @ about_z(roll).T  # of the inlet
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
        # Nodes distal to the first free joint and the head, and their shares of the
        # displacement.
        swinging = slice(index.links.start + self._free + 2, index.links.stop)
        self._nodes = np.vstack([data.xpos[swinging], data.site_xpos[index.head_site]])
        ahead = np.append(beyond[self._free + 2 :], 0.0)[:, None]
        self._shares = 1.0 - ahead / beyond[self._free + 1]
        self._anatomy = scene.anatomy
        depth = scene.anatomy.lumen(self._nodes)
        self._least = np.minimum(depth, scene.catheter.device.outer_radius)
        self._least[:-1] -= _PRESSED
        resting = shape.points(Joints(self._inserted, self._angles), roll)
        self._head, deepest = resting[-1], shape.depths(resting) + _PRESSED
        self._deepest = np.maximum(deepest, (forces.DEEPEST, _DEEPEST_IN_SHEATH))

    def clear_of_wall(self, displacement: np.ndarray) -> np.ndarray:
        """A displacement (3,), m, reversed or halved until it presses on no wall."""
        for factor in (1.0, -1.0, *_SMALLER):
            displaced = self._frame @ (factor * displacement)
            depth = self._anatomy.lumen(self._nodes + self._shares * displaced)
            if (depth >= self._least).all():
                return factor * displacement
        return np.zeros(3)

    def joints(self, displacement: np.ndarray, roll: float | None) -> Joints:
        """Joints that displace the head by (3,) m in the inlet's frame, linearised.

        With another roll of the base, rad, than that of the posture the hinge angles
        differ and the shape is the same.
        """
        angles, step = self._angles.copy(), self._steps @ displacement
        if further := (roll or 0.0) - self.roll:
            turn, directions = about_z(-further)[:2, :2], self._directions.copy()
            directions[:, :2] = self._directions[:, :2] @ turn.T
            angles = bends_of(directions)
            step = np.concatenate([step[:1], turn @ step[1:]])
        angles[self._free] += step[1:]
        return Joints(max(self._inserted + step[0], 0.0), angles)

    def points(self, joints: Joints, roll: float | None) -> np.ndarray:
        """Points (m, 3) of the axis, m, world frame, with a roll of the base, rad."""
        return self._shape.points(joints, roll or 0.0)

    def stands_free(
        self, displacement: np.ndarray, joints: Joints, points: np.ndarray
    ) -> bool:
        """Whether joints displace the head as asked, and the device is in no wall.

        Args:
            displacement: (3,), m, frame of the inlet.
            joints: Joints of the device.
            points: Their points, see `points`.
        """
        size = np.linalg.norm(displacement)
        slide = abs(joints.insertion - self._inserted)
        miss = points[-1] - self._head - self._frame @ displacement
        if size and not (
            slide <= _LARGEST_SLIDE * size
            and np.linalg.norm(miss) <= _LARGEST_MISS * size
        ):
            return False
        return bool((self._shape.depths(points) <= self._deepest).all())

    def displacement(self, head: np.ndarray) -> np.ndarray:
        """Displacement (3,), m, frame of the inlet, of a head (3,), world frame."""
        return (head - self._head) @ self._frame

    def write(self, qpos: np.ndarray, joints: Joints) -> None:
        """Writes joints into the configuration (nq,)."""
        qpos[self._insertion], qpos[self._bends] = joints


class _Settling:
    """Lets a device come to rest, with motors and base at rest."""

    def __init__(self, scene: Scene, model: mujoco.MjModel, index: ModelIndex):
        """Takes a model without randomisation."""
        self._scene, self._model, self._index = scene, model, index
        self._shape = Shape(scene)

    def on_line(self, advance: float) -> _Posture:
        """Lays the device along the line at an advance (m), and lets it settle.

        Raises:
            ValueError: if it does not come to rest inside the lumen.
        """
        # The base cannot go back behind its start, so the stroke begins 1 mm later.
        at, scene = START_JITTER + advance, self._scene
        lengths, line = scene.catheter.link_lengths, scene.placement.line
        joints = Joints(at, joints_along(lengths, line, at))
        return self._settled(joints, advance, 0.0, _SETTLING_TIME)

    def on_lines(self, advances: np.ndarray) -> list[_Posture]:
        """Postures at advances (m), without those that do not come to rest inside."""
        settled = []
        for advance in advances.tolist():
            with contextlib.suppress(ValueError):
                settled.append(self.on_line(advance))
        return settled

    def rolled(self, posture: _Posture, roll: float) -> _Posture:
        """Lets the device settle from a posture with its base rolled, rad.

        Raises:
            ValueError: if it does not come to rest inside the lumen.
        """
        base = self._model.body_quat[self._index.links.start]
        level = base.copy()
        base[:] = rolled(level, roll)
        try:
            joints = posture.joints(np.zeros(3), roll)
            return self._settled(joints, posture.advance, roll, _TURNING_TIME)
        finally:
            base[:] = level

    def _settled(
        self, joints: Joints, advance: float, roll: float, time: float
    ) -> _Posture:
        """The posture after a time, s, in which the device moves freely.

        Args:
            joints: Joints at its beginning.
            advance: Of the posture, m.
            roll: Of the base, rad, which the model has.

        Raises:
            ValueError: if the device does not come to rest inside the lumen.
        """
        scene, model, index = self._scene, self._model, self._index
        data, depth = mujoco.MjData(model), scene.placement.start_depth
        data.qpos[index.insertion_qpos], data.qpos[index.bends_qpos] = joints
        hold(model, data, index.driven)
        with contextlib.ExitStack() as stack:
            if not scene.sheath.touches:
                held = Held(model, scene.catheter, index.bends_qpos)
                stack.enter_context(held.at(model, depth, joints.insertion))
            for _ in range(round(time / model.opt.timestep)):
                mujoco.mj_step(model, data)
        _refuse_outside(scene, index, data)
        return _Posture(scene, model, index, self._shape, data, advance, roll)


def _refuse_outside(scene: Scene, index: ModelIndex, data: mujoco.MjData) -> None:
    """Raise ValueError unless a device has settled inside the lumen."""
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
