"""Quantities that a task reads from the simulator, for one simulation or for many.

Arrays have the leading axes of their source, written `...` below: none for an
`mujoco.MjData`, whose arrays are such as qpos (nq,), and N for a `mujoco.batch.Batch`.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import mujoco
import numpy as np

from cathsim_dmc import rows as array_rows
from cathsim_dmc.entities.chain import Chain
from cathsim_dmc.entities.robot import Robot
from cathsim_dmc.physics import forces


class Readings(NamedTuple):
    """State of the device after a control step.

    Positions and velocities of joints are those at the end of the step. MuJoCo derives
    all other quantities at the start of the last physics step (some 4 ms)
    earlier. World frame, SI units, float64. J joints, L links.

    Attributes:
        insertion: (...), slide of the base, m, 0 at the start of the stroke.
        joint_positions: (..., J), in the order of the chain, x before y, m and rad.
        joint_velocities: (..., J), m/s and rad/s.
        com_inertia: (..., L, 10), inertia of each link about the subtree's centre of
            mass (MuJoCo `cinert`), kg·m², kg·m and kg.
        com_velocity: (..., L, 6), rotational and translational velocity of each link
            about the subtree's centre of mass (`cvel`), rad/s and m/s.
        actuator_force: (..., J), generalised force of the motors, N and N·m.
        external_force: (..., L, 6), contact torque and force on each link about the
            subtree's centre of mass (`cfrc_ext`), N·m and N.
        centreline: (..., L + 1, 3), proximal ends of the links and the head, m.
        head: (..., 3), distal end, m.
        head_frame: (..., 3, 3), orientation of the last link, its axes in columns.
        push_force: (...), N, positive when the base pushes the device forward.
        push_torque: (...), N·m, torque of the base on the device about its axis.
        load_cell: (..., 3), N, force of the phantom on its support.
    """

    insertion: np.ndarray
    joint_positions: np.ndarray
    joint_velocities: np.ndarray
    com_inertia: np.ndarray
    com_velocity: np.ndarray
    actuator_force: np.ndarray
    external_force: np.ndarray
    centreline: np.ndarray
    head: np.ndarray
    head_frame: np.ndarray
    push_force: np.ndarray
    push_torque: np.ndarray
    load_cell: np.ndarray


class CoaxialReadings(NamedTuple):
    """State of K devices after a control step, arrays with the leading axis N.

    Attributes:
        insertion: (N, K), distance of each device's end beyond the chain's end at zero
            insertion, m; negative for a device withdrawn farther.
        rotation: (N, K), of the rotary units, rad.
        tip_rotation: (N, K), of the ends of the devices, rad.
        points: (N, K, P, 3), points of each device `DEVICE_PLACES` from its end,
            m, world frame, see `device_points`; the last one is its end.
        leading_load: (N,), N, axial force in the device that reaches farthest where it
            leaves the others, positive when it is pushed forward; for one device alone,
            the push force.
        lumen_friction: (N,), N, sum of the friction forces between the devices; they
            persist when the devices stop.
        push: (N, K), N, force of each drive on its device, positive when it pushes it
            forward; their sum is the push force.
    """

    insertion: np.ndarray
    rotation: np.ndarray
    tip_rotation: np.ndarray
    points: np.ndarray
    leading_load: np.ndarray
    lumen_friction: np.ndarray
    push: np.ndarray


class ModelIndex:
    """Indices of a task's quantities in the arrays of a compiled model."""

    # Fields of `mujoco.MjData` that `reader` uses, for a batch to bind beforehand.
    FIELDS = ("qpos", "qvel", "cinert", "cvel", "qfrc_actuator", "cfrc_ext", "xpos")
    FIELDS += ("site_xpos", "site_xmat", "sensordata", "cdof", "subtree_com")

    def __init__(self, model: mujoco.MjModel, chain: Chain, robot: Robot):
        """Finds the elements; ValueError if the model lacks one of them."""
        joints = ids(model, chain.joints)
        self.links = _as_slice(ids(model, chain.links))
        self.geoms = ids(model, chain.link_geoms)
        # The geoms of the world body that collide are the wall.
        world = (model.geom_bodyid == 0) & (model.geom_contype != 0)
        self.walls = np.flatnonzero(world)
        self.qpos = _as_slice(np.sort(model.jnt_qposadr[joints]))
        self.dofs = _as_slice(np.sort(model.jnt_dofadr[joints]))
        self._order = joints - joints.min()
        self.driven = _as_slice(ids(model, chain.actuators))
        # (n - 1, 2), hinges about x and y.
        self.bends_qpos = model.jnt_qposadr[ids(model, chain.bends)].reshape(-1, 2)
        base = [each for each in (chain.insertion, chain.rotation) if each is not None]
        self.insertion_qpos, *turned = model.jnt_qposadr[ids(model, base)].tolist()
        self.rotation_qpos: int | None = turned[0] if turned else None
        # The slide is along z of the handle, the first hinge about its x.
        first = [chain.insertion, chain.bends[0]]
        self.handle_dofs = model.jnt_dofadr[ids(model, first)].tolist()
        # NumPy casts indices of another type than `intp` at each access.
        self.robot_qpos = model.jnt_qposadr[ids(model, robot.joints)].astype(np.intp)
        (self.head_site,) = ids(model, [chain.head]).tolist()
        self.push_force = sensor(model, chain.push_force.full_identifier)
        self.push_torque = sensor(model, chain.push_torque.full_identifier)
        self.load_cell = sensor(model, "load_cell")
        self.wall_contacts = sensor(model, "wall_contacts")

    def handles(self, motions: np.ndarray) -> np.ndarray:
        """Orientations (..., 3, 3) of the handles, axes in columns, from MuJoCo's cdof.

        Args:
            motions: (..., nv, 6), axes of the degrees of freedom.
        """
        slide, hinge = self.handle_dofs
        z, x = motions[..., slide, 3:], motions[..., hinge, :3]
        return np.stack([x, np.cross(z, x), z], axis=-1)

    def reader(self, data) -> Callable[[], Readings]:
        """Returns a function that reads the arrays of a simulator.

        Args:
            data: an `mujoco.MjData` or a `mujoco.batch.Batch` with `FIELDS` bound.

        Returns:
            Function that returns copies of the present readings; it is valid as long as
            `data` lives.
        """
        qpos, sensors = data.qpos, data.sensordata
        positions, velocities = qpos[..., self.qpos], data.qvel[..., self.dofs]
        motors = data.qfrc_actuator[..., self.dofs]
        head = data.site_xpos[..., self.head_site, :]
        nodes = (data.xpos[..., self.links, :], head[..., None, :])
        frame = data.site_xmat[..., self.head_site, :]
        insertion = qpos[..., self.insertion_qpos]
        moving = data.cinert, data.cvel, data.cfrc_ext
        inertia, velocity, external = (each[..., self.links, :] for each in moving)
        # MuJoCo reports the force of the parent on the site's body.
        force = sensors[..., self.push_force.start + 2]
        torque = sensors[..., self.push_torque.start + 2]
        cell, order = sensors[..., self.load_cell], self._order

        def read() -> Readings:
            return Readings(
                insertion=insertion.copy(),
                joint_positions=positions.take(order, axis=-1),
                joint_velocities=velocities.take(order, axis=-1),
                com_inertia=array_rows.copied(inertia),
                com_velocity=array_rows.copied(velocity),
                actuator_force=motors.take(order, axis=-1),
                external_force=array_rows.copied(external),
                centreline=np.concatenate(nodes, axis=-2),
                head=head.copy(),
                head_frame=frame.reshape((*frame.shape[:-1], 3, 3)).copy(),
                push_force=force.copy(),
                push_torque=torque.copy(),
                load_cell=-cell,
            )

        return read

    def read(self, data) -> Readings:
        """Returns copies of the present readings; see `reader`."""
        return self.reader(data)()

    def contacts(self, sensordata: np.ndarray) -> forces.Contacts:
        """Contacts with the wall, from `sensordata` (..., nsensordata)."""
        return forces.Contacts.from_sensor(sensordata[..., self.wall_contacts])


def part(measured: Any, rows: np.ndarray | slice | int) -> Any:
    """Rows of all arrays of a named tuple and of nested ones; None is kept."""
    if measured is None:
        return None
    if isinstance(measured, np.ndarray):
        return measured[rows]
    return type(measured)._make(part(value, rows) for value in measured)


def copied(measured: Any) -> Any:
    """A copy of a named tuple, with copies of all arrays, nested ones included."""
    if hasattr(measured, "_fields"):
        return type(measured)._make(map(copied, measured))
    return array_rows.copied(measured) if np.ndim(measured) else measured


def merged(old: Any, new: Any, rows: np.ndarray) -> Any:
    """A copy of `old` with `new` in some rows of its arrays (N, ...)."""
    if old is None:
        return None
    if isinstance(old, np.ndarray):
        array = old.copy()
        array[rows] = new
        return array
    pairs = zip(old, new, strict=True)
    return type(old)._make(merged(before, now, rows) for before, now in pairs)


def ids(model: mujoco.MjModel, elements: Sequence[Any]) -> np.ndarray:
    """Ids (n,) of MJCF elements in a model; ValueError if one is missing."""
    kinds = mujoco.mjtObj.__members__
    found = [
        _id(model, kinds[f"mjOBJ_{each.spec.namespace.upper()}"], each.full_identifier)
        for each in elements
    ]
    return np.array(found, dtype=int)


def _id(model: mujoco.MjModel, kind: mujoco.mjtObj, name: str) -> int:
    index = mujoco.mj_name2id(model, kind, name)
    if index < 0:
        raise ValueError(f"the model has no {kind.name[6:].lower()} named {name!r}")
    return index


def sensor(model: mujoco.MjModel, name: str) -> slice:
    """Slice of a sensor in `sensordata`; ValueError if the model lacks the sensor."""
    index = _id(model, mujoco.mjtObj.mjOBJ_SENSOR, name)
    start = int(model.sensor_adr[index])
    return slice(start, start + int(model.sensor_dim[index]))


def _as_slice(indices) -> slice:
    indices = np.asarray(indices)
    if (np.diff(indices) != 1).any():
        raise ValueError(f"the catheter's elements are not contiguous: {indices}")
    return slice(int(indices[0]), int(indices[-1]) + 1)
