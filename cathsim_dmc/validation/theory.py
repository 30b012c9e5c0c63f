"""Closed forms for slender rods: elastica, column, twist and belt friction.

A rod is a sequence of uniform sections, from the clamp to the free end, given by
their lengths (m) and bending stiffnesses EI (N·m²). SI units throughout.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import brentq
from scipy.special import ellipe, ellipeinc, ellipk, ellipkinc


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


def elastica_by_elliptic_integrals(
    length: float, stiffness: float, end_angle: float
) -> tuple[float, np.ndarray]:
    """Force and end (2,), axial and transverse, of a uniform cantilever's elastica.

    With k² = (1 + sin α)/2 and sin φ = 1/(k√2): L√(F/EI) = K(k) - F(φ, k), the
    deflection is L - 2√(EI/F) (E(k) - E(φ, k)) and the axial place √(2 EI sin α / F)
    (Bisshopp and Drucker, Quart. Appl. Math. 3 (1945) 272).
    """
    parameter = (1 + np.sin(end_angle)) / 2
    amplitude = np.arcsin(1 / np.sqrt(2 * parameter))
    number = ellipk(parameter) - ellipkinc(amplitude, parameter)
    force = stiffness * (number / length) ** 2
    scale = np.sqrt(stiffness / force)
    deflection = length - 2 * scale * (
        ellipe(parameter) - ellipeinc(amplitude, parameter)
    )
    return float(force), np.array([scale * np.sqrt(2 * np.sin(end_angle)), deflection])


def buckling_load(
    lengths: Sequence[float] | np.ndarray,
    stiffnesses: Sequence[float] | np.ndarray,
    *,
    end: str = "sliding",
) -> float:
    """Lowest critical axial load (N) of a stepped column, clamped at its start.

    The end keeps its direction. "sliding": it is free to move sideways (effective
    length L, π²EI/L² if uniform); "fixed": it is not (L/2, 4π²EI/L²). From the
    transfer matrices of EI w'''' + P w'' = 0 (Timoshenko and Gere, Theory of Elastic
    Stability, ch. 2).
    """
    rows = {"sliding": (1, 3), "fixed": (0, 1)}
    if end not in rows:
        raise ValueError(f"end is {end!r}; allowed are {', '.join(rows)}")
    total = float(np.sum(lengths))
    scale = float(np.max(stiffnesses)) / total**2

    def determinant(load):
        # Deflection, slope, moment and transverse force, scaled to order one.
        matrix = np.eye(4)
        for length, stiffness in zip(lengths, stiffnesses, strict=True):
            matrix = _column(length / total, stiffness / scale / total**2, load) @ (
                matrix
            )
        # Clamped: only moment and transverse force are free at the start.
        return np.linalg.det(matrix[np.ix_(rows[end], (2, 3))])

    # The stiffest section alone bounds the load by 4π² of these units.
    loads = np.linspace(1e-3, 60, 6001)
    values = np.array([determinant(load) for load in loads])
    index = int(np.flatnonzero(np.sign(values[1:]) != np.sign(values[:-1]))[0])
    return brentq(determinant, loads[index], loads[index + 1]) * scale


def _column(length: float, stiffness: float, load: float) -> np.ndarray:
    """Transfer matrix of a uniform column; V is the force normal to the *line* of load.

    w' = θ, EI θ' = M, M' = V - Pθ, V' = 0.
    """
    k = np.sqrt(load / stiffness)
    c, s = np.cos(k * length), np.sin(k * length)
    return np.array(
        [
            [1, s / k, (1 - c) / load, (length - s / k) / load],
            [0, c, s / (k * stiffness), (1 - c) / load],
            [0, -k * stiffness * s, c, s / k],
            [0, 0, 0, 1],
        ]
    )


def twist(torque: float, lengths, torsional_stiffnesses) -> float:
    """Twist angle (rad) Σ T l / GJ of a stepped shaft under an end torque (N·m)."""
    return float(
        torque * np.sum(np.asarray(lengths) / np.asarray(torsional_stiffnesses))
    )


def capstan_ratio(friction: float, angle: float) -> float:
    """Tension ratio exp(μθ) of a belt that slides round a drum (Euler-Eytelwein)."""
    return float(np.exp(friction * angle))
