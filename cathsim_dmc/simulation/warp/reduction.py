"""Forces, errors and sensors, reduced on the device to keep transfers small."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from cathsim_dmc.compiled import compiled
from cathsim_dmc.simulation.warp.contacts import WallContacts
from cathsim_dmc.simulation.warp.devices import NONE, Device

_LARGEST = 1e10  # MuJoCo's mjMAXVAL: beyond it a simulation has diverged
_FORCES = 7  # rows of `Totals.force`


class Totals(NamedTuple):
    """Totals over the physics steps of a control step, float64.

    Attributes:
        force: (7, N) the forces of `physics.forces.WallForce`, N, with sums over the
            physics steps in place of the means, and the largest contact depth, m.
        diverged: (N,) 1 if an entry of the state is beyond MuJoCo's mjMAXVAL or not
            finite, else 0.
        beside: (N, B) the sensors other than those of contacts.
    """

    force: Any
    diverged: Any
    beside: Any


class Added(NamedTuple):
    """Arrays of `clear` and `add`, most of them Warp's.

    Attributes:
        counts, starts: (N,), see `WallContacts`.
        is_wall: (ngeom,) whether a geom is the wall of the vessel.
        geom: (K, 2) geoms of the contacts.
        dist: (K,) signed distances of the contacts, m.
        dim: (K,) number of constraint rows of a contact.
        rows: (K, dim) indices of these rows; -1 for none.
        forces: (N, R) forces of the rows, N.
        out: (8 + B, N) the fields of `Totals`, concatenated.
    """

    counts: Any
    starts: Any
    is_wall: Any
    geom: Any
    dist: Any
    dim: Any
    rows: Any
    forces: Any
    out: Any


class Ended(NamedTuple):
    """Arrays of `end`.

    Attributes:
        sensors: (N, nsensordata), Warp's.
        places: (B,) indices of the sensors other than those of contacts.
        qpos: (N, nq), Warp's.
        qvel: (N, nv), Warp's.
        out: See `Added`.
    """

    sensors: Any
    places: Any
    qpos: Any
    qvel: Any
    out: Any


@compiled
def clear(world, scratch, given):
    """Begins a control step of a world; `given` is `Added`."""
    for k in range(_FORCES + 1):
        given.out[k, world] = 0.0


@compiled
def add(world, scratch, given):
    """Adds a physics step of a world; see `physics.forces_loops.summed`.

    Args:
        world: Its number.
        scratch: Not used.
        given: `Added`.
    """
    out, rows, forces = given.out, given.rows, given.forces
    total, largest, deepest = 0.0, 0.0, out[6, world]
    first = given.starts[world]
    for at in range(first, first + given.counts[world]):
        if not given.is_wall[given.geom[at, 1]]:
            continue
        square = 0.0
        # Three forces, and no torques.
        for k in range(min(given.dim[at], 3)):
            if 0 <= rows[at, k] < forces.shape[1]:
                square += float(forces[world, rows[at, k]]) ** 2
        force = math.sqrt(square)
        total += force
        largest = max(largest, force)
        deepest = max(deepest, -float(given.dist[at]))
    out[0, world], out[1, world] = total, largest
    out[2, world], out[3, world] = (
        max(out[2, world], total),
        max(out[3, world], largest),
    )
    out[4, world] += total
    out[5, world] += largest
    out[6, world] = deepest


@compiled
def end(world, scratch, given):
    """Ends a control step of a world; `given` is `Ended`."""
    out, qpos, qvel = given.out, given.qpos, given.qvel
    for k in range(qpos.shape[1]):
        if not abs(qpos[world, k]) < _LARGEST:
            out[_FORCES, world] = 1.0
    for k in range(qvel.shape[1]):
        if not abs(qvel[world, k]) < _LARGEST:
            out[_FORCES, world] = 1.0
    for k in range(len(given.places)):
        out[_FORCES + 1 + k, world] = given.sensors[world, given.places[k]]


class Reduction:
    """Forces, errors and sensors of N worlds over a control step."""

    def __init__(
        self, device: Device, data: Any, contacts: WallContacts, beside: np.ndarray
    ):
        """Takes the arrays of Warp's data.

        Args:
            device: Device of these arrays.
            data: `mujoco_warp.Data`.
            contacts: Has the places of the contacts.
            beside: (B,) indices of the sensors other than those of contacts.
        """
        view, found = device.view, data.contact
        self._device, self._count = device, len(data.qpos)
        self._out = device.constant(np.zeros((_FORCES + 1 + len(beside), self._count)))
        self._added = Added(
            counts=contacts.counts,
            starts=contacts.starts,
            is_wall=device.constant(contacts.is_wall),
            geom=view(found.geom),
            dist=view(found.dist),
            dim=view(found.dim),
            rows=view(found.efc_address),
            forces=view(data.efc.force),
            out=self._out,
        )
        self._ended = Ended(
            sensors=view(data.sensordata),
            places=device.constant(beside.astype(np.int64)),
            qpos=view(data.qpos),
            qvel=view(data.qvel),
            out=self._out,
        )

    def begin(self) -> None:
        """Begins a control step."""
        self._device.launch(clear, self._count, NONE, self._added)

    def add(self) -> None:
        """Adds a physics step."""
        self._device.launch(add, self._count, NONE, self._added)

    def end(self) -> None:
        """Ends a control step."""
        self._device.launch(end, self._count, NONE, self._ended)

    def read(self) -> Totals:
        """The totals on the host."""
        out = self._device.host(self._out)
        return Totals(out[:_FORCES], out[_FORCES], out[_FORCES + 1 :].T)
