"""One device in a task, moved by its own motors; the base of coaxial devices."""

from __future__ import annotations

from typing import TYPE_CHECKING

import mujoco
import numpy as np

from cathsim_dmc.entities.chain import BENDING_RELAXATION_TIME, Chain
from cathsim_dmc.entities.posture import x_first
from cathsim_dmc.entities.robot import follower_posture
from cathsim_dmc.imaging.device import Shadow
from cathsim_dmc.physics.drives import Drives
from cathsim_dmc.physics.effects import Effect, World
from cathsim_dmc.physics.randomisation import Episode
from cathsim_dmc.physics.readings import Readings, ids

if TYPE_CHECKING:
    from cathsim_dmc.physics.sliding import CoaxialReadings

# Length of the straight device behind its base that X-rays meet, m.
BEHIND = 0.3


class Turning:
    """Rates of the hinges of a chain that turns about its axis in a bend at rest.

    In a pair of hinges about x and y, x nearer to the base, at angles x and y, and
    where the link before it turns about its axis at Ω,

        x' = Ω cos x tan y,    y' = -Ω sin x,

    and the link after it turns at Ω cos x / cos y; with y nearer, x and y change
    places, and the rates their signs.
    """

    def __init__(self, model: mujoco.MjModel, chain: Chain):
        """Finds the joints in a compiled model."""
        bends = np.sort(ids(model, chain.bends))
        self.qpos = model.jnt_qposadr[bends]
        self._near, self._far = self.qpos[0::2], self.qpos[1::2]
        joints = range(1, len(self._near) + 1)
        self._sign = np.where([x_first(joint) for joint in joints], 1.0, -1.0)
        axial = ids(model, [chain.rotation, *chain.hinges[len(bends) :]])
        self._axial = model.jnt_dofadr[axial]
        # The joint before which each of them turns the chain.
        self._before = np.searchsorted(bends[0::2], axial)

    def rates(self, qpos: np.ndarray, qvel: np.ndarray) -> np.ndarray:
        """Rates (N, 2 J) of the hinges in the order of the chain, rad/s.

        Args:
            qpos: (N, nq).
            qvel: (N, nv).
        """
        near, far = qpos[:, self._near], qpos[:, self._far]
        along = np.cos(near)
        gain = np.ones_like(near)
        np.cumprod((along / np.cos(far))[:, :-1], axis=1, out=gain[:, 1:])
        turning = np.zeros_like(near)
        for joint, axial in zip(self._before, self._axial, strict=True):
            turning[:, joint] += qvel[:, axial]
        turning = self._sign * gain * np.cumsum(turning / gain, axis=1)
        rates = np.empty((len(near), 2 * near.shape[1]))
        rates[:, 0::2] = turning * along * np.tan(far)
        rates[:, 1::2] = -turning * np.sin(near)
        return rates


class SingleDevice(Effect):
    """One device, whose own motors move it.

    The damping of a hinge beyond that of the material resists how it moves in the
    vessel, not that the device turns about its axis: the springs lead by what it takes.
    """

    data_fields: tuple[str, ...] = ("act",)
    model_fields: tuple[str, ...] = ()

    def __init__(self, chain: Chain):
        """Takes the entity of the device."""
        if chain.rotation is not None:
            self.model_fields = ("qpos_spring",)
        self._radius = chain.device.outer_radius
        self._behind = BEHIND / float(chain.link_lengths[0])  # links

    def settle(self, model: mujoco.MjModel) -> None:
        """Writes the properties of the chain at the start into a model."""

    def bind(self, world: World) -> None:
        """Finds the drives in the model."""
        super().bind(world)
        self._drives = Drives(world.model, world.arrays)
        self._turning = None
        if world.chain.rotation is not None:
            self._turning = Turning(world.model, world.chain)
            self._rest = world.model.qpos_spring[self._turning.qpos]
            self._lead = np.zeros((world.num_simulations, len(self._rest)))
            self._springs = [self._rest] * world.num_simulations

    def restart(
        self, index: int, episode: Episode, random_state: np.random.RandomState
    ) -> None:
        """Holds the base of one simulation where it stands."""
        self._drives.hold(index)
        if self._turning is not None:
            self._lead[index] = 0.0
            self.refresh(index)

    @property
    def state(self) -> dict[str, np.ndarray]:
        """What is not in MuJoCo's state."""
        drives = {"slipped": self._drives.slipped, "told": self._drives.told}
        return drives if self._turning is None else {**drives, "lead": self._lead}

    def refresh(self, index: int) -> None:
        """Writes the springs of one simulation."""
        if self._turning is not None:
            self._springs[index] = self.world.field(index, "qpos_spring")
            self._springs[index][self._turning.qpos] = self._rest + self._lead[index]

    @property
    def slipped(self) -> np.ndarray:
        """Way by which the clamps have slipped in the episode, m and rad.

        (N, 1) or, with rotation, (N, 2) of a single device; (N, 2 K) of coaxial
        devices, translation and rotation of each.
        """
        return self._drives.slipped

    def act(self, action: np.ndarray, state: Readings) -> np.ndarray:
        """Lets clamps slip; the motors take the action as it is."""
        self._drives.follow(action[:, len(self.world.chain.tip_motors) :])
        if self._turning is not None:
            arrays = self.world.arrays
            rates = self._turning.rates(arrays.qpos, arrays.qvel)
            self._lead[:] = BENDING_RELAXATION_TIME * rates
            for spring, rest in zip(
                self._springs, self._rest + self._lead, strict=True
            ):
                spring[self._turning.qpos] = rest
        return action

    def follower_posture(self) -> np.ndarray:
        """Joints (N, len(JOINTS)) of the robot that holds the devices."""
        index, qpos = self.world.index, self.world.arrays.qpos
        turned = 0.0 if index.rotation_qpos is None else qpos[:, index.rotation_qpos]
        return follower_posture(qpos[:, index.insertion_qpos], turned)

    def shadows(self, line: np.ndarray) -> list[Shadow]:
        """The devices as X-rays meet them, from the innermost outwards.

        Args:
            line: (N, L + 1, 3), `Readings.centreline`.
        """
        first = line[:, :1] + self._behind * (line[:, :1] - line[:, 1:2])
        return [Shadow(np.concatenate([first, line], axis=1), self._radius)]

    def read(self, readings: Readings) -> CoaxialReadings | None:
        """State of coaxial devices at some readings; None for one alone."""
        del readings
        return None
