"""Parts of an anatomy: its lumen's surface, inlet, free ends and goals.

Lengths are metres, positions are in the patient frame LPS.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from cathsim_dmc import bounds
from cathsim_dmc.anatomy.centreline import Array, _readonly

# Radius of the hole in the cap over the inlet of an exported wall, m. The front of the
# introducer sheath covers it; its rim stays clear of the device.
INLET_HOLE_RADIUS = 2.5e-3


def _vector(value: ArrayLike, name: str) -> Array:
    vector = _readonly(bounds.array(name, value))
    if vector.shape != (3,) or not np.isfinite(vector).all():
        raise ValueError(f"{name} is {value!r}; give three finite numbers in metres.")
    return vector


def _unit(value: ArrayLike, name: str) -> Array:
    vector = _vector(value, name)
    norm = np.linalg.norm(vector)
    if norm < 1e-9:
        raise ValueError(f"{name} is zero; give a direction.")
    return _readonly(vector / norm)


@dataclass(frozen=True, eq=False)
class Goal:
    """A place to reach: `position` (3,), `arc_length` (m) on a vessel's centreline."""

    name: str
    vessel: str
    position: Array
    arc_length: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "position", _vector(self.position, "goal position"))


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
        object.__setattr__(self, "position", _vector(self.position, "inlet position"))
        object.__setattr__(self, "direction", _unit(self.direction, "inlet direction"))
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
        object.__setattr__(self, "position", _vector(self.position, "end position"))
        object.__setattr__(self, "direction", _unit(self.direction, "end direction"))


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
        vertices = _readonly(bounds.array("vertices", self.vertices))
        faces = np.array(bounds.array("faces", self.faces, "iu"), dtype=np.int32)
        faces.setflags(write=False)
        if vertices.ndim != 2 or vertices.shape[1] != 3:
            raise ValueError(f"vertices have shape {vertices.shape}; give (V, 3).")
        if faces.ndim != 2 or faces.shape[1] != 3:
            raise ValueError(f"faces have shape {faces.shape}; give (F, 3).")
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
