"""Text of an episode as Rerun entities: a log of events and a page about it."""

import json

import numpy as np
import rerun as rr

from cathsim_dmc.recording.episode import Episode
from cathsim_dmc.recording.geometry import force_text
from cathsim_dmc.recording.rerun_scene import Log

EVENTS, PAGE = "events", "info"  # entities
# Steps without contact after which the next contact is an event again.
_QUIET = 10
_LEVELS = {"success": "INFO", "physics_error": "ERROR"}  # of terminations; else WARN
_LONG = 200  # characters of a value: longer ones are series, which belong in plots


def log_text(log: Log) -> None:
    """Log events at their states, and the page."""
    rows, texts, levels = zip(*events(log.episode), strict=True)
    lines = rr.TextLog.columns(text=texts, level=levels)
    log.columns(EVENTS, lines, np.array(rows, dtype=np.int64))
    page = rr.TextDocument(markdown(log.episode), media_type="text/markdown")
    log.static(PAGE, page)


def events(episode: Episode) -> list[tuple[int, str, str]]:
    """Return (number of the state, text, level) of every event, sorted by state.

    Events are the start, new contacts, the largest force, half of the distance to the
    goal, the smallest distance, and the end.
    """
    found = [(0, f"start of {episode.task}", "INFO")]
    touched = np.unique(episode.contact_step)
    for row in touched[np.diff(touched, prepend=-_QUIET - 1) > _QUIET].tolist():
        force = episode.contact_force[episode.contact_step == row]
        largest = force_text(float(np.linalg.norm(force, axis=-1).max()))
        found.append((row + 1, f"contact with the wall, {largest}", "INFO"))
    force = episode.wall_force_max
    if force.max(initial=0.0) > 0:
        text = f"largest force, {force_text(float(force.max()))}"
        found.append((int(force.argmax()) + 1, text, "WARN"))
    if away := episode.meta.get("distance"):
        distance = np.asarray(away)
        text = f"nearest to the goal, {1e3 * distance.min():.1f} mm"
        found.append((int(distance.argmin()), text, "INFO"))
        for row in np.flatnonzero(distance <= distance[0] / 2)[:1].tolist():
            found.append((row, "half of the distance to the goal", "INFO"))
    end = episode.termination
    level = _LEVELS.get(end, "WARN")
    found.append((episode.steps, f"end: {end.replace('_', ' ')}", level))
    return sorted(found, key=lambda event: event[0])


def markdown(episode: Episode) -> str:
    """Return a page in Markdown: outcome, forces, versions and options."""
    force = np.linalg.norm(episode.contact_force, axis=-1)
    path = np.linalg.norm(np.diff(episode.head, axis=0), axis=-1).sum()
    mean, largest = (
        force_text(float(of(force))) if len(force) else "-" for of in (np.mean, np.max)
    )
    rows = {
        "outcome": episode.termination.replace("_", " "),
        "seed": episode.seed,
        "steps": episode.steps,
        "simulated time": f"{np.ptp(episode.time):.2f} s",
        "return": f"{episode.reward.sum():.3f}",
        "contacts": len(force),
        "mean force of a contact": mean,
        "largest force of a contact": largest,
        "last insertion": f"{1e3 * episode.insertion[-1]:.1f} mm",
        "path of the head": f"{1e3 * path:.1f} mm",
    }
    if away := episode.meta.get("distance"):
        rows["distance to the goal"] = f"{1e3 * away[0]:.1f} to {1e3 * away[-1]:.1f} mm"
    told = {"success", "termination", "distance", *rows}
    rows |= {key: v for key, v in episode.meta.items() if key not in told}
    lines = [f"# {_cell(episode.task)}", "", "| | |", "|---|---|"]
    for name, value in rows.items():
        text = value if isinstance(value, str) else json.dumps(value)
        if len(text) <= _LONG:
            lines.append(f"| {_cell(name)} | {_cell(text)} |")
    return "\n".join(lines) + "\n"


def _cell(text: str) -> str:
    return text.replace("\\", "\\\\").replace("|", "\\|").replace("\n", " ")
