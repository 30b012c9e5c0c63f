"""Coaxial devices of N simulations: moved by the actions, written into the models.

Once in a control step, before its physics steps, the devices are moved along and about
their axis, and what the chain is made of then goes into the fields of the models. Where
each device is and how it is turned lies in MuJoCo's `userdata`, so it is part of the
state that is saved, dumped and replayed.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple, Protocol

import mujoco
import numpy as np

from cathsim_dmc.entities.chain import (
    BENDING_RELAXATION_TIME,
    MAX_PUSH_SPEED,
    MAX_ROTATION_SPEED,
)
from cathsim_dmc.entities.coaxial import Links, Overlap
from cathsim_dmc.entities.device_stack import DeviceStack
from cathsim_dmc.entities.robot import follower_posture
from cathsim_dmc.imaging.device import Shadow
from cathsim_dmc.tasks.config import CONTROL_TIMESTEP
from cathsim_dmc.tasks.readings import ModelIndex, Readings

# Fields of the model that change as the devices slide. The constants that MuJoCo
# derives from masses (`body_invweight0`, ...) stay those of the start: the armature of
# the hinges outweighs the links in them a thousand times.
FIELDS = (
    "jnt_stiffness",
    "dof_damping",
    "qpos_spring",
    "geom_size",
    "geom_rbound",
    "geom_aabb",
    "geom_friction",
    "body_mass",
    "body_inertia",
    "body_subtreemass",
    "body_gravcomp",
)
# Where points of a device are tracked, m from its end.
DEVICE_PLACES = np.arange(7, -1, -1) * 15e-3
# Rate of sliding above which the friction between devices acts in full, m/s.
_SLIDING = 1e-3


class CoaxialReadings(NamedTuple):
    """State of K devices after a control step, arrays with the leading axis N.

    Attributes:
      insertion: (N, K), way of the end of each device from where the chain's end is at
        zero insertion, m; negative for one that has been withdrawn farther.
      rotation: (N, K), of the rotary units, rad.
      tip_rotation: (N, K), of the ends of the devices, rad.
      twist: (N, K), torque of the rotary units on the devices at rest, N·m.
      points: (N, K, P, 3), points of each device `DEVICE_PLACES` from its end, m, world
        frame; the last one is its end.
      leading_load: (N,), N, axial force in the device that reaches farthest where it
        leaves the others, positive when it is pushed forward; for one device alone,
        the push force.
      lumen_friction: (N,), N, friction between the devices, that resists their sliding
        in each other; 0 while they do not.
    """

    insertion: np.ndarray
    rotation: np.ndarray
    tip_rotation: np.ndarray
    twist: np.ndarray
    points: np.ndarray
    leading_load: np.ndarray
    lumen_friction: np.ndarray


class State(Protocol):
    """The arrays of the simulations that coaxial devices read; see `FIELDS_READ`."""

    qpos: np.ndarray
    userdata: np.ndarray
    cfrc_int: np.ndarray


# Fields of `mujoco.MjData` beside `ModelIndex.FIELDS`, for a batch to bind beforehand.
FIELDS_READ = ("userdata", "cfrc_int")


def user_data(stack: DeviceStack) -> int:
    """Numbers of `userdata` that the devices take: insertions, rotations of nodes."""
    return len(stack.devices) * (1 + len(stack.stack.nodes))


class ChainFields:
    """Places in a model of what changes as the devices slide."""

    def __init__(self, model: mujoco.MjModel, scope: str):
        """Finds the elements of the chain.

        Args:
          model: the compiled model.
          scope: MJCF scope of the chain.
        """
        bodies = [
            body
            for body in range(model.nbody)
            if model.body(body).name.startswith(f"{scope}/link_")
        ]
        count = len(bodies)
        self.bodies = slice(bodies[0], bodies[0] + count)
        joints = [
            joint
            for joint in range(model.njnt)
            if model.joint(joint).name.startswith(f"{scope}/bend_")
        ]
        self.joints = slice(joints[0], joints[-1] + 1)
        self.dofs = _same(model.jnt_dofadr[joints])
        self.qpos = _same(model.jnt_qposadr[joints])
        geoms = [model.geom(f"{scope}/link_{link}").id for link in range(count)]
        self.geoms = np.array(geoms, dtype=np.intp)
        self.half_lengths = model.geom_size[geoms, 1].copy()
        # MuJoCo orders the axes of inertia in its own way.
        inertia = model.body_inertia[self.bodies]
        along = inertia.argmin(axis=-1)
        self.axes = np.where(np.arange(3) == along[:, None], 1, 0)

    def write(self, arrays: Mapping[str, np.ndarray], made: Made, row: int) -> None:
        """Writes what the chain of one simulation is made of.

        Args:
          arrays: live `FIELDS` of its model.
          made: of some simulations.
          row: which of them.
        """
        both = np.repeat(made.stiffness[row], 2)
        arrays["jnt_stiffness"][self.joints] = both
        arrays["dof_damping"][self.dofs] = BENDING_RELAXATION_TIME * both
        arrays["qpos_spring"][self.qpos] = made.rest[row].ravel()
        radius, geoms = made.links.radius[row], self.geoms
        arrays["geom_size"][geoms, 0] = radius
        arrays["geom_rbound"][geoms] = radius + self.half_lengths
        box = arrays["geom_aabb"]
        box[geoms, 3] = box[geoms, 4] = radius
        box[geoms, 5] = radius + self.half_lengths
        arrays["geom_friction"][geoms, 0] = made.links.friction[row]
        mass, inertia = made.links.mass[row], made.inertia[row]
        arrays["body_mass"][self.bodies] = mass
        arrays["body_subtreemass"][self.bodies] = np.cumsum(mass[::-1])[::-1]
        arrays["body_inertia"][self.bodies] = np.where(
            self.axes, inertia[:, 1:], inertia[:, :1]
        )
        arrays["body_gravcomp"][self.bodies] = made.lightness[row]


class Made(NamedTuple):
    """What chains are made of, arrays with the leading axis N.

    Attributes:
      stiffness: (N, J), of the hinges, N·m/rad.
      rest: (N, J, 2), angles of the free hinges about x and y, rad.
      links: arrays (N, L).
      inertia: (N, L, 2), across and along a link, kg·m².
      lightness: (N, L), share of a link's mass that gravity does not pull at, beside
        that which blood carries where all devices are.
    """

    stiffness: np.ndarray
    rest: np.ndarray
    links: Links
    inertia: np.ndarray
    lightness: np.ndarray


def made_of(
    entity: DeviceStack,
    overlap: Overlap,
    turns: np.ndarray,
    friction: np.ndarray,
    factor: np.ndarray,
    spin: np.ndarray | float = 0.0,
) -> Made:
    """What chains are made of.

    The damping of a hinge resists how it moves against the turning shape, not against
    the vessel: else a shaped device would be held back by its own damping when it is
    turned. So the spring leads by what the damper takes.

    Args:
      entity: of the devices.
      overlap: of the devices.
      turns: (N, K, J), rotation of each device at each joint, rad.
      friction: (N,), Coulomb coefficient of an uncoated device on the wall.
      factor: (N,), of all stiffnesses.
      spin: (N, K, J), rate of that rotation, rad/s.
    """
    stack, share = entity.stack, entity.buoyant_share
    free = stack.rest_angles(overlap, turns, 1 + 1j * BENDING_RELAXATION_TIME * spin)
    links = stack.links(overlap, friction)
    lightness = np.zeros_like(links.mass)
    if share > 0:
        # Exactly nothing where all devices are: MuJoCo then passes the link over.
        some = overlap.present.min(axis=1) < 1.0
        lightness = np.where(some, 1.0 - links.weight / (links.mass * share), 0.0)
    return Made(
        stiffness=factor[:, None] / overlap.compliance,
        rest=np.stack([-np.imag(free), np.real(free)], axis=-1),
        links=links,
        inertia=stack.inertia(links.mass, links.radius),
        lightness=lightness,
    )


def write_still(
    entity: DeviceStack,
    model: mujoco.MjModel,
    gaps: np.ndarray | None = None,
    rotation: np.ndarray | None = None,
) -> None:
    """Writes into a model what the chain is made of while the devices stand still.

    Args:
      entity: of the devices.
      model: the compiled model.
      gaps: (K,), way from the end of each device to that of the chain, m; those at the
        start of an episode if None.
      rotation: (K,), of each device, not twisted, rad; 0 if None.
    """
    gaps = entity.start_gaps if gaps is None else np.asarray(gaps, np.float64)
    turns = np.zeros((1, len(entity.devices), len(entity.stack.spans)))
    if rotation is not None:
        turns += np.asarray(rotation)[:, None]
    overlap = entity.stack.overlap(gaps[None])
    made = made_of(entity, overlap, turns, np.array([entity.friction]), np.ones(1))
    arrays = {name: getattr(model, name) for name in FIELDS}
    ChainFields(model, entity.mjcf_model.model).write(arrays, made, 0)


class CoaxialDevices:
    """The devices of N simulations."""

    def __init__(
        self,
        stack: DeviceStack,
        model: mujoco.MjModel,
        index: ModelIndex,
        state: State,
        field: Callable[[int, str], np.ndarray],
        start_depth: float,
        num_simulations: int,
    ):
        """Finds the places; no episode has begun yet.

        Args:
          stack: entity of the devices.
          model: the compiled model.
          index: places of the task's quantities in it.
          state: arrays of the simulations.
          field: gives a field of the model of one simulation, to be written.
          start_depth: way of the chain's end past the mouth of the sheath at zero
            insertion, m.
          num_simulations: N.
        """
        self._entity, self._stack, self._rods = stack, stack.stack, stack.rods
        self._index, self._qpos, self._field = index, state.qpos, field
        self._internal_force = state.cfrc_int[:, index.links]
        self._start_depth = start_depth
        count, nodes = len(stack.devices), len(self._stack.nodes)
        user = state.userdata
        # Views: writing to them writes the state.
        self._insertion = user[:, :count]
        self._angles = user[:, count : count * (1 + nodes)].reshape(-1, count, nodes)
        self._places = ChainFields(model, stack.mjcf_model.model)
        self._arrays: list[dict[str, np.ndarray]] = [{} for _ in range(num_simulations)]
        self._radii = np.array([device.outer_radius for device in stack.devices])
        self._friction = np.full(num_simulations, stack.friction)
        self._factor = np.ones(num_simulations)
        # How fast the devices slide in each other, m/s, and press on each other, N.
        self._sliding = np.zeros((num_simulations, count))
        self._pressing = np.zeros(num_simulations)
        # Rates at which they turn at the joints, rad/s.
        self._spin = np.zeros((num_simulations, count, nodes - 2))

    # The course of an episode.

    def restart(
        self, index: int, friction: float | None, stiffness: float | None
    ) -> None:
        """Puts the devices of one simulation, whose chain lies at the start, there.

        Args:
          index: of the simulation.
          friction: Coulomb coefficient of an uncoated device on the wall in this
            episode; None for that of the entity.
          stiffness: factor of all stiffnesses in this episode; None for 1.
        """
        gaps = self._entity.start_gaps
        self._insertion[index] = self._qpos[index, self._index.insertion_qpos] - gaps
        self._angles[index] = 0.0
        self._sliding[index] = self._pressing[index] = self._spin[index] = 0.0
        self._friction[index] = self._entity.friction if friction is None else friction
        self._factor[index] = 1.0 if stiffness is None else stiffness
        self._arrays[index] = {name: self._field(index, name) for name in FIELDS}
        row = np.array([index])
        turns = np.zeros((1, *self._spin.shape[1:]))
        self._write(row, self._stack.overlap(self._gaps(row)), turns)

    def command(self, action: np.ndarray, external_force: np.ndarray) -> np.ndarray:
        """Moves the devices and writes what the chains are made of then.

        The chain is driven to where the device will be that reaches farthest; the
        others move as they are told. A device that leads is held up with the chain.

        Args:
          action: (N, 2 K) in [-1, 1], translation and rotation of each device.
          external_force: (N, L, 6), contact force on the links, `Readings`.

        Returns:
          Control (N, 1) of the chain's motor.
        """
        reached = self._qpos[:, self._index.insertion_qpos]
        before = self._held(reached)
        step = MAX_PUSH_SPEED * CONTROL_TIMESTEP
        target = before + step * action[:, 0::2]
        np.clip(target, -self._withdrawn, self._entity.stroke, out=target)
        # The chain's own end cannot be drawn back behind its start.
        everyone, leader = np.arange(len(target)), target.argmax(axis=1)
        lead = np.maximum(target[everyone, leader], 0.0)
        target[everyone, leader] = lead
        self._sliding[:] = (target - lead[:, None] - before + reached[:, None]) / (
            CONTROL_TIMESTEP
        )
        self._insertion[:] = target
        overlap, turns = self._turn(action[:, 1::2], lead, external_force)
        self._write(everyone, overlap, turns)
        return ((lead - reached) / step)[:, None]

    @property
    def _withdrawn(self) -> float:
        """How far a device may be withdrawn: until its end has left the patient."""
        return self._start_depth

    def _held(self, reached: np.ndarray) -> np.ndarray:
        """Insertions (N, K) with those that lead where the chain has come to."""
        held = np.minimum(self._insertion, reached[:, None])
        leader = self._insertion.argmax(axis=1)
        held[np.arange(len(held)), leader] = reached
        return held

    def _gaps(self, rows: np.ndarray | slice) -> np.ndarray:
        insertion = self._insertion[rows]
        return insertion.max(axis=1, keepdims=True) - insertion

    def _turn(
        self, rate: np.ndarray, lead: np.ndarray, external_force: np.ndarray
    ) -> tuple[Overlap, np.ndarray]:
        """Turns the devices, against their shape in the vessel and friction.

        Returns:
          Overlap, and rotations (N, K, J) at the joints.
        """
        stack, rods, gaps = self._stack, self._rods, self._gaps(slice(None))
        overlap, turns = stack.overlap(gaps), rods.at_joints(self._angles, gaps)
        bends = self._qpos[:, self._places.qpos]
        bends = bends[:, 1::2] - 1j * bends[:, 0::2]
        loads = np.empty((3, *turns.shape))
        loads[0], loads[1] = stack.restoring(overlap, bends, turns)
        loads[:2] *= self._factor[:, None, None]
        loads[2] = self._friction_torque(overlap, bends, turns, lead, external_force)
        turned = MAX_ROTATION_SPEED * CONTROL_TIMESTEP * rate
        self._angles[:] = rods.turn(
            self._angles, turned, CONTROL_TIMESTEP, *rods.at_nodes(loads, gaps)
        )
        after = rods.at_joints(self._angles, gaps)
        self._spin[:] = (after - turns) / CONTROL_TIMESTEP
        return overlap, after

    def _friction_torque(
        self,
        overlap: Overlap,
        bends: np.ndarray,
        turns: np.ndarray,
        lead: np.ndarray,
        external_force: np.ndarray,
    ) -> np.ndarray:
        """Largest torques (N, K, J) of friction on the devices at the joints, N·m."""
        stack, entity = self._stack, self._entity
        force = np.sqrt((external_force[..., 3:] ** 2).sum(axis=-1))
        # Nothing rubs in the sheath.
        force = np.where(
            lead[:, None] - stack.nodes[1:] > -self._start_depth, force, 0.0
        )
        torque = stack.wall_friction(overlap, force, self._friction)
        if len(entity.devices) > 1:
            pressure = stack.pressure(overlap, bends, turns)
            pressure *= entity.lumen_friction * self._factor[:, None, None]
            self._pressing = pressure.sum(axis=(1, 2))
            # The lumen holds back the device in it; that one is too soft in torsion
            # to turn the lumen in its turn.
            torque[:, :-1] += pressure * self._radii[:-1, None]
        return torque

    def _write(self, rows: np.ndarray, overlap: Overlap, turns: np.ndarray) -> None:
        """Writes what the chains of some simulations are made of."""
        friction, factor = self._friction[rows], self._factor[rows]
        spin = self._spin[rows]
        made = made_of(self._entity, overlap, turns, friction, factor, spin)
        for row, number in enumerate(rows.tolist()):
            self._places.write(self._arrays[number], made, row)

    # What others may read.

    def pushed(self) -> np.ndarray:
        """Insertion (N, K) of each device, m."""
        return self._held(self._qpos[:, self._index.insertion_qpos])

    def follower_posture(self) -> np.ndarray:
        """Joints (N, len(JOINTS)) of the robot that holds the outer and inner device.

        Of more than two devices it holds the outermost and the innermost; of one, both
        units work on the same.
        """
        pushed, turned = self.pushed(), self._angles[..., 0]
        if len(pushed) == 1:  # plain floats take a third of the time
            inner, outer = float(pushed[0, 0]), float(pushed[0, -1])
            return follower_posture(
                outer,
                float(turned[0, -1]),
                guidewire_insertion=inner,
                guidewire_rotation=float(turned[0, 0]),
            )
        return follower_posture(
            pushed[:, -1],
            turned[:, -1],
            guidewire_insertion=pushed[:, 0],
            guidewire_rotation=turned[:, 0],
        )

    def turned(self) -> np.ndarray:
        """Rotation (N, K) of the rotary unit of each device, rad."""
        return self._angles[..., 0].copy()

    def read(self, readings: Readings) -> CoaxialReadings:
        """State of the devices.

        Args:
          readings: of the same control step.
        """
        insertion = self.pushed()
        gaps = insertion.max(axis=1, keepdims=True) - insertion
        friction = self._pressing * np.clip(
            np.abs(np.diff(self._sliding, axis=1)).sum(axis=1) / _SLIDING, 0.0, 1.0
        )
        return CoaxialReadings(
            insertion=insertion,
            rotation=self.turned(),
            tip_rotation=self._angles[..., -1].copy(),
            twist=self._rods.base_torque(self._angles),
            points=self.points(readings.centreline, gaps[..., None] + DEVICE_PLACES),
            leading_load=self._leading_load(readings, gaps),
            lumen_friction=friction,
        )

    def points(self, line: np.ndarray, places: np.ndarray) -> np.ndarray:
        """Points (N, K, P, 3) of the chain at places (N, K, P), m, from its end.

        Args:
          line: (N, L + 1, 3), `Readings.centreline`.
          places: those beyond the base are the base.
        """
        ascending = self._stack.nodes[::-1]
        place = np.clip(places, 0.0, ascending[-1])
        above = np.clip(
            np.searchsorted(ascending, place, side="right"), 1, len(ascending) - 1
        )
        share = (place - ascending[above - 1]) / (
            ascending[above] - ascending[above - 1]
        )
        last = len(ascending) - 1
        rows = np.arange(len(line))[:, None, None]
        near, far = line[rows, last - above + 1], line[rows, last - above]
        return near + share[..., None] * (far - near)

    def shadows(self, line: np.ndarray) -> list[Shadow]:
        """The devices as X-rays meet them, from the innermost outwards.

        Args:
          line: (N, L + 1, 3), `Readings.centreline`.
        """
        nodes = self._stack.nodes
        insertion = self.pushed()
        gaps = insertion.max(axis=1, keepdims=True) - insertion
        # A device has as many points as the chain: its own nodes, and its end.
        beyond = (nodes < gaps[..., None]).sum(axis=-1, keepdims=True)
        own = np.arange(len(nodes)) - np.maximum(beyond - 1, 0)
        places = np.maximum(nodes[np.maximum(own, 0)], gaps[..., None])
        points = self.points(line, places)
        return [
            Shadow(
                points[:, k],
                device.outer_radius,
                device.attenuation,
                device.marker_attenuation,
                device.marker_length,
            )
            for k, device in enumerate(self._entity.devices)
        ]

    def _leading_load(self, readings: Readings, gaps: np.ndarray) -> np.ndarray:
        """Axial force (N,) in the leading device where it leaves the others, N."""
        if gaps.shape[1] == 1:
            return readings.push_force.copy()
        second = np.sort(gaps, axis=1)[:, 1]
        # The link that has the place in it: its joint bears what lies beyond.
        link = (self._stack.nodes[1:] > second[:, None]).sum(axis=1)
        link = np.minimum(link + 1, len(self._stack.link_lengths) - 1)
        rows = np.arange(len(link))
        line = readings.centreline
        along = line[rows, link + 1] - line[rows, link]
        force = self._internal_force[rows, link, 3:]
        return (force * along).sum(axis=-1) / np.sqrt((along**2).sum(axis=-1))


def _same(places: np.ndarray) -> slice:
    """The places of the hinges, which follow each other, as a slice."""
    return slice(int(places[0]), int(places[-1]) + 1)
