"""Units and frames of scans."""

from __future__ import annotations

import numpy as np

UNITS = {"mm": 1e-3, "cm": 1e-2, "m": 1.0}  # metres per unit
# 3D Slicer wrote numbers before it wrote names.
_SYSTEMS = {"LPS": 1.0, "1": 1.0, "RAS": -1.0, "0": -1.0}
_AXES = {
    "L": (1, 0, 0),
    "R": (-1, 0, 0),
    "P": (0, 1, 0),
    "A": (0, -1, 0),
    "S": (0, 0, 1),
    "I": (0, 0, -1),
}


def metres_per(units: str) -> float:
    """Metres per unit of length; ValueError lists the units."""
    try:
        return UNITS[units]
    except (KeyError, TypeError):
        raise ValueError(
            f"units are {units!r}; give one of {', '.join(UNITS)}."
        ) from None


def frame_sign(frame: str) -> np.ndarray:
    """Factors (3,) that take a point of ``frame`` ("LPS" or "RAS") to LPS."""
    try:
        sign = _SYSTEMS[str(frame)]
    except KeyError:
        raise ValueError(
            f"coordinate system is {frame!r}; give 'LPS' or 'RAS'."
        ) from None
    return np.array([sign, sign, 1.0])


def upright(axes: str | None) -> np.ndarray:
    """Rotation (3, 3) that takes points of a turned scan to LPS.

    Args:
        axes: where the scan's +x, +y and +z point in the patient, three of the letters
            L, R (left, right), A, P (front, back), S, I (head, feet): "ILA" says that
            +x points to the feet, +y to the left and +z to the front. None and "LPS"
            leave points as they are.

    Raises:
        ValueError: if it is no such triple, or one that mirrors the patient.
    """
    if axes is None:
        return np.eye(3)
    letters = str(axes).upper()
    if len(letters) != 3 or not set(letters) <= set(_AXES):
        raise ValueError(
            f"axes are {axes!r}; give three letters of L, R, A, P, S and I, where +x, "
            "+y and +z of the scan point, such as 'ILA'."
        )
    turn = np.array([_AXES[letter] for letter in letters], dtype=float).T
    if abs(np.linalg.det(turn)) < 0.5:
        raise ValueError(f"axes {axes!r} name one direction twice; give all three.")
    if np.linalg.det(turn) < 0.0:
        raise ValueError(
            f"axes {axes!r} mirror the patient; check the directions (LPS and RAS do "
            "not)."
        )
    return turn
