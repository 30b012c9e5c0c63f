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
# Bits of mujoco_warp's OverflowType for contacts and constraint rows; others are the
# limits of iterations of the solver.
_ROOM = 0b1001111
_DIVERGED, _LOST, _BESIDE = _FORCES, _FORCES + 1, _FORCES + 2  # rows of `Added.out`


class Totals(NamedTuple):
    """Totals over the physics steps of a control step, float64.

    Attributes:
        force: (7, N) the forces of `physics.forces.WallForce`, N, with sums over the
            physics steps in place of the means, and the largest contact depth, m.
        diverged: (N,) 1 if an entry of the state is beyond MuJoCo's mjMAXVAL or not
            finite, else 0.
        lost: (N,) 1 if there were more contacts or constraint rows than room, else 0.
        beside: (N, B) the sensors other than those of contacts.
    """

    force: Any
    diverged: Any
    lost: Any
    beside: Any


class Added(NamedTuple):
    """Arguments of `add`; the arrays without a description are Warp's.

    Attributes:
        step: Number of the physics step.
        last: Number of the last physics step.
        counts, starts: (N,), see `WallContacts`.
        is_wall: (ngeom,) whether a geom is the wall of the vessel.
        force: (N, R) forces of the constraint rows, N.
        beside: (B,) indices of the sensors other than those of contacts.
        out: (9 + B, N) the fields of `Totals`, concatenated.
    """

    step: int
    last: int
    counts: Any
    starts: Any
    is_wall: Any
    geom: Any
    dist: Any
    dim: Any
    efc_address: Any
    force: Any
    qpos: Any
    qvel: Any
    sensordata: Any
    overflow: Any
    beside: Any
    out: Any


@compiled
def add(world, scratch, given):
    """Adds a physics step of a world of `Added`; see `physics.forces_loops.summed`."""
    out, rows, forces = given.out, given.efc_address, given.force
    if given.step == 0:
        for k in range(_FORCES):
            out[k, world] = 0.0
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
    out[2, world] = max(out[2, world], total)
    out[3, world] = max(out[3, world], largest)
    out[4, world] += total
    out[5, world] += largest
    out[6, world] = deepest
    if given.step == given.last:
        _end(world, given)


@compiled
def _end(world, given):
    """Ends a control step of a world of `Added`."""
    out = given.out
    fine = _is_fine(given.qpos[world]) and _is_fine(given.qvel[world])
    out[_DIVERGED, world] = 0.0 if fine else 1.0
    out[_LOST, world] = 1.0 if given.overflow[world] & _ROOM else 0.0
    given.overflow[world] = 0
    for k in range(len(given.beside)):
        out[_BESIDE + k, world] = given.sensordata[world, given.beside[k]]


@compiled
def _is_fine(values):
    """Whether all values are finite and below MuJoCo's mjMAXVAL."""
    for k in range(len(values)):
        if not abs(values[k]) < _LARGEST:
            return False
    return True


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
        self._device, self._count = device, len(data.qpos)
        view, found = device.view, data.contact
        self._added = device.views(
            Added,
            data,
            step=0,
            last=0,
            counts=contacts.counts,
            starts=contacts.starts,
            is_wall=device.constant(contacts.is_wall),
            geom=view(found.geom),
            dist=view(found.dist),
            dim=view(found.dim),
            efc_address=view(found.efc_address),
            force=view(data.efc.force),
            beside=device.constant(beside.astype(np.int64)),
            out=device.constant(np.zeros((_BESIDE + len(beside), self._count))),
        )

    def add(self, step: int, last: int) -> None:
        """Adds a physics step; the first begins a control step, the last ends it."""
        given = self._added._replace(step=step, last=last)
        self._device.launch(add, self._count, NONE, given)

    def read(self) -> Totals:
        """The totals on the host."""
        out = self._device.host(self._added.out)
        return Totals(out[:_FORCES], out[_DIVERGED], out[_LOST], out[_BESIDE:].T)
