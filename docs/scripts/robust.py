"""The tables of docs/robustness.md and robustness_pair.md.

The input is the files of benchmarks/robust.py.

    python docs/scripts/robust.py RUN.jsonl … [--keep]

`--keep` first writes the lines into docs/data/robust.jsonl, where they replace those of
the same cells; without files, the tables are made from that file.
"""

import argparse
import json
from pathlib import Path

from figures import grid, put

from cathsim_dmc import files
from cathsim_dmc.analysis.intervals import success_interval

DOCS = Path(__file__).parents[1]
DATA = DOCS / "data" / "robust.jsonl"
PAGES = DOCS / "robustness.md", DOCS / "robustness_pair.md"
_FIGURES = "safe, 0.5 N", "steps", "mean force, mN", "largest sum, N"
_KEYS = ("policy", "part", "goal", "access", "anatomy", "change", "arch", "devices")
_KEYS += ("radius",)
_HELD_OUT = {"arches": "held-out arches", "neck": "held-out arches with a neck"}
_PARTS = {
    **_HELD_OUT,
    "variants": "kinds of arches",
    "anatomies": "phantoms and scans",
    "changes": "one change at a time",
    "narrow": "branches that are too narrow",
}


def key(row):
    return tuple(row.get(name) for name in _KEYS)


def read(path):
    return [json.loads(line) for line in path.read_text().splitlines()]


def rate(successes, episodes):
    """Text of success with its interval over distinct conditions, in percent."""
    low, high = success_interval(successes, episodes)
    share = 100 * successes / episodes
    return f"{share:.0f} ({100 * low:.0f}–{100 * high:.0f}), {episodes}"


def figures(rows):
    """Cells of the columns of `_FIGURES` for rows that are pooled."""
    count = sum(row["episodes"] for row in rows)
    mean = {
        name: sum(row[name] * row["episodes"] for row in rows) / count
        for name in ("steps", "mean_force")
    }
    return [
        f"{100 * sum(row['safe'][0] for row in rows) / count:.0f}",
        f"{mean['steps']:.0f}",
        f"{1e3 * mean['mean_force']:.1f}",
        f"{max(row['largest_sum'] for row in rows):.2f}",
    ]


def pooled(rows):
    return rate(
        sum(row["success"] for row in rows), sum(row["episodes"] for row in rows)
    )


def arches(rows):
    """Table of held-out arches with a row for each policy, branch and access."""
    header = ["policy", "branch", "access", "success, % (95 %), arches", *_FIGURES]
    lines = []
    for policy in sorted({row["policy"] for row in rows}):
        own = [row for row in rows if row["policy"] == policy]
        groups = [(row["goal"].upper(), row["access"], [row]) for row in own]
        for goal, access, group in [*groups, ("all", "both", own)]:
            cells = [f"`{policy}`", goal, access, pooled(group)]
            lines.append([*cells, *figures(group)])
    return grid(header, lines)


def shares(rows, column, field, shown):
    """Table of success by the groups of `field` of the rows, for each policy."""
    lines = []
    for policy in sorted({row["policy"] for row in rows}):
        counts = {}
        for row in (row for row in rows if row["policy"] == policy):
            for name, (good, episodes) in row.get(field, {}).items():
                old = counts.get(name, (0, 0))
                counts[name] = old[0] + good, old[1] + episodes
        lines += [(f"`{policy}`", shown(n), rate(*c)) for n, c in counts.items()]
    return grid(("policy", column, "success, % (95 %), episodes"), lines)


def devices(rows):
    """Table of success by device, over all cells of a policy."""
    return shares(rows, "device", "by_device", "`{}`".format)


def kinds(rows):
    """Table of success by kind of arch, over the held-out arches of a policy."""
    return shares(
        rows, "kind", "by_kind", lambda n: n.replace("_", " ").removesuffix(" normal")
    )


def anatomies(rows):
    """Table of phantoms and scans, with a row for each policy and anatomy."""
    header = ["policy", "anatomy", "branches × accesses", "success, % (95 %), episodes"]
    lines = []
    for policy, name in dict.fromkeys((row["policy"], row["anatomy"]) for row in rows):
        own = [r for r in rows if (r["policy"], r["anatomy"]) == (policy, name)]
        cells = [f"`{policy}`", name, len(own), pooled(own)]
        lines.append([*cells, *figures(own)])
    return grid([*header, *_FIGURES], lines)


def weakest(rows):
    """Table of cells of the phantoms with success below 90 %."""
    cells = {(r["policy"], r["anatomy"], r["goal"], r["access"]): r for r in rows}
    lines = []
    for (policy, *cell), row in cells.items():
        if row["success"] < 0.9 * row["episodes"]:
            beside = cells.get(("expert", *cell))
            counts = [
                f"{one['success']} of {one['episodes']}" if one else "–"
                for one in (row, beside)
            ]
            place = cell[0], cell[1].upper(), cell[2] or "inlet"
            lines.append([f"`{policy}`", *place, *counts])
    header = "policy", "anatomy", "branch", "access", "success", "`expert`"
    return grid(header, lines) if lines else ["None."]


def pairs(rows):
    """Table of a guidewire in a catheter, with a row for each cell, worst first."""
    header = ["policy", "anatomy", "branch", "success, % (95 %), episodes", *_FIGURES]
    lines = []
    for row in sorted(
        rows, key=lambda r: (r["success"] / r["episodes"], r["safe"][0] / r["episodes"])
    ):
        place = row.get("anatomy") or _HELD_OUT[row["part"]]
        cells = [f"`{row['policy']}`", place, row["goal"].upper(), pooled([row])]
        lines.append([*cells, *figures([row])])
    return grid(header, lines)


def changes(rows):
    """Table of the success of each policy with one change at a time."""
    names = list(dict.fromkeys(row["policy"] for row in rows))
    lines = []
    for change in dict.fromkeys(row["change"] for row in rows):
        own = {row["policy"]: row for row in rows if row["change"] == change}
        cells = [
            f"{own[n]['success']} of {own[n]['episodes']}" if n in own else "–"
            for n in names
        ]
        lines.append([change.replace("_", " "), *cells])
    return grid(["change", *(f"`{name}`" for name in names)], lines)


def narrow(rows):
    """Table of branches that are too narrow, with results for each radius."""
    lines = [
        "| policy | radius, mm | arches | episodes | reached | ended by giving up "
        "| steps | largest sum, N |",
        "|---" * 8 + "|",
    ]
    for policy, radius in dict.fromkeys((r["policy"], r["radius"]) for r in rows):
        own = [r for r in rows if (r["policy"], r["radius"]) == (policy, radius)]
        total = {
            name: sum(row[name] for row in own)
            for name in ("episodes", "success", "given_up")
        }
        steps = sum(row["steps"] * row["episodes"] for row in own) / total["episodes"]
        lines.append(
            f"| `{policy}` | {radius} | {len(own)} | {total['episodes']} "
            f"| {total['success']} | {total['given_up']} | {steps:.0f} "
            f"| {max(row['largest_sum'] for row in own):.2f} |"
        )
    return lines


def measured(rows):
    """Table of when, and at which commit, the cells of a policy were played."""
    count = {}
    for row in rows:
        commit = row["commit"][:7] + row["commit"][40:]
        place = row["policy"], _PARTS[row["part"]], row["date"], commit
        count[place] = count.get(place, 0) + 1
    lines = [
        (f"`{policy}`", part, number, date, commit)
        for (policy, part, date, commit), number in sorted(count.items())
    ]
    return grid(("policy", "table", "cells", "date", "commit"), lines)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("runs", nargs="*", type=Path)
    parser.add_argument("--keep", action="store_true")
    options = parser.parse_args()
    rows = {key(row): row for row in (read(DATA) if DATA.exists() else [])}
    for path in options.runs:
        rows |= {key(row): row for row in read(path)}
    if options.keep:
        lines = (json.dumps(row) for row in rows.values())
        files.write_text(DATA, "\n".join(lines) + "\n")
    coaxial = [row for row in rows.values() if row.get("devices")]
    rows = {key: row for key, row in rows.items() if row not in coaxial}
    makers = {"arches": arches, "anatomies": anatomies, "changes": changes}
    makers |= {"narrow": narrow}
    found = {
        name: make([row for row in rows.values() if row["part"] == name])
        for name, make in makers.items()
    }
    varied = [r for r in rows.values() if r["part"] not in ("changes", "narrow")]
    found["weakest"] = weakest([r for r in varied if r["part"] == "anatomies"])
    found["devices"] = devices(varied)
    found["kinds"] = kinds([r for r in varied if r["part"] != "anatomies"])
    tabled = "anatomies", *_HELD_OUT
    found["pair"] = pairs([row for row in coaxial if row["part"] in tabled])
    found["measured"] = measured(rows.values())
    found["pair measured"] = measured(coaxial)
    for page in PAGES:
        text = page.read_text()
        own = {name: x for name, x in found.items() if f"<!-- {name} -->" in text}
        put(page, **own)


if __name__ == "__main__":
    main()
