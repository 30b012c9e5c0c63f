"""Parts of an anatomy, its surface, inlet, free ends and goals: metres, frame LPS."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike

from cathsim_dmc import bounds
from cathsim_dmc.anatomy.centreline import Array, _readonly

# Radius of the hole in the cap over the inlet of an exported wall, m. The front of the
# introducer sheath covers it; its rim stays clear of the device.
INLET_HOLE_RADIUS = 2.5e-3
MARGIN = 4e-3  # m, by which the box of a field exceeds the lumen


def _vector(name: str, value: ArrayLike) -> Array:
    return _readonly(bounds.vector(name, value, 3))


def _unit(name: str, value: ArrayLike) -> Array:
    vector = _vector(name, value)
    if (norm := np.linalg.norm(vector)) < 1e-9:
        raise ValueError(f"{name} is zero; give a direction.")
    return _readonly(vector / norm)


class _Part:
    """A place in a vessel; each field has the check of its name."""

    _CHECKS: ClassVar[dict[str, Callable]] = {
        "name": bounds.text,
        "vessel": bounds.text,
        "position": _vector,
        "direction": _unit,
        "arc_length": bounds.number,
        "radius": partial(bounds.number, positive=True),
        "open": bounds.switch,
    }

    def __post_init__(self) -> None:
        what = type(self).__name__.lower()
        for field, value in list(vars(self).items()):
            vars(self)[field] = self._CHECKS[field](f"{what} {field}", value)


@dataclass(frozen=True, eq=False)
class Goal(_Part):
    """A place to reach: `position` (3,), `arc_length` (m) on a vessel's centreline."""

    name: str
    vessel: str
    position: Array
    arc_length: float


@dataclass(frozen=True, eq=False)
class Inlet(_Part):
    """Where the device enters: `position` (3,), unit `direction` (3,) into the lumen.

    `radius` (m) is the lumen radius there.
    """

    vessel: str
    position: Array
    direction: Array
    radius: float


@dataclass(frozen=True, eq=False)
class End(_Part):
    """A flat end of the lumen: `position` (3,), unit `direction` (3,) out of it.

    `radius` (m) is that of the lumen; `open` is true for the inlet, false where a wall
    cap closes the vessel.
    """

    vessel: str
    position: Array
    direction: Array
    radius: float
    open: bool


@dataclass(frozen=True, eq=False)
class FileFrame:
    """Unit and frame of the file that an anatomy comes from.

    Attributes:
        unit: name of the unit of its coordinates, such as "mm".
        to_lps: (3, 3), matrix from its coordinates to metres, LPS.
    """

    unit: str
    to_lps: Array

    def __post_init__(self) -> None:
        matrix = bounds.array("to_lps", self.to_lps, shape=(3, 3))
        if not abs(np.linalg.det(matrix)) > 0.0:
            bounds.refuse("to_lps", self.to_lps, "a matrix that can be inverted")
        vars(self).update(unit=bounds.text("unit", self.unit), to_lps=_readonly(matrix))


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
        vars(self).update(vertices=vertices, faces=faces)

    @property
    def volume(self) -> float:
        """Enclosed volume (m^3), positive when normals point outwards."""
        a, b, c = (self.vertices[self.faces[:, i]] for i in range(3))
        return float(np.einsum("fj,fj->", a, np.cross(b, c)) / 6.0)

    @cached_property
    def normals(self) -> Array:
        """Area-weighted unit normals (V, 3) of vertices; +z where there is no area."""
        import igl

        weighting = igl.PER_VERTEX_NORMALS_WEIGHTING_TYPE_AREA
        faces = self.faces.astype(np.int64)
        normals = igl.per_vertex_normals(self.vertices, faces, weighting)
        fine = np.isfinite(normals).all(axis=1, keepdims=True)
        return np.where(fine, normals, [0.0, 0.0, 1.0])
