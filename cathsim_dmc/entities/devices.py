"""Endovascular devices: what a catheter or guidewire is made of, in SI units."""

import dataclasses
import math
import warnings

import numpy as np

from cathsim_dmc import bounds

_MOST_LINKS = 200
FRENCH = 1e-3 / 3.0  # m of outer diameter per French
INCH = 25.4e-3  # m

POLYMER_DENSITY = 1100.0  # kg/m^3, braided polyamide or Pebax shaft
NITINOL_DENSITY = 6450.0  # kg/m^3
POLYMER_POISSON_RATIO = 0.4
METAL_POISSON_RATIO = 0.33


@dataclasses.dataclass(frozen=True)
class Section:
    """A stretch of uniform rod.

    Attributes:
      bending_stiffness: EI in N·m².
      torsional_stiffness: GJ in N·m².
    """

    bending_stiffness: float
    torsional_stiffness: float

    def __post_init__(self):
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            try:
                bounds.number(field.name, value, positive=True)
            except ValueError as error:
                raise ValueError(f"{error}, in N·m² (1 N·mm² = 1e-6 N·m²)") from error

    @classmethod
    def isotropic(cls, bending_stiffness: float, poisson_ratio: float) -> "Section":
        """A round section of one isotropic material: GJ = EI / (1 + ν)."""
        return cls(bending_stiffness, bending_stiffness / (1 + poisson_ratio))


@dataclasses.dataclass(frozen=True)
class Arc:
    """A circular arc of a pre-shaped tip.

    Attributes:
      radius: radius of curvature of the centreline, m.
      angle: turning angle, rad; the sign is the side to which it turns.
    """

    radius: float
    angle: float

    def __post_init__(self):
        bounds.number("radius", self.radius, positive=True)
        bounds.number("angle", self.angle)

    @property
    def length(self) -> float:
        """Length along the centreline, m."""
        return abs(self.radius * self.angle)


@dataclasses.dataclass(frozen=True)
class Device:
    """A catheter or guidewire.

    Attributes:
      name: key in `DEVICES`.
      outer_radius: m.
      linear_density: mass per length, kg/m.
      shaft: section proximal of the tip.
      tip: section of the distal `tip_length`.
      tip_length: m.
      tip_links: rigid links that the tip is divided into.
      steering_angle: largest angle that the motor of one tip joint bends it by
        when nothing else loads it, rad. 0 makes a passive device without motors.
      tip_shape: arcs of the unloaded shape, from proximal to distal; they end at
        the distal end and bend in the local x-z plane.
    """

    name: str
    outer_radius: float
    linear_density: float
    shaft: Section
    tip: Section
    tip_length: float = 0.07
    tip_links: int = 10
    steering_angle: float = 0.0
    tip_shape: tuple[Arc, ...] = ()

    def __post_init__(self):
        bounds.instance("name", self.name, str)
        of_device = f"of device {self.name!r}"
        for name in ("outer_radius", "linear_density", "tip_length"):
            bounds.number(f"{name} {of_device}", getattr(self, name), positive=True)
        bounds.whole(f"tip_links {of_device}", self.tip_links, 1, _MOST_LINKS)
        for name in ("shaft", "tip"):
            bounds.instance(f"{name} {of_device}", getattr(self, name), Section)
        arcs = self.tip_shape
        if not isinstance(arcs, tuple) or not all(isinstance(a, Arc) for a in arcs):
            bounds.refuse(f"tip_shape {of_device}", arcs, "a tuple of Arc")
        angle = f"steering_angle {of_device}"
        if bounds.number(angle, self.steering_angle, 0.0) >= math.pi / 2:
            bounds.refuse(angle, self.steering_angle, "in [0, π/2) rad for each joint")

    @property
    def steerable(self) -> bool:
        """Whether the joints of the tip carry motors."""
        return self.steering_angle > 0

    @property
    def axial_stiffness(self) -> float:
        """EA of the shaft in N, as of a solid round rod: EA = 4 EI / r²."""
        return 4 * self.shaft.bending_stiffness / self.outer_radius**2

    def rest_angle(self, start: float, stop: float) -> float:
        """Turning angle of the unloaded shape between two places.

        Args:
          start: distance from the distal end, m.
          stop: distance from the distal end, m, at most `start`.

        Returns:
          The angle in rad that the centreline turns by from `start` to `stop`.
        """
        total, distal = 0.0, 0.0
        for arc in reversed(self.tip_shape):
            proximal = distal + arc.length
            overlap = min(start, proximal) - max(stop, distal)
            if overlap > 0:
                total += math.copysign(overlap / arc.radius, arc.angle)
            distal = proximal
        return total


def _tube_density(outer: float, inner: float, density: float) -> float:
    return density * math.pi * (outer**2 - inner**2)


def _polymer(bending_stiffness: float) -> Section:
    return Section.isotropic(bending_stiffness, POLYMER_POISSON_RATIO)


def _metal(bending_stiffness: float) -> Section:
    return Section.isotropic(bending_stiffness, METAL_POISSON_RATIO)


# The device of the registered tasks: the published discretisation of the tip (ten links
# over 7 cm, 20 motors) on a 5F body. The published stiffness equals a rod stiffer than
# any metal, so real ones take its place: a shaft between the body of a steerable 4F
# tube (22.7 N·mm²) and an Amplatz wire (291 N·mm²), and that body's own figure for the
# steerable part.
STEERABLE_5F = Device(
    name="steerable_5f",
    outer_radius=5 * FRENCH / 2,
    linear_density=_tube_density(5 * FRENCH / 2, 0.5e-3, POLYMER_DENSITY),
    shaft=_polymer(50e-6),
    tip=_polymer(22.7e-6),
    steering_angle=0.3,
)

# A 1.33 mm / 0.8 mm steerable tube: 22.7 N·mm² body, 2.8 N·mm² tip.
STEERABLE_4F = Device(
    name="steerable_4f",
    outer_radius=1.33e-3 / 2,
    linear_density=_tube_density(1.33e-3 / 2, 0.8e-3 / 2, POLYMER_DENSITY),
    shaft=_polymer(22.7e-6),
    tip=_polymer(2.8e-6),
    steering_angle=0.3,
)

# J tip: an arc of 12.1 mm over 72 degrees.
DIAGNOSTIC_5F_J = Device(
    name="diagnostic_5f_j",
    outer_radius=5 * FRENCH / 2,
    linear_density=_tube_density(5 * FRENCH / 2, 0.5e-3, POLYMER_DENSITY),
    shaft=_polymer(50e-6),
    tip=_polymer(22.7e-6),
    tip_shape=(Arc(12.1e-3, math.radians(72)),),
)

# Simmons: arcs of 20, 20, 6 and 10 mm at -70, 20, 185 and -2 degrees up to the tip.
DIAGNOSTIC_5F_SIMMONS = dataclasses.replace(
    DIAGNOSTIC_5F_J,
    name="diagnostic_5f_simmons",
    tip_links=14,
    tip_shape=(
        Arc(20e-3, math.radians(-70)),
        Arc(20e-3, math.radians(20)),
        Arc(6e-3, math.radians(185)),
        Arc(10e-3, math.radians(-2)),
    ),
)


def _guidewire(name: str, shaft: float) -> Device:
    radius = 0.035 * INCH / 2
    return Device(
        name=name,
        outer_radius=radius,
        linear_density=_tube_density(radius, 0.0, NITINOL_DENSITY),
        shaft=_metal(shaft),
        # Floppy ends are an order of magnitude softer than their shafts.
        tip=_metal(shaft / 10),
        tip_shape=(Arc(12.1e-3, math.radians(72)),),
    )


# Flexural moduli of 0.035 inch shafts: Harrison et al. 2011.
WIRE_035_AMPLATZ = _guidewire("wire_035_amplatz", 291e-6)
WIRE_035_HEAVY_DUTY = _guidewire("wire_035_heavy_duty", 400e-6)
WIRE_035_EXTRA_STIFF = _guidewire("wire_035_extra_stiff", 895e-6)
WIRE_035_SUPER_STIFF = _guidewire("wire_035_super_stiff", 1850e-6)
WIRE_035_LUNDERQUIST = _guidewire("wire_035_lunderquist", 4860e-6)

DEVICES: dict[str, Device] = {
    device.name: device
    for device in (
        STEERABLE_5F,
        STEERABLE_4F,
        DIAGNOSTIC_5F_J,
        DIAGNOSTIC_5F_SIMMONS,
        WIRE_035_AMPLATZ,
        WIRE_035_HEAVY_DUTY,
        WIRE_035_EXTRA_STIFF,
        WIRE_035_SUPER_STIFF,
        WIRE_035_LUNDERQUIST,
    )
}


# Names that devices had before; runs and scripts that were made then say them.
FORMER_NAMES = {"published": "steerable_5f"}
PUBLISHED = STEERABLE_5F


def get(device: "str | Device") -> Device:
    """Returns a device by name; a `Device` is returned as it is.

    Raises:
      ValueError: if no device has that name.
    """
    if isinstance(device, Device):
        return device
    if isinstance(device, str) and device in FORMER_NAMES:
        name = FORMER_NAMES[device]
        warnings.warn(
            f"device {device!r} is called {name!r} now: only the layout of its tip is "
            "that of the publication",
            FutureWarning,
            stacklevel=2,
        )
        device = name
    if not isinstance(device, str) or device not in DEVICES:
        raise ValueError(
            f"no device is named {device!r}; known devices: {', '.join(DEVICES)}"
        )
    return DEVICES[device]


@dataclasses.dataclass(frozen=True)
class Discretisation:
    """How a device is divided into rigid links.

    Attributes:
      working_length: length of the simulated distal part, m.
      shaft_link: longest link of the shaft, m. The default is what the convergence
        study in docs/validation.md supports.
      torsion_joints: hinges about the device's axis, evenly spread along the shaft.
        0 makes the shaft torsionally rigid.
    """

    working_length: float = 0.35
    shaft_link: float = 0.0175
    torsion_joints: int = 0

    def __post_init__(self):
        for name in ("working_length", "shaft_link"):
            bounds.number(name, getattr(self, name), positive=True)
        bounds.whole("torsion_joints", self.torsion_joints, 0)

    def link_lengths(self, device: Device) -> np.ndarray:
        """Lengths (n,) of the links from proximal to distal, m."""
        shaft_length = self.working_length - device.tip_length
        if shaft_length <= 0:
            raise ValueError(
                f"working_length is {self.working_length} m, but the tip of "
                f"{device.name!r} alone takes {device.tip_length} m"
            )
        shaft = math.ceil(round(shaft_length / self.shaft_link, 6))
        return np.concatenate(
            [
                np.full(shaft, shaft_length / shaft),
                np.full(device.tip_links, device.tip_length / device.tip_links),
            ]
        )
