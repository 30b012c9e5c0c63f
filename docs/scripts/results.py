"""Writes docs/results.md and results_detail.md from the files of finished cells.

    python benchmarks/trainings.py     # trains missing cells, into results/
    python docs/scripts/results.py

Further inputs are the published results (docs/data/published_results.json), those of
the expert (docs/data/difficulty.json, test_arches.jsonl) and the grid, for missing
cells.
"""

import argparse
import os
import sys
from pathlib import Path

# torchrl must be imported before dm_control.
from cathsim_dmc import agents  # isort: skip  # noqa: F401

from cathsim_dmc import files

sys.path.append(str(Path(__file__).parents[2] / "benchmarks"))
import results_figures as drawings
import results_tables as tables
from trainings import HERE, differences, read_grid, read_result

DOCS = Path(__file__).parents[1]
PAGE, DETAIL_PAGE = "results.md", "results_detail.md"
# Task of the comparison with and without demonstrations.
DEMONSTRATED = "type1_lcca"

BEFORE = """\
† marks figures of trainings before version 0.3. The drive, the sheath, the armature,
the wall and the judged force (now the mean over a control step) have changed since;
these trainings were not repeated. Their forces are those at the end of a control step.

"""

INTRODUCTION = """\
# Results

This page compares success and force of trained agents with the publication (Jianu et
al.).

{before}\
Every policy acts deterministically in 30 episodes with different seeds, or in one
episode on each of the 98 test arches, by the published rule: 2,000 control steps at
most, success within 8 mm of the goal and inside the target branch. Agents have the
preset `tuned`, or `tuned_image`, unless their row states another
([settings](training.md)) or [what is missing](results_detail.md#what-is-missing) names
settings that have changed since.
[Results in detail](results_detail.md) has all columns, seeds and times of training;
`python docs/scripts/results.py` writes both pages from `results/`.
"""

DETAIL = """\
# Results in detail

All columns of [results](results.md) for each task, with seeds, worst seed and times of
training.

{before}\
Cells show ours / published. Success counts the episodes of all seeds, *worst* those of
the worst seed; episodes in their own arches have Wilson's 95 % interval.
Forces are in mN, ± deviation over episodes: see [results](results.md#force).
"""


def main(arguments=None):
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--results", type=Path, default=DOCS.parent / "results")
    parser.add_argument("--grid", type=Path, default=HERE / "grid.toml")
    parser.add_argument("--out", type=Path, default=DOCS / PAGE)
    options = parser.parse_args(arguments)
    results, broken = read_all(options.results)
    cells = read_grid(options.grid)
    for line in broken:
        print(line, file=sys.stderr)
    options.out.parent.mkdir(parents=True, exist_ok=True)
    for name, text in pages(results, broken, cells, options.out.parent).items():
        files.write_text(options.out.with_name(name), text)
    return 1 if broken else 0


def read_all(directory):
    """All results of a directory by name, and a line for each damaged file."""
    results, broken = {}, []
    for path in sorted(directory.glob("*.json")):
        try:
            results[path.stem] = read_result(path)
        except ValueError as error:
            broken.append(str(error).replace(f"{path.parent}{os.sep}", ""))
    return results, broken


def pages(results, broken, cells, directory):
    """Text of both pages by name; draws their figures beside them."""
    table = arranged(results, cells)
    kinds = [found for labels in table.values() for found in labels.values()]
    before = BEFORE if any(tables.marked("", found) for found in kinds) else ""
    main, detail = ([text.format(before=before)] for text in (INTRODUCTION, DETAIL))
    if results:
        main_figures, further_figures = drawn(table, directory)
        main += [tables.failures(table), tables.successes(table)]
        main += [tables.force_tables(table), tables.other_tasks(table), *main_figures]
        detail += [tables.full_tables(table, cells), tables.cost(table)]
        detail += further_figures
    detail.append(standing(results, broken, cells))
    parts = {PAGE: main, DETAIL_PAGE: detail}
    return {name: "\n".join(filter(None, one)) for name, one in parts.items()}


def arranged(results, cells):
    """Results as {task: {label: [by seed]}}, in the order of the grid."""
    order = {cell.name: index for index, cell in enumerate(cells)}
    found = sorted(
        results.values(), key=lambda r: (order.get(r.path.stem, len(order)), r.path)
    )
    tasks = [*tables.PUBLISHED_TASKS, *(r.evaluation["task"] for r in found)]
    table = {task: {} for task in tasks}
    for result in found:
        agents_ = table[result.evaluation["task"]]
        agents_.setdefault(result.cell["label"], []).append(result)
    return {task: agents_ for task, agents_ in table.items() if agents_}


def standing(results, broken, cells):
    """Section on missing or outdated cells of the grid and missing published agents."""
    missing = [cell for cell in cells if cell.name not in results]
    lines = [
        "## What is missing",
        "",
        f"{len(cells) - len(missing)} of the {len(cells)} cells of the grid "
        f"(`benchmarks/grid.toml`) are finished.",
    ]
    rows = {}
    for cell in missing:
        seeds = rows.setdefault(cell.label, {}).setdefault(cell.task, [])
        seeds.append(str(cell.seed))
    lines += [""] * bool(rows)
    for label, tasks in rows.items():
        of = (f"{task} (seed {', '.join(seeds)})" for task, seeds in tasks.items())
        lines.append(f"- {label}: {'; '.join(of)}")
    outdated = {}
    for cell in cells:
        if cell.name in results and (found := differences(results[cell.name], cell)):
            outdated.setdefault(cell.label, {}).update(dict.fromkeys(found))
    if outdated:
        text = "Trained with other settings than the grid and its presets have now:"
        lines += ["", text, ""]
        lines += [f"- {label}: {', '.join(names)}" for label, names in outdated.items()]
    planned = tables.in_grid(cells)
    beyond = [
        f"- {name}: {', '.join(left)}"
        for name, tasks in tables.published_agents().items()
        if (left := [task for task in tasks if (name, task) not in planned])
    ]
    if beyond:
        lines += ["", "Published agents that the grid leaves out:", "", *beyond]
    if broken:
        lines += ["", "Cannot be read, and are left out:", ""]
        lines += [f"- {line}" for line in broken]
    return "\n".join(lines) + "\n"


def drawn(table, directory):
    """Draws the figures beside the pages; returns the parts of both that show them."""
    published = tables.published_agents()
    reference = {task: {} for task in tables.PUBLISHED_TASKS}
    for task, of_task in reference.items():
        for label, found in table.get(task, {}).items():
            theirs = published.get(tables.published_label(found[0]), {})
            if task in theirs:
                of_task[label] = theirs[task]["max_force"]
    images = directory / "images"
    return drawings.drawn(table, reference, demonstrated(table), images)


def demonstrated(table):
    """Agents to compare on `DEMONSTRATED`; empty if none learnt from demonstrations."""
    agents_ = table.get(DEMONSTRATED, {}).items()
    compared = {k: v for k, v in agents_ if v[0].cell["observation"] == "internal"}
    if any(tables.taught(result) for found in compared.values() for result in found):
        return compared
    return {}


if __name__ == "__main__":
    sys.exit(main())
