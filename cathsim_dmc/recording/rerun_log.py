"""Episodes as Rerun recordings.

One file holds one episode: the scene in 3D, the fluoroscopy if there is any, every
series over simulated time, and the layout that opens them.
Whole series are sent as columns, so the cost does not grow with calls per step.
"""

import os
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import rerun as rr
from rerun.blueprint import Blueprint
from rerun.error_utils import catch_and_log_exceptions

from cathsim_dmc.anatomy.parts import Surface
from cathsim_dmc.files import atomic_path
from cathsim_dmc.recording import blueprint
from cathsim_dmc.recording.coaxial import CoaxialRecord
from cathsim_dmc.recording.drawing import Drawing, goal_distance
from cathsim_dmc.recording.episode import Episode
from cathsim_dmc.recording.living import VesselRecord
from cathsim_dmc.recording.rerun_device import log_catheter, log_contacts
from cathsim_dmc.recording.rerun_scene import log_bodies, log_static, log_vessel
from cathsim_dmc.recording.rerun_series import log_frames, log_series
from cathsim_dmc.recording.rerun_stream import Log
from cathsim_dmc.recording.scene import BodyGeom

APPLICATION_ID = "cathsim"
SUFFIX = ".rrd"


def write_rrd(
    episode: Episode,
    surface: Surface,
    path: str | os.PathLike[str],
    *,
    robot_geoms: Iterable[BodyGeom] = (),
    fluoroscopy: np.ndarray | None = None,
) -> Path:
    """Write one episode as a Rerun recording, whole or not at all.

    Args:
        episode: What to draw; radii of the device and the goal are in ``meta``.
        surface: Lumen surface of the vessel.
        path: Target, ``*.rrd``; an existing file is replaced.
        robot_geoms: Primitives that the body poses of the episode move.
        fluoroscopy: (T+1, H, W, P) uint8 frames, one per state, of one plane or two.

    Returns:
        The path.

    Raises:
        ValueError: on frames, radii or geoms that do not fit the episode.
        RuntimeError: if Rerun is switched off by the ``RERUN`` environment variable.
    """
    drawing = Drawing.of(
        episode, surface, robot_geoms=robot_geoms, fluoroscopy=fluoroscopy
    )

    with atomic_path(path, SUFFIX) as temporary:
        stream = rr.RecordingStream(APPLICATION_ID)
        if not stream.is_enabled():
            raise RuntimeError(
                "Rerun is switched off; unset the environment variable RERUN"
            )
        # By default Rerun turns errors into warnings.
        with catch_and_log_exceptions(strict=True):
            stream.set_log_tick_enabled(False)
            stream.set_log_time_enabled(False)
            # Not `save`, which hangs on a full disk.
            encoded = stream.binary_stream()
            # Active at once: a viewer that reads over a network has made itself a
            # layout by the time that this one arrives.
            layout = _layout(episode, drawing)
            stream.send_blueprint(layout, make_active=True, make_default=True)
            stream.send_recording_name(_title(episode))
            _fill(Log(stream, episode), drawing)
            data = encoded.read()
            stream.disconnect()
        temporary.write_bytes(data or b"")
    return Path(path)


def _fill(log: Log, drawing: Drawing) -> None:
    log_static(log, drawing)
    log_vessel(log, drawing)
    if drawing.frames is not None:
        log_frames(log, drawing.frames)
    log_catheter(log, drawing.radii)
    log_bodies(log, drawing.geoms)
    log_contacts(log)
    log_series(log)


def _layout(episode: Episode, drawing: Drawing) -> Blueprint:
    vertices = drawing.surface.vertices
    low, high = vertices.min(0), vertices.max(0)
    planes = 0 if drawing.frames is None else drawing.frames.shape[-1]
    robots = [g.body for g in drawing.geoms if g.body_name.startswith("robot/")]
    robot = episode.body_pos[0, sorted(set(robots))].mean(0) if robots else None
    return blueprint.episode_blueprint(
        centre=(low + high) / 2,
        extent=float((high - low).max()),
        planes=planes,
        distance=goal_distance(episode) is not None,
        rotation=CoaxialRecord.of(episode) is not None,
        living=VesselRecord.of(episode) is not None,
        head=episode.head[0],
        robot=robot,
    )


def _title(episode: Episode) -> str:
    seed = "unseeded" if episode.seed is None else f"seed {episode.seed}"
    return f"{episode.task}, {seed}, {episode.termination}"
