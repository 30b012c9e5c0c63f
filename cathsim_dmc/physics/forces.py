"""Forces between device and wall, as functions of the contact sensor's readings."""

import dataclasses
from typing import NamedTuple

import numpy as np

# Layout of one contact in the sensor's row: found, force, dist, pos, normal, tangent.
# The order is MuJoCo's own, whatever the order in the model file.
CONTACT_SIZE = 1 + 3 + 1 + 3 + 3 + 3

# A physics step was too long if it ends with a contact harder, N, or deeper, m, than
# this: something crossed the lumen in it and hit the wall. Deeper than its radius, the
# device is pushed out of the pieces of the wall on whatever side is nearest.
HARDEST = 5.0
DEEPEST = 0.6e-3
# The control step is then done again with steps so many times shorter; a power of two,
# which divides exactly.
REFINEMENT = 4


def _slots(row: np.ndarray) -> np.ndarray:
    """The sensor's row (..., K * 14) contact by contact (..., K, 14)."""
    places = row.shape[-1] // CONTACT_SIZE
    return row.reshape(*row.shape[:-1], places, CONTACT_SIZE)


@dataclasses.dataclass(frozen=True)
class Contacts:
    """Contacts of the device with the wall; K places, of which some are empty.

    World frame, SI units, float64. Empty places hold zeros.

    Attributes:
        present: (..., K) bool.
        force: (..., K, 3), N, force of the device on the wall.
        magnitude: (..., K), N, norm of normal and friction force together.
        position: (..., K, 3), m.
        penetration: (..., K), m, depth of the device in the wall; 0 where empty.
        found: (...), number of contacts, which exceeds K if the sensor overflowed.
    """

    present: np.ndarray
    force: np.ndarray
    magnitude: np.ndarray
    position: np.ndarray
    penetration: np.ndarray
    found: np.ndarray

    @classmethod
    def from_sensor(cls, row: np.ndarray) -> "Contacts":
        """Reads the sensor's row (..., K * 14) as `entities.phantom` declares it."""
        slots = _slots(row)
        found = slots[..., 0]
        present = found > 0
        normal, tangent = slots[..., 8:11], slots[..., 11:14]
        local = slots[..., 1:4]
        force = (
            local[..., 0:1] * normal
            + local[..., 1:2] * tangent
            + local[..., 2:3] * np.cross(normal, tangent)
        )
        return cls(
            present=present,
            force=-force,
            magnitude=np.sqrt((local**2).sum(-1)),
            position=slots[..., 5:8].copy(),
            penetration=np.where(present, -slots[..., 4], 0.0),
            found=found.max(-1, initial=0.0),
        )


def magnitudes(row: np.ndarray) -> np.ndarray:
    """Contact force magnitudes in N from the sensor's row (..., K * 14).

    Returns:
        (..., M) with M <= K, the most contacts of any row: the sensor fills its places
        from the first, and most are empty.
    """
    slots = _slots(row)
    occupied = min(int(slots[..., 0, 0].max()), slots.shape[-2])
    force = slots[..., :occupied, 1:4]
    return np.sqrt(np.vecdot(force, force))


def distances(rows: np.ndarray) -> np.ndarray:
    """Distances (..., K) m of the contacts in rows (..., K * 14), 0 where empty."""
    # Without `_slots`, which copies long rows that are not contiguous.
    return rows[..., 4::CONTACT_SIZE]


def pressing_work(rows: np.ndarray) -> np.ndarray:
    """Work (...) J that has pressed springs in, ½ Σ f r, from rows (..., K * 14)."""
    normal, depth = rows[..., 1::CONTACT_SIZE], -distances(rows)
    return 0.5 * (normal * np.maximum(depth, 0.0)).sum(axis=-1)


def too_coarse(
    magnitude: np.ndarray, rows: np.ndarray, deepest: float | None = None
) -> np.ndarray:
    """Whether control steps need shorter physics steps.

    Args:
        magnitude: (..., S, M), N, of the contacts in S physics steps.
        rows: (..., S, K * 14) of the sensor, with K >= M.
        deepest: m; None for `DEEPEST`.

    Returns:
        (...) bool: some contact is harder than `HARDEST` or deeper than `deepest`.
    """
    distance = distances(rows)[..., : magnitude.shape[-1]]
    wrong = magnitude > HARDEST
    wrong |= distance < -(DEEPEST if deepest is None else deepest)
    return np.logical_or.reduce(wrong, axis=(-2, -1))


class ContactHistory:
    """Contacts in each physics step of a control step, without the empty places.

    A row of the sensor is long and mostly empty; copying it after every physics step
    would take as long as a tenth of a free one.
    """

    def __init__(self, steps: int, places: int):
        """Starts empty, for `steps` physics steps and a row of `places` numbers."""
        self._rows = np.zeros((steps, places))
        self._width = 0

    def clear(self) -> None:
        """Begins a control step, without contacts."""
        if self._width:
            self._rows[:, : self._width] = 0.0
            self._width = 0

    def keep(self, step: int, row: np.ndarray) -> None:
        """Keeps the sensor's row (K * 14,) of the physics step just done."""
        found = row[0]
        if found:
            width = min(int(found) * CONTACT_SIZE, len(row))
            self._rows[step, :width] = row[:width]
            self._width = max(self._width, width)

    @property
    def rows(self) -> np.ndarray:
        """Rows (S, M * 14) of the S physics steps, of the M places used."""
        return self._rows[:, : self._width]


class WallForce(NamedTuple):
    """Force on the wall over one control step, N.

    Attributes:
        sum: (...), sum of the magnitudes of all contacts, last substep.
        max: (...), largest single contact, last substep.
        peak_sum: (...), largest sum of any substep of the control step.
        peak_max: (...), largest single contact of any substep.
    """

    sum: np.ndarray
    max: np.ndarray
    peak_sum: np.ndarray
    peak_max: np.ndarray


NO_FORCE = WallForce(*(np.zeros(()) for _ in WallForce._fields))


def wall_force(magnitude: np.ndarray) -> WallForce:
    """Summarises the contact magnitudes (..., S, M) of S substeps, in N."""
    if not magnitude.shape[-1]:
        shape = magnitude.shape[:-2]
        return WallForce(
            np.zeros(shape), np.zeros(shape), np.zeros(shape), np.zeros(shape)
        )
    # One contact after the other: numpy's pairwise sum along the last axis would depend
    # on the number of empty places, and so on what other simulations touch.
    total = magnitude.cumsum(-1)[..., -1]
    largest = magnitude.max(-1)
    return WallForce(
        sum=total[..., -1],
        max=largest[..., -1],
        peak_sum=total.max(-1),
        peak_max=largest.max(-1),
    )
