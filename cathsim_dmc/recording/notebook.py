"""Rerun's viewer in a notebook."""

from __future__ import annotations

import importlib.util
from collections.abc import Iterable
from typing import Any

import numpy as np
import rerun as rr

from cathsim_dmc.recording.drawing import Drawing
from cathsim_dmc.recording.episode import Episode
from cathsim_dmc.recording.geometry import force_colours, force_scale, force_text
from cathsim_dmc.recording.rerun_device import (
    ARROW_RADIUS,
    LABEL_COLOUR,
    LABEL_RADIUS,
    LONGEST_ARROW,
)
from cathsim_dmc.recording.rerun_log import APPLICATION_ID, layout_of, log_episode
from cathsim_dmc.recording.scene import BodyGeom


def episode_viewer(
    episode: Episode,
    surface: Any,
    *,
    robot_geoms: Iterable[BodyGeom] = (),
    fluoroscopy: np.ndarray | None = None,
    contacts: tuple[np.ndarray, np.ndarray] | None = None,
    width: int = 1200,
    height: int = 700,
) -> Any:
    """Rerun's viewer of an episode, for the output of a notebook's cell.

    Args:
        episode: What to show; of no steps for a single state.
        surface: The vessel, ``(vertices, faces)`` or an object with these, metres.
        robot_geoms: Primitives that the body poses of the episode move.
        fluoroscopy: (T+1, H, W, P) uint8 frames of P planes, one per state.
        contacts: Places (K, 3), m, and forces (K, 3), N, of a single state.
        width: Width of the viewer, pixels.
        height: Height of the viewer, pixels.

    Returns:
        A `rerun.notebook.Viewer`.

    Raises:
        ImportError: `rerun-notebook` is not installed; says what to install.
        ValueError: on frames or geoms that do not fit the episode.
    """
    if importlib.util.find_spec("rerun_notebook") is None:
        raise ImportError(
            "Rerun's viewer in a notebook needs rerun-notebook: pip install "
            "'cathsim-dmc[notebook]'; or leave viewer='rerun' away for a figure, or "
            "write an .rrd file and open it with `cathsim replay`"
        )
    from rerun.notebook import Viewer

    drawing = Drawing.of(
        episode, surface, robot_geoms=robot_geoms, fluoroscopy=fluoroscopy
    )
    stream = rr.RecordingStream(APPLICATION_ID)
    viewer = Viewer(
        width=width,
        height=height,
        recording=stream,
        blueprint=layout_of(episode, drawing),
    )
    log_episode(stream, episode, drawing)
    if contacts is not None:
        _log_moment(stream, *contacts)
    return viewer


def _log_moment(
    stream: rr.RecordingStream, position: np.ndarray, force: np.ndarray
) -> None:
    magnitude = np.linalg.norm(force, axis=-1)
    top = force_scale(magnitude)
    vectors = LONGEST_ARROW / top * force
    arrows = rr.Arrows3D(
        vectors=vectors,
        origins=position,
        colors=force_colours(magnitude, top),
        radii=ARROW_RADIUS,
    )
    stream.log("world/contacts", arrows, static=True, strict=True)
    if not len(magnitude):
        return
    largest = int(magnitude.argmax())
    text = rr.Points3D(
        position[largest] + vectors[largest],
        labels=force_text(magnitude[largest]),
        colors=LABEL_COLOUR,
        radii=LABEL_RADIUS,
        show_labels=True,
    )
    stream.log("world/contacts/largest", text, static=True, strict=True)
