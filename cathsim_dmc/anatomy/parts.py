"""Parts of an anatomy: its lumen's surface, inlet, free ends and goals.

Lengths are metres, positions are in the patient frame LPS.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from cathsim_dmc import bounds
from cathsim_dmc.anatomy.centreline import Array, _readonly

# Radius of the hole in the cap over the inlet of an exported wall, m. The front of the
# introducer sheath covers it; its rim stays clear of the device.
INLET_HOLE_RADIUS = 2.5e-3


def _checked(part: "Goal | Inlet | End", what: str) -> None:
    """Checks the fields that goals, inlets and ends share, and freezes the vectors."""
    bounds.text(f"{what} vessel", part.vessel)
    for field in ("position", "direction"):
        if hasattr(part, field):
            vector = np.array(bounds.vector(f"{what} {field}", getattr(part, field), 3))
            if field == "direction":
                norm = np.linalg.norm(vector)
                if norm < 1e-9:
                    raise ValueError(f"{what} direction is zero; give a direction.")
                vector = vector / norm
            object.__setattr__(part, field, _readonly(vector))


@dataclass(frozen=True, eq=False)
class Goal:
    """A place to reach: `position` (3,), `arc_length` (m) on a vessel's centreline."""

    name: str
    vessel: str
    position: Array
    arc_length: float

    def __post_init__(self) -> None:
        _checked(self, "goal")
        bounds.text("goal name", self.name)
        bounds.number("goal arc_length", self.arc_length)


@dataclass(frozen=True, eq=False)
class Inlet:
    """Where the device enters: `position` (3,), unit `direction` (3,) into the lumen.

    `radius` (m) is the lumen radius there.
    """

    vessel: str
    position: Array
    direction: Array
    radius: float

    def __post_init__(self) -> None:
        _checked(self, "inlet")
        bounds.number("inlet radius", self.radius, positive=True)


@dataclass(frozen=True, eq=False)
class End:
    """A flat end of the lumen: `position` (3,), unit `direction` (3,) out of it.

    `open` is true for the inlet, false where a wall cap closes the vessel.
    """

    vessel: str
    position: Array
    direction: Array
    radius: float
    open: bool

    def __post_init__(self) -> None:
        _checked(self, "end")
        bounds.number("end radius", self.radius)
        bounds.switch("end open", self.open)


@dataclass(frozen=True, eq=False, repr=False)
class Surface:
    """Triangles of the lumen surface, normals outwards, closed.

    Attributes:
        vertices: (V, 3) float64, metres, LPS.
        faces: (F, 3) int32, counter-clockwise seen from outside the lumen.
    """

    vertices: Array
    faces: np.ndarray

    def __post_init__(self) -> None:
        vertices = _readonly(bounds.array("vertices", self.vertices, shape=(-1, 3)))
        faces = bounds.array("faces", self.faces, "iu", shape=(-1, 3))
        faces = np.array(faces, dtype=np.int32)
        faces.setflags(write=False)
        if faces.size and (faces.min() < 0 or faces.max() >= len(vertices)):
            raise ValueError(
                f"faces name vertices {faces.min()} to {faces.max()}; there are "
                f"{len(vertices)}."
            )
        object.__setattr__(self, "vertices", vertices)
        object.__setattr__(self, "faces", faces)

    def __repr__(self) -> str:
        """Numbers of vertices and triangles."""
        return f"<Surface: {len(self.vertices)} vertices, {len(self.faces)} triangles>"

    @property
    def volume(self) -> float:
        """Enclosed volume (m^3), positive when normals point outwards."""
        a, b, c = (self.vertices[self.faces[:, i]] for i in range(3))
        return float(np.einsum("fj,fj->", a, np.cross(b, c)) / 6.0)

    @cached_property
    def normals(self) -> Array:
        """Unit normals (V, 3) of the vertices, by area; +z where there is no area."""
        import igl

        weighting = igl.PER_VERTEX_NORMALS_WEIGHTING_TYPE_AREA
        faces = self.faces.astype(np.int64)
        normals = igl.per_vertex_normals(self.vertices, faces, weighting)
        fine = np.isfinite(normals).all(axis=1, keepdims=True)
        return np.where(fine, normals, [0.0, 0.0, 1.0])
