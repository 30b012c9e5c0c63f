"""Rows of the table of observations that coaxial devices add."""

from operator import attrgetter

import numpy as np

from cathsim_dmc.physics.sliding import DEVICE_PLACES
from cathsim_dmc.tasks.observation_kind import (
    COAXIAL,
    Entry,
    Frame,
    Observation,
    ObservationTable,
    flat,
)

COAXIAL_OBSERVATIONS = ObservationTable()

_devices = attrgetter("devices")


@COAXIAL_OBSERVATIONS.row(
    Entry(
        "device_insertion",
        _devices,
        "m",
        "of each device from the innermost outwards: way of its end, 0 where the "
        "chain's end is at the start of the stroke",
    ),
    Entry("device_rotation", _devices, "rad", "of the rotary unit of each device"),
    needs=COAXIAL,
)
def drives(frame: Frame) -> Observation:
    """How far the operator has pushed and turned each coaxial device."""
    state = frame.devices
    assert state is not None
    return {"device_insertion": state.insertion, "device_rotation": state.rotation}


@COAXIAL_OBSERVATIONS.row(
    Entry("device_tip_rotation", _devices, "rad", "of the end of each device"),
    Entry(
        "device_points",
        lambda sizes: 3 * sizes.devices * len(DEVICE_PLACES),
        "m",
        f"{len(DEVICE_PLACES)} points along each device, every "
        f"{1e3 * DEVICE_PLACES[-2]:g} mm, proximal to its end, world frame",
    ),
    Entry(
        "device_load",
        2,
        "N",
        "axial force in the device that reaches farthest where it leaves the others, "
        "and friction between the devices",
    ),
    needs=COAXIAL,
)
def devices(frame: Frame) -> Observation:
    """Shape of each coaxial device and the load on it."""
    state = frame.devices
    assert state is not None
    return {
        "device_tip_rotation": state.tip_rotation,
        "device_points": flat(state.points, 3),
        "device_load": np.stack([state.leading_load, state.lumen_friction], axis=-1),
    }
