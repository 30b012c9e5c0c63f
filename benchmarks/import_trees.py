"""Vessel trees that are no arches: what an import finds, leaves out and calls."""

import argparse
import re
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import import_cases
import numpy as np
import trimesh
from scipy.interpolate import PchipInterpolator

from cathsim_dmc.anatomy.anatomy import Anatomy
from cathsim_dmc.anatomy.centreline import Centreline, Vessel, VesselTree
from cathsim_dmc.anatomy.parts import Surface
from cathsim_dmc.anatomy.scan.importer import import_scan
from cathsim_dmc.anatomy.scan.naming import BRANCHES
from cathsim_dmc.anatomy.scan.topology import decimated
from cathsim_dmc.anatomy.scan.units import UNITS
from cathsim_dmc.anatomy.surface import lumen_surface
from cathsim_dmc.cli.options import show
from cathsim_dmc.validation.checks import Check, Report

SEED = 4_800
SCALES = (0.7, 1.0, 1.4)  # of the usual size
TRIANGLES = (3_000, 14_000)
STEP = 0.5  # mm, between points of a centreline
GRID = (2.5e-3, 0.3)  # m, and in least radii: step of marching cubes
COVERED = 0.6  # of a found vessel's own centreline, least share in the tree
NAMES = {"aorta", "rva", *BRANCHES}  # of vessels of an arch


@dataclass(frozen=True)
class Case:
    """One tree: its kind, a key of `KINDS`, seed, scale, triangles and file's unit."""

    kind: str
    seed: int
    scale: float
    triangles: int
    units: str

    @property
    def name(self) -> str:
        """Unique name of the case, for a line of the results."""
        return f"{self.kind}-{self.seed}-{self.scale:g}-{self.triangles}-{self.units}"


def cases(seed: int = SEED) -> list[Case]:
    """Cases of every kind at three scales and two meshings, with alternating kinds."""
    order = product(TRIANGLES, SCALES, KINDS)
    return [
        Case(kind, seed + k, scale, triangles, ("mm", "cm", "mm", "m")[k % 4])
        for k, (triangles, scale, kind) in enumerate(order)
    ]


class _Grower:
    """Adds vessels along corners in mm, each of which is slightly randomised."""

    def __init__(self, rng: np.random.Generator, shake: float):
        self._rng, self._shake = rng, shake
        self.vessels: dict[str, Vessel] = {}

    def root(self, corners: Sequence, radii: Sequence[float]) -> None:
        self.vessels["trunk"] = Vessel("trunk", self._line(corners, radii, ()))

    def branch(
        self,
        name: str,
        parent: str,
        share: float,
        corners: Sequence,
        radii: Sequence[float],
        *,
        joins: str | None = None,
    ) -> None:
        """Adds a vessel at a share of its parent's length; it may end in another."""
        trunk = self.vessels[parent].centreline
        start = trunk.at(share * trunk.length).position * 1e3
        ends = [start, *(start + np.array(corners))]
        fixed = [0]
        if joins is not None:
            other = self.vessels[joins].centreline
            gap = np.linalg.norm(other.points * 1e3 - ends[-1], axis=1).argmin()
            ends[-1] = other.points[gap] * 1e3
            fixed.append(len(ends) - 1)
        line = self._line(ends, radii, fixed)
        place = trunk.project(line.points)
        out = place.distance > place.radius
        at = int(out.argmax()) if out.any() else len(out) // 2
        ostium = float(line.arc_length[at])
        self.vessels[name] = Vessel(name, line, parent, ostium)

    def _line(self, corners, radii, fixed) -> Centreline:
        corners = np.array(corners, dtype=float)
        moved = self._rng.normal(0.0, self._shake, corners.shape)
        moved[[*fixed]] = 0.0
        corners = corners + moved
        t = np.linspace(0.0, 1.0, len(corners))
        fine = np.linspace(0.0, 1.0, 400)
        points = PchipInterpolator(t, corners)(fine)
        along = np.linspace(0.0, 1.0, len(radii))
        width = np.interp(fine, along, np.array(radii))
        return Centreline(1e-3 * points, 1e-3 * width).resampled(1e-3 * STEP)


def _carotid(grow: _Grower) -> None:
    grow.root([(0, 0, 0), (2, 1, 40), (0, 0, 80)], [3.2, 3.2, 3.6])
    ica = [(-4, 4, 15), (-8, 8, 40), (-6, 6, 75)]
    grow.branch("ica", "trunk", 0.98, ica, [3.6, 3.0, 2.5, 2.5])
    eca = [(4, -3, 12), (8, -6, 30), (9, -8, 60)]
    grow.branch("eca", "trunk", 0.98, eca, [2.6, 2.1, 2.0, 1.8])
    grow.branch("thyroid", "eca", 0.25, [(6, -6, -2), (9, -10, -18)], [1.2, 1.0, 0.9])


def _iliacs(grow: _Grower) -> None:
    grow.root([(0, 0, 0), (3, -3, -50), (0, 0, -110)], [9.5, 9.0, 8.5])
    for side, name in ((1, "left"), (-1, "right")):
        common = [(12 * side, 2, -25), (22 * side, 16, -45), (30 * side, 8, -65)]
        grow.branch(name, "trunk", 0.98, common, [6.5, 5.5, 5.2, 5.0])
        outer = [(6 * side, -12, -25), (14 * side, -22, -55), (16 * side, -25, -85)]
        grow.branch(f"{name}_external", name, 0.98, outer, [4.8, 4.4, 4.2, 4.0])
        inner = [(2 * side, 14, -15), (0, 26, -40)]
        grow.branch(f"{name}_internal", name, 0.98, inner, [3.8, 3.2, 2.8])


def _renals(grow: _Grower) -> None:
    grow.root([(0, 0, 0), (2, -2, -70), (0, 3, -140)], [10.5, 9.5, 8.5])
    for side, name in ((1, "left"), (-1, "right")):
        way = [(18 * side, 4, -5), (40 * side, 10, -14)]
        grow.branch(f"renal_{name}", "trunk", 0.45, way, [3.2, 2.8, 2.6])
    grow.branch("celiac", "trunk", 0.12, [(2, -18, -6), (4, -34, -4)], [3.8, 3.4, 3.2])
    grow.branch("sma", "trunk", 0.28, [(0, -16, -8), (0, -24, -55)], [3.8, 3.4, 3.0])


def _pulmonary(grow: _Grower) -> None:
    grow.root([(0, 0, 0), (-2, 12, 22), (0, 30, 42)], [13.5, 13.0, 12.5])
    right = [(-22, 10, 4), (-52, 16, -4)]
    grow.branch("right", "trunk", 0.97, right, [11.0, 9.5, 8.5])
    left = [(14, 16, 8), (30, 34, 0), (38, 44, -16)]
    grow.branch("left", "trunk", 0.97, left, [10.5, 9.0, 8.0, 7.0])
    for name, side in (("right", -1), ("left", 1)):
        up = [(8 * side, 4, 18), (18 * side, 8, 46)]
        grow.branch(f"{name}_upper", name, 0.7, up, [5.5, 4.8, 3.6])
        down = [(14 * side, 10, -16), (30 * side, 22, -60)]
        grow.branch(f"{name}_lower", name, 0.97, down, [6.2, 5.4, 3.8])
        out = [(20 * side, -8, -8), (46 * side, -20, -14)]
        grow.branch(f"{name}_middle", name, 0.9, out, [4.4, 3.8, 3.0])


def _coronary(grow: _Grower) -> None:
    grow.root([(0, 0, 0), (6, -4, 1), (14, -8, 0)], [2.4, 2.3, 2.2])
    lad = [(10, -16, -8), (20, -26, -34), (16, -30, -70)]
    grow.branch("lad", "trunk", 0.96, lad, [2.0, 1.8, 1.4, 1.0])
    lcx = [(16, 10, -8), (20, 30, -26), (8, 42, -44)]
    grow.branch("lcx", "trunk", 0.96, lcx, [1.9, 1.7, 1.4, 1.1])
    grow.branch("diagonal", "lad", 0.35, [(12, 0, -10), (20, 6, -34)], [1.4, 1.2, 0.9])
    grow.branch("marginal", "lcx", 0.35, [(12, 4, -14), (16, 6, -40)], [1.4, 1.2, 0.9])


def _circle(grow: _Grower) -> None:
    """A left and a right half that join in front and behind."""
    grow.root([(-14, -4, -40), (-13, 2, -18), (-12, -4, 0)], [2.5, 2.3, 2.1])
    a1 = [(6, -8, 2), (12, -13, 4), (18, -8, 2), (24, 0, 0)]
    grow.branch("front", "trunk", 0.97, a1, [1.5, 1.3, 1.2, 1.3, 1.5])
    back = [(2, 10, -2), (6, 18, -4), (12, 21, -5), (18, 18, -4), (23, 10, -2)]
    back = [*back, (24, 0, 0)]
    grow.branch("behind", "trunk", 0.97, back, [1.3, 1.2, 1.3, 1.5, 1.3, 1.2, 1.3],
                joins="front")  # fmt: skip
    grow.branch(
        "mca_right", "trunk", 0.97, [(-14, -2, 4), (-30, 2, 8)], [1.6, 1.4, 1.3]
    )
    mca = [(14, -2, 4), (30, 2, 8)]
    grow.branch("mca_left", "front", 0.99, mca, [1.6, 1.4, 1.3])
    aca = [(1, -6, 12), (0, 0, 34)]
    grow.branch("aca", "front", 0.5, aca, [1.2, 1.1, 1.0])
    grow.branch("basilar", "behind", 0.5, [(0, 1, -10), (0, 4, -30)], [1.6, 1.6, 1.7])


def _tube(grow: _Grower) -> None:
    corners = [(0, 0, 0), (12, 4, 30), (-6, 10, 70), (4, 0, 110)]
    grow.root(corners, [4.2, 4.0, 3.8, 3.8])


def _access(grow: _Grower) -> None:
    """A brachial artery with a loop of graft to a vein, for dialysis."""
    grow.root([(0, 0, 0), (3, 2, -60), (0, 0, -130)], [2.6, 2.4, 2.2])
    loop = [(8, -8, -16), (16, -10, -60), (32, -12, -84), (48, -10, -60), (54, -6, 0)]
    loop = [*loop, (50, -2, 40)]
    grow.branch("graft", "trunk", 0.35, loop, [2.6, 3.0, 3.0, 3.0, 3.1, 3.6, 4.2])


KINDS = {
    "carotid": _carotid,
    "iliacs": _iliacs,
    "renals": _renals,
    "pulmonary": _pulmonary,
    "coronary": _coronary,
    "circle of Willis": _circle,
    "tube": _tube,
    "access loop": _access,
}


def truth(case: Case) -> VesselTree:
    """The tree of a case, m."""
    grower = _Grower(np.random.default_rng(case.seed), 1.0)
    KINDS[case.kind](grower)
    return VesselTree(grower.vessels).scaled(case.scale)


def surface(case: Case, tree: VesselTree) -> Surface:
    """The closed surface of a tree, with about the triangles of the case."""
    least = min(float(v.centreline.radii.min()) for v in tree.vessels.values())
    fine = lumen_surface(tree, min(GRID[0], max(GRID[1] * least, 0.25e-3)))
    return Surface(*decimated(fine.vertices, np.asarray(fine.faces), case.triangles))


def run(case: Case) -> dict:
    """Import one case and compare it with its truth."""
    tree = truth(case)
    lumen = surface(case, tree)
    out: dict = {"case": case.name, "kind": case.kind, "triangles": len(lumen.faces)}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "lumen.ply"
        scale = 1.0 / UNITS[case.units]
        mesh = trimesh.Trimesh(scale * lumen.vertices, lumen.faces, process=False)
        mesh.export(path)
        start = time.process_time()
        notes: list[str] = []
        try:
            anatomy, out["units"] = import_scan(path, notes=notes), "guessed"
        except ValueError as error:
            out["said"] = str(error)
            if "may be in several units" not in str(error):
                return out | {"units": "guessed", "refused": True}
            out["units"] = "asked"
            notes.clear()
            try:
                anatomy = import_scan(path, units=case.units, notes=notes)
            except ValueError as again:
                return out | {"refused": True, "said": str(again)}
        out["cpu_s"] = round(time.process_time() - start, 2)
    return out | compared(anatomy, tree, notes, UNITS[case.units]) | {"notes": notes}


def compared(
    anatomy: Anatomy, tree: VesselTree, notes: Sequence[str], unit: float
) -> dict:
    """Comparison of units, names and vessels with the truth; `unit` in m."""
    size = [
        float(np.linalg.norm(np.ptp(points, axis=0)))
        for points in (anatomy.surface.vertices, lumen_surface(tree, 2e-3).vertices)
    ]
    told = [place * unit for note in notes for place in places(note)]
    said = np.array(told).reshape(-1, 3)
    found, noted, missing = [], [], []
    device = passing(anatomy)
    lines = [vessel.centreline for vessel in anatomy.tree.vessels.values()]
    for name, vessel in tree.vessels.items():
        line = vessel.centreline
        own = line.slice(min(vessel.ostium, line.length - 2e-3), line.length)
        width = 2.0 * float(np.median(own.radii))
        if width <= 2.0 * device or own.length <= width:
            continue
        near = [one.project(own.points) for one in lines]
        inside = np.any([p.distance < p.radius for p in near], axis=0)
        gaps = np.linalg.norm(own.points[:, None] - said, axis=2)
        if inside.mean() >= COVERED:
            found.append(name)
        elif (gaps < width + 1e-3).any():
            noted.append(name)
        else:
            missing.append(name)
    words = " ".join(notes)
    return {
        "scale_right": bool(0.6 < size[0] / size[1] < 1.6),
        "found": found,
        "noted": noted,
        "missing": missing,
        "arch": sorted(NAMES & set(anatomy.tree.vessels)),
        "axes": "--axes" in words or "upright" in words,
        "goals": len(anatomy.goals),
    }


def passing(anatomy: Anatomy) -> float:
    """Radius (m) of a device that passes every route to a goal, at most 5 Fr."""
    radii = [float(anatomy.route(goal).radii.min()) for goal in anatomy.goals]
    return min([0.84e-3, *radii])


def places(note: str) -> Iterator[np.ndarray]:
    """The places (3,) that a note names, in the file's unit."""
    number = r"(-?\d+(?:\.\d+)?)"
    for found in re.finditer(rf"\({number}, {number}, {number}\)", note):
        yield np.array([float(x) for x in found.groups()])


def report(rows: list[dict]) -> Report:
    """Checks and counts over all trees, and a table with a line for each kind."""
    kinds = dict.fromkeys(row["kind"] for row in rows)
    groups = {kind: [row for row in rows if row["kind"] == kind] for kind in kinds}
    groups["**all**"] = rows
    cells = {kind: counted(group) for kind, group in groups.items()}
    every = cells["**all**"]
    lines = [" | ".join(["| trees", *every, ""]), "|---" * (len(every) + 1) + "|"]
    for kind, row in cells.items():
        lines.append(" | ".join([f"| {kind}", *map(str, row.values()), ""]))
    none = "unit wrong", "refused", "in neither", "arch names", "word on axes"
    checks = [Check.at_most(name, every[name], 0) for name in none]
    text = "\n".join(line.rstrip() for line in lines)
    return Report("trees", checks, every | {"table": text})


def counted(rows: list[dict]) -> dict[str, int]:
    """Numbers of trees and vessels by the result of the import."""
    fine = [row for row in rows if "found" in row]
    return {
        "number": len(rows),
        "unit guessed": sum(row["units"] == "guessed" for row in rows),
        "unit asked for": sum(row["units"] == "asked" for row in rows),
        "unit wrong": sum(not row["scale_right"] for row in fine),
        "refused": sum(row.get("refused", False) for row in rows),
        "vessels in the tree": sum(len(row["found"]) for row in fine),
        "in a note": sum(len(row["noted"]) for row in fine),
        "in neither": sum(len(row["missing"]) for row in fine),
        "arch names": sum(bool(row["arch"]) for row in fine),
        "word on axes": sum(bool(row["axes"]) for row in fine),
    }


def main() -> int:
    """Run the cases that are not in the file yet, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path, help="JSON lines, one per case; resumed")
    parser.add_argument("--only", default="", help="part of a case's name")
    parser.add_argument("--seed", type=int, default=SEED, help="of the first case")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    options = parser.parse_args()
    chosen = [case for case in cases(options.seed) if options.only in case.name]
    found = report(import_cases.resumed(options.out, chosen, run))
    if not options.json:
        print(found.findings["table"])
    return show(found, options.json)


if __name__ == "__main__":
    sys.exit(main())
