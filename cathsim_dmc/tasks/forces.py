"""Forces between device and wall, as functions of the contact sensor's readings."""

import dataclasses

import numpy as np

# Layout of one contact in the sensor's row: found, force, dist, pos, normal, tangent.
# The order is MuJoCo's own, whatever the order in the model file.
_CONTACT_SIZE = 1 + 3 + 1 + 3 + 3 + 3


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
        slots = row.reshape(*row.shape[:-1], -1, _CONTACT_SIZE)
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
    slots = row.reshape(*row.shape[:-1], -1, _CONTACT_SIZE)
    occupied = min(int(slots[..., 0, 0].max()), slots.shape[-2])
    force = slots[..., :occupied, 1:4]
    return np.sqrt(np.einsum("...i,...i->...", force, force))


@dataclasses.dataclass(frozen=True)
class WallForce:
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


def wall_force(magnitude: np.ndarray) -> WallForce:
    """Summarises the contact magnitudes (..., S, M) of S substeps, in N."""
    if not magnitude.shape[-1]:
        return WallForce(*np.zeros((4, *magnitude.shape[:-2])))
    # One contact after the other: numpy's pairwise sum along the last axis would depend
    # on the number of empty places, and so on what other simulations touch.
    total = np.ascontiguousarray(np.moveaxis(magnitude, -1, 0)).sum(0)
    largest = magnitude.max(-1)
    return WallForce(
        sum=total[..., -1],
        max=largest[..., -1],
        peak_sum=total.max(-1),
        peak_max=largest.max(-1),
    )
