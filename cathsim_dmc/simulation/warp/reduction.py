"""What is summed up on the device, so that little has to be copied from it."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from cathsim_dmc.compiled import compiled
from cathsim_dmc.physics.forces import CONTACT_SIZE
from cathsim_dmc.simulation.warp.devices import NONE, Device

_LARGEST = 1e10  # MuJoCo's mjMAXVAL: beyond it a simulation has diverged


class Totals(NamedTuple):
    """Of the physics steps of a control step, float64.

    Attributes:
        force: (7, N) the forces of `physics.forces.WallForce`, N, of the means the sums
            over the physics steps, and the depth of the deepest contact, m.
        diverged: (N,) whether the state is not finite.
        beside: (N, B) sensors beside those of contacts.
    """

    force: Any
    diverged: Any
    beside: Any


@compiled
def clear(world, scratch, totals):
    """Begins a control step of a world."""
    for k in range(7):
        totals.force[k, world] = 0.0
    totals.diverged[world] = 0


class Added(NamedTuple):
    """What a physics step adds to the totals.

    Attributes:
        sensors: (N, nsensordata), Warp's.
        first, last: Places of the wall's contacts in it.
        qpos: (N, nq), Warp's.
        qvel: (N, nv), Warp's.
        totals: See `Totals`.
    """

    sensors: Any
    first: Any
    last: Any
    qpos: Any
    qvel: Any
    totals: Totals


@compiled
def add(world, scratch, given):
    """Adds a physics step of a world; see `physics.forces_loops.summed`.

    Args:
        world: Its number.
        scratch: Not used.
        given: `Added`.
    """
    sensors, first, last = given.sensors, given.first, given.last
    qpos, qvel, totals = given.qpos, given.qvel, given.totals
    total, largest, deepest = 0.0, 0.0, totals.force[6, world]
    for at in range(first, last, CONTACT_SIZE):
        if sensors[world, at] == 0.0:
            break
        x, y, z = sensors[world, at + 1], sensors[world, at + 2], sensors[world, at + 3]
        force = math.sqrt(float(x) ** 2 + float(y) ** 2 + float(z) ** 2)
        total += force
        largest = max(largest, force)
        deepest = max(deepest, -float(sensors[world, at + 4]))
    totals.force[0, world], totals.force[1, world] = total, largest
    totals.force[2, world] = max(totals.force[2, world], total)
    totals.force[3, world] = max(totals.force[3, world], largest)
    totals.force[4, world] += total
    totals.force[5, world] += largest
    totals.force[6, world] = deepest
    for k in range(totals.beside.shape[1]):
        at = k if k < first else k - first + last
        totals.beside[world, k] = sensors[world, at]
    for k in range(qpos.shape[1]):
        if not abs(qpos[world, k]) < _LARGEST:
            totals.diverged[world] = 1
    for k in range(qvel.shape[1]):
        if not abs(qvel[world, k]) < _LARGEST:
            totals.diverged[world] = 1


class Reduction:
    """Forces, errors and sensors of N worlds over a control step."""

    def __init__(self, device: Device, data: Any, contacts: slice):
        """Takes the arrays of Warp's data.

        Args:
            device: Where they are.
            data: `mujoco_warp.Data`.
            contacts: Place of the wall's contacts in `sensordata`.
        """
        view = device.view
        self._device, self._contacts = device, contacts
        self._count, size = data.sensordata.shape
        beside = size - (contacts.stop - contacts.start)
        self._totals = Totals(
            device.constant(np.zeros((7, self._count))),
            device.constant(np.zeros(self._count, np.int32)),
            device.constant(np.zeros((self._count, beside))),
        )
        state = view(data.qpos), view(data.qvel)
        sensors, first, last = view(data.sensordata), contacts.start, contacts.stop
        self._added = Added(sensors, first, last, state[0], state[1], self._totals)

    def begin(self) -> None:
        """Begins a control step."""
        self._device.launch(clear, self._count, NONE, self._totals)

    def add(self) -> None:
        """Adds a physics step."""
        self._device.launch(add, self._count, NONE, self._added)

    def read(self) -> Totals:
        """The totals on the host."""
        return Totals._make(map(self._device.host, self._totals))
