"""Writes the tree files of the measured phantoms from the measurements.

python docs/scripts/measured_phantoms.py [--check]

The measurements are points on the centrelines about 6 mm apart with the radius of the
inscribed sphere (lattice of 0.5 mm: error of 0.5 mm in position, 0.3 mm in radius). The
points are unchanged; the splines of `anatomy.curves` smooth them. The radii become
those of each vessel's own lumen, see `own_radii`.
"""

import argparse
import json
import sys
from pathlib import Path

import numpy as np

from cathsim_dmc import files
from cathsim_dmc.anatomy.builder import default_goals
from cathsim_dmc.anatomy.centreline import Centreline
from cathsim_dmc.anatomy.curves import smooth_tree
from cathsim_dmc.anatomy.phantoms import _DATA, MEASURED
from cathsim_dmc.anatomy.tree_file import FORMAT, FORMAT_VERSION, parse_tree

ROOT = Path(__file__).parents[2]
MEASUREMENTS = ROOT / "tests/data/measured"
# An inscribed sphere nearer to the parent than this (mm) extends into its lumen: the
# radius of a branch counts from there on.
SEEN = 3.0
CAPPED = 10.0  # mm from a free end, where the cap makes the inscribed sphere small
# Least radius (mm) that differs from an artefact of the lattice.
NARROWEST = 1.5
NOTE = (
    "Published aortic arch phantom of Type {type}, measured by the authors of this "
    "package on its released scan: points on the centrelines, radii of inscribed "
    "spheres; written by docs/scripts/measured_phantoms.py."
)


def own_radii(points, radii, parent, is_fork):
    """Radii (n,) mm of a vessel's own lumen from those of the inscribed sphere.

    The first own radius of a branch extends back to its parent, the last one to a free
    end. No radius is smaller than `NARROWEST`.
    """
    line = Centreline(points, radii)
    s = line.arc_length
    own = s <= s[-1] - CAPPED
    own[:2] = True
    radii = radii.copy()
    radii[~own] = radii[own][-1]
    if parent is not None:
        fine = np.arange(0.0, s[-1], 0.1)
        near = parent.project(line.at(fine).position)
        ostium = fine[np.flatnonzero(near.distance < near.radius)[-1]]
        # At a fork the sphere fits both daughters alike, and not the parent.
        first = 1 if is_fork else int((s >= ostium + SEEN).argmax())
        radii[:first] = radii[first]
    return np.maximum(radii, NARROWEST)


def tree_file(name):
    """Content of the tree file of the phantom `name`."""
    measured = json.loads((MEASUREMENTS / f"{name}.json").read_text())
    vessels, lines = {}, {}
    for key, vessel in measured["vessels"].items():
        columns = np.array(vessel["points"])
        points, radii = columns[:, :3], columns[:, 3]
        lines[key] = Centreline(points, radii)
        parent = vessel["parent"]
        own = own_radii(points, radii, lines.get(parent), "parts_at_point" in vessel)
        vessels[key] = {
            "parent": parent,
            "points_mm": points.tolist(),
            "radii_mm": np.round(own, 2).tolist(),
        }
    content = {
        "format": FORMAT,
        "version": FORMAT_VERSION,
        "name": name,
        "units": "mm",
        "frame": "LPS",
        "note": NOTE.format(type=measured["type"]),
        "vessels": vessels,
        "inlets": {
            "ascending": {"vessel": "aorta", "end": "first"},
            "descending": {"vessel": "aorta", "end": "last"},
        },
    }
    tree = smooth_tree(parse_tree(content).curves)
    goals = default_goals(tree)
    content["goals"] = {
        key: {
            "vessel": key,
            "past_ostium_mm": round(
                1e3 * (goal.arc_length - tree.vessel(key).ostium), 1
            ),
        }
        for key, goal in goals.items()
        if key != "lsa_fork2"  # a stub of 12 mm
    }
    arc = 1e3 * tree.root.centreline.length - 30.0
    content["goals"]["descending"] = {"vessel": "aorta", "arc_length_mm": round(arc, 1)}
    return content


def text(content):
    """JSON text with one point on each line."""
    lines = json.dumps(content, indent=1, ensure_ascii=False)
    lines = lines.replace("[\n     ", "[").replace("\n    ]", "]")
    return lines.replace(",\n     ", ", ") + "\n"


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--check", action="store_true", help="compare, write nothing")
    check, stale = parser.parse_args().check, []
    for name in MEASURED:
        new = text(tree_file(name)).encode()
        path = _DATA / f"{name}.json"
        if check:
            if path.read_bytes() != new:
                stale.append(str(path))
        else:
            files.write_bytes(path, new)
    if stale:
        sys.exit(f"{', '.join(stale)}: run docs/scripts/measured_phantoms.py")


if __name__ == "__main__":
    main()
