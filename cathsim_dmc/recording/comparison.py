"""Several episodes in one Rerun recording, side by side in one scene."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr

from cathsim_dmc.recording.blueprint import comparison_blueprint
from cathsim_dmc.recording.drawing import Drawing, goal_distance
from cathsim_dmc.recording.episode import Episode
from cathsim_dmc.recording.rerun_device import log_catheter
from cathsim_dmc.recording.rerun_log import write_recording
from cathsim_dmc.recording.rerun_scene import log_static
from cathsim_dmc.recording.rerun_stream import Log

COLOURS = (
    (86, 180, 233), (230, 159, 0), (0, 158, 115),
    (204, 121, 167), (240, 228, 66), (213, 94, 0),
)  # fmt: skip


def write_comparison(
    episodes: Mapping[str, Episode], surface: Any, path: str | os.PathLike[str]
) -> Path:
    """Write episodes of one anatomy as one recording, whole or not at all.

    All begin at time 0. Each device has its colour, its path and its curves; a shorter
    episode stays at its end.

    Args:
        episodes: Episodes by the name that the legend shows, 2 to 6.
        surface: The vessel, ``(vertices, faces)`` or an object with these, metres.
        path: Target, ``*.rrd``; an existing file is replaced.

    Returns:
        The path.

    Raises:
        ValueError: on fewer or more episodes, a name that no entity can have, or
            goals that differ.
        RuntimeError: if Rerun is switched off by the ``RERUN`` environment variable.
    """
    _check(episodes)
    drawings = {name: Drawing.of(each, surface) for name, each in episodes.items()}
    first = next(iter(drawings.values()))
    devices = {name: f"world/{name}" for name in episodes}
    low, high = first.vertices.min(0), first.vertices.max(0)
    layout = comparison_blueprint(
        (low + high) / 2,
        float((high - low).max()),
        list(devices.values()),
        distance=all(goal_distance(each) is not None for each in episodes.values()),
    )

    def fill(stream: rr.RecordingStream) -> None:
        for number, (name, episode) in enumerate(episodes.items()):
            log = Log(stream, episode, from_zero=True)
            if not number:
                log_static(log, first)
            log_catheter(log, drawings[name].radii, COLOURS[number], devices[name])
            _log_series(log, name, COLOURS[number])
        text = rr.TextDocument(_table(episodes), media_type="text/markdown")
        stream.log("info", text, static=True, strict=True)

    write_recording(path, layout, " and ".join(episodes), fill)
    return Path(path)


def _check(episodes: Mapping[str, Episode]) -> None:
    if not 2 <= len(episodes) <= len(COLOURS):
        raise ValueError(
            f"{len(episodes)} episodes are to be compared; give 2 to {len(COLOURS)}"
        )
    taken = ("vessel", "goal", "contacts", "heat")
    bad = [n for n in episodes if n in taken or not re.fullmatch(r"[\w-]+", n)]
    if bad:
        raise ValueError(
            f"episodes are called {bad}; use letters, digits, - and _ only, and not "
            f"{', '.join(taken)}"
        )
    if len({tuple(e.meta.get("goal_position") or ()) for e in episodes.values()}) > 1:
        raise ValueError(
            "the episodes have different goals; compare those of one task and anatomy"
        )


def _log_series(log: Log, name: str, colour: tuple[int, int, int]) -> None:
    episode = log.episode
    every, measured = slice(None), slice(1, None)
    series = {
        "force": (1e3 * episode.wall_force_max, measured),
        "reward": (episode.reward, measured),
        "insertion_mm": (1e3 * episode.insertion, every),
    }
    distance = goal_distance(episode)
    if distance is not None:
        series["distance_mm"] = (1e3 * distance, every)
    for kind, (values, rows) in series.items():
        log.series(f"series/{kind}/{name}", values, rows, name, colors=[colour])


def _table(episodes: Mapping[str, Episode]) -> str:
    """Outcome, length and force of every episode as a Markdown table."""
    lines = [
        "| episode | task | seed | outcome | steps | largest contact, mN |",
        "|---|---|---|---|---|---|",
    ]
    for name, episode in episodes.items():
        force = 1e3 * np.max(episode.wall_force_max, initial=0.0)
        lines.append(
            f"| {name} | {episode.task} | {episode.seed} | "
            f"{episode.termination.replace('_', ' ')} | {episode.steps} | {force:.3g} |"
        )
    return "\n".join(lines) + "\n"
