"""Episodes as Rerun recordings.

One file holds one episode: the scene in 3D, the fluoroscopy if there is any, every
series over simulated time, and the layout that opens them.
Whole series are sent as columns, so the cost does not grow with calls per step.
"""

import os
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from rerun.error_utils import catch_and_log_exceptions

from cathsim_dmc.anatomy.parts import Surface
from cathsim_dmc.files import atomic_path
from cathsim_dmc.recording import rerun_scene
from cathsim_dmc.recording.episode import Episode
from cathsim_dmc.recording.rerun_scene import BodyGeom
from cathsim_dmc.recording.rerun_stream import (
    FLUOROSCOPY,
    TIMELINE_STEP,
    TIMELINE_TIME,
    Log,
    log_frames,
    log_series,
)

APPLICATION_ID = "cathsim"
_PLANE_NAMES = ("Fluoroscopy, frontal", "Fluoroscopy, second plane")
# Distance of the eye in extents of the scene: the viewer's vertical field of view
# is near 45 degrees, which shows 0.83 of the distance.
_EYE_DISTANCE = 1.35
# Of the eye from the tip that it follows, and from the robot, m.
_TIP_OFFSET, _ROBOT_OFFSET = (0.0, -0.075, 0.0), (-0.16, -0.42, 0.2)
_BACKGROUND = (30, 32, 38)
# Plots from top to bottom: name, entity, whether there are several lines.
_PLOTS = (
    ("Reward and its terms", "reward", True),
    ("Distance to goal, mm", "distance_mm", False),
    ("Force, mN", "force", True),
    ("Insertion, mm", "insertion_mm", False),
    ("Rotation, °", "rotation_deg", True),
    ("Action", "action", False),
    ("Heart, breathing, wall", "vessel", True),
)


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
    """
    planes = 0 if fluoroscopy is None else fluoroscopy.shape[-1]
    robot_geoms = tuple(robot_geoms)
    with atomic_path(path, ".rrd") as temporary:
        stream = rr.RecordingStream(APPLICATION_ID)
        # By default Rerun turns errors into warnings.
        with catch_and_log_exceptions(strict=True):
            stream.set_log_tick_enabled(False)
            stream.set_log_time_enabled(False)
            # Not `save`, which hangs on a full disk.
            encoded, log = stream.binary_stream(), Log(stream, episode)
            # Active at once: a viewer that reads over a network has made itself a
            # layout by the time that this one arrives.
            layout = _layout(log, surface, robot_geoms, planes)
            stream.send_blueprint(layout, make_active=True, make_default=True)
            seed = "unseeded" if episode.seed is None else f"seed {episode.seed}"
            title = f"{episode.task}, {seed}, {episode.termination}"
            stream.send_recording_name(title)
            rerun_scene.log_vessel(log, surface)
            if fluoroscopy is not None:
                log_frames(log, fluoroscopy)
            rerun_scene.log_catheter(log)
            rerun_scene.log_bodies(log, robot_geoms)
            rerun_scene.log_contacts(log)
            log_series(log)
            data = encoded.read()
            stream.disconnect()
        temporary.write_bytes(data or b"")
    return Path(path)


def _layout(
    log: Log, surface: Surface, geoms: Sequence[BodyGeom], planes: int
) -> rrb.Blueprint:
    """The layout: scene on the left, X-ray in the middle, series on the right."""
    episode = log.episode
    low, high = surface.vertices.min(0), surface.vertices.max(0)
    # From the front, as in an antero-posterior projection; y points backwards.
    offset = (0.0, -_EYE_DISTANCE * float((high - low).max()), 0.0)
    trail = ("world/catheter/trail", "world/heat")
    scene = _world("Scene", (low + high) / 2, offset, so_far=trail)
    contents = ("+ $origin/**", "- $origin/goal")
    tip = _world("Tip", episode.head[0], _TIP_OFFSET, contents, "world/catheter/head")
    insets: list[rrb.View] = [tip]
    robots = {geom.body for geom in geoms if geom.body_name.startswith("robot/")}
    if robots:
        contents = ("+ $origin/robot/**", "+ $origin/sheath/**", "+ $origin/catheter")
        middle = episode.body_pos[0, sorted(robots)].mean(0)
        insets.append(_world("Robot", middle, _ROBOT_OFFSET, contents))
    images = [
        rrb.Spatial2DView(origin=origin, name=name)
        for origin, name in zip(FLUOROSCOPY[:planes], _PLANE_NAMES, strict=False)
    ]
    there = {
        "distance_mm": "distance" in episode.meta,
        "rotation_deg": log.coaxial is not None,
        "vessel": log.vessel is not None,
    }
    plots = [
        rrb.TimeSeriesView(
            origin=f"series/{entity}",
            name=name,
            plot_legend=rrb.PlotLegend(corner="LeftTop", visible=legend),
        )
        for name, entity, legend in _PLOTS
        if there.get(entity, True)
    ]
    left = rrb.Vertical(scene, rrb.Horizontal(*insets), row_shares=[3, 2])
    columns = [(left, 5), (rrb.Vertical(*images), 3.4), (rrb.Vertical(*plots), 3)]
    columns, shares = zip(*(columns if planes else columns[::2]), strict=True)
    return rrb.Blueprint(
        rrb.Horizontal(*columns, column_shares=shares),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(
            state="collapsed",
            play_state="playing",
            timeline=TIMELINE_TIME,
            loop_mode="all",
        ),
        auto_views=False,
        auto_layout=False,
    )


def _world(
    name: str,
    target: np.ndarray,
    offset: Sequence[float],
    contents: Sequence[str] = ("+ $origin/**",),
    tracked: str | None = None,
    so_far: Sequence[str] = ("world/heat",),
) -> rrb.Spatial3DView:
    """A view of the world; of the entities `so_far`, where they have been is shown."""
    ranges = [
        rrb.VisibleTimeRange(
            timeline,
            start=rrb.TimeRangeBoundary.infinite(),
            end=rrb.TimeRangeBoundary.cursor_relative(),
        )
        for timeline in (TIMELINE_TIME, TIMELINE_STEP)
    ]
    return rrb.Spatial3DView(
        origin="world",
        name=name,
        contents=list(contents),
        eye_controls=rrb.EyeControls3D(
            kind="orbital",
            position=target + offset,
            look_target=target,
            eye_up=[0.0, 0.0, 1.0],
            tracking_entity=tracked,
        ),
        background=_BACKGROUND,
        line_grid=False,
        overrides={entity: rrb.VisibleTimeRanges(ranges) for entity in so_far},
    )
