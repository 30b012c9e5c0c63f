"""An episode as curves over time: forces, insertion, distance, phases."""

from itertools import groupby
from typing import Any

import numpy as np
from matplotlib.patches import Patch
from scipy.ndimage import median_filter

from cathsim_dmc.physics.forces import PEAK_NOTE
from cathsim_dmc.pictures.anatomies import Picture
from cathsim_dmc.recording.episode import Episode
from cathsim_dmc.style import COLOURS

# A base slower than this rests, m/s: a twentieth of its full speed.
REST_SPEED = 2e-3
_SMOOTHED = 5  # control steps whose median speed decides
PHASES = {"advance": "#cfe3f3", "rest": "#eeeeee", "withdraw": "#f6d9c8"}
_TOUCH = "0.35"
_SIZE_IN = 9.0, 7.2


def phases(episode: Episode) -> list[tuple[str, int, int]]:
    """Phases of the motion of the device's base, in order of time.

    Args:
        episode: The episode; with coaxial devices, the phases are of the leading one.

    Returns:
        (phase of `PHASES`, first, last) for each phase: the numbers of the states
        between which the base advances, rests (slower than `REST_SPEED`) or withdraws.
        The median over five control steps decides.
    """
    speed = np.diff(episode.insertion) / np.diff(episode.time)
    speed = median_filter(speed, _SMOOTHED, mode="nearest") if len(speed) else speed
    names = np.select(
        [speed > REST_SPEED, speed < -REST_SPEED], ["advance", "withdraw"], "rest"
    ).tolist()
    found, first = [], 0
    for name, each in groupby(names):
        last = first + len(list(each))
        found.append((name, first, last))
        first = last
    return found


def plot(episode: Episode) -> Picture:
    """Draw forces, insertion and distance of an episode over time, with its phases.

    Args:
        episode: What `record` returns or `Episode.load` reads.

    Returns:
        The figure; a notebook draws it, `.savefig(path)` writes it. Forces are in mN:
        sum and largest contact, means over each control step, the peak of the sum
        within it, and the push force at the base. Shades are the phases of the base:
        it advances, rests or withdraws. A bar marks contact with the wall.

    Raises:
        TypeError: it is no episode.
    """
    if not isinstance(episode, Episode):
        raise TypeError(
            "plot takes an Episode, such as cathsim_dmc.record returns or "
            f"Episode.load reads, not {type(episode).__name__}"
        )
    figure = Picture(figsize=_SIZE_IN, dpi=120, layout="constrained")
    panels = figure.subplots(3, 1, sharex=True, height_ratios=(1.5, 1, 1))
    time = episode.time - episode.time[0]
    for axes in panels:
        for name, first, last in phases(episode):
            axes.axvspan(time[first], time[last], color=PHASES[name], lw=0, zorder=0)
    _draw_forces(panels[0], episode, time)
    _draw_insertion(panels[1], episode, time)
    _draw_distance(panels[2], episode, time)
    panels[-1].set_xlabel("time, s")
    panels[-1].set_xlim(0, max(float(time[-1]), 1e-3))
    shades = [Patch(color=colour, label=name) for name, colour in PHASES.items()]
    shades.append(Patch(color=_TOUCH, label="contact with the wall"))
    figure.legend(handles=shades, loc="outside lower center", ncols=4, fontsize=8)
    seed = "" if episode.seed is None else f", seed {episode.seed}"
    end = episode.termination.replace("_", " ")
    figure.suptitle(
        f"{episode.task}{seed}: {end} after {episode.steps} control steps", fontsize=11
    )
    return figure


def _draw_forces(axes: Any, episode: Episode, time: np.ndarray) -> None:
    peak = episode.meta.get("wall_force_peak_sum")
    total = episode.meta.get("wall_force_mean_sum") or episode.wall_force_sum
    largest = episode.meta.get("wall_force_mean_max") or episode.wall_force_max
    curves = {
        "wall, sum": (np.asarray(total), COLOURS[1], "-", 1.4),
        "wall, largest contact": (np.asarray(largest), COLOURS[4], "-", 1.2),
        "push force": (episode.push_force, COLOURS[0], "--", 1.0),
    }
    if peak:
        label = "wall, peak sum of a physics step*"
        curves[label] = (np.array(peak, np.float64), "0.45", ":", 1.0)
        axes.text(
            0.0, 1.02, f"* {PEAK_NOTE}", transform=axes.transAxes, fontsize=7,
            color="0.35",
        )  # fmt: skip
    for label, (force, colour, style, width) in curves.items():
        axes.plot(time[1:], 1e3 * force, style, color=colour, lw=width, label=label)
    touching = np.isin(np.arange(episode.steps), episode.contact_step)
    edges = np.flatnonzero(np.diff(touching, prepend=False, append=False))
    for first, last in edges.reshape(-1, 2):
        axes.axvspan(time[first], time[last], 0.97, 1.0, color=_TOUCH, lw=0)
    axes.set_ylabel("force, mN")
    axes.margins(y=0.1)
    axes.legend(fontsize=8, loc="upper left", framealpha=0.9)


def _draw_insertion(axes: Any, episode: Episode, time: np.ndarray) -> None:
    devices = episode.meta.get("devices") or []
    for number, each in enumerate(devices):
        way = 1e3 * np.array(each["insertion"], np.float64)
        colour = COLOURS[number % len(COLOURS)]
        axes.plot(time, way, color=colour, lw=1.4, label=each["name"])
    if devices:
        axes.legend(fontsize=8, loc="upper left", framealpha=0.9)
    else:
        axes.plot(time, 1e3 * episode.insertion, color=COLOURS[0], lw=1.4)
    axes.set_ylabel("insertion, mm")


def _draw_distance(axes: Any, episode: Episode, time: np.ndarray) -> None:
    axes.set_ylabel("to the goal, mm")
    axes.set_ylim(bottom=0)
    distance = episode.meta.get("distance")
    if distance is None and (goal := episode.meta.get("goal_position")):
        distance = np.linalg.norm(episode.head - np.array(goal), axis=-1)
    if distance is None:
        axes.text(0.5, 0.5, "the episode has no goal", transform=axes.transAxes)
        return
    axes.plot(time, 1e3 * np.array(distance), color=COLOURS[2], lw=1.4)
    if radius := episode.meta.get("goal_radius"):
        axes.axhline(1e3 * radius, color=COLOURS[2], lw=1.0, ls="--")
        place = {"xytext": (3, 3), "textcoords": "offset points"}
        axes.annotate("reached below", (0.0, 1e3 * radius), fontsize=8, **place)
    axes.set_ylim(0, 1.08e3 * max(np.max(distance), radius or 0.0))
