"""The option `vessel` of a task: blood that flows, a wall that gives and moves."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from cathsim_dmc import bounds
from cathsim_dmc.anatomy import Anatomy
from cathsim_dmc.physics.blood import StillBlood
from cathsim_dmc.physics.effects import Effect
from cathsim_dmc.physics.flow import Flow, FlowOptions
from cathsim_dmc.physics.readings import Readings

PRESETS: dict[str, dict[str, Any]] = {"rigid": {}, "living": {"flow": True}}


INFO = ("heart_phase", "blood_speed")  # of a vessel that lives


class VesselReadings(NamedTuple):
    """State of the vessels of N simulations at the end of a control step.

    Attributes:
        heart_phase: (N,), 0 to 1, at the heart.
        blood_velocity: (N, 3), at the head, m/s, world frame.
    """

    heart_phase: np.ndarray
    blood_velocity: np.ndarray

    def info(self) -> dict[str, np.ndarray]:
        """Figures (N,) for `tasks.step.Step.info`, of `INFO`."""
        speed = np.sqrt((self.blood_velocity**2).sum(axis=-1))
        return {"heart_phase": self.heart_phase, "blood_speed": speed}


def read(
    effects: Sequence[Effect], time: np.ndarray, state: Readings
) -> VesselReadings | None:
    """State of the vessels at times (N,) s; None where none of them lives."""
    found: dict[str, np.ndarray] = {}
    for effect in effects:
        if isinstance(effect, Flow):
            found |= effect.read(time, state)
    return VesselReadings(**found) if found else None


@dataclasses.dataclass(frozen=True)
class VesselOptions:
    """What a vessel does; None for nothing.

    Attributes:
        flow: Options of the flow of blood.
    """

    flow: FlowOptions | None = None

    @classmethod
    def make(cls, value: Any) -> VesselOptions:
        """From a task's option: the name of a preset, or a mapping of its parts.

        Raises:
            ValueError: if it is neither, or a part is wrong.
        """
        if isinstance(value, VesselOptions):
            return value
        if isinstance(value, str):
            value = PRESETS[bounds.choice("vessel", value, PRESETS)]
        if not isinstance(value, Mapping):
            names = ", ".join(field.name for field in dataclasses.fields(cls))
            bounds.refuse(
                "vessel", value, f"one of {', '.join(PRESETS)}, or a mapping of {names}"
            )
        bounds.mapping("vessel", value, _KINDS)
        return cls(**{name: _part(name, part) for name, part in value.items()})

    @property
    def living(self) -> bool:
        """Whether there is anything to observe of it."""
        return self.flow is not None

    @property
    def blood(self) -> StillBlood:
        """The effect of the blood."""
        return StillBlood() if self.flow is None else Flow(self.flow)

    def check(self, anatomy: Anatomy) -> None:
        """Raises ValueError if an anatomy cannot do what the options ask for."""
        if self.flow is not None:
            anatomy.circulation  # noqa: B018


_KINDS = {"flow": FlowOptions}


def _part(name: str, value: Any) -> Any:
    """Options of a part: None and False for none, True for the defaults."""
    kind = _KINDS[name]
    if value is None or value is False or isinstance(value, kind):
        return value or None
    if value is True:
        return kind()
    known = [field.name for field in dataclasses.fields(kind)]
    if not isinstance(value, Mapping):
        bounds.refuse(
            f"vessel {name}", value, f"True, False, or some of {', '.join(known)}"
        )
    bounds.mapping(f"vessel {name}", value, known)
    try:
        return kind(**value)
    except ValueError as error:
        raise ValueError(f"vessel {name}: {error}") from error
