"""Writes docs/difficulty.md's tables from reports of `python benchmarks/difficulty.py`.

    python benchmarks/difficulty.py --out docs/data/difficulty.json
    python docs/scripts/difficulty.py

Further reports, such as of single tasks or policies, are merged into that file: python
docs/scripts/difficulty.py REPORT.json ... If several have the same policy and task, the
one with most episodes is kept, or else the last.
"""

import argparse
import json
import sys
from pathlib import Path

import figures

PAGE = Path(__file__).parents[1] / "difficulty.md"
DATA = PAGE.parent / "data" / "difficulty.json"
COMMAND = "python benchmarks/difficulty.py"
POLICIES = {
    "push": "straight push",
    "random": "random actions",
    "random_curl": "push, random curl",
    "expert": "expert",
}


def main(paths):
    reports = [json.loads(path.read_text()) for path in (DATA, *paths) if path.exists()]
    missing = [str(path) for path in paths if not path.exists()]
    if missing or not reports:
        sys.exit(f"no report at {', '.join(missing) or DATA}; see the usage above")
    report = merged(reports)
    if paths or "commit" not in reports[0]:
        figures.keep(DATA.stem, report, COMMAND)
    since = figures.since(json.loads(DATA.read_text()))
    figures.put(PAGE, measured=[since, "", *tables(report)])


def merged(reports):
    """Merges reports with equal limits: the union of their tasks and policies."""
    limits, found, checks = {}, {}, {}
    for report in reports:
        for key, limit in report["findings"]["limits"].items():
            if limits.setdefault(key, limit) != limit:
                sys.exit(f"the reports cut off {key!r} by different rules")
        bounds = {check["name"]: check for check in report["checks"]}
        for task, trials in report["findings"]["tasks"].items():
            kept = found.setdefault(task, {})
            for policy, trial in trials.items():
                if kept.get(policy, {"episodes": 0})["episodes"] <= trial["episodes"]:
                    kept[policy] = trial
                    name = f"{task}, {POLICIES[policy]}"
                    checks.update({name: bounds[name]} if name in bounds else {})
    return {
        "checks": list(checks.values()),
        "passed": all(check["passed"] for check in checks.values()),
        "findings": {"limits": limits, "tasks": found},
    }


def tables(report):
    """The tables as lines of Markdown."""
    header, found = ["task", *POLICIES.values()], report["findings"]["tasks"]
    order = sorted(found, key=lambda name: (name.startswith("femoral"), name))

    def shown(cell):
        rows = ([f"`{n}`", *(cell(found[n].get(p)) for p in POLICIES)] for n in order)
        return figures.grid(header, rows)

    lines = [
        "Success, % (95 % interval), and number of episodes:",
        "",
        *shown(_success),
        "",
        "Mean force on the wall (sum over all contacts, mean over the steps) / largest "
        "contact of an episode (mean over the episodes), mN; control steps:",
        "",
        *shown(_force),
    ]
    missed = [check for check in report["checks"] if not check["passed"]]
    end = ":" if missed else "."
    lines += ["", f"{len(report['checks'])} bounds, {len(missed)} missed{end}", ""]
    lines += [
        f"- {c['name']}: {c['value']:.0f} % where the bound is {c['bound']} % "
        f"({c['note']})"
        for c in missed
    ]
    return lines


def _success(trial):
    if trial is None:
        return "–"
    low, high = (100 * bound for bound in trial["success_ci95"])
    rate = 100 * trial["success"]
    return f"{rate:.0f} ({low:.0f}–{high:.0f}), {trial['episodes']}"


def _force(trial):
    if trial is None:
        return "–"
    mean, largest = 1e3 * trial["mean_force"], 1e3 * trial["max_force"]
    return f"{mean:.1f} / {largest:.0f}; {trial['steps']:.0f}"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("reports", nargs="*", type=Path, help="further reports")
    main(parser.parse_args().reports)
