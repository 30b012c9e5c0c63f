"""Figures of docs/results.md: learning curves, box plots, force maps."""

import math

import numpy as np
from judgement import map_from_values
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter

from cathsim_dmc import style, suite
from cathsim_dmc.analysis.heatmap import AP_AXES, ForceMap
from cathsim_dmc.analysis.intervals import success_interval
from cathsim_dmc.style import COLOURS

DPI = 90
PANEL = (4.2, 3.0)  # inches
STYLES = ("-", "--", ":")
POINTS = 200


def rate_of(found):
    """Success rate over the episodes of all seeds, and the number of episodes."""
    counts = [result.evaluation["summary"]["episodes"] for result in found]
    rates = [result.success for result in found]
    reached = sum(round(r * n) for r, n in zip(rates, counts, strict=True))
    return reached / sum(counts), sum(counts)


def values_of(found, name):
    """Values of a quantity in the episodes of all seeds, without missing ones."""
    return [v for r in found for v in r.evaluation["episodes"][name] if v is not None]


class Looks:
    """Colour and line style of each agent, the same in every figure."""

    def __init__(self, labels):
        self._order = {label: index for index, label in enumerate(labels)}

    def __getitem__(self, label):
        index = self._order[label]
        line = STYLES[index // len(COLOURS) % len(STYLES)]
        return {"color": COLOURS[index % len(COLOURS)], "linestyle": line}


def learning_curves(by_task, looks, path):
    """Draws success in training over frames: mean over seeds, band from least to most.

    Args:
        by_task: Results of each task by the label of the agent: {task: {label: [...]}}.
        looks: Looks of the agents.
        path: Path of the PNG.
    """
    figure, panels = _panels(len(by_task))
    counts: dict[str, set[int]] = {}
    for agents in by_task.values():
        for label, results in agents.items():
            counts.setdefault(label, set()).add(len(results))
    for axes, (task, agents) in zip(panels, by_task.items(), strict=False):
        for label, results in agents.items():
            frames, success = _common(results)
            if frames is None:
                continue
            line = {**looks[label], "label": f"{label} ({_seeds(*counts[label])})"}
            axes.plot(frames, 100 * success.mean(0), lw=1.6, **line)
            if len(success) > 1:
                axes.fill_between(
                    frames,
                    100 * success.min(0),
                    100 * success.max(0),
                    color=line["color"],
                    alpha=0.2,
                    lw=0,
                )
        _by_frames(axes)
        axes.set_title(task, fontsize=10)
        axes.set_ylabel("success in training, %")
    named = {
        label: line
        for axes in figure.axes
        for line, label in zip(*axes.get_legend_handles_labels(), strict=True)
    }
    lines, labels = named.values(), named.keys()
    figure.legend(lines, labels, fontsize=7, loc="outside lower center", ncols=3)
    style.save(figure, path, DPI)
    return path


def with_demonstrations(agents, looks, path):
    """Draws success of agents on one task over the frames of their training.

    Args:
        agents: Results of the task by label: {label: [...]}.
        looks: Looks of the agents.
        path: Path of the PNG.
    """
    figure, (axes,) = _panels(1, height=3.6, width=8.4)
    for label, results in agents.items():
        line = looks[label]
        frames, success = _common(results)
        if frames is not None:
            axes.plot(frames, 100 * success.mean(0), lw=1.2, alpha=0.6, **line)
        rate, count = rate_of(results)
        interval = success_interval(round(rate * count), count)
        axes.errorbar(
            [np.mean([result.training["frames"] for result in results])],
            [100 * rate],
            yerr=100 * np.abs(np.array(interval)[:, None] - rate),
            marker="o",
            capsize=3,
            **line,
            label=f"{label} ({_seeds(len(results))})",
        )
    _by_frames(axes)
    axes.set_ylabel("success, %")
    figure.legend(fontsize=8, loc="outside right center", handlelength=4)
    style.save(figure, path, DPI)
    return path


def _by_frames(axes):
    """Makes axes of success, %, over frames."""
    axes.set_xscale("log")
    axes.set_ylim(-3, 103)
    axes.set_xticks([1e4, 2e4, 5e4, 1e5, 2e5, 5e5])
    axes.minorticks_off()
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    axes.set_xlabel("frames")
    axes.grid(alpha=0.3)


# Episodes after which the running mean of success is shown.
_FIRST_EPISODES = 100


def _common(results):
    """Frames (P,) in the range of all seeds, and success (seeds, P) at them."""
    curves = []
    for result in results:
        curve = result.training["curve"]
        columns = (curve.get(name, ()) for name in ("frames", "success", "episodes"))
        # Successful episodes end first, so a mean over the first few is biased.
        known = [
            (frames, success)
            for frames, success, episodes in zip(*columns, strict=True)
            if success is not None and episodes >= _FIRST_EPISODES
        ]
        if len(known) >= 2:
            curves.append(np.array(known, dtype=float))
    if not curves:
        return None, None
    frames = np.linspace(
        max(c[0, 0] for c in curves), min(c[-1, 0] for c in curves), POINTS
    )
    return frames, np.array([np.interp(frames, c[:, 0], c[:, 1]) for c in curves])


def force_boxes(by_task, looks, published, path):
    """Draws largest contact forces of evaluation episodes, with a box for each agent.

    Args:
        by_task: Results, as in `learning_curves`.
        looks: Looks of the agents.
        published: Published (mean, deviation) in N by task and label, drawn as bars.
        path: Path of the PNG.
    """
    widest = max(len(agents) for agents in by_task.values())
    figure, panels = _panels(len(by_task), height=1.4 + 0.42 * widest)
    for axes, (task, agents) in zip(panels, by_task.items(), strict=False):
        labels = list(agents)[::-1]
        for row, label in enumerate(labels):
            forces = [1e3 * value for value in values_of(agents[label], "max_force")]
            colour = looks[label]["color"]
            axes.boxplot(
                forces,
                positions=[row],
                orientation="horizontal",
                widths=0.6,
                patch_artist=True,
                boxprops={"facecolor": colour, "alpha": 0.5},
                medianprops={"color": "black"},
                flierprops={"markersize": 3, "markeredgecolor": colour},
            )
            reference = published.get(task, {}).get(label)
            if reference is not None:
                mean, deviation = (1e3 * value for value in reference)
                axes.errorbar(
                    mean, row - 0.4, xerr=deviation, fmt="d", ms=4, color="0.35", lw=1
                )
        names = [f"{label}\n{_seeds(len(agents[label]))}" for label in labels]
        axes.set_yticks(range(len(labels)), names, fontsize=7)
        axes.set_ylim(-0.8, len(labels) - 0.4)
        axes.set_xlim(left=0)
        axes.set_title(task, fontsize=10)
        axes.set_xlabel("largest contact, mN")
        axes.grid(axis="x", alpha=0.3)
    style.save(figure, path, DPI)
    return path


def force_maps(chosen, path):
    """Draws maps of the mean contact force for one agent of each task.

    Args:
        chosen: Results of all seeds of one agent for each task, {task: [...]}.
        path: Path of the PNG.

    Returns:
        The path, or None if no task has a map that can be drawn.
    """
    fields = {}
    for task, results in chosen.items():
        maps = [r.evaluation["force_map"] for r in results if r.evaluation["force_map"]]
        definition = suite.TASKS.get(task)
        if maps and definition is not None and definition.anatomy is not None:
            fields[task] = (_merged([map_from_values(one) for one in maps]), results)
    if not fields:
        return None
    figure, panels = _panels(len(fields), columns=4, width=2.9, height=3.9)
    for axes, (task, (field, results)) in zip(panels, fields.items(), strict=False):
        _draw_map(figure, axes, field, task)
        episodes = sum(r.evaluation["summary"]["episodes"] for r in results)
        label = results[0].cell["label"]
        axes.set_title(
            f"{task}\n{label}\n{_seeds(len(results))}, {episodes} episodes", fontsize=8
        )
    style.save(figure, path, DPI)
    return path


def _draw_map(figure, axes, field, task):
    definition = suite.TASKS[task]
    surface = suite.load_anatomy(definition.anatomy, definition.access).surface
    triangles = 1e3 * np.asarray(surface.vertices)[:, AP_AXES][surface.faces]
    # Dark and wide below light, which leaves a rim around the silhouette.
    for colour, rim in (("0.5", 1.8), ("0.92", 0.5)):
        axes.add_collection(
            PolyCollection(
                list(triangles), facecolors=colour, edgecolors=colour, lw=rim,
                rasterized=True,
            )
        )  # fmt: skip
    touched = field.mean[field.count > 0]
    # A percentile limits the effect of single large forces on the colour scale.
    limit = 1e3 * float(np.percentile(touched, 98)) if len(touched) else 1.0
    image = axes.pcolormesh(
        1e3 * field.x_edges,
        1e3 * field.z_edges,
        1e3 * np.ma.masked_invalid(field.mean),
        cmap="inferno_r",
        vmin=0.0,
        vmax=limit or 1.0,
        zorder=3,
    )
    bar = figure.colorbar(image, ax=axes, extend="max", shrink=0.7, pad=0.02)
    bar.set_label("mean contact force, mN", fontsize=7)
    bar.ax.tick_params(labelsize=7)
    axes.set_xlim(1e3 * field.x_edges[0], 1e3 * field.x_edges[-1])
    axes.set_ylim(1e3 * field.z_edges[0], 1e3 * field.z_edges[-1])
    axes.set_aspect("equal")
    axes.tick_params(labelsize=7)
    axes.set_xlabel("x, mm (patient left →)", fontsize=7)
    axes.set_ylabel("z, mm (head ↑)", fontsize=7)


def _merged(maps):
    """Merges maps of the same vessel, with equal weights of all contacts."""
    first = maps[0]
    total = sum(np.nan_to_num(one.mean) * one.count for one in maps)
    count = sum(one.count for one in maps)
    mean = np.full(count.shape, np.nan)
    np.divide(total, count, out=mean, where=count > 0)
    outside = sum(one.outside for one in maps)
    return ForceMap(first.x_edges, first.z_edges, mean, count, outside)


def _panels(count, columns=2, width=PANEL[0], height=PANEL[1]):
    columns = min(columns, count)
    rows = math.ceil(count / columns)
    figure = Figure(figsize=(columns * width, rows * height), layout="constrained")
    panels = figure.subplots(rows, columns, squeeze=False).ravel()
    for unused in panels[count:]:
        unused.remove()
    return figure, panels


def span(counts):
    """Text of the least and the largest of some whole numbers, once if they agree."""
    return "–".join(map(str, sorted({min(counts), max(counts)})))


def _seeds(*counts):
    return f"{span(counts)} seed" + "s" * (max(counts) != 1)


def drawn(table, reference, compared, images):
    """Draws the figures.

    Args:
        table: {task: {label: [results by seed]}}.
        reference: Published mean and deviation of the largest force, N, by task and
            label, for every published task.
        compared: {label: [results]} with and without demonstrations on one task.
        images: Folder of the figures.

    Returns:
        Markdown parts with the figures of the published tasks, and of all others.
    """
    looks = Looks(dict.fromkeys(label for one in table.values() for label in one))
    main = {task: table[task] for task in reference if task in table}
    further = {task: one for task, one in table.items() if task not in main}
    shown_main, shown_further = ["## Figures\n"], ["## Figures\n"]
    diamonds = "; whiskers at 1.5 interquartile ranges. Diamonds are the published mean"
    for parts, which, name, tasks, more in (
        (shown_main, "published", "", main, f"{diamonds} ± deviation"),
        (shown_further, "further", "_further", further, ""),
    ):
        if not tasks:
            continue
        path = learning_curves(tasks, looks, images / f"results_curves{name}.png")
        parts += shown(
            path,
            f"Success in training on the {which} tasks, mean over seeds (number in the "
            "legend) with a band from the least to the most successful seed. Training "
            "episodes explore.",
        )
        path = images / f"results_forces{name}.png"
        force_boxes(tasks, looks, reference, path)
        parts += shown(
            path,
            f"Largest contact force of every evaluation episode on the {which} tasks, "
            f"episodes of all seeds together{more}.",
        )
    if compared:
        task = next(iter(compared.values()))[0].evaluation["task"]
        path = images / "results_demonstrations.png"
        with_demonstrations(compared, looks, path)
        shown_further += shown(
            path,
            f"With and without demonstrations on {task}, all from the "
            "observation `internal`: success of the evaluation (points, with 95 % "
            "intervals over the episodes of all seeds) where the training ended, and "
            "of the training episodes on the way there (lines). Frames that the expert "
            "played for the dataset are not counted.",
        )
    best = {
        task: max(
            agents_.values(), key=lambda found: np.mean([r.success for r in found])
        )
        for task, agents_ in table.items()
    }
    path = force_maps(best, images / "results_force_maps.png")
    if path is not None:
        shown_further += shown(
            path,
            "Mean contact force per place (2 mm) over all evaluation episodes of the "
            "most successful agent of each task, seen from the front; the colour scale "
            "ends at the 98th percentile.",
        )
    return shown_main, shown_further


def shown(path, caption):
    return [f"![{caption.split(',')[0]}](images/{path.name})\n\n{caption}\n"]
