"""Units and frames of scans."""

from __future__ import annotations

import re

import numpy as np
from numpy.typing import ArrayLike

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

_NEITHER = (
    "axes are {!r}; give three letters of L, R, A, P, S and I, where +x, +y and +z of "
    "the scan point, such as 'ILA', or nine numbers: the patient's left, back and head "
    "as directions in the scan."
)
_OFF = 0.05  # most by which directions given by numbers may differ from a rotation


def metres_per(units: str) -> float:
    """Metres per unit of length; ValueError lists the units."""
    try:
        return UNITS[units]
    except (KeyError, TypeError):
        raise ValueError(
            f"units are {units!r}; give one of {', '.join(UNITS)}."
        ) from None


def in_mm(point: np.ndarray) -> str:
    """A place (3,) m as text, in whole millimetres."""
    return "(" + ", ".join(f"{x * 1e3:.0f}" for x in point) + ") mm"


def frame_sign(frame: str) -> np.ndarray:
    """Factors (3,) that take a point of ``frame`` ("LPS" or "RAS") to LPS."""
    try:
        sign = _SYSTEMS[str(frame)]
    except KeyError:
        raise ValueError(
            f"coordinate system is {frame!r}; give 'LPS' or 'RAS'."
        ) from None
    return np.array([sign, sign, 1.0])


def upright(axes: str | ArrayLike | None) -> np.ndarray:
    """Rotation (3, 3) that takes points of a turned scan to LPS.

    Args:
        axes: three letters, where the scan's +x, +y and +z point in the patient: "ILA"
            says that +x points to the feet, +y to the left and +z to the front (L, R
            left, right; A, P front, back; S, I head, feet). Or nine numbers (3, 3),
            also as text: the patient's left, back and head as directions in the scan.
            None and "LPS" leave points as they are.

    Raises:
        ValueError: if it is neither, or mirrors the patient.
    """
    if axes is None:
        return np.eye(3)
    if isinstance(axes, str) and not re.search(r"\d", axes):
        letters = axes.upper()
        if len(letters) != 3 or not set(letters) <= set(_AXES):
            raise ValueError(_NEITHER.format(axes))
        turn = np.array([_AXES[letter] for letter in letters], dtype=float).T
        if abs(np.linalg.det(turn)) < 0.5:
            raise ValueError(f"axes {axes!r} name one direction twice; give all three.")
    else:
        try:
            text = isinstance(axes, str)
            numbers = re.split(r"[\s,;]+", axes.strip()) if text else axes
            given = np.array(numbers, dtype=float).reshape(3, 3)
            given /= np.linalg.norm(given, axis=1, keepdims=True)
            left, _, right = np.linalg.svd(given)
            turn = left @ right  # the nearest rotation
        except (ValueError, TypeError, np.linalg.LinAlgError):
            raise ValueError(_NEITHER.format(axes)) from None
        if not np.abs(turn - given).max() < _OFF:
            raise ValueError(
                f"axes {axes!r} are not at right angles; give the patient's left, back "
                "and head as three perpendicular directions of the scan."
            )
    if np.linalg.det(turn) < 0.0:
        raise ValueError(
            f"axes {axes!r} mirror the patient; check the directions (LPS and RAS do "
            "not)."
        )
    return turn
