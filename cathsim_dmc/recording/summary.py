"""A page of text about one episode."""

from __future__ import annotations

import json

import numpy as np

from cathsim_dmc.recording.episode import Episode

# Series and name lists of the metadata belong in plots, not on the page.
_LONG = 8


def episode_markdown(episode: Episode) -> str:
    """Return a Markdown page: outcome, forces, versions and options."""
    force = np.linalg.norm(episode.contact_force, axis=-1)
    head_path = np.linalg.norm(np.diff(episode.head, axis=0), axis=-1).sum()
    rows = {
        "Task": episode.task,
        "Seed": "none" if episode.seed is None else str(episode.seed),
        "Outcome": episode.termination.replace("_", " "),
        "Steps": str(episode.steps),
        "Simulated time": f"{episode.time[-1] - episode.time[0]:.2f} s",
        "Return": f"{episode.reward.sum():.3f}",
        "Contacts": str(len(force)),
        "Force per contact, mean": f"{force.mean():.4f} N" if len(force) else "-",
        "Force per contact, largest": f"{force.max():.4f} N" if len(force) else "-",
        "Wall force sum, largest": f"{np.max(episode.wall_force_sum, initial=0):.4f} N",
        "Insertion, last": f"{1e3 * episode.insertion[-1]:.1f} mm",
        "Path of the head": f"{1e3 * head_path:.1f} mm",
    }
    if episode.meta.get("distance"):
        distance = 1e3 * np.asarray(episode.meta["distance"])
        rows["Distance to goal, first"] = f"{distance[0]:.1f} mm"
        rows["Distance to goal, last"] = f"{distance[-1]:.1f} mm"
    shown = {"success", "termination"}
    for key, value in episode.meta.items():
        text = value if isinstance(value, str) else json.dumps(value)
        if key not in shown and not (isinstance(value, list) and len(value) > _LONG):
            rows[key] = text
    lines = [f"# {_cell(episode.task)}", "", "| | |", "|---|---|"]
    lines += [f"| {_cell(key)} | {_cell(text)} |" for key, text in rows.items()]
    return "\n".join(lines) + "\n"


def _cell(text: str) -> str:
    return text.replace("\\", "\\\\").replace("|", "\\|").replace("\n", " ")
