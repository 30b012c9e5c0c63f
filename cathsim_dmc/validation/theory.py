"""Closed forms for slender rods: elastica, column and twist.

A rod is a sequence of uniform sections, from the clamp to the free end, given by
their lengths (m) and bending stiffnesses EI (N·m²). SI units throughout.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from cathsim_dmc.entities.device import Device


class Elastica(NamedTuple):
    """Shape of a clamped rod under a dead transverse force at its free end.

    Attributes:
        force: N.
        position: (n, 2), axial and transverse place from the clamp to the end, m.
        angle: (n,), of the tangent against the clamp's, rad.
    """

    force: float
    position: np.ndarray
    angle: np.ndarray


def elastica(
    lengths: Sequence[float] | np.ndarray,
    stiffnesses: Sequence[float] | np.ndarray,
    end_angle: float,
) -> Elastica:
    """The elastica of a stepped cantilever that ends at `end_angle` (rad).

    The equation is EI θ'' = -F cos θ with θ = 0 at the clamp and θ' = 0 at the end
    (Love, A Treatise on the Mathematical Theory of Elasticity, ch. XIX). It is
    integrated from the end to the clamp; the force is the one that meets the clamp.

    Raises:
        ValueError: if the end angle is not inside (0, π/2).
    """
    if not 0 < end_angle < np.pi / 2:
        raise ValueError(f"end_angle is {end_angle} rad; it must be inside (0, π/2)")
    sections = list(zip(lengths, stiffnesses, strict=True))[::-1]
    compliance = _tip_compliance(lengths, stiffnesses)

    def shape(force):
        # θ, M and the place relative to the end, along t, the way from the end.
        state = np.array([end_angle, 0.0, 0.0, 0.0])
        rows = [state]
        for length, stiffness in sections:

            def slope(t, y, stiffness=stiffness):
                theta, moment = y[:2]
                cos, sin = np.cos(theta), np.sin(theta)
                return -moment / stiffness, force * cos, -cos, -sin

            solution = solve_ivp(
                slope,
                (0.0, length),
                state,
                rtol=1e-10,
                atol=1e-12,
                t_eval=np.linspace(0.0, length, 41),
            )
            state = solution.y[:, -1]
            rows.extend(solution.y.T[1:])
        return np.array(rows[::-1])

    # The small-deflection slope is F Σ∫(L - s)/EI ds; the real one is less.
    low = end_angle / compliance
    force = brentq(lambda f: shape(f)[0, 0], 0.5 * low, 20 * low, xtol=1e-12 * low)
    rows = shape(force)
    return Elastica(force, rows[:, 2:] - rows[0, 2:], rows[:, 0])


def _tip_compliance(lengths, stiffnesses) -> float:
    """Slope at the end per transverse force in the linear theory, rad/N."""
    total, beyond = 0.0, 0.0
    for length, stiffness in list(zip(lengths, stiffnesses, strict=True))[::-1]:
        total += ((beyond + length) ** 2 - beyond**2) / (2 * stiffness)
        beyond += length
    return total


def buckling_load(length: float, stiffness: float, end: str = "sliding") -> float:
    """Euler's load (N) of a uniform column of EI (N·m²), clamped at its start.

    The end keeps its direction. "sliding": it is free to move sideways (π²EI/L²);
    "fixed": it is not (4π²EI/L²).
    """
    factors = {"sliding": 1, "fixed": 4}
    if end not in factors:
        raise ValueError(f"end is {end!r}; allowed are {', '.join(factors)}")
    return factors[end] * np.pi**2 * stiffness / length**2


def twist(torque: float, lengths, torsional_stiffnesses) -> float:
    """Twist angle (rad) Σ T l / GJ of a stepped shaft under an end torque (N·m)."""
    return float(
        torque * np.sum(np.asarray(lengths) / np.asarray(torsional_stiffnesses))
    )


def profile(device: Device, places: np.ndarray) -> tuple[np.ndarray, ...]:
    """EI, GJ and curvature at places (n,) from the device's end, 0 beyond it."""
    there, tip = places >= 0, places < device.tip_length
    parts = [
        there * np.where(tip, getattr(device.tip, name), getattr(device.shaft, name))
        for name in ("bending_stiffness", "torsional_stiffness")
    ]
    curvature, start = np.zeros(len(places)), 0.0
    for arc in reversed(device.tip_shape):
        inside = (places >= start) & (places < start + arc.length)
        curvature[inside] = np.copysign(1 / arc.radius, arc.angle)
        start += arc.length
    return (*parts, curvature)
