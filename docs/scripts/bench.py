"""Rewrites docs/bench.md and bench_sensitivity.md: simulated and measured guidewires.

``python docs/scripts/bench.py REPORT``

REPORT is the output of ``python benchmarks/wires.py DIRECTORY``. Only statistics are
written: the measured data may not be redistributed.
"""

import argparse
import json
from pathlib import Path

import figures
import numpy as np
from matplotlib.figure import Figure

from cathsim_dmc import style
from cathsim_dmc.validation.bench import BASELINES, WAYS
from cathsim_dmc.validation.checks import Check, Report

PAGE = figures.ROOT / "docs" / "bench.md"
PAGES = {"frames": PAGE, "sensitivity": PAGE.with_name("bench_sensitivity.md")}
FIGURE = PAGE.parent / "images" / "validation_bench.png"
SHOWN = (*WAYS, "centreline", "nearest")


def main(report):
    found = json.loads(Path(report).read_text(encoding="utf-8"))
    checks = [Check(**check) for check in found["checks"]]
    measured = Report(found["title"], checks, found["findings"])
    command = "python benchmarks/wires.py"
    figures.keep("validation_bench", measured.as_dict(), command)
    found = tables(measured).items()
    for (name, page), (title, rows) in zip(PAGES.items(), found, strict=True):
        figures.put(page, **{name: [f"{title}:", "", *figures.grid(rows[0], rows[1:])]})
    figures.main([])
    style.save(figure(measured.findings["frames"]), FIGURE)


def tables(report: Report) -> dict[str, list[list[str]]]:
    """Tables by title, rows of text with the header first: frames and sensitivity."""
    frames = [["frame", "wire, tip in", "half", *WAYS, *BASELINES]]
    for row in report.findings["frames"]:
        half = "folded" if row["folded"] else row["half"]
        cells = [row["frame"], f"{row['wire']}, {row['vessel']}", half]
        for name in (*WAYS, *BASELINES):
            each = row[name]
            turned = row["wire"] == "angled" and name in WAYS
            median = f" / {each['median_rms']:.1f}" if turned else ""
            cells.append(f"{each['rms']:.1f}{median} ({each['largest']:.0f})")
        frames.append(cells)
    found = {"RMS distance: best turn / median turn (largest distance), mm": frames}
    variants = report.findings.get("sensitivity", {})
    if variants:
        names = list(next(iter(variants.values())))
        rows = [
            [key, *(f"{row[n]:.2f}" for n in names)] for key, row in variants.items()
        ]
        found["Median RMS distance by variant, mm"] = [["variant", *names], *rows]
    return found


def figure(rows):
    """Figure of the RMS distance of every frame, by insertion history and baseline."""
    figure = Figure(figsize=(9.2, 4.2), layout="constrained")
    rows = sorted(rows, key=lambda row: (row["folded"], row["wire"], row["frame"]))
    ax = figure.subplots()
    style.tidy(ax)
    places = np.arange(len(rows))
    for index, name in enumerate(SHOWN):
        values = [row[name]["rms"] for row in rows]
        marker = "o" if name in WAYS else "_"
        ax.plot(
            places + 0.1 * (index - 2),
            values,
            marker,
            markersize=6 if marker == "o" else 12,
            markeredgewidth=1 if marker == "o" else 2,
            color=style.COLOURS[index],
            label=name,
        )
    ax.set_yscale("log")
    ax.set_yticks([0.5, 1, 2, 5, 10, 20], ["0.5", "1", "2", "5", "10", "20"])
    ax.minorticks_off()
    labels = [
        f"{row['frame']}\n{row['vessel']}{', folded' if row['folded'] else ''}"
        for row in rows
    ]
    ax.set_xticks(places, labels, rotation=60, ha="right", fontsize=7)
    ax.set_ylabel("RMS distance from the measured wire, mm")
    ax.legend(ncols=len(SHOWN), loc="lower center", bbox_to_anchor=(0.5, 1.0))
    return figure


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("report", help="output of benchmarks/wires.py")
    main(parser.parse_args().report)
