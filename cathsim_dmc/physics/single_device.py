"""One device in a task, moved by its own motors; the base of coaxial devices."""

import mujoco
import numpy as np

from cathsim_dmc.entities.chain import Chain
from cathsim_dmc.entities.robot import postures
from cathsim_dmc.imaging.device import Shadow
from cathsim_dmc.physics.drives import Drives
from cathsim_dmc.physics.effects import Effect, Episode, World
from cathsim_dmc.physics.readings import CoaxialReadings, Readings

# Length of the straight device behind its base that X-rays meet, m.
BEHIND = 0.3


class SingleDevice(Effect):
    """One device, whose own motors move it."""

    data_fields: tuple[str, ...] = ("act",)
    model_fields: tuple[str, ...] = ()

    def __init__(self, chain: Chain):
        """Takes the entity of the device."""
        self._radius = chain.device.outer_radius
        self._behind = BEHIND / float(chain.link_lengths[0])  # links

    def settle(self, model: mujoco.MjModel) -> None:
        """Writes the properties of the chain at the start into a model."""

    def bind(self, world: World) -> None:
        """Finds the drives in the model."""
        super().bind(world)
        self._drives = Drives(world.model, world.arrays)

    def restart(
        self, index: int, episode: Episode, random_state: np.random.RandomState
    ) -> None:
        """Holds the base of one simulation where it stands."""
        self._drives.hold(index)

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
        return action

    def follower_posture(self) -> np.ndarray:
        """Joints (N, len(JOINTS)) of the robot that holds the devices."""
        index, qpos = self.world.index, self.world.arrays.qpos
        held = np.zeros((4, len(qpos)))
        held[::2] = qpos[:, index.insertion_qpos]
        if index.rotation_qpos is not None:
            held[1::2] = qpos[:, index.rotation_qpos]
        return postures(held)

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
