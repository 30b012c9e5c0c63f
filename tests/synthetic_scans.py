"""Scans made of tubes: surfaces and centrelines with known truth, mm in files."""

import json
from pathlib import Path

import numpy as np

from cathsim_dmc.anatomy.centreline import Centreline, Vessel, VesselTree
from cathsim_dmc.anatomy.surface import lumen_surface


def tube(points, radii, step: float = 1e-3) -> Centreline:
    """A centreline through corners, mm, with a point for each step, m."""
    line = Centreline(np.array(points) * 1e-3, np.array(radii) * 1e-3)
    return line.resampled(step)


def y_tree() -> VesselTree:
    """A trunk of 6 mm radius that parts into branches of 3.5 and 3 mm radius."""
    left = [(0, 0, 50), (4, 0, 58), (16, 0, 78), (24, 0, 100)]
    right = [(0, 0, 50), (-4, 4, 58), (-12, 15, 75), (-15, 26, 88)]
    return VesselTree(
        {
            "trunk": Vessel("trunk", tube([(0, 0, 0), (0, 0, 50)], [6, 6])),
            "left": Vessel("left", tube(left, [5, 4, 3.5, 3.5]), "trunk", 9e-3),
            "right": Vessel("right", tube(right, [5, 4, 3, 3]), "trunk", 9e-3),
        }
    )


def marched(tree: VesselTree, spacing: float = 2.0e-3):
    """Closed surface of a tree's lumen: vertices (mm), faces with outward normals."""
    surface = lumen_surface(tree, spacing)
    return surface.vertices * 1e3, np.asarray(surface.faces)


def write_obj(path: Path, vertices, faces) -> Path:
    lines = [f"v {x:.5f} {y:.5f} {z:.5f}" for x, y, z in vertices]
    lines += [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in faces]
    path.write_text("\n".join(lines) + "\n")
    return path


def write_markup(path: Path, points_mm, *, system="LPS", radii=None) -> Path:
    markup = {
        "type": "Curve",
        "coordinateSystem": system,
        "coordinateUnits": "mm",
        "controlPoints": [{"position": list(map(float, p))} for p in points_mm],
    }
    if radii is not None:
        markup["measurements"] = [
            {"name": "Radius", "controlPointValues": list(map(float, radii))}
        ]
    path.write_text(json.dumps({"markups": [markup]}))
    return path
