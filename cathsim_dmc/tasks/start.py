"""Start posture of a device."""

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
from cathsim_dmc.tasks.placement import matrix_of, past_sheath
from cathsim_dmc.tasks.scene import AROUND_SHEATH, Scene

_SETTLING_TIME = 2.0  # s, after which the device rests
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
_SAMPLES = 0.5e-3  # m, between points of a posture whose depth is checked
_GUIDED = 0.02  # m of the shaft in the sheath that are checked, as they may turn


class _Joints(NamedTuple):
    """Insertion, m, and angles (n - 1, 2) of the bending hinges of a device, rad."""

    insertion: float
    bends: np.ndarray


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
    the settled posture, at rest, with the head displaced as drawn. A drawn roll leaves
    the posture as it is, so a shaped device then turns into its rolled shape.
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
                    f"{scene.catheter.device.name!r} fits nowhere there in "
                    f"{scene.anatomy.name!r}; give smaller fractions"
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
            posture = self._ahead[number]
            posture.write(qpos, posture.joints(np.zeros(3), episode.roll))
            return Started(posture.advance, np.zeros(3))
        wanted = self._scale * (episode.insertion or 0.0)
        posture = min(self._starts, key=lambda one: abs(one.advance - wanted))
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


class _Posture:
    """A device at rest at one advance (m), and the Jacobian that displaces its head."""

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
        resting = shape.points(_Joints(self._inserted, self._angles))
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

    def joints(self, displacement: np.ndarray, roll: float | None) -> _Joints:
        """Joints that displace the head by (3,) m in the inlet's frame, linearised.

        With a roll of the base, rad, the hinge angles differ and the shape is the same.
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

    def points(self, joints: _Joints, roll: float | None) -> np.ndarray:
        """Points (m, 3) of the axis, m, world frame, with a roll of the base, rad."""
        return self._shape.points(joints, roll or 0.0)

    def stands_free(
        self, displacement: np.ndarray, joints: _Joints, points: np.ndarray
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

    def write(self, qpos: np.ndarray, joints: _Joints) -> None:
        """Writes joints into the configuration (nq,)."""
        qpos[self._insertion], qpos[self._bends] = joints


class _Shape:
    """Points of a device with given joints, and their depths in the walls."""

    def __init__(self, scene: Scene):
        """Takes the device, the field of the vessel and the bore of the sheath."""
        place, lengths = scene.placement, scene.catheter.link_lengths
        self._lengths, self._inlet = lengths, place.inlet
        self._base = place.start_depth - float(np.sum(lengths))
        self._frame = matrix_of(place.quaternion)
        counts = np.ceil(lengths / _SAMPLES).astype(int)
        shares = [np.arange(count) / count for count in counts]
        self._links = np.repeat(np.arange(len(lengths)), counts)
        self._shares = np.concatenate(shares)[:, None]
        self._radius = scene.catheter.device.outer_radius
        self._bore, self._lumen = scene.sheath.bore_radius, scene.anatomy.lumen
        self._hole = self._bore + AROUND_SHEATH
        self._walled = self._lumen.with_hole(self._hole)

    def points(self, joints: _Joints, roll: float = 0.0) -> np.ndarray:
        """Points (m, 3) of the axis, m, world frame, the head last.

        Args:
            joints: Joints of the device.
            roll: Rotation of the base about its axis, rad.
        """
        nodes = nodes_of(self._lengths, joints.bends)
        c, s = np.cos(roll), np.sin(roll)
        turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        nodes = nodes @ turn.T + (0.0, 0.0, self._base + joints.insertion)
        along = np.diff(nodes, axis=0)[self._links]
        points = np.vstack([nodes[self._links] + self._shares * along, nodes[-1:]])
        return self._inlet + points @ self._frame.T

    def depths(self, points: np.ndarray) -> np.ndarray:
        """Largest depths (2,), m, of points in the walls of vessel and sheath."""
        local = (points - self._inlet) @ self._frame
        near = local[:, 2] > -_GUIDED
        points, (x, y, level) = points[near], local[near].T
        clear, guided = self._walled(points, free=True), level <= 0.0
        bore = self._bore - np.hypot(x[guided], y[guided])
        # A vessel may bend back beside the sheath.
        inside = self._lumen(points[guided])
        bore = np.where(inside > 0.0, np.maximum(bore, inside), bore)
        # Beside the sheath, outside the lumen, the physics has no wall.
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
    """Lays the device along the line at an advance (m), and lets it settle."""
    data = mujoco.MjData(model)
    at = START_JITTER + advance
    data.qpos[index.insertion_qpos] = at
    data.qpos[index.bends_qpos] = joints_along(
        scene.catheter.link_lengths, scene.placement.line, at
    )
    hold(model, data, index.driven)
    depth = scene.placement.start_depth
    with contextlib.ExitStack() as stack:
        if not scene.sheath.touches:
            held = Held(model, scene.catheter, index.bends_qpos)
            stack.enter_context(held.at(model, depth, at))
        for _ in range(round(_SETTLING_TIME / model.opt.timestep)):
            mujoco.mj_step(model, data)
    _refuse_outside(scene, index, data)
    return _Posture(scene, model, index, shape, data, advance)


def _settled(
    settle: Callable[[float], _Posture], advances: np.ndarray
) -> list[_Posture]:
    """Postures at advances (m), without those that do not come to rest inside."""
    settled = []
    for advance in advances.tolist():
        with contextlib.suppress(ValueError):
            settled.append(settle(advance))
    return settled


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
