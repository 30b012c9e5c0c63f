"""Coaxial devices of N simulations, moved by the actions.

Once per control step, coaxial devices are moved along and about their axis;
`chain_fields` then writes the properties of the chain. Insertions and rotations of the
devices lie in MuJoCo's `userdata`, which is part of the saved state.
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
)
from cathsim_dmc.entities.device import Device
from cathsim_dmc.entities.device_stack import DeviceStack
from cathsim_dmc.entities.robot import postures
from cathsim_dmc.laws import sliding
from cathsim_dmc.laws.parameters import Array
from cathsim_dmc.physics import chain_fields, held
from cathsim_dmc.physics.device_points import (
    DEVICE_PLACES,
    device_points,
    gaps_of,
    points_at,
)
from cathsim_dmc.physics.effects import Draw, World
from cathsim_dmc.physics.readings import CoaxialReadings, Readings
from cathsim_dmc.physics.single_device import SingleDevice
from cathsim_dmc.physics.stepper import CONTROL_TIMESTEP

# Sliding distance over which the friction in the lumen builds up, m.
_PRESLIDING = 40e-6
# Slip of a clamp in a control step per force beyond its limit, m/N. The axial force of
# a stiff wire in a tight bend changes by 0.8 N/mm at most.
_GIVE = 1e-3


class Positions(NamedTuple):
    """Positions of K coaxial devices, part of the saved state.

    Attributes:
        insertion: (K,), commanded insertion of each device, m.
        angles: (K, M + 1), rotations of the nodes of each device, rad.
    """

    insertion: Any = Array("devices")
    angles: Any = Array("devices", "nodes")


class SlidingDevices(SingleDevice):
    """Coaxial devices, each moved along and about its axis by its actions.

    Attributes:
        slipped: (N, 2 K), slip of the clamps of each of the K devices in the episode,
            along and about its axis, m and rad.
    """

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
        """Finds the chain in the model and allocates the state of the devices."""
        super().bind(world)
        total, count = world.num_simulations, len(self._entity.devices)
        self.slipped = np.zeros((total, 2 * count))
        self._index, self._qpos = world.index, world.arrays.qpos
        self._internal_force = world.arrays.cfrc_int[:, world.index.links]
        (base,) = np.flatnonzero(world.model.jnt_qposadr == self._index.insertion_qpos)
        self._others = world.arrays.qfrc_applied[:, world.model.jnt_dofadr[base]]
        # Views: writing to them writes the state.
        self._insertion, self._angles = world.parameters
        tables = self._stack.tables
        places = chain_fields.places_of(world.model, self._entity)
        joints, model = len(self._stack.spans), world.model
        self._hinges = self._qpos[:, places.qpos : places.qpos + 2 * joints]
        self._fields: list[Any] = [None] * total
        self._live = chain_fields.Live(
            devices=devices_at(self._entity),
            scratch=stack_memory.settling(tables),
            chain=stack_memory.chain(tables),
            places=places,
            fields=np.zeros((total, len(chain_fields.FIELDS)), np.int64),
            sizes=np.array([model.njnt, model.nv, model.nq, model.ngeom, model.nbody]),
            sheathed=self._sheathed if self._holds else None,
        )
        # Factors of all stiffnesses, and of all loss factors.
        self._friction, self._factors = np.zeros(total), np.ones((total, 2))
        # Fraction of the friction between devices that acts, positive when the inner
        # one has slid forward; that friction, N; and the forces of the drives, N,
        # without the push force, which the leading device bears.
        self._ways, self._drag = np.zeros((2, total, count - 1))
        self._axial = np.zeros((total, count))

    # The course of an episode.

    def restart(self, index: int, episode: Draw, random_state: RandomState) -> None:
        """Places the devices of one simulation at the start."""
        self._drives.hold(index)
        gaps = self._entity.start_gaps
        self._insertion[index] = self._qpos[index, self._index.insertion_qpos] - gaps
        for each in (self._angles, self.slipped, self._ways, self._drag):
            each[index] = 0.0
        self._axial[index] = self._others[index] = 0.0
        friction, factors = episode.friction, (episode.stiffness, episode.loss)
        self._friction[index] = self._entity.friction if friction is None else friction
        self._factors[index] = [1.0 if each is None else each for each in factors]
        self._fields[index] = fields = chain_fields.fields_of(
            lambda name: self.world.field(index, name)
        )
        self._live.fields[index] = held.addresses(fields)
        self._find_hinges(index)
        total, links = len(self._insertion), len(self._stack.tables.lengths)
        turned, force = np.zeros(self._insertion.shape), np.zeros((total, links))
        gaps, load = np.tile(gaps, (total, 1)), np.zeros(total)
        self._write(gaps, turned, force, load, laid=index)

    def act(self, action: np.ndarray, state: Readings) -> np.ndarray:
        """Moves the devices and writes the properties of the chains.

        The chain is driven to the target of the leading device; the others move as
        commanded. Where the chain is held up, so is the leading device.

        Args:
            action: (N, 2 K) in [-1, 1], translation and rotation of each device.
            state: Readings after the last control step.

        Returns:
            Control (N, 1) of the chain's motor.
        """
        reached, step = self._drives.resting()[:, 0], MAX_PUSH_SPEED * CONTROL_TIMESTEP
        before = self._pushed(reached)
        self._pose(before)
        leaders = np.argmax(self._insertion, axis=1)
        told = step * action[:, 0::2]
        moved = self._clamped(told, leaders)
        self.slipped[:, 0::2] += np.abs(told - moved)
        # A device may be withdrawn until its end has left the patient.
        least = -self.world.start_depth
        target, lead = np.empty(before.shape), np.empty(len(before))
        limits = least, self.world.stroke
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
        """Commanded travel (N, K), m, less the slip of the clamps.

        The clamp of the leading device is left out: it slips in the physics steps.
        """
        excess = np.abs(self._axial) - MAX_PUSH_FORCE
        excess[np.arange(len(excess)), leaders] = -1.0
        if (excess < 0.0).all():
            return told
        way = np.sign(self._axial)
        given = way * np.minimum(way * told, -excess * _GIVE)
        return np.where(excess < 0.0, told, given)

    def _settle(self, rate: np.ndarray, lead: np.ndarray, state: Readings) -> None:
        """Turns the devices, writes the chains and finds the forces of the drives."""
        nodes, turned = self._stack.nodes, MAX_ROTATION_SPEED * CONTROL_TIMESTEP * rate
        gaps = gaps_of(self._insertion)
        # The sheath is frictionless.
        depth, outside = self.world.start_depth, state.external_force
        force = np.empty(outside.shape[:2])
        sliding.rubbing(outside, lead, depth, nodes, force)
        count = gaps.shape[1]
        load = np.zeros(len(gaps))
        if count > 1:
            # Forces of the wall on all links beyond: MuJoCo's internal forces are not
            # part of its state.
            beyond = -np.cumsum(outside[:, ::-1], axis=1)[:, ::-1]
            beyond = np.ascontiguousarray(beyond)
            sliding.leading_load(beyond, state.centreline, gaps, nodes, load)
        axial = self._write(gaps, turned, force, load)
        if count > 1:
            self._axial[:] = axial.sum(axis=-1)
            self._axial[:, :-1] += self._drag
            self._axial[:, 1:] -= self._drag
            # The leading device's drive bears the chain's load and these forces.
            leaders = np.argmin(gaps, axis=1)
            self._others[:] = -self._axial[np.arange(len(gaps)), leaders]

    def _write(
        self,
        gaps: np.ndarray,
        turned: np.ndarray,
        force: np.ndarray,
        load: np.ndarray,
        laid: int | None = None,
    ) -> np.ndarray:
        """Writes the chains of all simulations, or of one.

        Args:
            gaps: (N, K), m; the others are those of `laws.sliding.Loads`, with an axis
                N.
            laid: Index of the simulation to write, whose devices are at the start of an
                episode and are not turned; None for all simulations.

        Returns:
            Axial forces (N, K, J) at the joints, N.
        """
        from cathsim_dmc.physics import adapters  # late, as numba takes long

        axial = np.zeros((*gaps.shape, len(self._stack.spans)))
        stiffness, loss = self._factors[:, 0], self._factors[:, 1]
        loads = sliding.Loads(turned, force, load, self._friction, stiffness, loss)
        state = sliding.State(
            gaps=gaps,
            hinges=self._hinges,
            angles=self._angles,
            ways=self._ways,
            drag=self._drag,
            slipped=self.slipped,
            axial=axial,
        )

        def settle(own: slice) -> None:
            tables, live = self._stack.tables, self._live
            if len(gaps) >= rows.MANY:  # threads settle at the same time
                live = live._replace(
                    scratch=stack_memory.settling(tables),
                    chain=stack_memory.chain(tables),
                )
            adapters.settle(live, loads, state, (own.start, own.stop), laid is not None)

        if laid is None:
            rows.each(len(gaps), settle)
        else:
            settle(slice(laid, laid + 1))
        return axial

    # Readings.

    def _pushed(self, reached: np.ndarray | None = None) -> np.ndarray:
        """Insertions (N, K) at which the devices come to rest, m.

        The leading device is at `reached` (N,), that of the chain; None for that of its
        drive. The others are as commanded, at most at that insertion.
        """
        place = self._drives.resting()[:, 0] if reached is None else reached
        where = np.minimum(self._insertion, place[:, None])
        where[np.arange(len(where)), self._insertion.argmax(axis=1)] = place
        return where

    def pose_robot(self) -> None:
        """Poses the robot, which holds the outermost and the innermost device.

        Both units hold a single device.
        """
        self._pose(self._pushed())

    def _pose(self, pushed: np.ndarray) -> None:
        """Poses the robot for devices that come to rest at insertions (N, K), m."""
        reached = self._qpos[:, self._index.insertion_qpos]
        pushed = reached[:, None] - gaps_of(pushed)
        turned = self._angles[..., 0]
        ends = (pushed[:, -1], turned[:, -1], pushed[:, 0], turned[:, 0])
        self._qpos[:, self._index.robot_qpos] = postures(np.array(ends))

    def read(self, readings: Readings) -> CoaxialReadings:
        """State of the devices at readings of the same control step."""
        gaps, nodes = gaps_of(self._pushed()), self._stack.nodes
        # In motion the chain lags its command, and all devices with it.
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
    """Devices of an entity and limits of their drives, for `laws.sliding`."""
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
    """Returns the effect that moves the devices of a chain; see `SingleDevice`."""
    if isinstance(chain, DeviceStack):
        return SlidingDevices(chain, holds)
    return SingleDevice(chain, holds)
