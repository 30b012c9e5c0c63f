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


class Frame(NamedTuple):
    """Input of the observations after a control step.

    Attributes:
        readings: state of the device.
        wall_force: force on the wall over the control step.
        action: (..., A), the last action, zeros after a reset.
        goal: (3,) or (..., 3), m.
        chain: the device as observations show it.
        images: of the sensors, by name: (..., H, W, P) uint8 of P planes "past_0", the
            last one, "past_1" and "past_2"; (..., H, W, 2 P) uint8 "masks", see
            `imaging.angiograph.masks`; (..., P, K + 1, 2) "pixels" of tracked points
            and goal, (column, row); endoluminal views.
        ahead: route ahead of the tip; None where no observation needs it.
        devices: state of coaxial devices; None for a device alone.
        vessel: state of the vessel; None for a rigid one with blood at rest.
    """

    readings: readings.Readings
    wall_force: forces.WallForce
    action: np.ndarray
    goal: np.ndarray
    chain: CommonChain
    images: Mapping[str, np.ndarray] = MappingProxyType({})
    ahead: Ahead | None = None
    devices: CoaxialReadings | None = None
    vessel: VesselReadings | None = None
