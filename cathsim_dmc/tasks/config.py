"""Options of a navigation task."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, cast

from cathsim_dmc.entities import devices
from cathsim_dmc.entities.contact import FRICTION
from cathsim_dmc.imaging.options import FluoroscopyOptions
from cathsim_dmc.tasks.cameras import CameraOptions
from cathsim_dmc.tasks.variations import Randomisation

PHYSICS_TIMESTEP = 0.004  # s
CONTROL_TIMESTEP = 0.04  # s, one frame of fluoroscopy
MAX_STEPS = 2000  # published


@dataclasses.dataclass(frozen=True)
class NavigationConfig:
    """Options of a navigation task; scene and objective come beside them.

    Attributes:
      observation: name or names in `observations.OBSERVATIONS`.
      device: name in `devices.DEVICES`, or a device.
      rotation: whether the action has a rotation of the base.
      max_steps: control steps until truncation.
      friction: Coulomb coefficient of device on wall.
      shaft_link: longest link of the shaft, m.
      torsion_joints: torsion hinges along the shaft; None for 4 with rotation and a
        torsionally rigid shaft without.
      working_length: simulated length of the device, m; None for what the goal needs.
      physics_timestep: s.
      fluoroscopy: `imaging.FluoroscopyOptions` of the image observations, or a
        mapping of its fields.
      cameras: `cameras.CameraOptions` of `rgb` and `depth`, or a mapping.
      randomisation: `variations.Randomisation`, a mapping of its fields, True for
        `variations.DEFAULT_RANGES`, False for none.
    """

    observation: str | Sequence[str] = "internal"
    device: str | devices.Device = "published"
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
        if self.max_steps < 1:
            raise ValueError(f"max_steps is {self.max_steps}; at least 1")
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


def _options(name: str, kind: type, value: Mapping[str, Any]):
    known = [field.name for field in dataclasses.fields(kind)]
    if not isinstance(value, Mapping) or set(value) - set(known):
        raise ValueError(
            f"{name} is {value!r}; give a mapping with some of {', '.join(known)}"
        )
    return kind(**value)
