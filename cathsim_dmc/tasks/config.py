"""Options of a navigation task."""

import dataclasses
import warnings
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from cathsim_dmc import bounds
from cathsim_dmc.entities.arena import SOLVER_TOLERANCE
from cathsim_dmc.entities.chain import Chain
from cathsim_dmc.entities.contact import FRICTION, MOST_FRICTION
from cathsim_dmc.entities.device import LONGEST, Device
from cathsim_dmc.entities.device_stack import LEAD, LUMEN_FRICTION
from cathsim_dmc.imaging.options import FluoroscopyOptions
from cathsim_dmc.physics.effect_checks import check_declared
from cathsim_dmc.physics.effects import Effect, copied
from cathsim_dmc.physics.held import Released
from cathsim_dmc.physics.randomisation import (
    ActionDelay,
    Randomisation,
    RandomisedModel,
)
from cathsim_dmc.physics.sliding import devices_of
from cathsim_dmc.physics.stepper import CONTROL_TIMESTEP, PHYSICS_TIMESTEP
from cathsim_dmc.physics.vessel import VesselOptions
from cathsim_dmc.tasks.cameras import CameraOptions

MAX_STEPS = 2000  # published
EVALUATION_SEED = 1_000_000  # of the first episode; apart from those of training
WORKING_LENGTHS = (0.02, LONGEST)  # m
_FRICTION = (0.0, MOST_FRICTION, "")  # Coulomb coefficient
# Allowed ranges (low, high, unit). A link of the shaft is longer than its radius and
# shorter than the diameter of a large vessel.
_NUMBERS = {
    "lead": (0.0, 0.3, "m"),
    "lumen_friction": _FRICTION,
    "friction": _FRICTION,
    "shaft_link": (2e-3, 0.1, "m"),
    "working_length": (*WORKING_LENGTHS, "m"),
    "sheath_clearance": (0.1e-3, 2e-3, "m"),
    "solver_tolerance": (1e-12, 1e-4, ""),
}
# Range in which the physics holds (docs/physics.md); the library stays within it.
_LONGEST_TIMESTEP = 5e-3  # s
_STIFFEST = 5e-3  # N·m², EI
# Least and largest number of physics steps in a control step.
_SUBSTEPS = (2, 1000)
_REPLACED = "device", "rotation"  # options that `devices` replaces


def refuse_replaced(given: Mapping[str, Any], devices: Any) -> None:
    """Raise ValueError if an option is given that coaxial devices replace."""
    for name in _REPLACED:
        if name in given:
            raise ValueError(
                f"{name} is {given[name]!r}, but devices is {devices!r}, which "
                "replaces it; leave one of the two out"
            )


@dataclasses.dataclass(frozen=True)
class NavigationConfig:
    """Options of a navigation task.

    Attributes:
        observation: Name or names of observations, see `observations.OBSERVATIONS`.
        device: Name of a device in `devices.DEVICES`, or a device.
        devices: Coaxial devices or their names, from the innermost outwards, in place
            of `device`; each has two actions, translation and rotation. None for
            `device`.
        lead: Length by which each coaxial device starts ahead of the next outer one, m.
        lumen_friction: Coulomb coefficient between coaxial devices.
        rotation: Whether the action has a rotation of the base.
        start_along_route: Range (low, high) of the fraction of the way from the usual
            start to the goal at which an episode starts, for curricula.
        max_steps: Number of control steps until the episode is truncated.
        give_up: Whether an episode ends without success when the memory of attempts
            (`tasks.retry`) gives up, as in a lumen too narrow for the device.
        friction: Coulomb coefficient between an uncoated device and the wall; that of a
            hydrophilic device is this times its `friction_ratio`. A `friction` of
            `randomisation` replaces it.
        shaft_link: Length of the longest link of the shaft, m.
        working_length: Simulated length of the device, m; None for the length that the
            goal requires. Shapes of observations do not depend on it.
        sheath_clearance: Radial clearance of the device in the bore of the sheath, m;
            None for a sheath that clamps the device on its axis
            (docs/sheath_and_drive.md).
        physics_timestep: Length of a physics step, s; it divides the control step.
        solver_tolerance: Relative improvement at which the solver of contacts stops;
            with 1e-8 devices at rest are steadier (docs/validation.md), for up to a
            seventh more time.
        outside_range: Whether a physics step above 5 ms or a device stiffer than 5000
            N·mm², for which the physics is not valid, gives a warning instead of an
            error.
        fluoroscopy: `imaging.options.FluoroscopyOptions`, or a mapping of its fields.
        endoluminal_size: Pixels along a side of endoluminal views, or (rows, columns).
        cameras: `cameras.CameraOptions` of `rgb` and `depth`, or a mapping of its
            fields.
        randomisation: Ranges that each episode draws from: True for
            `randomisation.DEFAULT_RANGES`, False for none, a
            `randomisation.Randomisation` or a mapping of its fields.
        effects: User-defined effects, see `physics.effects.Effect`.
        vessel: Name of a preset in `physics.vessel.PRESETS`, or a mapping of the fields
            of `physics.vessel.VesselOptions`.
    """

    observation: str | Sequence[str] = "internal"
    device: str | Device = "steerable_5f"
    devices: Sequence[str | Device] | None = None
    lead: float = LEAD
    lumen_friction: float = LUMEN_FRICTION
    rotation: bool = False
    start_along_route: Sequence[float] | None = None
    max_steps: int = MAX_STEPS
    give_up: bool = False
    friction: float = FRICTION
    shaft_link: float = 0.0175
    working_length: float | None = None
    sheath_clearance: float | None = None
    physics_timestep: float = PHYSICS_TIMESTEP
    solver_tolerance: float = SOLVER_TOLERANCE
    outside_range: bool = False
    # These fields accept what `__post_init__` converts to an object of options.
    fluoroscopy: Any = FluoroscopyOptions()
    endoluminal_size: Any = (128, 128)
    cameras: Any = CameraOptions()
    randomisation: Any = Randomisation()
    effects: Sequence[Effect] = ()
    vessel: Any = VesselOptions()

    def __post_init__(self):
        self._check_numbers()
        self._check_devices()
        self._check_range()
        vars(self).update(
            fluoroscopy=bounds.made(
                "fluoroscopy", self.fluoroscopy, FluoroscopyOptions
            ),
            endoluminal_size=bounds.pixels("endoluminal_size", self.endoluminal_size),
            cameras=bounds.made("cameras", self.cameras, CameraOptions),
            randomisation=Randomisation.make(self.randomisation),
            vessel=VesselOptions.make(self.vessel),
        )
        if self.start_along_route is not None and self.randomisation.start_insertion:
            raise ValueError(
                "start_along_route and randomisation start_insertion both say where an "
                "episode begins; leave one of the two out"
            )
        self._check_views()
        if not isinstance(self.effects, Sequence) or not all(
            isinstance(effect, Effect) for effect in self.effects
        ):
            allowed = "a list of objects of physics.effects.Effect, such as [Mine()]"
            bounds.refuse("effects", self.effects, allowed)
        for effect in self.effects:
            check_declared(effect)
        object.__setattr__(self, "effects", tuple(self.effects))

    def effects_on(self, chain: Chain) -> list[Effect]:
        """Returns new effects for one rollout, in the order in which they act."""
        own = [copied(effect) for effect in self.effects]
        delay = ActionDelay(self.randomisation.longest_delay)
        model = RandomisedModel(self.randomisation)
        blood, walls = self.vessel.effects()
        holds = self.sheath_clearance is None
        devices = devices_of(chain, holds=holds)
        released = [] if chain.coaxial else [Released()]
        if chain.coaxial or holds:
            _check_fields(own, devices, chain.coaxial)
        return [blood, *released, model, delay, *walls, *own, devices]

    def check_timesteps(self, control: float, physics: float) -> None:
        """Raise ValueError unless a task has the time steps, s, of its options."""
        if (control, physics) != (CONTROL_TIMESTEP, self.physics_timestep):
            raise ValueError(
                f"the task has a control step of {control:g} s and a physics step of "
                f"{physics:g} s; a control step lasts {CONTROL_TIMESTEP:g} s, and the "
                "option physics_timestep of suite.make_task sets the physics step"
            )

    def _check_devices(self):
        if self.devices is None:
            self._check_alone("devices")
            return
        named = isinstance(self.devices, Sequence) and not isinstance(self.devices, str)
        if not named or not self.devices:
            bounds.refuse(
                "devices",
                self.devices,
                "None, or a list of devices (names or objects of Device) from the "
                "innermost outwards, such as ['wire_035_glide', 'berenstein_5f']",
            )
        object.__setattr__(self, "devices", tuple(self.devices))
        if len(self.devices) == 1:
            self._check_alone("another device in devices")
        given = {name: getattr(self, name) for name in _REPLACED}
        changed = {n: v for n, v in given.items() if v != getattr(type(self), n)}
        refuse_replaced(changed, self.devices)

    def _check_alone(self, missing: str):
        """Raise ValueError if an option between coaxial devices is given for one."""
        for name in ("lead", "lumen_friction"):
            if getattr(self, name) != getattr(type(self), name):
                raise ValueError(
                    f"{name} is {getattr(self, name)!r}, which only several coaxial "
                    f"devices have; give {missing}, or leave it out"
                )

    def _check_numbers(self):
        required = {
            name: limits
            for name, limits in _NUMBERS.items()
            if getattr(self, name) is not None or getattr(type(self), name) is not None
        }
        bounds.fields(self, required)
        bounds.switch("rotation", self.rotation)
        bounds.switch("give_up", self.give_up)
        bounds.whole("max_steps", self.max_steps, 1, bounds.MOST_STEPS)
        if (shares := self.start_along_route) is not None:
            most = bounds.MOST_START_SHARE
            shares = bounds.interval("start_along_route", shares, 0.0, most)
            object.__setattr__(self, "start_along_route", shares)
        timestep = bounds.number("physics_timestep", self.physics_timestep)
        substeps, (least, most) = CONTROL_TIMESTEP / (timestep or np.inf), _SUBSTEPS
        within = least - 1e-6 <= substeps <= most + 1e-6
        if not within or abs(substeps - round(substeps)) >= 1e-6:
            bounds.refuse(
                "physics_timestep",
                self.physics_timestep,
                f"the control step of {CONTROL_TIMESTEP:g} s divided by a whole "
                f"number from {least} to {most}",
            )

    def _check_range(self):
        bounds.switch("outside_range", self.outside_range)
        faults = []
        if self.physics_timestep > _LONGEST_TIMESTEP * (1 + 1e-9):
            faults.append(
                f"physics_timestep is {self.physics_timestep:g} s, but the physics "
                f"holds up to {_LONGEST_TIMESTEP:g} s"
            )
        for device in (self.device, *(self.devices or ())):
            parts = (device.shaft, device.tip) if isinstance(device, Device) else ()
            ei = max((part.bending_stiffness for part in parts), default=0.0)
            if ei > _STIFFEST:
                faults.append(
                    f"device {getattr(device, 'name', device)!r} has an EI of {ei:g} "
                    f"N·m², but the physics holds up to {_STIFFEST:g} N·m²"
                )
        if faults and not self.outside_range:
            raise ValueError(f"{faults[0]}; outside_range=True overrides this check")
        for fault in faults:
            warnings.warn(fault, stacklevel=4)

    def _check_views(self):
        """Check that the C-arms exist at the largest deviations of the view."""
        view = self.randomisation.view
        ends = view if isinstance(view, Sequence) else (0.0,)
        for deviation in {round(end) for end in ends}:
            try:
                self.fluoroscopy.carms(np.zeros((1, 3)), (deviation, deviation))
            except ValueError as error:
                raise ValueError(
                    f"randomisation: view is {view!r}, but fluoroscopy has no view "
                    f"that deviates by {deviation} degrees: {error}"
                ) from error


def _check_fields(own: Sequence[Effect], devices: Effect, coaxial: bool) -> None:
    """Raise ValueError if an effect writes a field that the devices overwrite."""
    for effect in own:
        written = effect.model_fields if coaxial else effect.step_fields
        if lost := sorted({*written} & {*devices.step_fields}):
            when, instead = "in act", "write them in restart, where an episode begins"
            if coaxial:
                when = "of coaxial devices"
                instead = "take friction, devices, lumen_friction and randomisation"
            raise ValueError(
                f"{type(effect).__name__} writes {', '.join(lost)} {when}, a field "
                f"that the devices write in every control step; {instead}"
            )
