"""Tables of docs/results.md and results_detail.md; `results.py` writes the pages."""

import json
from pathlib import Path

import numpy as np
from figures import grid
from results_figures import rate_of, span, values_of

from cathsim_dmc.analysis.intervals import success_interval

DOCS = Path(__file__).parents[1]
PUBLISHED = DOCS / "data/published_results.json"
DIFFICULTY = DOCS / "data/difficulty.json"
TEST_ARCHES = DOCS / "data/test_arches.jsonl"
PUBLISHED_TASKS = ("type1_bca", "type1_lcca", "type2_bca", "type2_lcca")
TAUGHT = ("bc", "dagger")  # algorithms that need demonstrations
NAMES = {"internal": "Internal", "image": "Image", "sequential": "Sequential"}

RESAMPLES = 10_000  # of the bootstrap over seeds

FAILURES = """\
## What fails

- The episodes of a task differ only by 1 mm of the start, so a success of 100 % does
  not extend to other conditions: [robustness](robustness.md) and the
  [leaderboard](leaderboard.md) have distinct conditions. Of {trained} pairs of an agent
  and a task, {once} have one seed.
- Simulator, walls and force readings of the publication differ ([physics](physics.md)):
  success rates can be compared, forces only in their order of magnitude.
"""

SUCCESS = """\
## Success

Cells show ours / published; – was not trained. *Mean* is the mean over tasks and seeds
with the 95 % interval of a stratified bootstrap over seeds (Agarwal et al. 2021, Deep
reinforcement learning at the edge of the statistical precipice, NeurIPS 34). It is
given only where every task has several seeds.
"""

FORCE = """\
## Force

Cells show ours / published, in mN, ± deviation over episodes
([definitions](forces.md)): *mean* is the sum over all contacts, mean over all steps;
*contact* is the largest contact, mean over the steps with contact, nearest to the
published f_mean; *largest* is the largest contact of an episode, in the step where it
is largest, nearest to the published f_max. Both are means over a control step. *Steps*
is the length of the episodes.
"""

HEADER = "agent seeds success worst reward steps mean contact largest".split()
# Indices of the columns of `HEADER` on the page of results.
FORCE_COLUMNS = (0, 5, 6, 7, 8)


def in_grid(cells):
    """Pairs (label, task) of the cells of the grid."""
    return {(cell.label, cell.task) for cell in cells}


def published_label(result):
    """Name of the published agent that a cell reproduces, or None."""
    if taught(result):
        return None
    observation = result.cell["observation"]
    name = NAMES.get(observation) if isinstance(observation, str) else None
    return f"{result.cell['algorithm'].upper()}-{name}" if name else None


def taught(result):
    """Whether a cell has learnt from demonstrations."""
    config = result.values["config"]
    return config["algorithm"] in TAUGHT or bool(config.get("demonstrations"))


def published_agents():
    """Published results, {agent: {task: values}}."""
    return json.loads(PUBLISHED.read_text())["agents"]


def failures(table):
    """Section on failures: missed goals, and forces above the published ones."""
    rows, louder, published = [], [], published_agents()
    for task, label, found in ((t, a, r) for t in table for a, r in table[t].items()):
        rate, count = rate_of(found)
        name = f"{marked(label, found)} ({len(found)})"
        if rate < 1:
            worst = percent(min(result.success for result in found))
            missed = f"{count - round(rate * count)} of {count}"
            rows.append((rate, f"`{task}`", name, missed, worst))
        theirs = published.get(label, {}).get(task)
        ours = values_of(found, "max_force")
        if theirs and ours and np.mean(ours) > theirs["max_force"][0]:
            values = f"{1e3 * np.mean(ours):.0f} / {1e3 * theirs['max_force'][0]:.0f}"
            louder.append((f"`{task}`", name, values))
    counts = [len(found) for of_task in table.values() for found in of_task.values()]
    lines = [FAILURES.format(trained=len(counts), once=counts.count(1))]
    if rows:
        lines += [
            "Policies that miss the goal in some episodes, worst first (seeds):",
            "",
            *grid(
                ("task", "agent", "missed", "success of the worst seed"),
                (cells for _, *cells in sorted(rows)),
            ),
            "",
        ]
    if louder:
        lines += [
            "Policies whose largest contact is above the published one, means:",
            "",
            *grid(("task", "agent", "mN, ours / published"), louder),
            "",
        ]
    return "\n".join(lines)


def successes(table):
    """Section on success on the published tasks, with a row for each agent."""
    published, repeated = published_agents(), set()
    header = ["agent", "seeds", *(f"`{task}`" for task in PUBLISHED_TASKS), "mean"]
    rows = []
    labels = dict.fromkeys(label for t in PUBLISHED_TASKS for label in table.get(t, {}))
    for label in labels:
        of_task = {
            t: table[t][label] for t in PUBLISHED_TASKS if label in table.get(t, {})
        }
        repeated.add(label)
        count = span([len(one) for one in of_task.values()])
        rows.append(success_row(label, count, of_task, published.get(label, {})))
    for name, theirs in published.items():
        if name not in repeated:
            rows.append(success_row(name, "–", {}, theirs))
    return "\n".join([SUCCESS, *grid(header, rows), ""])


def success_row(label, count, of_task, theirs):
    """Cells of a row of `successes`."""
    cells = [label, count]
    for task in PUBLISHED_TASKS:
        found = of_task.get(task)
        ours = marked(percent(rate_of(found)[0]), found) if found else "–"
        cells.append(f"{ours} / {percent(theirs[task]['success'])}" if theirs else ours)
    whole, mean = len(of_task) == len(PUBLISHED_TASKS), "–"
    if whole and min(map(len, of_task.values())) > 1:
        rates = [[result.success for result in one] for one in of_task.values()]
        middle, (low, high) = mean_over_seeds(rates)
        mean = f"{percent(middle)} ({100 * low:.0f}–{100 * high:.0f})"
    return [*cells, mean]


def force_tables(table):
    """Section on steps and forces of the trained agents on each published task."""
    published, lines = published_agents(), [FORCE]
    for task in PUBLISHED_TASKS:
        if task not in table:
            continue
        rows = [HEADER]
        for label, found in table[task].items():
            theirs = published.get(label, {}).get(task)
            rows.append(row(marked(label, found), found, theirs))
        header, *rows = ([cells[n] for n in FORCE_COLUMNS] for cells in rows)
        lines += [f"### {task}", "", *grid(header, rows), ""]
    return "\n".join(lines)


def full_tables(table, cells):
    """Tables with all columns, one for each task."""
    published, lines = published_agents(), []
    planned = in_grid(cells)
    for task in dict.fromkeys((*PUBLISHED_TASKS, *table)):
        rows, repeated = [], set()
        for label, found in table.get(task, {}).items():
            name = published_label(found[0])
            repeated.add(name)
            theirs = published.get(name, {}).get(task)
            rows.append(row(marked(label, found), found, theirs))
        for name, tasks in published.items():
            if name not in repeated and task in tasks:
                why = "missing" if (name, task) in planned else "not trained"
                rows.append(row(f"{name} ({why})", [], tasks[task]))
        lines += [f"## {task}", "", *grid(HEADER, rows), ""]
    return "\n".join(lines)


def other_tasks(table):
    """Section with a table of the unpublished tasks, with results of the expert."""
    experts, rows = expert_rates(), []
    for task, agents_ in table.items():
        if task in PUBLISHED_TASKS:
            continue
        for label, found in agents_.items():
            _, success, _, _, steps, mean, _, largest = figures_of(found)
            expert = percent(experts[task]) if task in experts else "–"
            agent = marked(label, found)
            rows.append([f"`{task}`", agent, success, expert, steps, mean, largest])
    if not rows:
        return ""
    header = "task", "agent", "success (95 %)", "expert", "steps", "mean", "largest"
    lines = ["## Further tasks", "", "Forces as above, in mN.", ""]
    return "\n".join([*lines, *grid(header, rows), ""])


def expert_rates():
    """Success rate of the scripted expert by task, where it was measured."""
    rates = {}
    if DIFFICULTY.exists():
        tasks = json.loads(DIFFICULTY.read_text())["findings"]["tasks"]
        for task, trials in tasks.items():
            if "expert" in trials:
                rates[task] = trials["expert"]["success"]
    if TEST_ARCHES.exists():
        ends = {}
        for line in TEST_ARCHES.read_text().splitlines():
            episode = json.loads(line)
            ends.setdefault(episode["task"], []).append(episode["end"] == "success")
        rates |= {task: sum(reached) / len(reached) for task, reached in ends.items()}
    return rates


def row(label, found, theirs):
    """Cells of a row: our results and the published ones of the same agent."""
    cells = [label, *(figures_of(found) if found else ["–"] * 8)]
    if theirs is not None:
        for place, text in published_figures(theirs).items():
            cells[place] += f" / {text}"
    return cells


def marked(text, found):
    """The text, with a mark if a result is from the physics before version 0.3."""
    forces = (result.evaluation["summary"]["forces"] for result in found)
    return text + " †" * any("mean_sum" not in one for one in forces)


def figures_of(found):
    """Seeds, success, worst seed, reward, steps and forces of one agent, as text."""
    rate, count = rate_of(found)
    success = percent(rate)
    if found[0].evaluation.get("groups"):
        low, high = success_interval(round(rate * count), count)
        success += f" ({100 * low:.0f}–{100 * high:.0f})"
    return [
        str(len(found)),
        success,
        percent(min(result.success for result in found)),
        spread(found, "reward", 1, 0),
        spread(found, "length", 1, 0),
        spread(found, "mean_force", 1e3, 1),
        spread(found, "mean_contact_force", 1e3, 1),
        spread(found, "max_force", 1e3, 0),
    ]


def published_figures(theirs):
    """Published values as text, by the index of our column."""
    return {
        2: percent(theirs["success"]),
        4: "{:.0f} ± {:.0f}".format(*theirs["reward"]),
        7: "{:.0f} ± {:.0f}".format(*(1e3 * value for value in theirs["mean_force"])),
        8: "{:.0f} ± {:.0f}".format(*(1e3 * value for value in theirs["max_force"])),
    }


def spread(found, name, scale, digits):
    """Text of mean ± deviation of a quantity over the episodes of all seeds."""
    values = values_of(found, name)
    if not values:
        return "–"
    deviation = np.std(values, ddof=1) if len(values) > 1 else 0.0
    return f"{scale * np.mean(values):.{digits}f} ± {scale * deviation:.{digits}f}"


def percent(rate):
    return f"{100 * rate:.0f} %"


def clock(seconds):
    """Text of a time in seconds as hours, minutes and seconds."""
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes // 60}:{minutes % 60:02}:{rest:02}"


def mean_over_seeds(scores):
    """Mean over the runs of all tasks, with its 95 % interval over seeds.

    The runs of each task are resampled separately (stratified bootstrap, percentile
    interval; Agarwal et al. 2021, "Deep reinforcement learning at the edge of the
    statistical precipice"). Their interquartile mean is not used, because it would
    leave out one failing task of four.

    Args:
        scores: Scores of the runs (seeds) of each task; their numbers may differ.

    Returns:
        The mean, with equal weights of the tasks, and its interval.

    Raises:
        ValueError: if there is no task, or a task has fewer than two runs.
    """
    tasks = [np.asarray(runs, dtype=np.float64) for runs in scores]
    if not tasks or min(map(len, tasks)) < 2:
        raise ValueError(f"every task needs two runs or more; given are {scores!r}")
    random = np.random.default_rng(0)
    drawn = [
        runs[random.integers(len(runs), size=(RESAMPLES, len(runs)))] for runs in tasks
    ]
    means = np.mean([runs.mean(axis=1) for runs in drawn], axis=0)
    low, high = np.percentile(means, (2.5, 97.5))
    return float(np.mean([runs.mean() for runs in tasks])), (float(low), float(high))


def cost(table):
    """Section on frames and time of the trainings of each agent."""
    lines = [
        "## Frames and time",
        "",
        "Means over seeds. *To 90 %*: frames at which the last 100 training episodes "
        "first had 90 % success. Times are wall times of shared machines; the files in "
        "`results/` have those of each seed with machine, load and commit.",
        "",
    ]
    header = "task", "agent", "seeds", "frames", "time", "frames/s", "frames to 90 %"
    rows = []
    for task, agents_ in table.items():
        for label, found in agents_.items():
            trainings = [result.values["training"] for result in found]
            solved = [one["solved"]["frames"] for one in trainings if one["solved"]]
            columns = [
                task,
                label,
                str(len(found)),
                f"{np.mean([one['frames'] for one in trainings]):,.0f}",
                clock(np.mean([one["seconds"] for one in trainings])),
                f"{np.mean([result.frames_per_second for result in found]):.0f}",
                f"{np.mean(solved):,.0f}" if len(solved) == len(found) else "–",
            ]
            rows.append(columns)
    return "\n".join([*lines, *grid(header, rows), ""])
