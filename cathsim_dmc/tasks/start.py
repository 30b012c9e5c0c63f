"""The posture in which a device waits for its episode to begin."""

from collections.abc import Sequence

import mujoco
import numpy as np

from cathsim_dmc.entities.posture import bends_of, joints_along
from cathsim_dmc.physics.drives import hold
from cathsim_dmc.physics.randomisation import START_JITTER
from cathsim_dmc.physics.readings import ModelIndex
from cathsim_dmc.tasks.scene import Scene

# How long the device settles; its hinges relax in 0.4 s.
_SETTLING_TIME = 2.0  # s
_STARTS_ALONG_ROUTE = 16
# By how much the axis of a settled device may stand out of the lumen, m: the pieces of
# the wall stay behind it by less, the device's radius not counted.
_OUTSIDE = 0.5e-3
# Deepest contact that a device at rest makes with a wall that it does not stand in, m.
_DEEPEST = 1.0e-3


class StartPosture:
    """Where the joints of the device are at the start of an episode.

    The device is laid along the centreline of the vessel and let go, with motors and
    base at rest: a bent elastic device comes to lie against the wall. This is done
    once, on the compiled model without randomisation, so it is the same for every
    simulation and every seed. An episode starts there at rest, the head displaced by
    what was drawn.
    """

    def __init__(
        self,
        scene: Scene,
        model: mujoco.MjModel,
        index: ModelIndex,
        along_route: Sequence[float] | None = None,
    ):
        """Lets the device settle.

        Args:
            scene: Entities and where they stand.
            model: The compiled scene.
            index: Places of the task's quantities in the model.
            along_route: Least and largest share of the way to the goal that the head
                has made, for episodes that do not begin at the inlet; None for those
                that do.

        Raises:
            ValueError: if the device comes to rest outside the lumen or in its wall.
        """
        catheter = scene.catheter
        self._bends = index.bends_qpos
        self._insertion = index.insertion_qpos
        # The base cannot go back behind its start, so the stroke begins 1 mm later.
        data = self._settle(scene, model, START_JITTER)
        _refuse_outside(scene, model, index, data)
        data.qvel[:] = 0.0
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        self._angles = data.qpos[self._bends].copy()
        self._advance = float(data.qpos[self._insertion])
        self._directions = self._link_directions(index, data)
        self._find_levers(model, data, index, catheter.link_lengths, scene)
        self._anatomy = scene.anatomy
        self._radius = scene.device.outer_radius
        self._frame = data.xmat[index.links.start].reshape(3, 3).copy()
        self._head = data.site_xpos[index.head_site].copy()
        self._head_depth = float(scene.anatomy.depth(self._head))

        self._ahead: list[tuple[np.ndarray, float]] = []
        if along_route is not None:
            self._ahead = self._settled_along(scene, model, index, along_route)

    def _settle(
        self, scene: Scene, model: mujoco.MjModel, advance: float
    ) -> mujoco.MjData:
        """Lays the device along the line, so far advanced (m), and lets it go."""
        data = mujoco.MjData(model)
        data.qpos[self._insertion] = advance
        data.qpos[self._bends] = joints_along(
            scene.catheter.link_lengths, scene.placement.line, advance
        )
        hold(model, data)
        for _ in range(round(_SETTLING_TIME / model.opt.timestep)):
            mujoco.mj_step(model, data)
        return data

    def _settled_along(
        self,
        scene: Scene,
        model: mujoco.MjModel,
        index: ModelIndex,
        shares: Sequence[float],
    ) -> list[tuple[np.ndarray, float]]:
        """Angles of the hinges and insertions, further and further in.

        What springs out of a branch comes to rest elsewhere in the lumen; where a
        device cannot lie at all, none is kept.
        """
        place = scene.placement
        way = np.linalg.norm(np.diff(place.line, axis=0), axis=-1).sum()
        way -= float(np.sum(scene.catheter.link_lengths)) + START_JITTER
        settled = []
        for share in np.linspace(shares[0], shares[1], _STARTS_ALONG_ROUTE):
            data = self._settle(scene, model, START_JITTER + share * way)
            try:
                _refuse_outside(scene, model, index, data)
            except ValueError:
                continue
            advance = float(data.qpos[self._insertion])
            settled.append((data.qpos[self._bends].copy(), advance))
        if not settled:
            raise ValueError(
                f"start_along_route is {tuple(shares)}: {scene.device.name!r} can be "
                f"laid nowhere there in {scene.anatomy.name!r}; give smaller shares"
            )
        return settled

    def draw(self, random_state: np.random.RandomState) -> int | None:
        """Draws where along the route an episode starts; None for the inlet."""
        return random_state.randint(len(self._ahead)) if self._ahead else None

    def _link_directions(self, index: ModelIndex, data: mujoco.MjData) -> np.ndarray:
        """Unit vectors (n, 3) of the links in the frame of link 0."""
        frames = data.xmat[index.links].reshape(-1, 3, 3)
        return frames[..., 2] @ frames[0]

    def _find_levers(self, model, data, index, link_lengths, scene):
        """How base and the first free joint move the head, for the displacement."""
        beyond = np.cumsum(link_lengths[::-1])[::-1]  # from joint i to the head
        free = np.flatnonzero(beyond[1:] <= scene.placement.start_depth)
        self._free = int(free[0]) if free.size else len(link_lengths) - 2
        jacobian = np.zeros((3, model.nv))
        mujoco.mj_jacSite(model, data, jacobian, None, index.head_site)
        frame = data.xmat[index.links.start].reshape(3, 3)
        places = [self._insertion, *self._bends[self._free]]
        dofs = [_dof_of(model, place) for place in places]
        # Joint steps for a displacement in the frame of the inlet.
        self._steps = np.linalg.inv(frame.T @ jacobian[:, dofs])

    def clear_of_wall(self, displacement: np.ndarray) -> np.ndarray:
        """The displacement, or its opposite where it would press on the wall.

        Args:
            displacement: (3,) of the head in the frame of the inlet, m.

        Returns:
            (3,) m, of the same length.
        """
        depth = float(self._anatomy.depth(self._head + self._frame @ displacement))
        return (
            displacement
            if depth >= min(self._radius, self._head_depth)
            else -displacement
        )

    def write(
        self,
        qpos: np.ndarray,
        displacement: np.ndarray,
        roll: float | None = None,
        number: int | None = None,
    ) -> None:
        """Writes the start configuration of one simulation.

        Args:
            qpos: (nq,), written in place; joints of other entities are left alone.
            displacement: (3,) of the head in the frame of the inlet, whose z points
                into the lumen, m.
            roll: Angle by which the device is turned about its own axis, rad: its
                hinges stand otherwise, its shape is the same.
            number: What `draw` returned: a device that lies along the route is neither
                displaced nor turned.
        """
        if number is not None:
            qpos[self._bends], qpos[self._insertion] = self._ahead[number]
            return
        angles, step = self._angles, self._steps @ displacement
        if roll:
            angles = bends_of(_turned(self._directions, -roll))
            step = np.concatenate([step[:1], _turn(-roll) @ step[1:]])
        qpos[self._bends] = angles
        qpos[self._bends[self._free]] += step[1:]
        qpos[self._insertion] = max(self._advance + step[0], 0.0)


def _refuse_outside(
    scene: Scene, model: mujoco.MjModel, index: ModelIndex, data: mujoco.MjData
) -> None:
    """Raises ValueError if a settled device stands outside the lumen or in the wall."""
    nodes = np.vstack([data.xpos[index.links], data.site_xpos[index.head_site]])
    place, anatomy = scene.placement, scene.anatomy
    # Those behind the mouth lie in the sheath, and touch the wall where that does.
    entered = (nodes - place.inlet) @ place.direction > 0.0
    out = -float(anatomy.depth(nodes[entered]).min(initial=0.0))
    touching = np.isin(data.contact.geom, index.walls).any(axis=-1)
    deepest = -float(data.contact.dist[touching].min(initial=0.0))
    if out > _OUTSIDE or deepest > _DEEPEST:
        raise ValueError(
            f"{scene.device.name!r} comes to rest {1e3 * max(out, 0.0):.1f} mm outside "
            f"the lumen of {anatomy.name!r} and {1e3 * deepest:.1f} mm deep in its "
            f"wall before an episode begins (allowed are {1e3 * _OUTSIDE:g} and "
            f"{1e3 * _DEEPEST:g} mm): the sheath before its inlet or the first "
            f"{1e3 * place.start_depth:.0f} mm do not fit; enter it elsewhere, or take "
            "a device with a shorter or softer tip"
        )


def _dof_of(model: mujoco.MjModel, place: int) -> int:
    """Degree of freedom of the joint at a place in qpos."""
    return int(model.jnt_dofadr[np.flatnonzero(model.jnt_qposadr == place)[0]])


def _turn(angle: float) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s], [s, c]])


def _turned(vectors: np.ndarray, angle: float) -> np.ndarray:
    """Vectors (n, 3) turned about z."""
    turned = vectors.copy()
    turned[:, :2] = vectors[:, :2] @ _turn(angle).T
    return turned
