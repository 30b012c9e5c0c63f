"""The library of endovascular devices, and their division into links."""

import dataclasses
import itertools
import math
from collections.abc import Sequence

import numpy as np

from cathsim_dmc import bounds
from cathsim_dmc.entities.device import LONGEST, Arc, Device, Section
from cathsim_dmc.imaging import materials

FRENCH = 1e-3 / 3.0  # m of outer diameter per French
INCH = 25.4e-3  # m

POLYMER_DENSITY = 1100.0  # kg/m^3, braided polyamide or Pebax shaft
NITINOL_DENSITY = 6450.0  # kg/m^3
NITINOL_MODULUS = 48e9  # Pa, austenite in bending
POLYURETHANE_DENSITY = 1200.0  # kg/m^3, jacket of a hydrophilic wire, unfilled
POLYMER_POISSON_RATIO = 0.4
METAL_POISSON_RATIO = 0.33
# Loss factors: loss moduli are 0.1 to 1 % of storage moduli in metals, 1 to 200 % in
# polymers (Gerdeen 2012, 10.1201/9781420056372). A metal shaft is a coil on a core, so
# the upper end; for polymers `Device.loss_factor`, within a factor of two.
METAL_LOSS = 0.01
# Friction of a hydrophilic coat relative to PTFE: these have a sixth and a half of the
# friction of bare steel (Schröder 1993).
HYDROPHILIC = 1 / 3


def _tube_density(outer: float, inner: float, density: float) -> float:
    return density * math.pi * (outer**2 - inner**2)


def _polymer(bending_stiffness: float) -> Section:
    return Section.isotropic(bending_stiffness, POLYMER_POISSON_RATIO)


def _metal(bending_stiffness: float) -> Section:
    return Section.isotropic(bending_stiffness, METAL_POISSON_RATIO)


# Sources of the devices below.
_HARRISON = (
    "EI: flexural modulus in three-point bending, Harrison et al. 2011, J Endovasc "
    "Ther 18:797-801, doi:10.1583/11-3592.1"
)
_STEERABLE_TUBE = (
    "EI: 22.7 and 2.8 N·mm² of body and tip of a 1.33/0.8 mm steerable tube "
    "(unpublished figure)"
)
_FIVE_FRENCH = (
    "EI: shaft between the body of steerable_4f (22.7 N·mm²) and an Amplatz wire "
    "(291), tip as that body; lumen 1.0 mm, for wires up to 0.038 inch"
)

# The device of the registered tasks: the published discretisation of the tip (ten links
# over 7 cm, 20 motors) on a 5F body. The published stiffness is that of a rod stiffer
# than any metal; that of real devices replaces it.
STEERABLE_5F = Device(
    name="steerable_5f",
    outer_radius=5 * FRENCH / 2,
    linear_density=_tube_density(5 * FRENCH / 2, 0.5e-3, POLYMER_DENSITY),
    shaft=_polymer(50e-6),
    tip=_polymer(22.7e-6),
    steering_angle=0.3,
    inner_radius=0.5e-3,
    source=_FIVE_FRENCH,
)

STEERABLE_4F = Device(
    name="steerable_4f",
    outer_radius=1.33e-3 / 2,
    linear_density=_tube_density(1.33e-3 / 2, 0.8e-3 / 2, POLYMER_DENSITY),
    shaft=_polymer(22.7e-6),
    tip=_polymer(2.8e-6),
    steering_angle=0.3,
    inner_radius=0.8e-3 / 2,
    source=_STEERABLE_TUBE,
)


def _straight(length: float) -> Arc:
    """A straight section, as an arc of a very large radius."""
    return Arc(1e3, length / 1e3)


def _shaped(name: str, source: str, *arcs: Arc, tip_links: int = 10) -> Device:
    """A 5F catheter without motors whose tip has a shape."""
    return dataclasses.replace(
        STEERABLE_5F,
        name=name,
        steering_angle=0.0,
        tip_shape=arcs,
        tip_links=tip_links,
        source=f"{_FIVE_FRENCH}; {source}",
    )


_OUTLINE = "one bend, as this type has; its size is assumed, to within 10° and 2 mm"
DIAGNOSTIC_5F_J = _shaped(
    "diagnostic_5f_j", "arc of 12.1 mm over 72°", Arc(12.1e-3, math.radians(72))
)
DIAGNOSTIC_5F_SIMMONS = _shaped(
    "diagnostic_5f_simmons",
    "arcs of 20, 20, 6 and 10 mm over -70°, 20°, 185° and -2°",
    Arc(20e-3, math.radians(-70)),
    Arc(20e-3, math.radians(20)),
    Arc(6e-3, math.radians(185)),
    Arc(10e-3, math.radians(-2)),
    tip_links=14,
)
# Catheters with a single bend near the end, steep and short or gentle and long: the
# first choice for carotids.
BERENSTEIN_5F = _shaped(
    "berenstein_5f",
    f"{_OUTLINE}: 60° over 8 mm, then 8 mm straight",
    Arc(8e-3, math.radians(60)),
    _straight(8e-3),
)
VERTEBRAL_5F = _shaped(
    "vertebral_5f",
    f"{_OUTLINE}: 45° over 14 mm, then 10 mm straight",
    Arc(18e-3, math.radians(45)),
    _straight(10e-3),
)

# Distal part of a 2.1F tube of 0.021 inch lumen: I = π (R⁴ - r⁴) / 4 = 7.9e-15 m⁴ of
# the diameters 0.70 and 0.53 mm (7.81e-15 m⁴ with 0.021 inch), of polyether block
# amides with the moduli of the data sheets of Pebax 5533 and 4033.
MICROCATHETER_021 = Device(
    name="microcatheter_021",
    outer_radius=2.1 * FRENCH / 2,
    linear_density=_tube_density(2.1 * FRENCH / 2, 0.021 * INCH / 2, POLYMER_DENSITY),
    shaft=_polymer(170e6 * 7.9e-15),
    tip=_polymer(77e6 * 7.9e-15),
    tip_length=0.05,
    tip_links=8,
    inner_radius=0.021 * INCH / 2,
    friction_ratio=HYDROPHILIC,
    source="EI: E I of a 0.70/0.53 mm tube, flexural moduli 170 and 77 MPa (data "
    "sheets of Pebax 5533 and 4033); friction: as a hydrophilic wire",
)


def _guidewire(name: str, shaft: float) -> Device:
    radius = 0.035 * INCH / 2
    return Device(
        name=name,
        outer_radius=radius,
        linear_density=_tube_density(radius, 0.0, NITINOL_DENSITY),
        shaft=_metal(shaft),
        # A floppy end is an order of magnitude softer than its shaft.
        tip=_metal(shaft / 10),
        tip_shape=(Arc(12.1e-3, math.radians(72)),),
        loss_factor=METAL_LOSS,
        attenuation=materials.STEEL_WIRE,
        marker_attenuation=materials.STEEL_WIRE,
        source=f"{_HARRISON}; tip: a tenth, assumed",
    )


WIRE_035_AMPLATZ = _guidewire("wire_035_amplatz", 291e-6)
WIRE_035_HEAVY_DUTY = _guidewire("wire_035_heavy_duty", 400e-6)
WIRE_035_EXTRA_STIFF = _guidewire("wire_035_extra_stiff", 895e-6)
WIRE_035_SUPER_STIFF = _guidewire("wire_035_super_stiff", 1850e-6)
WIRE_035_LUNDERQUIST = _guidewire("wire_035_lunderquist", 4860e-6)


def _core(diameter: float) -> float:
    return NITINOL_MODULUS * math.pi * diameter**4 / 64


# Length of the platinum coil at the end of a hydrophilic wire, m; assumed.
_COIL = 10e-3


def _hydrophilic_wire(
    name: str, outer: float, cores: tuple[float, float], bend: Arc, tip_links: int
) -> Device:
    """A jacketed wire with a nitinol core.

    Args:
        outer: outer diameter, m.
        cores: diameters of the core in shaft and tip, m.
        bend: bend of the tip, before 4 mm straight.
    """
    shaft, tip = cores
    jacket = _tube_density(outer / 2, shaft / 2, POLYURETHANE_DENSITY)
    core = _tube_density(shaft / 2, 0.0, NITINOL_DENSITY)
    return Device(
        name=name,
        outer_radius=outer / 2,
        linear_density=core + jacket,
        shaft=_metal(_core(shaft)),
        tip=_metal(_core(tip)),
        tip_length=0.03,
        tip_links=tip_links,
        tip_shape=(bend, _straight(4e-3)),
        loss_factor=METAL_LOSS,
        friction_ratio=HYDROPHILIC,
        attenuation=materials.NITINOL_WIRE * (shaft / outer) ** 2,
        marker_attenuation=materials.MARKER,
        marker_length=_COIL,
        source=f"EI: nitinol core (48 GPa) of {1e3 * shaft:.2g} mm, {1e3 * tip:.2g} mm "
        "in the distal 30 mm, diameters assumed, jacket left out; friction: a third of "
        "a PTFE-coated wire, Schröder 1993, Cardiovasc Intervent Radiol 16:93-97, "
        "doi:10.1007/BF02602986",
    )


# An angled glide wire, and a micro-wire for the 0.021 inch micro-catheter.
WIRE_035_GLIDE = _hydrophilic_wire(
    "wire_035_glide",
    0.035 * INCH,
    (0.50e-3, 0.28e-3),
    Arc(8e-3, math.radians(45)),
    tip_links=5,
)
WIRE_014_MICRO = _hydrophilic_wire(
    "wire_014_micro",
    0.014 * INCH,
    (0.20e-3, 0.12e-3),
    Arc(4e-3, math.radians(45)),
    tip_links=7,
)

# Every device above, by name.
DEVICES: dict[str, Device] = {
    one.name: one for one in list(globals().values()) if isinstance(one, Device)
}


# Largest unloaded bend between two links, rad. With 57° the end of a pigtail of radius
# 6 mm is 0.3 mm off, with 87° 1.7 mm, with 130° 3.6 mm.
SHARPEST = math.radians(60.0)


def get(device: "str | Device", option: str = "device") -> Device:
    """Returns the device of a name, or a device as given.

    Raises:
        ValueError: if the name is unknown; the message names the option.
    """
    if isinstance(device, Device):
        return device
    if not isinstance(device, str) or device not in DEVICES:
        bounds.refuse(option, device, f"a Device, or one of {', '.join(DEVICES)}")
    return DEVICES[device]


def discretised(given: "Discretisation | None") -> "Discretisation":
    """Returns the division into links as given; that of the default for None."""
    return bounds.instance("discretisation", given or Discretisation(), Discretisation)


@dataclasses.dataclass(frozen=True)
class Discretisation:
    """Division of a device into rigid links.

    Attributes:
        working_length: length of the simulated distal part, m.
        shaft_link: longest link of the shaft, m. The convergence study in
            docs/validation.md supports the default.
        torsion_joints: number of hinges about the device's axis, evenly spread along
            the chain. 0 makes it torsionally rigid.
    """

    working_length: float = 0.35
    shaft_link: float = 0.0175
    torsion_joints: int = 0

    def __post_init__(self):
        for name in ("working_length", "shaft_link"):
            bounds.number(name, getattr(self, name), 0.0, LONGEST, "m", positive=True)
        bounds.whole("torsion_joints", self.torsion_joints, 0)

    def link_lengths(self, *devices: Device) -> np.ndarray:
        """Lengths (n,) of the links of a chain from proximal to distal, m.

        The longest tip has as many links as the largest `tip_links` of all devices.
        Where it is bent the most, links are half as long as where it is straight. A
        shape proximal of this tip, as under a wire that leads by more, has the longer
        links of the shaft.

        Args:
            *devices: one, or coaxial ones.

        Raises:
            ValueError: if the longest tip is as long as the chain, or a shape bends by
                more than `SHARPEST` from link to link.
        """
        tip_length = max(device.tip_length for device in devices)
        shaft_length = self.working_length - tip_length
        if shaft_length <= 0:
            names = " in ".join(repr(device.name) for device in devices)
            raise ValueError(
                f"working_length is {self.working_length} m, but the tip of "
                f"{names} alone takes {tip_length} m"
            )
        shaft = math.ceil(round(shaft_length / self.shaft_link, 6))
        tip = max(device.tip_links for device in devices)
        lengths = np.full(tip, tip_length / tip)
        arcs = [np.cumsum([a.length for a in d.tip_shape[::-1]]) for d in devices]
        edges = np.unique(np.concatenate([[0.0, tip_length], *arcs]))
        edges = edges[edges <= tip_length]
        bent = np.array(
            [
                max(abs(each.rest_angle(far, near)) for each in devices) / (far - near)
                for near, far in itertools.pairwise(edges.tolist())
            ]
        )
        if bent.any():
            links = np.append(0.0, np.cumsum((bent + bent.max()) * np.diff(edges)))
            places = np.linspace(0.0, links[-1], tip + 1)
            lengths = np.diff(np.interp(places, links, edges))[::-1]
        lengths = np.concatenate([np.full(shaft, shaft_length / shaft), lengths])
        _refuse_coarse(devices, lengths, tip)
        return lengths


def _refuse_coarse(
    devices: Sequence[Device], lengths: np.ndarray, tip_links: int
) -> None:
    """Raise ValueError if links (n,) are too long for the unloaded shape of a device.

    Args:
        tip_links: number of links of the longest tip.
    """
    for device in devices:
        angle = max(map(abs, device.rest_angles(lengths)), default=0.0)
        if angle > SHARPEST:
            raise ValueError(
                f"the tip_shape of device {device.name!r} bends by "
                f"{math.degrees(angle):.0f}° from one link to the next, and straight "
                f"links follow it up to {math.degrees(SHARPEST):.0f}°; give more "
                f"tip_links than {tip_links}, a tip_length that holds the shape, or a "
                "smaller shaft_link"
            )
