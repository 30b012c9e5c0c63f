"""Torsional rods of devices; `laws.torsion` has their law."""

from collections.abc import Sequence

import numpy as np

from cathsim_dmc.entities.device import Device
from cathsim_dmc.laws.torsion import Rods


def rods_of(devices: Sequence[Device], nodes: np.ndarray) -> Rods:
    """The rods of devices.

    Args:
        devices: K devices.
        nodes: (M + 1,), distances from a device's end, m.
    """
    tips = np.minimum(nodes, [[device.tip_length] for device in devices])
    in_tips = -np.diff(tips)
    in_shafts = -np.diff(nodes) - in_tips
    # Twist per torque of a segment, ∫ds/GJ.
    in_tips /= [[device.tip.torsional_stiffness] for device in devices]
    in_shafts /= [[device.shaft.torsional_stiffness] for device in devices]
    times = np.array([device.relaxation_time for device in devices])
    return Rods(1 / (in_tips + in_shafts), times)
