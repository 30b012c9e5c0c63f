"""The introducer sheath: a frictionless guide along a line, straight or curved."""

import numpy as np
from dm_control import composer, mjcf

from cathsim_dmc.collision import fields
from cathsim_dmc.entities.contact import sheath_contact

CLEARANCE = 0.35e-3  # m between the device and the bore all round
# Largest distance of a straight piece of the bore from the line, m.
_CHORD_TOLERANCE = 0.1e-3
_SPACING = 0.5e-3  # m, of the points that sample a curved line
_LEAST_CURVE_RADIUS = 0.01  # m
_VISIBLE_WALL = 0.4e-3  # m, as drawn
_COLOUR = (0.35, 0.45, 0.6, 0.35)


def straight(length: float) -> np.ndarray:
    """Line (2, 3) along +z to the origin, of a straight sheath of a length in m."""
    return np.array([[0.0, 0.0, -length], [0.0, 0.0, 0.0]])


class Sheath(composer.Entity):
    """A bore that follows a line; its mouth is the line's last point.

    Real followers grip the device just outside the sheath and support it up to there.
    The bore reaches back over the whole chain and represents both. Friction of clamps
    and valve is not modelled ("perfect motion"), so the bore has none.

    The bore is round: one geom that carries it as a field (`collision.fields`), which
    touches capsules from inside, with no edge at which a link could catch.
    """

    def _build(
        self,
        centreline: np.ndarray,
        device_radius: float,
        link_length: float = 0.0,
        name: str = "sheath",
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

        Raises:
            ValueError: if the line has fewer than two points, repeats a point or bends
                with a radius below 10 mm, or if a size is not positive.
        """
        if not device_radius > 0:
            raise ValueError(f"device_radius is {device_radius} m; it must be positive")
        self._bore_radius = device_radius + CLEARANCE
        self._axis = _Axis(centreline)
        self._mjcf_root = mjcf.RootElement(model=name)
        self._bore = self._mjcf_root.worldbody.add("body", name="bore")
        points, widths = self._axis.bore(self._bore_radius, link_length)
        self._bore_geom = self._bore.add(
            "geom",
            name="bore",
            **fields.carrier(fields.Bore(points, widths)),
            **sheath_contact(),
            mass=0,
            group=5,
            rgba=(0, 0, 0, 0),
        )
        for index in range(len(self._axis.arcs) - 1):
            self._bore.add(
                "geom",
                name=f"tube_{index}",
                type="cylinder",
                fromto=self._axis.vertices[index : index + 2].ravel(),
                size=[self._bore_radius + _VISIBLE_WALL],
                contype=0,
                conaffinity=0,
                mass=0,
                group=2,
                rgba=_COLOUR,
            )

    @property
    def mjcf_model(self) -> mjcf.RootElement:
        """The MJCF model of the sheath."""
        return self._mjcf_root

    @property
    def bodies(self) -> tuple:
        """The static body of the sheath."""
        return (self._bore,)

    @property
    def bore(self):
        """The geom that carries the bore."""
        return self._bore_geom

    @property
    def vertices(self) -> np.ndarray:
        """Ends (p + 1, 3) of the straight pieces of the axis, m, entity's frame."""
        return self._axis.vertices

    @property
    def length(self) -> float:
        """Length of the bore along its axis, m."""
        return float(self._axis.arcs[-1])

    @property
    def bore_radius(self) -> float:
        """Radius of the bore where it is straight, m."""
        return self._bore_radius


class _Axis:
    """The line of a sheath as straight pieces.

    Attributes:
        vertices: (p + 1, 3), ends of the pieces, m.
        arcs: (p + 1,), arc lengths of the vertices, m.
    """

    def __init__(self, centreline: np.ndarray):
        points = np.asarray(centreline, dtype=np.float64)
        if points.ndim != 2 or points.shape[1] != 3 or len(points) < 2:
            raise ValueError(
                f"centreline has shape {points.shape}; give (n, 3) with n >= 2"
            )
        steps = np.linalg.norm(np.diff(points, axis=0), axis=-1)
        if not (np.isfinite(steps).all() and (steps > 0).all()):
            raise ValueError(
                "centreline repeats a point or has a coordinate that is not finite"
            )
        arc = np.concatenate([[0.0], np.cumsum(steps)])
        self._fine_arc = np.linspace(0, arc[-1], max(2, round(arc[-1] / _SPACING) + 1))
        self._fine = np.stack(
            [np.interp(self._fine_arc, arc, axis) for axis in points.T], axis=-1
        )
        tangents = np.gradient(self._fine, self._fine_arc, axis=0)
        tangents /= np.linalg.norm(tangents, axis=-1, keepdims=True)
        self._check_bends(tangents)
        chosen = self._pieces()
        self.vertices = self._fine[chosen]
        self.arcs = self._fine_arc[chosen]

    def _check_bends(self, tangents: np.ndarray) -> None:
        # Over a window, because a line given by a few points has corners.
        window = round(_LEAST_CURVE_RADIUS / _SPACING)
        if len(tangents) <= window:
            return
        cosine = np.vecdot(tangents[window:], tangents[:-window]).min()
        if cosine < np.cos(1.0):
            raise ValueError(
                f"centreline turns by {np.degrees(np.arccos(cosine)):.0f}° within "
                f"{1e3 * _LEAST_CURVE_RADIUS:g} mm; a sheath bends with a radius of "
                f"{1e3 * _LEAST_CURVE_RADIUS:g} mm at least: smooth the line"
            )

    def _pieces(self) -> list[int]:
        """Indices of the fine points at the ends of the straight pieces."""
        chosen, last = [0], len(self._fine) - 1
        while chosen[-1] < last:
            start = chosen[-1]
            low, high = start + 1, last
            while low < high:  # the deviation grows with the length of the piece
                middle = (low + high + 1) // 2
                if self._deviation(start, middle) <= _CHORD_TOLERANCE:
                    low = middle
                else:
                    high = middle - 1
            chosen.append(low)
        return chosen

    def _deviation(self, start: int, stop: int) -> float:
        chord = self._fine[stop] - self._fine[start]
        offsets = self._fine[start : stop + 1] - self._fine[start]
        across = np.cross(offsets, chord / np.linalg.norm(chord))
        return float(np.linalg.norm(across, axis=-1).max())

    def bore(self, radius: float, link_length: float) -> tuple[np.ndarray, np.ndarray]:
        """Axis and radii of a bore that lets a chord pass.

        Args:
            radius: radius where the line is straight, m.
            link_length: chord that the bore must let pass, m.

        Returns:
            points (p + 1, 3) and radii (p + 1,), m.
        """
        inwards = self._sagitta(link_length)
        wider = np.linalg.norm(inwards, axis=-1) / 2
        return self.vertices + inwards / 2, radius + wider

    def _sagitta(self, chord: float) -> np.ndarray:
        """Vectors (p + 1, 3) from the line to the middle of a chord of it, m."""
        half, end = chord / 2, self._fine_arc[-1]
        if not 0 < chord < end:
            return np.zeros_like(self.vertices)
        # Beyond its ends, the line is assumed to bend as at its ends.
        arcs = np.clip(self.arcs, half, end - half)

        def at(arc: np.ndarray) -> np.ndarray:
            return np.stack(
                [np.interp(arc, self._fine_arc, axis) for axis in self._fine.T], axis=-1
            )

        return (at(arcs - half) + at(arcs + half)) / 2 - at(arcs)
