"""Option `vessel` of a task: flow of blood, compliance and motion of the wall."""

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from cathsim_dmc import bounds
from cathsim_dmc.anatomy import Anatomy
from cathsim_dmc.physics import forces
from cathsim_dmc.physics.blood import StillBlood
from cathsim_dmc.physics.effects import Effect
from cathsim_dmc.physics.flow import Flow, FlowOptions
from cathsim_dmc.physics.motion import OF_HEART, MotionOptions, Moving
from cathsim_dmc.physics.readings import Readings
from cathsim_dmc.physics.wall import STIFFENING, Wall, WallOptions

PRESETS: dict[str, dict[str, Any]] = {
    "rigid": {},
    "silicone": {"wall": {"modulus": 0.52e6, "thickness": 1.5e-3}},
    "living": {"flow": True, "wall": True, "motion": True},
}


# Names of the figures of a living vessel.
INFO = ("heart_phase", "breath_phase", "blood_speed", "indentation", "wall_work")


class VesselReadings(NamedTuple):
    """State of the vessels of N simulations at the end of a control step.

    Attributes:
        heart_phase: (N,), phase of the pulse at the heart, 0 to 1.
        breath_phase: (N,), 0 to 1; 0 is the end of expiration.
        blood_velocity: (N, 3), at the head, m/s, world frame.
        indentation: (N,), indentation of the wall under the deepest contact, m.
        wall_work: (N,), ½ Σ f r over the contacts with normal force f and depth r, the
            work of the indentation, J.
    """

    heart_phase: np.ndarray
    breath_phase: np.ndarray
    blood_velocity: np.ndarray
    indentation: np.ndarray
    wall_work: np.ndarray

    def info(self) -> dict[str, np.ndarray]:
        """Figures (N,) by the names in `INFO`, for `tasks.step.Step.info`."""
        speed = np.sqrt((self.blood_velocity**2).sum(axis=-1))
        phases = self.heart_phase, self.breath_phase
        values = *phases, speed, self.indentation, self.wall_work
        return dict(zip(INFO, values, strict=True))


def read(
    effects: Sequence[Effect], time: np.ndarray, state: Readings, rows: np.ndarray
) -> VesselReadings:
    """State of living vessels at times (N,), s.

    Args:
        effects: Effects of the task.
        rows: (N, M * 14), rows of the wall's sensor.
    """
    from cathsim_dmc.physics import forces_loops  # late, as numba takes long

    deepest, work = forces_loops.pressed(rows, forces.CONTACT_SIZE)
    phases = {name: np.zeros(len(time)) for name in INFO[:2]}
    for effect in effects:
        if isinstance(effect, Moving):
            phases |= zip(INFO[:2], effect.phases(), strict=True)
        if isinstance(effect, Flow):
            phases |= effect.read(time, state)
    return VesselReadings(**phases, indentation=deepest, wall_work=work)


@dataclasses.dataclass(frozen=True)
class VesselOptions:
    """Flow, compliance and motion options of a vessel; None for none.

    Each is given as such options, as a mapping of their fields, or as True for the
    defaults.

    Attributes:
        flow: `FlowOptions` of the blood.
        wall: `WallOptions` of a compliant wall.
        motion: `MotionOptions` of the vessel.
    """

    # These fields accept what `__post_init__` converts to an object of options.
    flow: Any = None
    wall: Any = None
    motion: Any = None

    def __post_init__(self):
        vars(self).update({name: _part(name, getattr(self, name)) for name in _KINDS})
        for name in OF_HEART if self.flow and self.motion else ():
            value = getattr(self.motion, name)
            if value is not None:
                raise ValueError(
                    f"vessel motion: {name} is {value}, and the flow has a heart of "
                    f"its own; give {name} of the flow alone"
                )

    @classmethod
    def make(cls, value: Any) -> "VesselOptions":
        """Builds it from a preset's name or a mapping; ValueError if invalid."""
        if isinstance(value, VesselOptions):
            return value
        named = f"one of {', '.join(PRESETS)}, or "
        if isinstance(value, str) and value in PRESETS:
            value = PRESETS[value]
        return cls(**bounds.mapping("vessel", value, _KINDS, named))

    @property
    def living(self) -> bool:
        """Whether the vessel has a flow, a compliant wall or a motion."""
        return any(part is not None for part in (self.flow, self.wall, self.motion))

    def effects(self) -> tuple[StillBlood, list[Effect]]:
        """Returns the effect of the blood, and those of the wall."""
        if not self.living:
            return StillBlood(), []
        moving = None if self.motion is None else Moving(self.motion)
        blood, walls = Flow(self.flow, moving), list[Effect]()
        if self.wall is not None:
            walls.append(Wall(self.wall, blood))
        if moving is not None:
            moving.flow = None if self.flow is None else blood
            walls.append(moving)
        return blood, walls

    @property
    def deepest(self) -> float | None:
        """Contact depth above which steps are repeated, m; None for the default."""
        return None if self.wall is None else STIFFENING

    def check(self, anatomy: Anatomy) -> None:
        """Raises ValueError if an anatomy does not support the options."""
        if self.flow is not None:
            anatomy.circulation.check(anatomy.name, anatomy.tree, anatomy.ends)
        if self.motion is not None:
            self.motion.check(anatomy)


_KINDS = {"flow": FlowOptions, "wall": WallOptions, "motion": MotionOptions}


def _part(name: str, value: Any) -> Any:
    """Options of a part: None and False for none, True for the defaults."""
    kind = _KINDS[name]
    if isinstance(value, bool) or value is None:
        return kind() if value else None
    return bounds.made(f"vessel {name}", value, kind, "True, False, or ")
