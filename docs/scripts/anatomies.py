"""Writes the tables and pictures of docs/anatomies.md and docs/arches.md.

python docs/scripts/anatomies.py
"""

import argparse
import json
from pathlib import Path

import numpy as np
from figures import grid, put
from matplotlib.figure import Figure

from cathsim_dmc import style
from cathsim_dmc.anatomy import measures, phantoms
from cathsim_dmc.anatomy.arch import arch, sampler
from cathsim_dmc.anatomy.surface import lumen_surface
from cathsim_dmc.anatomy.surface_depth import SurfaceDepth
from cathsim_dmc.pictures.anatomies import anatomy_figure, draw_anatomy
from cathsim_dmc.validation import wall

ROOT = Path(__file__).parents[1]
PAGE, ARCHES, IMAGES = ROOT / "anatomies.md", ROOT / "arches.md", ROOT / "images"
MEASUREMENTS = ROOT.parent / "tests/data/measured"
MAIN = ("bca", "lcca", "lsa")


def per_branch(found, key, digits=0):
    """Text of a measure of BCA, LCCA and LSA."""
    values = [found["branches"][name][key] for name in MAIN]
    return " / ".join(f"{value:.{digits}f}" for value in values)


def shapes(anatomies):
    """Table of measures of the anatomies, with a column for each."""
    found = {name: measures.measure(one.tree) for name, one in anatomies.items()}
    lines = {
        "type, drop of the BCA in LCCA diameters": lambda m: (
            f"{m['arch_type']}, {m['drop']:.2f}"
        ),
        "Ø aorta ascending / at BCA / at LSA / descending, mm": lambda m: " / ".join(
            f"{m['diameters'][level]:.0f}"
            for level in ("ascending", "bca", "lsa", "descending")
        ),
        "Ø BCA / LCCA / LSA, mm": lambda m: per_branch(m, "diameter_mm", 1),
        "narrowest Ø of the same, mm": lambda m: per_branch(m, "narrowest_mm", 1),
        "take-off upstream, °": lambda m: per_branch(m, "take_off_deg"),
        "lean out of the plane, °": lambda m: per_branch(m, "lean_deg"),
        "out of the plane 40 mm on, mm": lambda m: per_branch(m, "out_of_plane_mm"),
        "length over chord": lambda m: per_branch(m, "tortuosity", 2),
        "span / height, mm": lambda m: f"{m['span_mm']:.0f} / {m['height_mm']:.0f}",
        "first 30 mm against the vertical, °": lambda m: (
            f"{m['ascending_tilt_deg']:.0f}"
        ),
        "turn up to the BCA, °; mean radius, mm": lambda m: (
            f"{m['ascending_turn_deg']:.0f}; {m['bend_radius_mm']:.0f}"
        ),
        "tightest bend of the aorta, mm": lambda m: f"{m['tightest_bend_mm']:.0f}",
        "ostia off the start axis, mm": lambda m: per_branch(m, "axis_offset_mm"),
    }
    rows = [
        [line, *(show(one) for one in found.values())] for line, show in lines.items()
    ]
    return grid(["", *anatomies], rows)


def fields(anatomies):
    """Table of the errors of the fields."""
    rows = []
    for name, anatomy in anatomies.items():
        error = 1e3 * wall.field_error(anatomy)
        figures = (error.mean(), np.percentile(error, 99), error.max())
        checks = wall.lumen_checks(anatomy)
        rows.append(
            [
                name,
                " / ".join(f"{each:.3f}" for each in figures),
                f"{anatomy.lumen.nbytes / 1e6:.1f}",
                "yes" if all(check.passed for check in checks) else "**no**",
            ]
        )
    header = ["", "error of the field mean / p99 / max, mm", "memory, MB"]
    return grid([*header, "all checks pass"], rows)


def against_measured():
    """Table of errors of built centrelines and radii against the measured ones."""
    rows = []
    for name in phantoms.MEASURED:
        tree = phantoms.load(name).tree
        surface = lumen_surface(tree, 1e-3)
        depth = SurfaceDepth(surface)
        measured = json.loads((MEASUREMENTS / f"{name}.json").read_text())["vessels"]
        away, errors = [], []
        for key, vessel in measured.items():
            points = np.array(vessel["points"]) * 1e-3
            line = tree.vessel(key).centreline
            near = line.project(points[:, :3])
            away.append(near.distance)
            branch = tree.vessel(key)
            start = 10e-3 if branch.parent is None else branch.ostium + 3e-3
            own = near.arc_length > start
            own &= near.arc_length < line.length - 10e-3
            built = depth(line.at(near.arc_length[own]).position)
            errors.append(np.abs(built - points[own, 3]))
        away, errors = 1e3 * np.concatenate(away), 1e3 * np.concatenate(errors)
        rows.append(
            [
                name,
                *(f"{np.mean(x):.2f} / {np.percentile(x, 95):.2f} / {x.max():.2f}"
                  for x in (away, errors)),
            ]
        )  # fmt: skip
    header = ["", "centreline, mean / p95 / max, mm", "inscribed radius, the same"]
    return grid(header, rows)


def distributions():
    """Table of sampled sizes of the test arches beside the published ones."""
    seeds = arch.arch_set("test")
    drawn = [seed.parameters() for seed in seeds]
    found = [measures.measure(arch.arch_tree(one)) for one in drawn]
    rows = []

    def row(name, values, table_figures, digits=1):
        mean, deviation = table_figures
        rows.append(
            [
                name,
                f"{mean:.{digits}f} ± {deviation:.{digits}f}" if deviation else "–",
                f"{np.mean(values):.{digits}f} ± {np.std(values):.{digits}f}",
                f"{np.min(values):.{digits}f} to {np.max(values):.{digits}f}",
            ]
        )

    for name, (mean, deviation) in sampler.AORTA_DIAMETERS.items():
        level = name.removesuffix("_radius").replace("_", " ")
        values = [2e3 * getattr(one, name) for one in drawn]
        row(f"Ø aorta, {level}, mm", values, (1e3 * mean, 1e3 * deviation))
    for name, (mean, deviation) in sampler.BRANCH_DIAMETERS.items():
        values = [2e3 * getattr(one, name).radius for one in drawn]
        row(f"Ø {name} at its origin, mm", values, (1e3 * mean, 1e3 * deviation))
    for name, angles in sampler.TAKE_OFFS.items():
        values = [np.degrees(getattr(one, name).take_off) for one in drawn]
        row(f"take-off {name}, °", values, angles)
    row(
        "root to BCA, mm",
        [
            one["bend_radius_mm"] * np.radians(one["ascending_turn_deg"])
            for one in found
        ],
        [1e3 * figure for figure in sampler.ASCENDING_LENGTH],
    )
    nothing = (0.0, 0.0)
    row("turn up to the BCA, °", [m["ascending_turn_deg"] for m in found], nothing)
    row("radius of that bend, mm", [m["bend_radius_mm"] for m in found], nothing)
    branches = [branch for m in found for branch in m["branches"].values()]
    aside = [abs(branch["out_of_plane_mm"]) for branch in branches]
    row("branches out of the plane 40 mm on, mm", aside, nothing)
    bent = [branch["tortuosity"] for branch in branches]
    row("branches, length over chord", bent, nothing, 2)
    return grid(["", "table", "98 test arches", "range"], rows)


def necks():
    """Table of the arteries of neck and arms in the test arches, with their goals."""
    seeds, wanted = arch.arch_set("test_neck"), ("rcca", "rsa", "rva", "lva")
    found = {name: [] for name in wanted}
    for seed in seeds:
        anatomy = arch.build_seed(seed, access="descending")
        measured = measures.measure(anatomy.tree)["branches"]
        for name in wanted:
            vessel = anatomy.tree.vessel(name)
            off = anatomy.tree.vessel(vessel.parent).centreline.at(
                anatomy.tree.origin(name)
            )
            way = vessel.centreline.at(vessel.ostium + 10e-3).tangent
            angle = np.degrees(np.arccos(np.clip(way @ off.tangent, -1.0, 1.0)))
            route = 1e3 * anatomy.route(anatomy.goals[name]).length
            found[name].append((measured[name]["diameter_mm"], angle, route))
    rows = []
    for name, values in found.items():
        lows, highs = np.min(values, axis=0), np.max(values, axis=0)
        spans = zip(lows, highs, (1, 0, 0), strict=True)
        rows.append([name, *(f"{a:.{d}f} to {b:.{d}f}" for a, b, d in spans)])
    header = ["", "Ø 10 mm past the ostium, mm", "leaves its parent at, °"]
    return grid([*header, "route to its goal, mm"], rows)


def gallery(seeds, name):
    """Writes a figure of front and left views of random arches, three in a row."""
    rows = -(-len(seeds) // 3)
    figure = Figure(figsize=(15, 2.625 * rows), layout="constrained")
    axes = figure.subplots(rows, 6, squeeze=False)
    for place, seed in enumerate(seeds):
        anatomy = arch.build_seed(seed)
        for side, view in enumerate(("front", "left")):
            ax = axes[place // 3, 2 * (place % 3) + side]
            draw_anatomy(ax, anatomy, view)
            ax.set_xlabel("")
            ax.set_ylabel("")
            ax.tick_params(labelsize=6)
            ax.set_title(seed.name if side == 0 else "from the left", fontsize=7)
    style.save(figure, IMAGES / name)


def main():
    anatomies = {name: phantoms.load(name) for name in phantoms.PHANTOMS}
    for name in phantoms.MEASURED:
        style.save(anatomy_figure(anatomies[name]), IMAGES / f"anatomy_{name}.png")
    variants = arch.arch_set("test_variants")[:4]
    gallery([*arch.arch_set("test")[:8], *variants], "random_arches.png")
    gallery(arch.arch_set("test_neck")[:6], "neck_arches.png")
    blocks = {
        "shapes": shapes(anatomies),
        "fields": fields(anatomies),
        "against measured": against_measured(),
    }
    put(PAGE, **blocks)
    put(ARCHES, distributions=distributions(), necks=necks())


if __name__ == "__main__":
    argparse.ArgumentParser(description=__doc__.splitlines()[0]).parse_args()
    main()
