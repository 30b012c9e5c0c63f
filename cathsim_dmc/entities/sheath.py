"""The introducer sheath: a frictionless guide along a line, straight or curved."""

import itertools

import numpy as np
from dm_control import composer, mjcf

from cathsim_dmc import bounds
from cathsim_dmc.anatomy import Centreline
from cathsim_dmc.collision import fields
from cathsim_dmc.entities.contact import DRAWN, sheath_contact
from cathsim_dmc.entities.device import THICKEST

# Radial clearance between device and bore, m: assumed, for lack of a source.
CLEARANCE = 0.35e-3
_LEAST_CURVE_RADIUS, _SPACING = 0.01, 0.5e-3  # m
_VISIBLE_WALL = 0.4e-3  # m, as drawn
_COLOUR = (0.35, 0.45, 0.6, 0.35)


def straight(length: float) -> np.ndarray:
    """Centreline (2, 3) m of a straight sheath, `length` m along +z to the origin."""
    bounds.number("length", length, unit="m", positive=True)
    return np.array([[0.0, 0.0, -length], [0.0, 0.0, 0.0]])


class Sheath(composer.ModelWrapperEntity):
    """A bore that follows a line; its mouth is the line's last point.

    Real followers grip the device just outside the sheath and support it up to there.
    The bore reaches back over the whole chain and represents both. Friction of clamps
    and valve is not modelled ("perfect motion"), so the bore has none. By default the
    tasks have a bore without contact, and hinges hold the device on its axis.

    One geom carries the round bore as a field (`collision.fields`), which has no edge
    at which a link could catch.

    Attributes:
        bore: The geom that carries the bore.
        bore_radius: Radius of the bore where it is straight, m.
        touches: Whether the bore collides with the device.
        vertices: Points (n, 3) of the axis, m, entity's frame.
        length: Length of the bore along its axis, m.
    """

    def _build(
        self,
        centreline: np.ndarray,
        device_radius: float,
        link_length: float = 0.0,
        *,
        clearance: float | None = CLEARANCE,
    ):
        """Builds the bore.

        Args:
            centreline: points (n, 3) of the axis of the bore from its proximal end to
                its mouth, m, in the frame of the entity; `straight` gives a straight
                one.
            device_radius: outer radius of the guided device, m.
            link_length: longest link of the device, m. Links are straight, so in a bend
                their middles lie inside the line; the inner side of the bend is wider
                by that distance. No effect where the line is straight.
            clearance: radial clearance between device and bore, m; None for a bore
                without contact, where hinges hold the device (`physics.held`).

        Raises:
            ValueError: if the line has fewer than two points, repeats a point or bends
                with a radius below 10 mm, or if a size is out of range.
        """
        most = THICKEST
        bounds.number("device_radius", device_radius, 0.0, most, "m", positive=True)
        bounds.number("link_length", link_length, 0.0, unit="m")
        self.touches, play = clearance is not None, CLEARANCE
        if clearance is not None:
            play = bounds.number("clearance", clearance, 0.0, unit="m")
        self.bore_radius = device_radius + play
        line = Centreline(centreline, np.full(len(centreline), self.bore_radius))
        _refuse_sharp_bends(line)
        self.vertices, self.length = line.points, line.length
        root = mjcf.RootElement(model="sheath")
        super()._build(root)
        body = root.worldbody.add("body", name="bore")
        inwards = _sagitta(line, link_length) / 2
        widths = self.bore_radius + np.linalg.norm(inwards, axis=-1)
        carrier = fields.carrier(fields.Bore(line.points + inwards, widths))
        contact = sheath_contact()
        if not self.touches:
            contact["contype"] = 0
        self.bore = body.add("geom", name="bore", **carrier, **contact)
        for index, ends in enumerate(itertools.pairwise(line.points)):
            body.add(
                "geom",
                name=f"tube_{index}",
                type="cylinder",
                fromto=np.ravel(ends),
                size=[self.bore_radius + _VISIBLE_WALL],
                **DRAWN,
                rgba=_COLOUR,
            )


def _refuse_sharp_bends(line: Centreline) -> None:
    # Over a window, because a line given by a few points has corners.
    window = round(_LEAST_CURVE_RADIUS / _SPACING)
    heading = line.at(np.arange(0.0, line.length + _SPACING, _SPACING)).tangent
    cosine = np.vecdot(heading[window:], heading[:-window]).min(initial=1.0)
    if cosine < np.cos(1.0):
        raise ValueError(
            f"centreline turns by {np.degrees(np.arccos(cosine)):.0f}° within "
            f"{1e3 * _LEAST_CURVE_RADIUS:g} mm; a sheath bends with a radius of "
            f"{1e3 * _LEAST_CURVE_RADIUS:g} mm at least: smooth the line"
        )


def _sagitta(line: Centreline, chord: float) -> np.ndarray:
    """Vectors (n, 3) m from the points of a line to the middles of chords of it."""
    half = chord / 2
    if not 0 < chord < line.length:
        return np.zeros_like(line.points)
    # Beyond its ends, the line is assumed to bend as at its ends.
    arcs = np.clip(line.arc_length, half, line.length - half)
    before, after = (line.at(arcs + way).position for way in (-half, half))
    return (before + after) / 2 - line.at(arcs).position
