"""Figures of the validation, one for each report; `validation.py` draws them."""

import numpy as np
from matplotlib.figure import Figure

from cathsim_dmc import style
from cathsim_dmc.validation.convergence import DEFAULTS, LEAST_FORCE
from cathsim_dmc.validation.wall import ERROR_TREE, field_error

THEORY, SIMULATED, THIRD = style.COLOURS[:3]
COLOURS = (SIMULATED, THEORY, *style.COLOURS[2:5])


def draw(name, report, path):
    """Draws the measurements behind a report into a PNG; `name` is a key of `DRAWN`."""
    figure = DRAWN[name](**report.data)
    style.save(figure, path)


def canvas(rows, columns):
    figure = Figure(figsize=(4.6 * columns, 3.6 * rows), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False)
    for ax in axes.ravel():
        style.tidy(ax)
    return figure, axes


def rod(cantilevers, columns, short, lag):
    figure, axes = canvas(2, 2)
    _cantilevers(axes[0, 0], cantilevers)
    _lag(axes[0, 1], lag)
    _southwell(axes[1, 0], columns)
    _short_columns(axes[1, 1], [*short, *columns])
    return figure


def _cantilevers(ax, bent):
    for index, one in enumerate(bent):
        first = index == 0
        ax.plot(
            *(1e3 * one.expected.position.T),
            color=THEORY,
            linewidth=1.4,
            label="elastica" if first else None,
        )
        ax.plot(
            *(1e3 * one.simulated.T),
            ".",
            color=SIMULATED,
            markersize=4,
            label="joints" if first else None,
        )
        end = 1e3 * one.expected.position[-1]
        ax.annotate(
            f"{np.degrees(one.end_angle):.0f}°, {1e3 * one.expected.force:.2g} mN",
            end,
            xytext=(6, -2),
            textcoords="offset points",
            fontsize=7,
        )
    ax.set(
        title="Cantilever under end load",
        xlabel="along the axis, mm",
        ylabel="deflection, mm",
        xlim=(-20, 440),
    )
    ax.legend(frameon=False, fontsize=8, loc="upper left")


def _southwell(ax, columns):
    for colour, one in zip(COLOURS, columns, strict=False):
        w = 1e3 * one.deflection
        # Scaled by Euler's load, for which the line has slope 1.
        y = w / (one.load / one.expected)
        ax.plot(w, y, "o", color=colour, markersize=5, label=f"guide {one.end}")
        line = np.array([0.0, w.max()])
        offset = (y - w * one.expected / one.critical).mean()
        ax.plot(line, offset + line, color=colour, linewidth=1, alpha=0.7)
    ax.set(
        title="Southwell plot, 262 mm of shaft",
        xlabel="deflection w under axial load, mm",
        ylabel="w · Euler's load / load, mm",
    )
    ax.text(
        0.97, 0.05, "lines: slope 1,\nEuler's load", ha="right", fontsize=8,
        transform=ax.transAxes,
    )  # fmt: skip
    ax.legend(frameon=False, fontsize=8)


def _short_columns(ax, columns):
    for colour, end in zip(COLOURS, ("sliding", "fixed"), strict=False):
        those = sorted((c for c in columns if c.end == end), key=lambda c: c.length)
        ax.plot(
            [1e3 * c.length for c in those],
            [100 * (c.critical / c.expected - 1) for c in those],
            "o-",
            color=colour,
            linewidth=1,
            markersize=4,
            label=f"guide {end}",
        )
    ax.axhspan(-5, 5, color="0.93", zorder=0)
    ax.set(
        title="Buckling of shorter columns, default links",
        xlabel="length, mm",
        ylabel="deviation from Euler, %",
        ylim=(-8, 8),
    )
    ax.legend(frameon=False, fontsize=8, loc="upper right")


def _lag(ax, lag):
    behind = lag.base - lag.tip
    ax.plot(lag.time, lag.expected, color=THEORY, label="theory")
    ax.plot(
        lag.time[::12], behind[::12], ".", color=SIMULATED, markersize=4,
        label="simulated",
    )  # fmt: skip
    ax.set(
        title="Lag of the braked tip behind the base",
        xlabel="time, s",
        ylabel="lag, rad",
        xlim=(0, 2.5),
    )
    ax.legend(frameon=False, fontsize=8, loc="lower right")


def pair(turned):
    figure, ((right,),) = canvas(1, 1)
    for colour, (name, (base, tip)) in zip(COLOURS, turned.items(), strict=False):
        right.plot(np.degrees(base), np.degrees(tip), color=colour, label=name)
    ends = [0, np.degrees(turned["straight tube"][0][-1])]
    right.plot(ends, ends, color="0.6", linewidth=0.8)
    right.set(title="torque", xlabel="base, °", ylabel="end of the device, °")
    right.legend(frameon=False)
    return figure


def _convergence(axes, studies):
    (by_step, force_by_step), (by_link, force_by_link) = axes
    panels = {
        "physics_timestep": (by_step, force_by_step, "time step, ms"),
        "shaft_link": (by_link, force_by_link, "longest link, mm"),
    }
    scripts = list(dict.fromkeys(one["script"] for one in studies))
    for one in studies:
        path, force, label = panels[one["parameter"]]
        x = 1e3 * np.array(one["value"])
        colour = COLOURS[scripts.index(one["script"])]
        look = {"color": colour, "linewidth": 1, "markersize": 4}
        path.plot(x[1:], one["path_mean_mm"][1:], "o-", label=one["script"], **look)
        path.plot(x[1:], one["track_max_mm"][1:], "^:", **look)
        if one["force_mean"][0] > LEAST_FORCE:
            force.plot(x, 1e3 * np.array(one["force_mean"]), "o-", **look)
        for ax in (path, force):
            ax.set_xlabel(label)
            default = 1e3 * DEFAULTS[one["parameter"]]
            ax.axvline(default, color="0.6", linewidth=0.8, zorder=0)
    for path, force in axes:
        path.set(
            title="Tip path against the finest run",
            ylabel="same time, mean (o); off track, max (▵), mm",
            yscale="log",
        )
        force.set(title="Mean wall force", ylabel="mN")
        force.set_ylim(bottom=0)
    by_step.legend(frameon=False, fontsize=8, loc="lower right")


def wall(anatomies, capstans, studies):
    figure, rows = canvas(3, 2)
    axes = rows[0]
    _convergence(rows[1:], studies)
    ax = axes[0]
    for colour, anatomy in zip(COLOURS * 3, anatomies, strict=False):
        values = np.sort(1e3 * field_error(anatomy))
        share = 100 * (1 - np.arange(1, len(values) + 1) / len(values))
        ax.plot(values[:-1], share[:-1], color=colour, label=anatomy.name)
    ax.plot(ERROR_TREE, 1, "v", color="0.4", markersize=6)
    ax.set(
        title="Field against the exact distance to the wall",
        xlabel="error within 1 mm of the wall, mm",
        ylabel="share of the places above, %",
        xscale="log",
        yscale="log",
        xlim=(1e-4, 0.5),
        ylim=(1e-2, 120),
    )
    ax.legend(frameon=False, fontsize=8)
    ax = axes[1]
    for colour, one in zip(style.COLOURS, capstans, strict=False):
        expected, end = np.log(one.expected), 1e3 * one.travel[-1]
        ratio = np.log(one.ratio - one.bent + 1)  # the tip bends more easily
        ax.plot(1e3 * one.travel, ratio, color=colour, linewidth=1)
        ax.axhline(expected, color=colour, linestyle="--", linewidth=1)
        label = f"μ = {one.friction:g}, {np.degrees(one.angle):.0f}°"
        ax.text(1.03 * end, expected, label, va="center", fontsize=7, clip_on=False)
    ax.set(
        title="Rod pulled over a drum of 50 mm radius",
        xlim=(0, 1e3 * max(one.travel[-1] for one in capstans)),
        ylim=(0, 1.2 * np.log(max(one.expected for one in capstans))),
        xlabel="travel of the base, mm",
        ylabel="log. of tensions by friction (dashed: μθ)",
    )
    return figure


def forces(pushed, samples):
    del samples  # `cathsim validate forces --figure` draws them
    figure, ((ax,),) = canvas(1, 1)
    for colour, (name, runs) in zip(COLOURS, pushed.items(), strict=False):
        push = [one.push for one in runs]
        closed = [
            one.load_cell + (one.sheath if name == "wide" else 0.0) for one in runs
        ]
        ax.errorbar(
            push,
            closed,
            xerr=[one.ripple for one in runs],
            fmt="o",
            color=colour,
            markersize=5,
            elinewidth=0.8,
            capsize=2,
            label=f"{name} tube" + (", with rim of the sheath" * (name == "wide")),
        )
    limit = 1.3 * max(one.push for runs in pushed.values() for one in runs)
    ax.plot([0, limit], [0, limit], color="0.5", linewidth=0.8, zorder=0)
    ax.set(
        title="Pushed against a dead end",
        xlabel="push force (bar: ripple), N",
        ylabel="load cell, N",
    )
    ax.legend(frameon=False, fontsize=8)
    return figure


DRAWN = {"rod": rod, "pair": pair, "wall": wall, "forces": forces}
