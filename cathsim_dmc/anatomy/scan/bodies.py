"""Separate bodies of a surface: which of them are large, and why they are refused."""

from typing import NamedTuple

import numpy as np

from cathsim_dmc.anatomy.scan import topology
from cathsim_dmc.anatomy.scan.units import shown

# A separate part is dropped if its share of the area is at most PART_AREA, and it is at
# most PART_WIDTH, m, wide or more than PART_INSIDE of it lies in the largest part.
PART_AREA = 0.03
PART_WIDTH = 12e-3
PART_INSIDE = 0.25
_NESTED = 0.9  # share of the inner surface of a wall that lies in the outer one
MOST_SHOWN = 4  # separate parts whose places an error names


class Bodies(NamedTuple):
    """Parts of a surface.

    Attributes:
        label: (F,) part of each triangle.
        share: (n,) of the area that each part has.
        large: (k,) parts that may be vessels.
    """

    label: np.ndarray
    share: np.ndarray
    large: np.ndarray


def found(vertices: np.ndarray, faces: np.ndarray) -> Bodies:
    """Bodies of a surface (V, 3) m, (F, 3).

    Triangles that share a point belong to one body, unless only points hold two large
    bodies together, of which neither is in the other: no device passes such a point.
    """
    whole = _bodies(vertices, faces, topology.parts(faces))
    if len(whole.large) != 1:
        return whole
    label = topology.parts(faces, by_edges=True)
    if label.max() == whole.label.max():
        return whole
    apart = _bodies(vertices, faces, label)
    joined = len(apart.large) < 2 or _nested(vertices, faces, apart)
    return whole if joined else apart


def _bodies(vertices: np.ndarray, faces: np.ndarray, label: np.ndarray) -> Bodies:
    area = topology.areas(vertices, faces)
    share = np.bincount(label, area) / area.sum()
    wide = topology.widths(vertices, faces, label) > PART_WIDTH
    # Parts inside the lumen or its wall, such as calcifications, are no vessels.
    inside = topology.inside(vertices, faces, label, int(share.argmax())) > PART_INSIDE
    large = np.flatnonzero((share > PART_AREA) | (wide & ~inside))
    return Bodies(label, share, large)


def _nested(vertices: np.ndarray, faces: np.ndarray, bodies: Bodies) -> bool:
    """Whether one large body lies in another, as the surfaces of a thick wall do."""
    shares = (
        topology.inside(vertices, faces, bodies.label, int(one))[bodies.large]
        for one in bodies.large
    )
    return any(bool((share > _NESTED).any()) for share in shares)


def refusal(
    name: str, vertices: np.ndarray, faces: np.ndarray, bodies: Bodies
) -> ValueError:
    """Error that names the places of the large bodies and says how to join them."""
    label, share, large = bodies
    remedy = (
        "Keep the largest island (3D Slicer: Segment Editor, Islands), or join "
        "them where a vessel is interrupted"
    )
    if topology.overlap(vertices, faces, label, large):
        remedy = (
            "Some of them overlap: unite these (Blender: modifier Boolean, "
            "Union; 3D Slicer: import them as one segment)"
        )
    around = [
        shown(vertices[faces[label == k]].mean(axis=(0, 1)))
        for k in large[np.argsort(-share[large])][:MOST_SHOWN]
    ]
    return ValueError(
        f"{name} has {len(large)} separate parts, the largest around "
        f"{', '.join(around)}; one connected lumen is needed. {remedy}, and "
        "export again."
    )
