"""Compiled loop over the contacts of control steps; see `forces`."""

import math

import numpy as np

from cathsim_dmc.collision.native import fused
from cathsim_dmc.compiled import compiled


@compiled
def summed(rows, size):
    """The arrays (N,) of `forces.WallForce`, and the depth of the deepest contact.

    Args:
        rows: (N, S, K * size), rows of the sensor, filled from the first contact on.
        size: numbers of a contact.

    Returns:
        (7, N).
    """
    found, steps = np.zeros((7, len(rows))), rows.shape[1]
    for i in range(len(rows)):
        for step in range(steps):
            total, largest = 0.0, 0.0
            for place in range(0, rows.shape[2], size):
                contact = rows[i, step, place : place + size]
                if contact[0] == 0.0:
                    break
                x, y, z = contact[1], contact[2], contact[3]
                force = math.sqrt(fused(z, z, fused(y, y, x * x)))
                total += force
                largest = higher(force, largest)
                found[6, i] = max(found[6, i], -contact[4])
            found[0, i], found[1, i] = total, largest
            found[2, i] = higher(total, found[2, i])
            found[3, i] = higher(largest, found[3, i])
            found[4, i] += total / steps
            found[5, i] += largest / steps
    return found


@compiled
def pressed(rows, size):
    """Depth of the deepest contact, m, and the work ½ Σ f r of all, J: (2, N).

    Args:
        rows: (N, K * size), rows of the sensor.
        size: numbers of a contact.
    """
    found = np.zeros((2, len(rows)))
    for i in range(len(rows)):
        for place in range(0, rows.shape[1], size):
            depth = max(-rows[i, place + 4], 0.0)
            found[0, i] = max(found[0, i], depth)
            found[1, i] += 0.5 * rows[i, place + 1] * depth
    return found


@compiled
def higher(one, other):
    """The larger of two numbers; NaN if one of them is."""
    return one if one > other or math.isnan(one) else other
