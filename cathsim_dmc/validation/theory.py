"""Theory of slender rods: elastica, and EI along coaxial devices."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from cathsim_dmc.entities.device import Device


class Elastica(NamedTuple):
    """Shape of a clamped rod under a dead transverse force at its free end."""

    force: float  # N
    position: np.ndarray  # (n, 2), axial and transverse coordinates from the clamp, m


def elastica(lengths: ArrayLike, stiffnesses: ArrayLike, end_angle: float) -> Elastica:
    """The elastica of a stepped cantilever that ends at `end_angle` (0 to π/2 rad).

    The equation is EI θ'' = -F cos θ with θ = 0 at the clamp and θ' = 0 at the end
    (Love, A Treatise on the Mathematical Theory of Elasticity, ch. XIX). It is
    integrated from the end to the clamp, and the force is found by shooting.

    Args:
        lengths: (S,) lengths of uniform sections from the clamp to the free end, m.
        stiffnesses: (S,) bending stiffness EI of the sections, N·m².
    """
    lengths, stiffnesses = np.asarray(lengths)[::-1], np.asarray(stiffnesses)[::-1]

    def shape(force):
        # θ, M and the position relative to the end, by the arc length t from the end.
        rows = [np.array([end_angle, 0.0, 0.0, 0.0])]
        for length, stiffness in zip(lengths, stiffnesses, strict=True):

            def slope(t, y, stiffness=stiffness):
                cos, sin = np.cos(y[0]), np.sin(y[0])
                return -y[1] / stiffness, force * cos, -cos, -sin

            t, limits = np.linspace(0.0, length, 41), {"rtol": 1e-10, "atol": 1e-12}
            solved = solve_ivp(slope, (0.0, length), rows[-1], t_eval=t, **limits)
            rows.extend(solved.y.T[1:])
        return np.array(rows[::-1])

    # The small-deflection slope is F Σ∫(L - s)/EI ds; the real one is less.
    from_end = np.append(0.0, np.cumsum(lengths))
    low = end_angle / (np.diff(from_end**2) / (2 * stiffnesses)).sum()
    force = brentq(lambda f: shape(f)[0, 0], 0.5 * low, 20 * low, xtol=1e-12 * low)
    rows = shape(force)
    return Elastica(force, rows[:, 2:] - rows[0, 2:])


def profile(
    devices: Sequence[Device], gaps: ArrayLike, places: np.ndarray
) -> np.ndarray:
    """EI, GJ (N·m²) and curvature (1/m), (3, K, n), of coaxial devices; 0 beyond ends.

    Args:
        devices: K devices, which are not rotated.
        gaps: (K,) distances from their ends to that of the chain, m.
        places: (n,) distances from the end of the chain, m.
    """
    found = np.zeros((3, len(devices), len(places)))
    for k, (device, gap) in enumerate(zip(devices, np.asarray(gaps), strict=True)):
        place, start = places - gap, 0.0
        tip = place < device.tip_length
        for row, name in enumerate(("bending_stiffness", "torsional_stiffness")):
            own = np.where(tip, getattr(device.tip, name), getattr(device.shaft, name))
            found[row, k] = (place >= 0) * own
        for arc in reversed(device.tip_shape):
            inside = (place >= start) & (place < start + arc.length)
            found[2, k, inside] = np.copysign(1 / arc.radius, arc.angle)
            start += arc.length
    return found
