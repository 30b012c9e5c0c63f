"""The devices of N simulations, moved by the actions.

Once in a control step, coaxial devices are moved along and about their axis;
`chain_fields` then writes the properties of the chain. Where each device is and how it
is turned lies in MuJoCo's `userdata`, which is part of the state that is saved.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.random import RandomState

from cathsim_dmc import rows
from cathsim_dmc.entities import stack_memory
from cathsim_dmc.entities.chain import (
    MAX_PUSH_FORCE,
    MAX_PUSH_SPEED,
    MAX_ROTATION_SPEED,
    MAX_TORQUE,
    Chain,
    hinge_time,
)
from cathsim_dmc.entities.device import Device
from cathsim_dmc.entities.device_stack import DeviceStack
from cathsim_dmc.entities.robot import pose, postures
from cathsim_dmc.laws import sheath, sliding
from cathsim_dmc.laws.hinges import Bends
from cathsim_dmc.laws.parameters import Array
from cathsim_dmc.laws.springs import Springs
from cathsim_dmc.physics import chain_fields, held
from cathsim_dmc.physics.device_points import (
    BEHIND,
    DEVICE_PLACES,
    device_points,
    gaps_of,
    points_at,
)
from cathsim_dmc.physics.drives import Drives
from cathsim_dmc.physics.effects import Draw, Effect, World
from cathsim_dmc.physics.readings import CoaxialReadings, Readings
from cathsim_dmc.physics.stepper import CONTROL_TIMESTEP

# Way by which a device slides before the friction in the lumen acts in full, m.
_PRESLIDING = 40e-6
# Way of a slipping clamp in a control step by the force beyond its largest, m/N. The
# axial force of a stiff wire in a tight bend changes by 0.8 N/mm at most.
_GIVE = 1e-3


class Steering(NamedTuple):
    """How motors are turned out of untwisted frames into those of links.

    Attributes:
        places: (2 J,), of the hinges among MuJoCo's `qpos`, in the order of the chain.
        bends: `laws.hinges.Bends`, scratch.
    """

    places: Any
    bends: Any


class SingleDevice(Effect):
    """One device, whose own motors move it.

    Attributes:
        slipped: Way by which the clamps have slipped in the episode, m and rad: (N, 1)
            or, with rotation, (N, 2) of a single device; (N, 2 K) of coaxial devices,
            translation and rotation of each.
    """

    data_fields: tuple[str, ...] = ("act",)
    model_fields: tuple[str, ...] = held.FIELDS
    step_fields: tuple[str, ...] = held.FIELDS
    state = ("slipped", "told", "_free")

    def __init__(self, chain: Chain, holds: bool = True):
        """Takes the entity of the device.

        Args:
            holds: Whether the hinges hold the links that are in the sheath, which then
                has no bore that does.
        """
        self._device, self._holds = chain.device, holds
        self._behind = BEHIND / float(chain.link_lengths[0])  # links
        if self._device.tip_shape:
            self.parameters = Springs
            self.acts_in, self.adapter = "passive", "springs"

    def bind(self, world: World) -> None:
        """Finds the drives and the hinges in the model."""
        super().bind(world)
        self._drives = Drives(world.model, world.arrays)
        self.slipped, self.told = self._drives.slipped, self._drives.told
        model, places = world.model, world.index.bends_qpos
        joints, self._steering = len(places), None
        if world.chain.tip_motors:
            bends = Bends(np.empty(joints, complex), np.empty(joints))
            self._steering = Steering(np.sort(places, axis=None), bends)
        hinges_x = np.searchsorted(model.jnt_qposadr, places[:, 0])
        # The shape lies in the plane of x and z.
        rest = model.qpos_spring[places[:, 1]]
        self._springs = Springs(rest, 1 / model.jnt_stiffness[hinges_x])
        self._held = held.Held(model, world.chain, places, world.start_depth)
        self._sheathed = held.Sheathed(
            joints=self._held.joints,
            insertion=world.arrays.qpos[:, world.index.insertion_qpos],
            free=np.stack([self._held.nominal] * world.num_simulations),
            places=np.zeros((world.num_simulations, len(held.FIELDS)), np.int64),
            out=np.ones((world.num_simulations, joints)),
        )
        self._free = self._sheathed.free
        self._hinged: list[Any] = [None] * world.num_simulations
        turned = world.index.rotation_qpos
        rotation = -1 if turned is None else turned
        self._base = np.array([world.index.insertion_qpos, rotation])

    def restart(self, index: int, episode: Draw, random_state: RandomState) -> None:
        """Holds the base of one simulation where it stands."""
        self._drives.hold(index)
        if self.parameters is Springs:
            self.world.parameters.rest[index] = self._springs.rest
            self.world.parameters.compliance[index] = self._springs.compliance
        if not self._holds:
            return
        factor, loss = (
            1.0 if value is None else value
            for value in (episode.stiffness, episode.loss)
        )
        material = self._device.relaxation_time * loss
        stiffness, damping, _ = self._free[index]
        stiffness[:] = self._held.nominal[0] * factor
        damping[:] = hinge_time(material, self.world.chain.timestep) * stiffness
        self._find_hinges(index)
        self._hold(index)

    def _find_hinges(self, index: int) -> None:
        fields = held.fields_of(lambda name: self.world.field(index, name))
        self._hinged[index] = fields  # what lies at their addresses stays
        self._sheathed.places[index] = held.addresses(fields)

    def _hold(self, index: int) -> None:
        """Holds the links of one simulation that are in the sheath."""
        from cathsim_dmc.physics import adapters  # late, as numba takes long

        adapters.hold_links(self._sheathed, index, index + 1)
        self._soften(slice(index, index + 1))

    def _soften(self, rows: slice) -> None:
        """Writes the springs of a shaped device of which a part is in the sheath."""
        if self.parameters is Springs:
            free, out = self._free[rows, 0, :, 0], self._sheathed.out[rows]
            self.world.parameters.rest[rows] = self._springs.rest * out
            stiffness = sheath.held_stiffness(free, out)
            self.world.parameters.compliance[rows] = 1 / stiffness

    def act(self, action: np.ndarray, state: Readings) -> np.ndarray:
        """Lets clamps slip; turns motors against the twist of the links."""
        from cathsim_dmc.physics import adapters  # late, as numba takes long

        load = state.push_force[:, None]
        if self._drives.slipped.shape[1] > 1:
            load = np.stack([state.push_force, state.push_torque], axis=1)
        control, sheathed = action.copy(), self._sheathed if self._holds else None
        drives, steering = self._drives.bound, self._steering

        def move(own: slice) -> None:
            memory = steering
            if memory is not None:
                bends = Bends._make(map(np.empty_like, memory.bends))
                memory = memory._replace(bends=bends)
            held_ = sheathed and sheathed.of(own)
            adapters.act(drives.of(own), held_, memory, load[own], control[own])

        if len(control) < rows.MANY:
            adapters.act(drives, sheathed, steering, load, control)
        else:
            rows.each(len(control), move)
        if self._holds:
            self._soften(slice(None))
        return control

    def pose_robot(self) -> None:
        """Poses the robot that holds the devices."""
        index = self.world.index
        pose(self.world.arrays.qpos, self._base, index.robot_qpos)

    def courses(self, line: np.ndarray) -> list[tuple[Device, np.ndarray]]:
        """The devices and their points (N, n, 3) on a line (N, L + 1, 3), m.

        From the innermost outwards, as far behind the base as X-rays meet them.
        """
        first = line[:, :1] + self._behind * (line[:, :1] - line[:, 1:2])
        return [(self._device, np.concatenate([first, line], axis=1))]

    def read(self, readings: Readings) -> CoaxialReadings | None:
        """State of coaxial devices at some readings; None for one alone."""
        return None


class Positions(NamedTuple):
    """Where K coaxial devices are, part of the state that is saved.

    Attributes:
        insertion: (K,), way of each device, m.
        angles: (K, M + 1), rotations of its nodes, rad.
    """

    insertion: Any = Array("devices")
    angles: Any = Array("devices", "nodes")


class SlidingDevices(SingleDevice):
    """Coaxial devices, each moved along and about its axis by its actions."""

    data_fields = ("cfrc_int", "act", "qfrc_applied")
    model_fields = step_fields = chain_fields.FIELDS
    state = (
        *SingleDevice.state,
        *("_friction", "_factors", "_ways", "_drag", "_axial"),
    )
    parameters = Positions

    def __init__(self, stack: DeviceStack, holds: bool = True):
        """Takes the entity of the devices; see `SingleDevice`."""
        self._entity, self._stack, self._holds = stack, stack.stack, holds

    def bind(self, world: World) -> None:
        """Finds the places in the model."""
        super().bind(world)
        total, count = world.num_simulations, len(self._entity.devices)
        self.slipped = np.zeros((total, 2 * count))
        self._index, self._qpos = world.index, world.arrays.qpos
        self._internal_force = world.arrays.cfrc_int[:, world.index.links]
        (base,) = np.flatnonzero(world.model.jnt_qposadr == self._index.insertion_qpos)
        self._others = world.arrays.qfrc_applied[:, world.model.jnt_dofadr[base]]
        # Views: writing to them writes the state.
        self._insertion, self._angles = world.parameters
        self._places = chain_fields.places_of(world.model, self._entity)
        self._devices = devices_at(self._entity)
        first, tables = self._places.qpos, self._stack.tables
        self._hinges = self._qpos[:, first : first + 2 * len(self._stack.spans)]
        self._fields: list[Any] = [None] * total
        self._memory = stack_memory.settling(tables)
        self._chain = stack_memory.chain(tables)
        # Factors of all stiffnesses, and of all loss factors.
        self._friction, self._factors = np.zeros(total), np.ones((total, 2))
        # Fraction of the friction between devices that acts, positive when the inner
        # one has slid forward; that friction, and the forces of the drives but for the
        # push force, which the leading device bears, N.
        self._ways, self._drag = np.zeros((2, total, count - 1))
        self._axial = np.zeros((total, count))

    # The course of an episode.

    def restart(self, index: int, episode: Draw, random_state: RandomState) -> None:
        """Puts the devices of one simulation to the start of the chain."""
        self._drives.hold(index)
        gaps = self._entity.start_gaps
        self._insertion[index] = self._qpos[index, self._index.insertion_qpos] - gaps
        for each in (self._angles, self.slipped, self._ways, self._drag):
            each[index] = 0.0
        self._axial[index] = self._others[index] = 0.0
        drawn = episode.friction, episode.stiffness, episode.loss
        usual = self._entity.friction, 1.0, 1.0
        self._friction[index], *self._factors[index] = (
            default if value is None else value
            for value, default in zip(drawn, usual, strict=True)
        )
        self._fields[index] = chain_fields.fields_of(
            lambda name: self.world.field(index, name)
        )
        state = self._state(index, gaps, np.zeros((len(gaps), len(self._stack.spans))))
        friction = self._friction[index]
        sliding.lay(self._devices, state, friction, self._memory, self._chain)
        self._find_hinges(index)
        self._write(index)

    def act(self, action: np.ndarray, state: Readings) -> np.ndarray:
        """Moves the devices and writes the properties of the chains.

        The chain is driven to where the device will be that reaches farthest; the
        others move as they are told. A device that leads is held up with the chain.

        Args:
            action: (N, 2 K) in [-1, 1], translation and rotation of each device.
            state: Readings after the last control step.

        Returns:
            Control (N, 1) of the chain's motor.
        """
        reached = self._drives.resting()[:, 0]
        before, step = self._pushed(), MAX_PUSH_SPEED * CONTROL_TIMESTEP
        leaders = np.argmax(self._insertion, axis=1)
        told = step * action[:, 0::2]
        moved = self._clamped(told, leaders)
        self.slipped[:, 0::2] += np.abs(told - moved)
        # A device may be withdrawn until its end has left the patient.
        least = -self.world.start_depth
        target, lead = np.empty(before.shape), np.empty(len(before))
        limits = least, self._entity.stroke
        sliding.advance(before, moved, limits, target, lead)
        slid = -np.diff(target - before, axis=1) / _PRESLIDING
        self._ways[:] = np.clip(self._ways + slid, -1.0, 1.0)
        self._insertion[:] = target
        self._settle(action[:, 1::2], lead, state)
        command = ((lead - reached) / step)[:, None]
        load = state.push_force[:, None] - self._others[:, None]
        slip = np.abs(self._drives.follow(command, load)[:, 0])
        self.slipped[np.arange(len(before)), 2 * leaders] += slip
        return command

    def _clamped(self, told: np.ndarray, leaders: np.ndarray) -> np.ndarray:
        """Ways (N, K), m; the leading device's clamp slips in the physics steps."""
        excess = np.abs(self._axial) - MAX_PUSH_FORCE
        excess[np.arange(len(excess)), leaders] = -1.0
        if (excess < 0.0).all():
            return told
        way = np.sign(self._axial)
        given = way * np.minimum(way * told, -excess * _GIVE)
        return np.where(excess < 0.0, told, given)

    def _state(self, index: int, gaps: np.ndarray, axial: np.ndarray) -> sliding.State:
        """State of one simulation, with gaps (K,), m, and axial forces (K, J), N."""
        return sliding.State(
            gaps=gaps,
            hinges=self._hinges[index],
            angles=self._angles[index],
            ways=self._ways[index],
            drag=self._drag[index],
            slipped=self.slipped[index, 1::2],
            axial=axial,
        )

    def _write(self, index: int) -> None:
        """Writes the chain that a law has left into the model of one simulation."""
        factors, fields = self._factors[index].tolist(), self._fields[index]
        chain_fields.write(fields, self._places, self._chain, factors[0], factors[1])
        if self._holds:
            self._free[index] = self._held.read(self._hinged[index])
            self._hold(index)

    def _settle(self, rate: np.ndarray, lead: np.ndarray, state: Readings) -> None:
        """Turns the devices, writes the chains, computes the forces of the drives."""
        nodes, turned = self._stack.nodes, MAX_ROTATION_SPEED * CONTROL_TIMESTEP * rate
        gaps = gaps_of(np.ascontiguousarray(self._insertion))
        # The sheath is frictionless.
        depth, outside = self.world.start_depth, state.external_force
        force = np.empty(outside.shape[:2])
        sliding.rubbing(outside, lead, depth, nodes, force)
        count = gaps.shape[1]
        load, axial = np.zeros(len(gaps)), np.zeros((*gaps.shape, len(nodes) - 2))
        if count > 1:
            # What the wall does to the links beyond; forces within are not MuJoCo's
            # state.
            beyond = -np.cumsum(outside[:, ::-1], axis=1)[:, ::-1]
            beyond = np.ascontiguousarray(beyond)
            sliding.leading_load(beyond, state.centreline, gaps, nodes, load)
        for i in range(len(gaps)):
            stiffness, loss = self._factors[i].tolist()
            loads = sliding.Loads(
                turned=turned[i],
                force=force[i],
                axial=load[i],
                friction=self._friction[i],
                stiffness=stiffness,
                loss=loss,
            )
            posture = self._state(i, gaps[i], axial[i])
            sliding.settle(self._devices, loads, posture, self._memory, self._chain)
            self._write(i)
        if count > 1:
            self._axial[:] = axial.sum(axis=-1)
            self._axial[:, :-1] += self._drag
            self._axial[:, 1:] -= self._drag
            # The drive of the leading device bears what the chain's does, and these.
            leaders = np.argmin(gaps, axis=1)
            self._others[:] = -self._axial[np.arange(len(gaps)), leaders]

    # What others may read.

    def _pushed(self) -> np.ndarray:
        """Insertion (N, K) at which the devices come to rest, m."""
        place = np.ascontiguousarray(self._drives.resting()[:, 0])
        told = np.ascontiguousarray(self._insertion)
        where = np.empty_like(told)
        sliding.held(told, place, where)
        return where

    def pose_robot(self) -> None:
        """Poses the robot that holds the outer and the inner device.

        Of more than two devices it holds the outermost and the innermost; of one, both
        units work on the same.
        """
        reached = self._qpos[:, self._index.insertion_qpos]
        pushed = reached[:, None] - gaps_of(self._pushed())
        turned = self._angles[..., 0]
        ends = (pushed[:, -1], turned[:, -1], pushed[:, 0], turned[:, 0])
        self._qpos[:, self._index.robot_qpos] = postures(np.array(ends))

    def read(self, readings: Readings) -> CoaxialReadings:
        """State of the devices at readings of the same control step."""
        gaps, nodes = gaps_of(self._pushed()), self._stack.nodes
        # In motion the chain is behind its command, with all devices in it.
        insertion, push = readings.insertion[:, None] - gaps, self._axial.copy()
        push[np.arange(len(gaps)), gaps.argmin(axis=1)] += readings.push_force
        line, load = readings.centreline, readings.push_force.copy()
        if gaps.shape[1] > 1:
            force = np.ascontiguousarray(self._internal_force)
            sliding.leading_load(force, line, gaps, nodes, load)
        return CoaxialReadings(
            insertion=insertion,
            rotation=self._angles[..., 0].copy(),
            tip_rotation=self._angles[..., -1].copy(),
            points=points_at(line, gaps[..., None] + DEVICE_PLACES, nodes),
            leading_load=load,
            lumen_friction=np.abs(self._drag).sum(axis=1),
            push=push,
        )

    def courses(self, line: np.ndarray) -> list[tuple[Device, np.ndarray]]:
        """See `SingleDevice.courses`."""
        points = device_points(line, gaps_of(self._pushed()), self._stack.nodes)
        return [(each, points[:, k]) for k, each in enumerate(self._entity.devices)]


def devices_at(entity: DeviceStack) -> sliding.Devices:
    """What the law of a control step takes of devices and of their drives."""
    stack = entity.stack
    return sliding.Devices(
        tables=stack.tables,
        rods=entity.rods,
        arms=stack.arms,
        sections=stack.sections,
        lumen_friction=entity.lumen_friction,
        duration=CONTROL_TIMESTEP,
        torque=MAX_TORQUE,
    )


def devices_of(chain: Chain, holds: bool = True) -> SingleDevice:
    """The effect by which actions move the devices of a chain; see `SingleDevice`."""
    if isinstance(chain, DeviceStack):
        return SlidingDevices(chain, holds)
    return SingleDevice(chain, holds)
