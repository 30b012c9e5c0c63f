"""Parameters of an aortic arch, with the bounds of each."""

import math
from dataclasses import dataclass

from cathsim_dmc import bounds
from cathsim_dmc.anatomy.arch.neck import Course

MINIMUM_SEPTUM = 1e-3  # m of wall between two lumens side by side
# Tube proximal to the ascending aorta, m: the device starts with its steerable tip
# (70 mm) out of the introducer sheath and its head in the ascending aorta.
INLET_TUBE = 70e-3

LEVELS = ("ascending", "bca_level", "lcca_level", "lsa_level", "descending")
# Minimum, maximum and unit of each parameter.
_ANGLE, _TURN = (-1.3, 1.3, "rad"), (-2.0 * math.pi, 2.0 * math.pi, "rad")
_OF_BRANCH = {
    "radius": (1.5e-3, 12e-3, "m"),
    "end_radius": (1.0e-3, 12e-3, "m"),
    "length": (40e-3, 150e-3, "m"),
    **dict.fromkeys(("take_off", "lean"), _ANGLE),
    **dict.fromkeys(("bend_azimuth", "second_bend_azimuth"), _TURN),
}
_OF_ARCH = {
    **{f"{level}_radius": (7e-3, 25e-3, "m") for level in LEVELS},
    "descending_radius": (6e-3, 22e-3, "m"),
    "ascending_length": (5e-3, 300e-3, "m"),
    "descending_length": (40e-3, 400e-3, "m"),
    "arch_radius": (20e-3, 70e-3, "m"),
    "arch_height": (15e-3, 90e-3, "m"),
    "plane_rotation": (-math.pi, math.pi, "rad"),
    "bca_drop": (0.0, 4.0, "LCCA diameters"),
    "lsa_aberrant_spacing": (0.0, 80e-3, "m"),
    "ascending_bend": (0.0, 1.0, "rad"),
    "descending_bend": (-0.5, 0.5, "rad"),
    "plane_tilt": (-0.6, 0.6, "rad"),
    "bow": (-15e-3, 15e-3, "m"),
    "sway": (-15e-3, 15e-3, "m"),
}


@dataclass(frozen=True)
class BranchParameters:
    """Parameters of one branch of the arch (metres, radians).

    Attributes:
        radius: lumen radius at the origin, before the flare of the ostium.
        end_radius: lumen radius at the distal end; the taper is linear.
        take_off: angle of the first part from the vertical in the plane of the
            arch, positive upstream (towards the ascending aorta).
        length: from the ostium to the distal end.
        bend_radius: radius of curvature after the straight first part.
        bend_azimuth: direction of the bend: 0 downstream in the plane of the arch,
            pi upstream, pi/2 out of the plane to the patient's right and back.
        lean: angle of the first part out of the plane of the arch, positive to the
            patient's right and back; the ostium turns around the aorta by the same.
        second_bend_radius: radius of curvature of the distal half, after the first
            bend; None to continue the first bend.
        second_bend_azimuth: direction of the second bend, as `bend_azimuth`.
    """

    radius: float
    end_radius: float
    take_off: float
    length: float = 45e-3
    bend_radius: float = 100e-3
    bend_azimuth: float = 0.0
    lean: float = 0.0
    second_bend_radius: float | None = None
    second_bend_azimuth: float = 0.0

    def __post_init__(self) -> None:
        bounds.fields(self, _OF_BRANCH, "branch ")
        least = 3.0 * self.radius
        bounds.number("branch bend_radius", self.bend_radius, least, 10.0, "m")
        if self.second_bend_radius is not None:
            name = "branch second_bend_radius"
            bounds.number(name, self.second_bend_radius, least, 10.0, "m")


@dataclass(frozen=True)
class ArchParameters:
    """Parameters of an aortic arch (metres, radians).

    Attributes:
        ascending_radius, bca_level_radius, lcca_level_radius, lsa_level_radius,
            descending_radius: lumen radius of the aorta at five levels.
        ascending_length: straight part from the inlet to the start of the arch; it
            includes the phantom's `INLET_TUBE`.
        descending_length: straight part from the end of the arch to the cap.
        arch_radius: half the distance between the axes of the two limbs.
        arch_height: from the end of the straight limbs to the top of the arch's
            centreline; equal to arch_radius for a circular arch.
        plane_rotation: angle of the plane of the arch from the sagittal plane,
            positive when the descending aorta lies to the left of the ascending.
        bca_drop: height of the top of the arch above the BCA ostium, in LCCA
            diameters (type I below 1, II from 1 to 2, III above 2).
        bca_lcca_spacing, lcca_lsa_spacing: between ostium centres along the outer
            curve of the arch.
        bca, lcca, lsa: the branches.
        bovine: the LCCA leaves the BCA, `bca_lcca_spacing` above the BCA's ostium
            along the BCA, instead of leaving the arch; `lcca_lsa_spacing` is then
            from the BCA to the LSA.
        ascending_bend: angle by which the ascending limb turns, at constant
            curvature, before the arch; its first heading leans away from the
            descending limb by this angle.
        descending_bend: angle by which the descending limb turns after the arch, in
            the same direction.
        plane_tilt: angle of the plane of the arch from the vertical, positive with
            its top to the patient's right and back.
        bow, sway: amplitudes of the half-wave and the full-wave sinusoid that displace
            the aorta's centreline out of the plane, at first to the right and back.
        aberrant: right subclavian artery that leaves the aorta last ("rsa"); the
            first branch is then the right carotid ("rcca") with the values of `bca`.
        lsa_aberrant_spacing: between the ostium centres of LSA and aberrant artery,
            along the outer curve of the arch.
        neck: arteries beyond the branches of the arch, see `neck.sample_neck`.
    """

    bca: BranchParameters
    lcca: BranchParameters
    lsa: BranchParameters
    ascending_radius: float = 14.75e-3
    bca_level_radius: float = 14.3e-3
    lcca_level_radius: float = 13.55e-3
    lsa_level_radius: float = 12.65e-3
    descending_radius: float = 11.95e-3
    ascending_length: float = INLET_TUBE + 62.6e-3
    descending_length: float = 100e-3
    arch_radius: float = 34e-3
    arch_height: float = 34e-3
    plane_rotation: float = math.radians(50.3)
    bca_drop: float = 0.5
    bca_lcca_spacing: float = 21.8e-3
    lcca_lsa_spacing: float = 14.3e-3
    bovine: bool = False
    ascending_bend: float = 0.0
    descending_bend: float = 0.0
    plane_tilt: float = 0.0
    bow: float = 0.0
    sway: float = 0.0
    aberrant: BranchParameters | None = None
    lsa_aberrant_spacing: float = 16e-3
    neck: tuple[Course, ...] = ()

    def __post_init__(self) -> None:
        for name in ("bca", "lcca", "lsa"):
            bounds.instance(name, getattr(self, name), BranchParameters)
        if self.aberrant is not None:
            bounds.instance("aberrant", self.aberrant, BranchParameters)
        bounds.switch("bovine", self.bovine)
        bounds.fields(self, _OF_ARCH)
        self._check_bends()
        self._check_spacings()

    @property
    def branches(self) -> dict[str, BranchParameters]:
        """The branches by the names of their vessels, in the order of the arch."""
        if self.aberrant is None:
            return {"bca": self.bca, "lcca": self.lcca, "lsa": self.lsa}
        first = {"rcca": self.bca, "lcca": self.lcca}
        return {**first, "lsa": self.lsa, "rsa": self.aberrant}

    def _check_bends(self) -> None:
        widest = max(getattr(self, f"{level}_radius") for level in LEVELS)
        radius, height = self.arch_radius, self.arch_height
        bends = {"arch": min(radius**2 / height, height**2 / radius)}
        for limb in ("ascending", "descending"):
            if bend := abs(getattr(self, f"{limb}_bend")):
                bends[f"{limb} limb"] = getattr(self, f"{limb}_length") / bend
        for name, bend in bends.items():
            if bend < 1.25 * widest:
                raise ValueError(
                    f"the {name} bends with a radius of {bend:g} m, less than 1.25 "
                    f"times that of the lumen, {widest:g} m. Enlarge arch_radius and "
                    "arch_height, or reduce the limb's bend."
                )

    def _check_spacings(self) -> None:
        # A bovine LCCA leaves the BCA beyond its ostium and within its length.
        before_lsa, low, high = self.bca, self.lcca.radius + 2e-3, 25e-3
        if not self.bovine:
            before_lsa, high = self.lcca, 80e-3
            low = self.bca.radius + self.lcca.radius + MINIMUM_SEPTUM
        elif self.aberrant is not None:
            raise ValueError("an arch is bovine or has an aberrant, not both.")
        elif self.lcca.radius > 0.8 * self.bca.radius:
            least = self.lcca.radius / 0.8
            raise ValueError(f"a bovine LCCA needs a BCA of radius {least:g} m or more")
        bounds.number("bca_lcca_spacing", self.bca_lcca_spacing, low, high, "m")
        pairs = {"lcca_lsa_spacing": (before_lsa, self.lsa)}
        if self.aberrant is not None:
            pairs["lsa_aberrant_spacing"] = self.lsa, self.aberrant
        for name, (first, second) in pairs.items():
            need = first.radius + second.radius + MINIMUM_SEPTUM
            bounds.number(name, getattr(self, name), need, 80e-3, "m")
