"""Armature of the hinges, which sets the mass scale of the contact solver."""

import numpy as np

from cathsim_dmc.entities.coaxial import moved_mass
from cathsim_dmc.entities.device import Device

# Largest rotor inertia of a hinge, kg·m²: the stiffness of the rigid wall is 1.2 to
# 3.2 kN/m for steerable_5f with it (`physics.wall.rigid_stiffness`).
LARGEST = 1e-6
# A free end of this length, m, has a first mode with a period T, which the armature
# lengthens to T (1 + `_SLOWED`)^½: the first frequency is 9 % too low at most.
FREE_END = 0.12
_SLOWED = 0.21


def hinge_armatures(device: Device, lengths: np.ndarray) -> np.ndarray:
    """Rotor inertia (n - 1,) of the hinges of a device alone, kg·m².

    With the armature I at a hinge of stiffness k, a mode of the angular frequency ω has
    1/ω'² = 1/ω² + I/k (Dunkerley), so I = `_SLOWED` k / ω².

    Args:
        device: The device, in blood.
        lengths: (n,), lengths of the links from proximal to distal, m.
    """
    ends = np.cumsum(lengths)
    middles, hinges = ends - lengths / 2, ends[:-1]
    in_tip = ends[-1] - middles < device.tip_length
    tip, shaft = device.tip.bending_stiffness, device.shaft.bending_stiffness
    half = lengths / 2 / np.where(in_tip, tip, shaft)
    compliances = half[:-1] + half[1:]
    # Rayleigh's quotient of the free end, with its deflection under its own weight.
    free = hinges > ends[-1] - FREE_END
    arms = np.maximum(middles - hinges[free, None], 0.0)
    masses = moved_mass([device]) * lengths
    bent = arms.T @ (compliances[free] * (arms @ masses))
    square = (masses @ bent) / (masses @ bent**2)
    return np.minimum(LARGEST, _SLOWED / (square * compliances))
