"""What happens in an episode, as lines of text."""

from __future__ import annotations

import numpy as np

from cathsim_dmc.recording.episode import Episode
from cathsim_dmc.recording.geometry import force_text

# Steps without contact after which the next contact is an event again.
_QUIET = 10
INFO, WARN, ERROR = "INFO", "WARN", "ERROR"
_END = {"success": INFO, "truncated": WARN, "physics_error": ERROR}


def events(episode: Episode) -> list[tuple[int, str, str]]:
    """State (its number), text and level of every event, in the order of time.

    The start, contacts that begin, the largest force, the head half way and nearest to
    the goal, the end.
    """
    found = [(0, f"start of {episode.task}", INFO), *_contacts(episode)]
    force = episode.wall_force_max
    if force.max(initial=0.0) > 0:
        row = int(force.argmax())
        found.append((row + 1, f"largest force, {force_text(force[row])}", WARN))
    distance = episode.meta.get("distance")
    if distance:
        found += _approach(np.asarray(distance, dtype=np.float64))
    text = f"end: {episode.termination.replace('_', ' ')}"
    found.append((episode.steps, text, _END[episode.termination]))
    return sorted(found, key=lambda event: event[0])


def _contacts(episode: Episode) -> list[tuple[int, str, str]]:
    touched = np.unique(episode.contact_step)
    quiet = np.diff(touched, prepend=-_QUIET - 1) > _QUIET
    found = []
    for row in touched[quiet]:
        force = episode.contact_force[episode.contact_step == row]
        largest = np.linalg.norm(force, axis=-1).max()
        found.append(
            (int(row) + 1, f"contact with the wall, {force_text(largest)}", INFO)
        )
    return found


def _approach(distance: np.ndarray) -> list[tuple[int, str, str]]:
    half = np.flatnonzero(distance <= distance[0] / 2)
    nearest = int(distance.argmin())
    found = [(nearest, f"nearest to the goal, {1e3 * distance[nearest]:.1f} mm", INFO)]
    if len(half):
        found.append((int(half[0]), "half of the distance to the goal", INFO))
    return found
