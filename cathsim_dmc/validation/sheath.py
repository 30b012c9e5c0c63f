"""Device in a sheath: compliance beyond the mouth, force at the base."""

from collections.abc import Iterator

import numpy as np

from cathsim_dmc.entities import devices
from cathsim_dmc.entities.chain import MAX_PUSH_SPEED
from cathsim_dmc.entities.posture import joints_along
from cathsim_dmc.entities.sheath import Sheath
from cathsim_dmc.physics.held import Held
from cathsim_dmc.physics.readings import ids
from cathsim_dmc.physics.stepper import CONTROL_TIMESTEP
from cathsim_dmc.validation.checks import Check
from cathsim_dmc.validation.rig import Rig

FREE = np.arange(0.03, 0.101, 0.01)  # m of the device beyond the mouth
COMPLIANCE_BOUND = 5.0  # % of the deflection
SPEEDS = (0.0, 0.01, 0.04)  # m/s
PULL, ASIDE = 0.1, 2e-3  # N on the head, along the sheath and lateral
FORCE_BOUND = 2.0  # % of the pull
_LENGTH, _STROKE = 0.3, 0.13  # m
_BENT = 0.05  # deflection relative to the free length
_START, _WAY = 0.04, 0.06  # m: length beyond the mouth, and travel from there
_RESTING = 2.0  # s


class _Guided:
    """A device in a sheath; its length beyond the mouth is the insertion."""

    def __init__(self, line: np.ndarray | None):
        """Holds the device by its hinges, or in a bore along a line (n, 3), m."""
        division = devices.Discretisation(_LENGTH)
        self.rig = rig = Rig("steerable_5f", division, stroke=_STROKE, straight=True)
        if line is not None:
            radius, longest = rig.device.outer_radius, float(rig.lengths.max())
            rig.arena.attach(Sheath(line, radius, longest))
        rig.compile()
        bends = ids(rig.model, rig.catheter.bends)
        places = rig.model.jnt_qposadr[bends].reshape(-1, 2)
        self._held, self._line = Held(rig.model, rig.catheter, places), line

    def put(self, insertion: float) -> None:
        """Places the device along the line at an insertion, m."""
        self.rig.data.qpos[:] = self.rig.data.qvel[:] = 0.0
        self.rig.data.joint(f"{self.rig.name}/insertion").qpos = insertion
        if self._line is not None:
            ahead = self._line[-1] - self._line[-2]
            ahead *= 2 * _STROKE / np.linalg.norm(ahead)
            line = np.vstack([self._line, self._line[-1] + ahead])
            self.rig.bend(joints_along(self.rig.lengths, line, insertion))
        self.rig.hold(insertion)
        self.hold()

    def hold(self) -> None:
        """Holds the links that are in the sheath."""
        if self._line is None:
            self._held.hold(self.rig.model, 0.0, self.rig.qpos("insertion"))


def deflection(free: float, bore: np.ndarray | None = None) -> tuple[float, float]:
    """Deflection of the head under a lateral force, and that of a clamped rod, m.

    Args:
        free: Length of the device beyond the mouth, m.
        bore: Line (n, 3) of a bore, m; None for a straight sheath that holds hinges.
    """
    guided = _Guided(bore)
    rig = guided.rig
    guided.put(free)
    lengths, stiffness, _ = rig.sections
    ends = free - (np.append(0.0, np.cumsum(lengths[::-1]))).clip(max=free)
    # Compliance of the clamped rod by the distance from the head: ∫ t² / EI dt.
    parts = ((free - ends[1:]) ** 3 - (free - ends[:-1]) ** 3) / (3 * stiffness[::-1])
    force = _BENT * free / parts.sum()
    places = []
    for way in (1.0, -1.0):  # both ways, so that the play cancels
        rig.settle((way * force, 0.0, 0.0), change=1e-5, longest=60.0)
        places.append(rig.head_position[0])
    return float(places[0] - places[1]) / 2, _BENT * free


def base_force(speed: float, bore: np.ndarray | None = None) -> float:
    """Axial force at the base, N, while the head is pulled by `PULL` and `ASIDE`.

    Args:
        speed: Speed of the base, m/s; 0 for rest.
        bore: See `deflection`; the pull is along its end.
    """
    guided = _Guided(bore)
    rig, found = guided.rig, []
    guided.put(_START)
    axis = np.array([0.0, 0.0, 1.0]) if bore is None else bore[-1] - bore[-2]
    axis /= np.linalg.norm(axis)
    force = PULL * axis + ASIDE * np.cross([0.0, 1.0, 0.0], axis)
    duration = _WAY / speed if speed else _RESTING
    for step in range(-25, round(duration / CONTROL_TIMESTEP)):
        rig.drive([speed / MAX_PUSH_SPEED if step >= 0 else 0.0])
        guided.hold()
        for _ in range(round(CONTROL_TIMESTEP / rig.model.opt.timestep)):
            rig.step(force)
            if step >= 5:
                found.append(rig.sensor(f"{rig.name}/push_force")[2])
    return float(np.mean(found))


def checks() -> Iterator[Check]:
    """Checks of the compliance beyond the mouth and of the force at the base."""
    for free in FREE:
        found, expected = deflection(free)
        name = f"sheath, {1e3 * free:.0f} mm beyond its mouth: deflection"
        note = f"{1e3 * found:.3f} mm, clamped {1e3 * expected:.3f} mm"
        yield Check.deviation(name, found, expected, COMPLIANCE_BOUND, "m", note)
    for speed in SPEEDS:
        how = f"at {1e3 * speed:g} mm/s" if speed else "at rest"
        name = f"sheath, head pulled by {PULL:g} N, base {how}: force at the base"
        force = base_force(speed)
        yield Check.deviation(name, force, -PULL, FORCE_BOUND, "N")
