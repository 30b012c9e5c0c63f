"""The introducer sheath: a frictionless guide along a line, straight or curved."""

import numpy as np
from dm_control import composer, mjcf

from cathsim_dmc.entities.catheter import Catheter
from cathsim_dmc.entities.contact import CONTACT_SOLIMP, CONTACT_SOLREF, sheath_contact

CLEARANCE = 0.35e-3  # m between the device and each side of the bore
# Thickness of the sides, m: their front covers the hole in the cap of the inlet, and a
# loaded shaft cannot tunnel through them.
WALL = 8e-3
# Longest part behind the mouth with flat sides and a sharp rim, m. There the device
# leans on the sheath with a bending moment.
_MOUTH_LENGTH = 0.02
# Largest distance of a straight piece of rod from the line, m.
_CHORD_TOLERANCE = 0.1e-3
_SPACING = 0.5e-3  # m, of the points that sample a curved line
_LEAST_CURVE_RADIUS = 0.01  # m
_VISIBLE_WALL = 0.4e-3  # m, as drawn
_COLOUR = (0.35, 0.45, 0.6, 0.35)
_SIDES = {"right": (1, 0), "left": (-1, 0), "top": (0, 1), "bottom": (0, -1)}


def straight(length: float) -> np.ndarray:
    """Line (2, 3) along +z to the origin, of a straight sheath of a length in m."""
    return np.array([[0.0, 0.0, -length], [0.0, 0.0, 0.0]])


class Sheath(composer.Entity):
    """A bore that follows a line; its mouth is the line's last point.

    Real followers grip the device just outside the sheath and support it up to there.
    The bore reaches back over the whole chain and represents both. Friction of clamps
    and valve is not modelled ("perfect motion"), so the bore has none.

    The bore is square. The last piece before the mouth is four boxes with flat sides
    and a sharp rim. The rest is four rods, chains of capsules that turn with the line:
    capsule against capsule is MuJoCo's cheapest collision test, and a chain of capsules
    has no edge at which a link could catch. `guide` lists the pairs of links and rods
    that collide.
    """

    def _build(
        self,
        centreline: np.ndarray,
        device_radius: float,
        link_length: float = 0.0,
        wall: float = WALL,
        name: str = "sheath",
    ):
        """Builds the sides of the bore.

        Args:
            centreline: points (n, 3) of the axis of the bore from its proximal end to
                its mouth, m, in the frame of the entity; `straight` gives a straight
                one.
            device_radius: outer radius of the guided device, m.
            link_length: longest link of the device, m. Links are straight, so in a bend
                their middles lie inside the line; the inner side of the bend is wider
                by that distance. No effect where the line is straight.
            wall: thickness of the sides, m.
            name: name of the entity.

        Raises:
            ValueError: if the line has fewer than two points, repeats a point or bends
                with a radius below 10 mm, or if a size is not positive.
        """
        for what, value in (("device_radius", device_radius), ("wall", wall)):
            if not value > 0:
                raise ValueError(f"{what} is {value} m; it must be positive")
        self._bore_half_width = device_radius + CLEARANCE
        self._axis = _Axis(centreline)
        self._mjcf_root = mjcf.RootElement(model=name)
        self._bore = self._mjcf_root.worldbody.add("body", name="bore")
        # A body of its own, because the broad phase bounds all geoms of a body
        # together.
        self._mouth = self._mjcf_root.worldbody.add("body", name="mouth")
        faces, outwards = self._axis.sides(self._bore_half_width, link_length)
        last = len(self._axis.arcs) - 2
        # Sides of the bore, by piece from the proximal end.
        self._pieces: list[list] = []
        for index in range(last + 1):
            add = self._add_box if index == last else self._add_rod
            self._pieces.append(
                [
                    add(
                        f"{side}_{index}",
                        faces[index : index + 2, number],
                        outwards[index : index + 2, number],
                        wall,
                    )
                    for number, side in enumerate(_SIDES)
                ]
            )
            self._bore.add(
                "geom",
                name=f"tube_{index}",
                type="cylinder",
                fromto=self._axis.vertices[index : index + 2].ravel(),
                size=[self._bore_half_width + _VISIBLE_WALL],
                contype=0,
                conaffinity=0,
                mass=0,
                group=2,
                rgba=_COLOUR,
            )

    def _add_rod(self, name: str, face: np.ndarray, outwards: np.ndarray, wall: float):
        """Adds a rod that touches a line (2, 3) of the bore's face from outside."""
        return self._bore.add(
            "geom",
            name=name,
            type="capsule",
            fromto=(face + wall * outwards).ravel(),
            size=[wall],
            contype=0,
            conaffinity=0,
            mass=0,
            group=3,
        )

    def _add_box(self, name: str, face: np.ndarray, outwards: np.ndarray, wall: float):
        """Adds a box whose inner face has a middle line (2, 3)."""
        along = face[1] - face[0]
        length = np.linalg.norm(along)
        along /= length
        outward = outwards.sum(0) - outwards.sum(0) @ along * along
        outward /= np.linalg.norm(outward)
        return self._mouth.add(
            "geom",
            name=name,
            type="box",
            pos=face.mean(0) + wall / 2 * outward,
            xyaxes=(*outward, *np.cross(along, outward)),
            size=(wall / 2, self._bore_half_width + wall, length / 2),
            **sheath_contact(),
            mass=0,
            group=3,
        )

    def guide(self, catheter: Catheter, start_depth: float) -> None:
        """Adds the contact pairs of rods and links; both must be attached to one model.

        Args:
            catheter: the device in the bore.
            start_depth: distance of the device's head past the mouth at zero insertion,
                m; negative inside. Only pieces and links that can meet are paired.
        """
        contact = self._mjcf_root.root_model.contact
        lengths = catheter.link_lengths
        # Distance of the links' proximal ends past the proximal end of the sheath.
        starts = self.length + start_depth - np.cumsum(lengths[::-1])[::-1]
        # Bends and the axial compliance shift a link by less than its own length.
        spare = lengths.max()
        # All links are paired: with every other link, 1 N on a link makes a depth of
        # 0.6 mm instead of 0.25 mm.
        for link, (start, length) in enumerate(zip(starts, lengths, strict=True)):
            for index, sides in enumerate(self._pieces[:-1]):
                low, high = self._axis.arcs[index : index + 2]
                if high < start - spare:
                    continue
                if low > start + length + catheter.stroke + spare:
                    continue
                for side in sides:
                    contact.add(
                        "pair",
                        name=f"{self._mjcf_root.model}_{side.name}_link_{link}",
                        geom1=side,
                        geom2=catheter.link_geoms[link],
                        # Frictionless for every device: one row a contact.
                        condim=1,
                        solref=CONTACT_SOLREF,
                        solimp=CONTACT_SOLIMP,
                    )

    @property
    def mjcf_model(self) -> mjcf.RootElement:
        """The MJCF model of the sheath."""
        return self._mjcf_root

    @property
    def bodies(self) -> tuple:
        """The static bodies of the sheath: bore and mouth."""
        return self._bore, self._mouth

    @property
    def length(self) -> float:
        """Length of the bore along its axis, m."""
        return float(self._axis.arcs[-1])

    @property
    def bore_half_width(self) -> float:
        """Half the inner width of the straight bore, m."""
        return self._bore_half_width


class _Axis:
    """The line of a sheath as straight pieces with a twist-free frame.

    Attributes:
        vertices: (p + 1, 3), ends of the pieces, m.
        arcs: (p + 1,), arc lengths of the vertices, m.
        tangents: (p + 1, 3), unit directions of the line at the vertices.
        normals: (p + 1, 2, 3), unit vectors across it, transported without twist.
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
        self.tangents = tangents[chosen]
        self.normals = _untwisted(tangents)[chosen]

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
        # The last piece, the mouth, is straight and short.
        mouth = last - round(_MOUTH_LENGTH / self._fine_arc[1])
        if mouth > chosen[-2]:
            chosen.insert(-1, mouth)
        return chosen

    def _deviation(self, start: int, stop: int) -> float:
        chord = self._fine[stop] - self._fine[start]
        offsets = self._fine[start : stop + 1] - self._fine[start]
        across = np.cross(offsets, chord / np.linalg.norm(chord))
        return float(np.linalg.norm(across, axis=-1).max())

    def sides(
        self, half_width: float, link_length: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """Middle lines of the four faces of the bore, and their outward normals.

        Args:
            half_width: from the axis to a face where the line is straight, m.
            link_length: length of the chord that must fit into the bore, m.

        Returns:
            points (p + 1, 4, 3) of the faces, m; unit vectors (p + 1, 4, 3) from the
            axis to them.
        """
        inwards = self._sagitta(link_length)
        outwards = np.einsum("sa,pad->psd", list(_SIDES.values()), self.normals)
        wider = np.maximum(np.einsum("psd,pd->ps", outwards, inwards), 0.0)
        faces = self.vertices[:, None] + (half_width + wider)[..., None] * outwards
        return faces, outwards

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


def _untwisted(tangents: np.ndarray) -> np.ndarray:
    """Two normals (n, 2, 3) transported along unit tangents (n, 3) without twist."""
    x = np.array([1.0, 0.0, 0.0])
    if abs(tangents[0] @ x) > 0.9:
        x = np.array([0.0, 0.0, -1.0])
    normals = np.empty((len(tangents), 2, 3))
    for index, tangent in enumerate(tangents):
        x = x - (x @ tangent) * tangent
        x /= np.linalg.norm(x)
        normals[index] = x, np.cross(tangent, x)
    return normals
