"""Options of a navigation task."""

import dataclasses
import numbers
from collections.abc import Mapping, Sequence
from typing import Any, cast

import numpy as np

from cathsim_dmc.entities import devices
from cathsim_dmc.entities.contact import FRICTION
from cathsim_dmc.imaging.options import FluoroscopyOptions
from cathsim_dmc.tasks.cameras import CameraOptions
from cathsim_dmc.tasks.variations import Randomisation

PHYSICS_TIMESTEP = 0.004  # s
CONTROL_TIMESTEP = 0.04  # s, one frame of fluoroscopy
MAX_STEPS = 2000  # published
# A link shorter than its own radius is no rod; one longer than a vessel is wide does
# not follow its bends.
_LEAST_LINK, _LONGEST_LINK = 2e-3, 0.1  # m
# Composer does the last two of them itself.
_FEWEST_SUBSTEPS, _MOST_SUBSTEPS = 2, 1000


@dataclasses.dataclass(frozen=True)
class NavigationConfig:
    """Options of a navigation task; scene and objective come beside them.

    Attributes:
      observation: Name or names of observations, see `observations.OBSERVATIONS`.
      device: Name of a device in `devices.DEVICES`, or a device.
      rotation: Whether the action has a rotation of the base.
      max_steps: Number of control steps until the episode is truncated.
      friction: Coulomb coefficient of device on wall.
      shaft_link: Length of the longest link of the shaft, m.
      torsion_joints: Number of torsion hinges along the shaft; None for 4 with
        rotation and a torsionally rigid shaft without.
      working_length: Simulated length of the device, m; None for the length that all
        registered tasks share, or what the goal needs if that is more.
      physics_timestep: Time of a physics step, s; a control step is a whole number
        of them.
      fluoroscopy: Set-up of the image observations: `imaging.FluoroscopyOptions`, or
        a mapping of its fields.
      cameras: Cameras of `rgb` and `depth`: `cameras.CameraOptions`, or a mapping.
      randomisation: What differs from episode to episode: `variations.Randomisation`,
        a mapping of its fields, True for `variations.DEFAULT_RANGES`, False for none.
    """

    observation: str | Sequence[str] = "internal"
    device: str | devices.Device = "steerable_5f"
    rotation: bool = False
    max_steps: int = MAX_STEPS
    friction: float = FRICTION
    shaft_link: float = 0.0175
    torsion_joints: int | None = None
    working_length: float | None = None
    physics_timestep: float = PHYSICS_TIMESTEP
    fluoroscopy: FluoroscopyOptions | Mapping[str, Any] = FluoroscopyOptions()
    cameras: CameraOptions | Mapping[str, Any] = CameraOptions()
    randomisation: Randomisation | Mapping[str, Any] | bool = False

    def __post_init__(self):
        self._check_numbers()
        kinds = {"fluoroscopy": FluoroscopyOptions, "cameras": CameraOptions}
        for name, kind in kinds.items():
            value = getattr(self, name)
            if not isinstance(value, kind):
                object.__setattr__(self, name, _options(name, kind, value))
        object.__setattr__(
            self, "randomisation", Randomisation.make(self.randomisation)
        )

    # Three fields with the types that they have once the config is made.

    @property
    def ranges(self) -> Randomisation:
        """`randomisation`, whatever it was given as."""
        return cast(Randomisation, self.randomisation)

    @property
    def fluoroscopy_options(self) -> FluoroscopyOptions:
        """`fluoroscopy`, whatever it was given as."""
        return cast(FluoroscopyOptions, self.fluoroscopy)

    @property
    def camera_options(self) -> CameraOptions:
        """`cameras`, whatever they were given as."""
        return cast(CameraOptions, self.cameras)

    def _check_numbers(self):
        def require(name: str, good: bool, allowed: str):
            if not good:
                given = getattr(self, name)
                raise ValueError(f"{name} is {given!r}; it must be {allowed}")

        require("rotation", isinstance(self.rotation, bool), "True or False")
        steps = self.max_steps
        require("max_steps", _whole(steps) and steps >= 1, "an integer, at least 1")
        torsion = self.torsion_joints
        require(
            "torsion_joints",
            torsion is None or (_whole(torsion) and torsion >= 0),
            "an integer, at least 0, or None",
        )
        for name in ("friction", "shaft_link", "working_length", "physics_timestep"):
            value = getattr(self, name)
            good = value is None and name == "working_length"
            if isinstance(value, int | float) and not isinstance(value, bool):
                good = bool(np.isfinite(value))
            require(name, good, "a positive, finite number")
        require("friction", 0 <= self.friction <= 2, "between 0 and 2")
        require(
            "shaft_link",
            _LEAST_LINK <= self.shaft_link <= _LONGEST_LINK,
            f"positive, from {_LEAST_LINK:g} to {_LONGEST_LINK:g} m",
        )
        substeps = (
            CONTROL_TIMESTEP / self.physics_timestep if self.physics_timestep else 0
        )
        require(
            "physics_timestep",
            self.physics_timestep > 0
            and _FEWEST_SUBSTEPS <= round(substeps) <= _MOST_SUBSTEPS
            and abs(substeps - round(substeps)) < 1e-6,
            f"a whole part of the control step of {CONTROL_TIMESTEP:g} s, from "
            f"{_FEWEST_SUBSTEPS} to {_MOST_SUBSTEPS} physics steps each",
        )


def _whole(value: Any) -> bool:
    return isinstance(value, numbers.Integral) and not isinstance(value, bool)


def _options(name: str, kind: type, value: Mapping[str, Any]):
    known = [field.name for field in dataclasses.fields(kind)]
    if not isinstance(value, Mapping) or set(value) - set(known):
        raise ValueError(
            f"{name} is {value!r}; give a mapping with some of {', '.join(known)}"
        )
    return kind(**value)
