"""Units and frames of scans."""

import contextlib
import contextvars
import re
from collections.abc import Iterator

import numpy as np
from numpy.typing import ArrayLike

from cathsim_dmc import bounds

# Metres per unit.
UNITS = {"mm": 1e-3, "cm": 1e-2, "m": 1.0, "um": 1e-6, "inch": 25.4e-3}
_SYSTEMS = {"LPS": 1.0, "RAS": -1.0}
_AXES = dict(zip("LPSRAI", np.concatenate([np.eye(3), -np.eye(3)]), strict=True))
# Frame in which places are shown: matrix (3, 3) from there to m, LPS, its unit, and the
# enlargement of places and lengths.
_FILE: contextvars.ContextVar[tuple[np.ndarray, str, float]] = contextvars.ContextVar(
    "file", default=(1e-3 * np.eye(3), "mm", 1.0)
)
_OFF = 0.05  # largest difference of given directions from a rotation


def shown(point: np.ndarray) -> str:
    """A place (3,) m, LPS, as text: in mm, or in the frame of a `file_frame`."""
    matrix, unit, scale = _FILE.get()
    decimals = max(round(np.log10(UNITS[unit] / UNITS["mm"])), 0)
    numbers = np.linalg.solve(matrix, point) / scale
    return "(" + ", ".join(f"{x:.{decimals}f}" for x in numbers) + f") {unit}"


def mm(length: float | np.ndarray) -> float:
    """A length (m) in mm at the size of the patient; see `file_frame`."""
    return 1e3 * float(length) / _FILE.get()[2]


def enlargement() -> float:
    """Enlargement of places and lengths; see `file_frame`."""
    return _FILE.get()[2]


@contextlib.contextmanager
def file_frame(matrix: np.ndarray, unit: str, scale: float = 1.0) -> Iterator[None]:
    """Context in which `shown` uses the unit and frame of a file; see `to_lps`.

    Places and lengths given to `shown` and `mm` are enlarged by `scale`.
    """
    before = _FILE.set((matrix, unit, scale))
    try:
        yield
    finally:
        _FILE.reset(before)


@contextlib.contextmanager
def enlarged(scale: float) -> Iterator[None]:
    """Context with the same unit and frame and another enlargement `scale`."""
    matrix, unit, _ = _FILE.get()
    with file_frame(matrix, unit, scale):
        yield


def to_lps(
    units: str, frame: str = "LPS", axes: str | ArrayLike | None = None
) -> np.ndarray:
    """Matrix (3, 3) that takes points of a scan to metres in LPS.

    ValueError unless `units` is a key of `UNITS` and `frame` "LPS" or "RAS"; `axes`
    give the rotation of that frame in the patient, see `upright`.
    """
    scale = UNITS[bounds.choice("units", units, UNITS)]
    sign = _SYSTEMS[bounds.choice("mesh_frame", frame, _SYSTEMS)]
    return upright(axes) * (sign * scale, sign * scale, scale)


def upright(axes: str | ArrayLike | None) -> np.ndarray:
    """Rotation (3, 3) that takes points of a turned scan to LPS.

    Args:
        axes: three letters, where the scan's +x, +y and +z point in the patient: "ILA"
            says that +x points to the feet, +y to the left and +z to the front (L, R
            left, right; A, P front, back; S, I head, feet). Or nine numbers (3, 3),
            also as text: the patient's left, back and head as directions in the scan.
            ValueError if it is neither, or mirrors the patient.
    """
    if axes is None:
        return np.eye(3)
    try:
        if isinstance(axes, str) and not re.search(r"\d", axes):
            given = np.array([_AXES[letter] for letter in axes.upper()]).T
        else:
            text = isinstance(axes, str)
            given = re.split(r"[\s,;]+", axes.strip()) if text else axes
        given = np.array(given, dtype=float).reshape(3, 3)
        given /= np.maximum(np.linalg.norm(given, axis=1, keepdims=True), 1e-9)
        left, _, right = np.linalg.svd(given)
        turn = left @ right  # the nearest rotation
    except (ValueError, TypeError, KeyError, np.linalg.LinAlgError):
        raise ValueError(
            f"axes are {bounds.shown(axes)}; give three letters of L, R, A, P, S and "
            "I, where +x, +y and +z of the scan point, such as 'ILA', or nine numbers: "
            "the patient's left, back and head as directions in the scan."
        ) from None
    if not np.abs(turn - given).max() < _OFF or np.linalg.det(turn) < 0.0:
        raise ValueError(
            f"axes {bounds.shown(axes)} are not three directions at right angles, or "
            "mirror the patient (LPS and RAS do not); check them."
        )
    return turn
