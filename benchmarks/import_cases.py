"""Scans with ground truth for the import: arches, remeshed, cut and rotated."""

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from cathsim_dmc.anatomy import phantoms
from cathsim_dmc.anatomy.arch.arch import ArchSeed
from cathsim_dmc.anatomy.arch.neck import Course, with_courses
from cathsim_dmc.anatomy.arch.tree import arch_tree
from cathsim_dmc.anatomy.centreline import Centreline, Vessel, VesselTree
from cathsim_dmc.anatomy.parts import Surface
from cathsim_dmc.anatomy.scan.topology import decimated
from cathsim_dmc.anatomy.surface import lumen_surface

TRIANGLES = (2_000, 4_000, 12_000, 30_000, 100_000)
TYPES = ("I", "II", "III")
VARIANTS = ("normal", "bovine_trunk", "bovine_branch", "aberrant")
SEED = 9_100_000  # of the cases with which the import was developed
ASK = "ask"  # what an import should do if the surface does not show the truth
NAME = "name"
_MARCHED = 1.3e-3  # m, coarsest grid of marching cubes before decimation
_PER_AREA = 2.4  # triangles per squared step


@dataclass(frozen=True)
class Case:
    """One scan.

    Attributes:
        kind: change of the arch, a group of the report.
        source: type of a random arch, or name of a phantom.
        seed: seed of the arch and of random changes.
        variant: variant of a random arch.
        triangles: number of triangles of the surface.
        answer: expected answer of the import, "name" or "ask".
        change: vessel and its remaining length (m) past its ostium, 0 for none.
        noise: standard deviation of the surface, m.
        turn: None, "any" for a random rotation, or "x" or "y", a mirrored axis.
    """

    kind: str
    source: str
    seed: int
    variant: str = "normal"
    triangles: int = 12_000
    answer: str = NAME
    change: tuple[tuple[str, float], ...] = field(default=())
    noise: float = 0.0
    turn: str | None = None

    @property
    def name(self) -> str:
        """Unique name of the case, for a line of the results."""
        words = [self.kind, self.source, self.variant, self.seed, self.triangles]
        words += [f"{name}{1e3 * length:g}" for name, length in self.change]
        words += [self.turn] if self.turn else []
        words += [f"{1e3 * self.noise:g}mm"] if self.noise else []
        return "-".join(map(str, words))


def cases(seed: int = SEED) -> list[Case]:
    """All cases from a seed on, ordered so that the first ones are of every kind."""
    groups: list[list[Case]] = []
    seeds = iter(range(seed, seed + 100_000))

    def add(kind, sources, variants=("normal",), **options) -> None:
        groups.append(
            [
                Case(kind, source, next(seeds), variant, **options)
                for source, variant in product(sources, variants)
            ]
        )

    for count in TRIANGLES:
        add("remeshed", TYPES, VARIANTS, triangles=count)
        add("head and neck", ("I", "II"), VARIANTS[:3], triangles=count)
    for count in (4_000, 30_000):
        add("turned", TYPES, VARIANTS, triangles=count, turn="any")
        add("head and neck, turned", ("I", "II"), triangles=count, turn="any")
        add("vertebral off the arch", ("I", "II"), triangles=count)
    for noise in (0.15e-3, 0.3e-3):
        add("noise", TYPES, VARIANTS[:2], noise=noise)
    for name in ("bca", "lcca", "lsa"):
        for length in (8e-3, 12e-3, 20e-3):
            add("branch cut short", ("I", "II"), change=((name, length),))
        add("branch left out", ("I", "II"), change=((name, 0.0),), answer=ASK)
    for name in ("lcca", "lsa"):
        add(
            "branch left out, head and neck",
            ("I", "II"),
            change=((name, 0.0),),
            answer=ASK,
        )
    add("branch left out", ("I",), VARIANTS[1:3], change=(("lsa", 0.0),), answer=ASK)
    for limb, length in product(("ascending", "descending"), (25e-3, 60e-3)):
        add("limb cut short", TYPES, VARIANTS[:2], change=((limb, length),))
    narrow = {"change": (("narrow", 1.3e-3),), "triangles": 30_000}
    add("narrowed subclavian", TYPES, **narrow)
    add("narrowed subclavian", ("I", "II"), turn="any", **narrow)
    for axis in "xy":
        add("mirrored", TYPES, turn=axis, answer=ASK)
    for name in phantoms.PHANTOMS:
        for count in (4_000, 100_000):
            groups.append([Case("phantom", name, 0, triangles=count)])
        groups.append([Case("phantom, turned", name, abs(seed - SEED) + 1, turn="any")])
    # Kinds alternate, so that an interrupted run has cases of every kind.
    longest = max(map(len, groups))
    return [g[k] for k in range(longest) for g in groups if k < len(g)]


def truth(case: Case) -> VesselTree:
    """The tree of a case, changed but not rotated; m, LPS."""
    if case.kind.startswith("phantom"):
        return phantoms.load(case.source).tree
    seed = ArchSeed(case.seed, case.source, case.variant)
    tree = arch_tree(seed.parameters())
    rng = np.random.default_rng(case.seed)
    neck = "head and neck" in case.kind or case.kind == "narrowed subclavian"
    narrow = dict(case.change).get("narrow")
    if neck:
        tree = with_neck(tree, rng, narrow)
    if case.kind == "vertebral off the arch":
        tree = with_vertebral(tree, rng)
    for name, length in case.change:
        if name in ("ascending", "descending"):
            tree = limb_cut(tree, name, length)
        elif name != "narrow":
            tree = shortened(tree, name, length)
    return tree


def surface(case: Case, tree: VesselTree) -> Surface:
    """The surface of a case, rotated and with noise."""
    area = sum(
        2.0 * np.pi * float(np.median(v.centreline.radii)) * v.centreline.length
        for v in tree.vessels.values()
    )
    step = min(_MARCHED, np.sqrt(_PER_AREA * area / case.triangles))
    found = lumen_surface(tree, float(max(step, 0.5e-3)))
    vertices, faces = decimated(
        np.asarray(found.vertices), np.asarray(found.faces), case.triangles
    )
    rng = np.random.default_rng(case.seed)
    if case.noise:
        normals = Surface(vertices, faces).normals
        vertices = vertices + normals * rng.normal(0.0, case.noise, (len(vertices), 1))
    matrix = turn(case)
    vertices = vertices @ matrix.T
    if np.linalg.det(matrix) < 0.0:
        faces = faces[:, ::-1]
    return Surface(vertices, faces)


def turn(case: Case) -> np.ndarray:
    """Matrix (3, 3) that rotates or mirrors the points of a case."""
    if case.turn == "any":
        rng = np.random.default_rng(case.seed + 1)
        matrix = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        return matrix * np.sign(np.linalg.det(matrix))
    return np.diag([-1.0 if case.turn == axis else 1.0 for axis in "xyz"])


def shortened(tree: VesselTree, name: str, length: float) -> VesselTree:
    """The tree with a vessel cut `length` (m) past its ostium, without its branches."""
    vessels = {}
    for key, vessel in tree.vessels.items():
        if key == name:
            if length > 0.0:
                line = vessel.centreline.slice(0.0, vessel.ostium + length)
                vessels[key] = replace(vessel, centreline=line)
        elif vessel.parent is None or vessel.parent in vessels:
            kept = vessels.get(vessel.parent)
            if kept is not None and kept.name == name and length > 0.0:
                whole = tree.vessel(name).centreline
                if kept.centreline.length < whole.length:
                    continue
            vessels[key] = vessel
    return VesselTree(vessels)


def limb_cut(tree: VesselTree, limb: str, length: float) -> VesselTree:
    """The tree with `length` (m) of aorta before its first or after its last branch."""
    root = tree.root
    places = [tree.origin(k) for k, v in tree.vessels.items() if v.parent == root.name]
    line = root.centreline
    if limb == "ascending":
        line = line.slice(min(places) - length, line.length)
    else:
        line = line.slice(0.0, max(places) + length)
    return VesselTree({**tree.vessels, root.name: Vessel(root.name, line)})


def with_neck(tree: VesselTree, rng, narrow: float | None = None) -> VesselTree:
    """The tree with its branches extended to the neck and the arms.

    Args:
        tree: upright tree with a brachiocephalic artery.
        rng: source of randomness.
        narrow: radius of a stenosis of the right subclavian artery, m, or None.
    """
    right, up = np.array([-1.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0])
    back = np.array([0.0, 1.0, 0.0])

    def course(name, ways, radii, parent=None, place=0.0):
        """An artery with slightly randomised headings."""
        first = None if parent is None else tuple(ways[0][0])
        moved = ((way + rng.normal(0.0, 0.12, 3), length) for way, length in ways)
        drawn = tuple((tuple(way), length) for way, length in moved)
        return Course(name, drawn, radii, parent, place, first)

    bca, lsa = (tree.vessel(name).centreline for name in ("bca", "lsa"))
    wide, fork = float(bca.radii[-1]), bca.length - 2e-3
    arm = (0.75 * wide, 3.6e-3, 3.4e-3, 3.2e-3)
    if narrow is not None:
        arm = (0.75 * wide, 3.4e-3, narrow, 3.2e-3, 3.2e-3, 3.2e-3, 3.0e-3)
    steep = right + (1.6 if narrow is not None else 0.5) * up
    neck = 0.8 * wide, 3.2e-3, 3.0e-3
    at, thin = 30e-3 if narrow is None else 52e-3, (1.9e-3, 1.8e-3, 1.7e-3)
    rise = [(up + 0.5 * back + 0.2 * right, 25e-3), (up + 0.1 * back, 45e-3)]
    climb = [(up + 0.3 * back - 0.1 * right, 25e-3), (up, 45e-3)]
    over = [(-right + 0.3 * up, 30e-3), (-right, 40e-3)]
    carotid = [(up + 0.15 * right, 30e-3), (up, 60e-3)]
    courses = (
        course("rsa", [(steep, 25e-3), (right, 60e-3)], arm, "bca", fork),
        course("rcca", carotid, neck, "bca", fork),
        course("rva", rise, thin, "rsa", at),
        course("lcca", [(up, 60e-3)], (3.0e-3,)),
        course("lsa", over, (3.2e-3,)),
        course("lva", climb, thin, "lsa", lsa.length - 5e-3),
    )
    return with_courses(tree, courses)


def with_vertebral(tree: VesselTree, rng) -> VesselTree:
    """The tree with a left vertebral artery between LCCA and LSA."""
    root = tree.root.centreline
    places = [tree.origin(name) for name in ("lcca", "lsa")]
    place = root.at(float(np.mean(places)))
    ways = [tree.vessel(name).centreline.points[[0, -1]] for name in ("lcca", "lsa")]
    middle = np.mean(
        [(end - start) / np.linalg.norm(end - start) for start, end in ways], axis=0
    )
    length = float(place.radius) + 50e-3
    beyond = float(place.radius) + 12e-3
    first, last = (
        root.project(tree.vessel(name).centreline.points[-1]).arc_length
        for name in ("lcca", "lsa")
    )
    for _ in range(400):
        way = middle + rng.normal(0.0, 0.4, 3)
        way *= length / np.linalg.norm(way)
        points = place.position + np.linspace(0.0, 1.0, 30)[:, None] * way
        far = points[np.linalg.norm(points - place.position, axis=1) > beyond]
        clear = max(depth.max() for depth in tree.depths(far).values()) < -2.8e-3
        if clear and first < root.project(points[-1]).arc_length < last:
            break
    else:
        raise ValueError("no room for a vertebral artery between LCCA and LSA")
    line = Centreline(points, np.full(30, 1.9e-3))
    vessel = Vessel("lva", line, tree.root.name, float(place.radius))
    return VesselTree({**tree.vessels, "lva": vessel})


def resumed(
    out: Path, cases: Sequence[Any], run: Callable[[Any], dict[str, Any]]
) -> list[dict[str, Any]]:
    """Runs the cases that are not in a file of JSON lines; returns all of its rows."""
    rows = []
    if out.exists():
        rows = [json.loads(line) for line in out.read_text().splitlines()]
    done = {row["case"] for row in rows}
    for case in cases:
        if case.name not in done:
            rows.append(run(case))
            with out.open("a") as stream:
                stream.write(json.dumps(rows[-1]) + "\n")
    return rows
