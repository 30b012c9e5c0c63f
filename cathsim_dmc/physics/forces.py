"""Forces between device and wall, as functions of the contact sensor's readings."""

import dataclasses
from typing import NamedTuple

import numpy as np

# Layout of one contact in the sensor's row: found, force, dist, pos, normal, tangent.
# The order is MuJoCo's own, whatever the order in the model file.
CONTACT_SIZE = 1 + 3 + 1 + 3 + 3 + 3

# Note shown with every peak force.
PEAK_NOTE = "Peaks depend on the physics step: compare them at equal steps only."

# A control step is too coarse if one of its physics steps begins with a contact harder,
# N, or deeper, m, than this, or if it ends deeper: a device has snapped across the
# lumen.
HARDEST = 5.0
DEEPEST = 0.3e-3
# The control step is then repeated with physics steps shorter by this factor; a power
# of two divides exactly.
REFINEMENT = 8


@dataclasses.dataclass(frozen=True, eq=False)
class Contacts:
    """Contacts of the device with the wall; K rows, of which some are empty.

    World frame, SI units, float64. Empty rows are zeros. A contact with a concave wall
    may be two rows, each with about half of the load.

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
        slots = row.reshape((*row.shape[:-1], -1, CONTACT_SIZE))
        found, local = slots[..., 0], slots[..., 1:4]
        present = found > 0
        normal, tangent = slots[..., 8:11], slots[..., 11:14]
        force = local[..., 0:1] * normal + local[..., 1:2] * tangent
        force += local[..., 2:3] * np.cross(normal, tangent)
        return cls(
            present=present,
            force=-force,
            magnitude=np.sqrt((local**2).sum(-1)),
            position=slots[..., 5:8].copy(),
            penetration=np.where(present, -slots[..., 4], 0.0),
            found=found.max(-1, initial=0.0),
        )


class WallForce(NamedTuple):
    """Magnitudes of the force on the wall over one control step, N, never negative.

    The means correspond to a load cell that is read at 25 Hz. Reward terms, `safe
    success`, the observation `force` and the expert use them, because they hardly
    depend on the time step.

    Attributes:
        sum: (...), sum of the magnitudes of all contacts, last physics step.
        max: (...), largest single contact, last physics step; a concave wall may have
            two contacts at one place.
        peak_sum: (...), largest sum of any physics step of the control step; it depends
            on the time step, see `PEAK_NOTE`.
        peak_max: (...), largest single contact of any physics step; likewise.
        mean_sum: (...), mean over the physics steps of the sum over all contacts; `sum`
            before the first control step.
        mean_max: (...), mean over the physics steps of the largest single contact.
    """

    sum: np.ndarray
    max: np.ndarray
    peak_sum: np.ndarray
    peak_max: np.ndarray
    mean_sum: np.ndarray
    mean_max: np.ndarray

    def named(self) -> dict[str, np.ndarray]:
        """The forces by their names in logs and records, `NAMES`."""
        return dict(zip(NAMES, self, strict=True))


NAMES = tuple(f"wall_force_{name}" for name in WallForce._fields)


def wall_force(rows: np.ndarray) -> tuple[WallForce, np.ndarray]:
    """Summarises the rows of the sensor over a control step.

    Args:
        rows: (N, S, K * 14) of S physics steps and K contacts.

    Returns:
        Forces, arrays (N,), and the depth (N,) of the deepest contact, m.
    """
    from cathsim_dmc.physics import forces_loops  # late, as numba takes long

    found = forces_loops.summed(rows, CONTACT_SIZE)
    return WallForce._make(found[:6]), found[6]
