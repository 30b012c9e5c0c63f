"""Input of the observations after a control step."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from cathsim_dmc.physics import forces, readings
from cathsim_dmc.physics.readings import CoaxialReadings
from cathsim_dmc.physics.vessel import VesselReadings
from cathsim_dmc.tasks.common_chain import CommonChain
from cathsim_dmc.tasks.route import Ahead


class Images(NamedTuple):
    """Images of the sensors; None where no observation needs them.

    Attributes:
        image: (..., H, W, P) uint8, fluoroscopy of P planes.
        past_images: the same, one and two control steps before, newest first.
        masks: (..., H, W, 2 P) uint8, see `imaging.angiograph.masks`.
        pixels: (..., P, K + 1, 2), tracked points and goal, (column, row).
        views: endoluminal views by name.
    """

    image: np.ndarray | None = None
    past_images: tuple[np.ndarray, ...] = ()
    masks: np.ndarray | None = None
    pixels: np.ndarray | None = None
    views: Mapping[str, np.ndarray] = MappingProxyType({})


NO_IMAGES = Images()


class Frame(NamedTuple):
    """Input of the observations after a control step.

    Attributes:
        readings: state of the device.
        wall_force: force on the wall over the control step.
        action: (..., A), the last action, zeros after a reset.
        goal: (3,) or (..., 3), m.
        chain: the device as observations show it.
        images: images of the sensors.
        ahead: route ahead of the tip; None where no observation needs it.
        devices: state of coaxial devices; None for a device alone.
        vessel: state of the vessel; None for a rigid one with blood at rest.
    """

    readings: readings.Readings
    wall_force: forces.WallForce
    action: np.ndarray
    goal: np.ndarray
    chain: CommonChain
    images: Images = NO_IMAGES
    ahead: Ahead | None = None
    devices: CoaxialReadings | None = None
    vessel: VesselReadings | None = None
