"""Catheters and guidewires: rods of two sections with a shape, in SI units."""

import dataclasses
import itertools
import math

import numpy as np

from cathsim_dmc import bounds
from cathsim_dmc.imaging import materials
from cathsim_dmc.imaging.device import Shadow

_MOST_LINKS = 200
# Lengths beyond these are taken for ones given in millimetres.
LONGEST = 3.0  # m, the longest wires sold
_LONGEST_TIP = 1.0  # m
THICKEST = 10e-3  # m, outer radius; sheaths of aortic valves have half of it
DENSEST = 22.6e3  # kg/m³, osmium
# Frequency at which a damper has the loss factor of the material, Hz; that of the first
# mode of a free tip of 0.2 m in blood.
LOSS_FREQUENCY = 1.0


@dataclasses.dataclass(frozen=True)
class Section:
    """A uniform section of a rod.

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
        bounds.number("poisson_ratio", poisson_ratio, 0.0, 0.5)
        return cls(bending_stiffness, bending_stiffness / (1 + poisson_ratio))


@dataclasses.dataclass(frozen=True)
class Arc:
    """A circular arc of a pre-shaped tip.

    Attributes:
        radius: radius of curvature of the centreline, m.
        angle: turning angle, rad; the sign gives the side.
    """

    radius: float
    angle: float

    def __post_init__(self):
        bounds.number("radius", self.radius, positive=True)
        turns = 4 * math.pi  # a pigtail has less
        bounds.number("angle", self.angle, -turns, turns, "rad")

    @property
    def length(self) -> float:
        """Length along the centreline, m."""
        return abs(self.radius * self.angle)


@dataclasses.dataclass(frozen=True)
class Device:
    """A catheter or guidewire.

    Attributes:
        name: key in `DEVICES`.
        outer_radius: outer radius, m.
        linear_density: mass per length, kg/m.
        shaft: section proximal of the tip.
        tip: section of the distal `tip_length`.
        tip_length: length of the tip, m.
        tip_links: number of rigid links of the tip.
        steering_angle: largest angle by which the motor bends an unloaded tip joint,
            rad. 0 makes a passive device without motors.
        tip_shape: arcs of the unloaded shape in the local x-z plane, from proximal to
            distal; the last one ends at the distal end.
        inner_radius: radius of the lumen, m; 0 for a wire.
        loss_factor: loss modulus over storage modulus in bending at `LOSS_FREQUENCY`;
            the default is that of a polyether block amide.
        friction_ratio: Coulomb coefficient on the wall relative to that of an uncoated
            device in the same vessel.
        attenuation: X-ray attenuation above that of water, averaged over the section,
            1/m.
        marker_attenuation: that of the radiopaque marker at the distal end, 1/m.
        marker_length: length of the marker, m.
        source: source of the figures, as text.
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
    inner_radius: float = 0.0
    loss_factor: float = 0.1
    friction_ratio: float = 1.0
    attenuation: float = materials.CATHETER
    marker_attenuation: float = materials.MARKER
    marker_length: float = materials.MARKER_LENGTH
    source: str = ""

    def __post_init__(self):
        bounds.instance("name", self.name, str)
        of_device = f"of device {self.name!r}"
        density, tip = f"linear_density {of_device}", f"tip_length {of_device}"
        bounds.number(density, self.linear_density, positive=True)
        bounds.number(tip, self.tip_length, 0.0, _LONGEST_TIP, "m", positive=True)
        radius = f"outer_radius {of_device}"
        bounds.number(radius, self.outer_radius, 0.0, THICKEST, "m", positive=True)
        bounds.whole(f"tip_links {of_device}", self.tip_links, 1, _MOST_LINKS)
        for name in ("shaft", "tip"):
            bounds.instance(f"{name} {of_device}", getattr(self, name), Section)
        for arc in bounds.instance(f"tip_shape {of_device}", self.tip_shape, tuple):
            bounds.instance(f"an entry of tip_shape {of_device}", arc, Arc)
        lumen = f"inner_radius {of_device}"
        if bounds.number(lumen, self.inner_radius, 0.0) >= self.outer_radius:
            bounds.refuse(lumen, self.inner_radius, "less than its outer_radius")
        solid = math.pi * (self.outer_radius**2 - self.inner_radius**2)
        if self.linear_density > DENSEST * solid:
            most = f"{DENSEST * solid:.2g} kg/m (1 g/m = 1e-3 kg/m)"
            densest = f"at most {most}, what its section weighs of the densest metal"
            bounds.refuse(f"linear_density {of_device}", self.linear_density, densest)
        others = "attenuation", "marker_attenuation", "marker_length"
        for name in ("friction_ratio", "loss_factor", *others):
            bounds.number(f"{name} {of_device}", getattr(self, name), 0.0)
        bounds.instance(f"source {of_device}", self.source, str)
        angle = f"steering_angle {of_device}"
        if bounds.number(angle, self.steering_angle, 0.0) >= math.pi / 2:
            bounds.refuse(angle, self.steering_angle, "in [0, π/2) rad for each joint")

    def shadow(self, points: np.ndarray) -> Shadow:
        """X-ray shadow of the device along points (..., n, 3), m, from base to tip."""
        return Shadow(
            points,
            radius=self.outer_radius,
            mu=self.attenuation,
            marker_mu=self.marker_attenuation,
            marker_length=self.marker_length,
        )

    @property
    def steerable(self) -> bool:
        """Whether the tip joints have motors."""
        return self.steering_angle > 0

    @property
    def relaxation_time(self) -> float:
        """Damping over stiffness of the material (Kelvin-Voigt), s."""
        return self.loss_factor / (2 * math.pi * LOSS_FREQUENCY)

    @property
    def axial_stiffness(self) -> float:
        """EA of the shaft, N; that of a solid round rod, 4 EI / r²."""
        return 4 * self.shaft.bending_stiffness / self.outer_radius**2

    @property
    def is_wire(self) -> bool:
        """Whether the device is solid."""
        return self.inner_radius == 0.0

    def rest_angle(self, start: float, stop: float) -> float:
        """Turning angle of the unloaded shape between two places.

        Args:
            start: distance from the distal end, m.
            stop: distance from the distal end, m, at most `start`.

        Returns:
            The turning angle of the centreline from `start` to `stop`, rad.
        """
        total, distal = 0.0, 0.0
        for arc in reversed(self.tip_shape):
            proximal = distal + arc.length
            overlap = min(start, proximal) - max(stop, distal)
            if overlap > 0:
                total += math.copysign(overlap / arc.radius, arc.angle)
            distal = proximal
        return total

    def rest_angles(self, lengths: np.ndarray) -> list[float]:
        """Turning angles (n - 1) of the unloaded shape from link to link, rad.

        Args:
            lengths: (n,), lengths of the links from the base on, m.
        """
        middles = [lengths[n:].sum() - lengths[n] / 2 for n in range(len(lengths))]
        return [self.rest_angle(far, near) for far, near in itertools.pairwise(middles)]
