"""Imports of scans with known truth: names right, asked or wrong, entry, radii."""

import argparse
import sys
import tempfile
import time
from collections import defaultdict
from pathlib import Path

import import_cases
import numpy as np
import trimesh
from import_cases import ASK, Case

from cathsim_dmc import files
from cathsim_dmc.anatomy.anatomy import Anatomy
from cathsim_dmc.anatomy.centreline import VesselTree
from cathsim_dmc.anatomy.scan.importer import import_scan
from cathsim_dmc.anatomy.scan.naming import BRANCHES
from cathsim_dmc.cli.options import show
from cathsim_dmc.validation.checks import Check, Report

ENTRY = 20e-3  # m, distance of the inlet from the end of the descending aorta
LONG = 22e-3  # m past its ostium; shorter branches need no name
CLEAR = 6e-3  # m past an ostium, beyond which a vessel differs from its parent
MARGIN = 15e-3  # m at the ends of the aorta, where its radius is not compared
WORDS = ("right", "asked", "wrong", "refused")


def run(case: Case) -> dict:
    """Import one case and compare it with its truth."""
    tree = import_cases.truth(case)
    lumen = import_cases.surface(case, tree)
    out: dict = {"case": case.name, "kind": case.kind, "answer": case.answer}
    out["triangles"] = len(lumen.faces)
    notes: list[str] = []
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "lumen.ply"
        mesh = trimesh.Trimesh(1e3 * lumen.vertices, lumen.faces, process=False)
        mesh.export(path)
        start = time.process_time()
        try:
            anatomy = import_scan(path, notes=notes)
        except ValueError as error:
            asks = " mirror" in str(error) or "--heart" in str(error)
            out |= {"names": "asked" if asks else "refused", "said": str(error)}
            return out
        finally:
            out["cpu_s"] = round(time.process_time() - start, 2)
    back = np.linalg.inv(import_cases.turn(case))
    return out | compared(anatomy, tree, back) | {"notes": notes}


def compared(anatomy: Anatomy, tree: VesselTree, back: np.ndarray) -> dict:
    """Comparison of names, entry and radii of an import with the truth."""
    wrong, missing = [], []
    found = {}
    for name, vessel in anatomy.tree.vessels.items():
        if name != anatomy.tree.root.name:
            line = vessel.centreline
            start = min(vessel.ostium + CLEAR, line.length - 1e-3)
            s = np.arange(start, line.length, 1e-3)
            found[name] = whose(tree, line.at(s).position @ back.T)
    for name, (first, last) in found.items():
        if name in (*BRANCHES, "rva") and name not in (first, last):
            wrong.append(f"{name} is {first}")
    for name, vessel in tree.vessels.items():
        if "_" in name:  # an unnamed second branch of a phantom's vessel
            continue
        visible = vessel.centreline.length - vessel.ostium > LONG
        if vessel.parent is not None and visible and name not in found:
            missing.append(name)
    root = tree.root.centreline
    heart, end = root.points[0], root.points[-1]
    entry = anatomy.inlet.position @ back.T
    far = float(np.linalg.norm(entry - end))
    line = anatomy.tree.root.centreline
    near = root.project(line.points @ back.T)
    inner = (near.arc_length > MARGIN) & (near.arc_length < root.length - MARGIN)
    error = line.radii[inner] - near.radius[inner]
    names = "wrong" if wrong else "asked" if missing else "right"
    return {
        "names": names,
        "wrong": wrong,
        "missing": missing,
        "found": sorted(found),
        "entry": bool(far < ENTRY and far < np.linalg.norm(entry - heart)),
        "radius_mm": round(1e3 * float(np.median(error)), 3) if len(error) else None,
        "radius_error_mm": round(1e3 * float(np.median(abs(error))), 3)
        if len(error)
        else None,
    }


def whose(tree: VesselTree, points: np.ndarray) -> tuple[str, str]:
    """Names of the vessels that hold the first and the last third of points (n, 3)."""
    names = [name.split("_")[0] for name in tree.vessels]
    depth = np.stack(list(tree.depths(points).values()))
    owner = depth.argmax(axis=0)
    third = max(1, len(points) // 3)
    first, last = (
        np.bincount(part).argmax() for part in (owner[:third], owner[-third:])
    )
    return names[int(first)], names[int(last)]


def report(rows: list[dict]) -> Report:
    """Counts of all cases and of those with visible names, and their table."""
    groups = defaultdict(list)
    for row in rows:
        groups[row["kind"]].append(row)
    shown = [row for row in rows if row["answer"] != ASK]
    asks = [row for row in rows if row["answer"] == ASK]
    groups["**all that show their names**"] = shown
    groups["**all that must be asked for**"] = asks
    head = (
        "| cases | number | names right | asked | wrong | refused | entry right | "
        "radius of the aorta, error (median, mm) |\n|---|---|---|---|---|---|---|---|"
    )
    right = 100.0 * counted(shown)["right"] / max(len(shown), 1)
    checks = [
        Check.at_most("cases with a wrong name", counted(rows)["wrong"], 0),
        Check.at_least("named right, of those that show their names", right, 95, "%"),
    ]
    findings = {"cases": len(rows), "show their names": len(shown)} | counted(shown)
    lines = [head, *(_line(kind, group) for kind, group in groups.items())]
    return Report("imports", checks, findings | {"table": "\n".join(lines)})


def counted(rows: list[dict]) -> dict[str, int]:
    """Number of cases with each result of `WORDS`."""
    return {word: sum(row["names"] == word for row in rows) for word in WORDS}


def _line(kind: str, rows: list[dict]) -> str:
    entered = [row["entry"] for row in rows if "entry" in row]
    errors = [row["radius_error_mm"] for row in rows if row.get("radius_error_mm")]
    radius = f"{np.median(errors):.2f}" if errors else ""
    cells = [kind, len(rows), *counted(rows).values()]
    cells += [f"{sum(entered)} of {len(entered)}", radius]
    return "| " + " | ".join(map(str, cells)) + " |"


def main() -> int:
    """Run the cases that are not in the file yet, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path, help="JSON lines, one per case; resumed")
    parser.add_argument("--only", default="", help="part of a case's name")
    parser.add_argument(
        "--seed", type=int, default=import_cases.SEED, help="of the first case"
    )
    parser.add_argument("--part", default="0/1", help="k/n: every n-th case from k on")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    options = parser.parse_args()
    files.require_file(options.out)
    first, step = map(int, options.part.split("/"))
    chosen = [c for c in import_cases.cases(options.seed) if options.only in c.name]
    found = report(import_cases.resumed(options.out, chosen[first::step], run))
    if not options.json:
        print(found.findings["table"])
    return show(found, options.json)


if __name__ == "__main__":
    sys.exit(main())
