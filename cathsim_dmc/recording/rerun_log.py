"""Episodes as Rerun recordings: scene, fluoroscopy, series, text, and their layout.

Whole series are sent as columns, so the cost does not grow with calls per step.
"""

import io
import os
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from rerun.error_utils import catch_and_log_exceptions

from cathsim_dmc import bounds
from cathsim_dmc.anatomy.parts import Surface
from cathsim_dmc.files import atomic_path
from cathsim_dmc.recording import rerun_scene, rerun_text
from cathsim_dmc.recording.episode import Episode
from cathsim_dmc.recording.records import VESSEL_SERIES
from cathsim_dmc.recording.rerun_scene import TIMELINES, BodyGeom, Log

APPLICATION_ID = "cathsim"
# Entities of the X-ray planes, frontal first.
FLUOROSCOPY = ("fluoroscopy", "fluoroscopy_lateral")
# At this quality noisy frames take about half the size of a PNG.
JPEG_QUALITY = 90
_PLANE_NAMES = ("Fluoroscopy, frontal", "Fluoroscopy, second plane")
# Distance of the eye in extents of the scene: the viewer's vertical field of view
# is near 45 degrees, which shows 0.83 of the distance.
_EYE_DISTANCE = 1.35
# Offset of the eye from the tip that it follows, and from the robot, m.
_TIP_OFFSET, _ROBOT_OFFSET = (0.0, -0.075, 0.0), (-0.16, -0.42, 0.2)
_BACKGROUND = (30, 32, 38)
# Plots from top to bottom: name, entity, whether the legend is shown.
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
    bounds.instance("episode", episode, Episode)
    if fluoroscopy is not None:
        shape = (episode.steps + 1, -1, -1, -1)
        fluoroscopy = bounds.array("fluoroscopy", fluoroscopy, "u", shape)
    bounds.instance("surface", surface, Surface)
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
            # Active at once: a viewer that reads over a network makes a layout of its
            # own before this one arrives.
            layout = _layout(log, surface, robot_geoms, planes)
            stream.send_blueprint(layout, make_active=True, make_default=True)
            seed = "unseeded" if episode.seed is None else f"seed {episode.seed}"
            title = f"{episode.task}, {seed}, {episode.termination}"
            stream.send_recording_name(title)
            rerun_scene.log_vessel(log, surface)
            if fluoroscopy is not None:
                _log_frames(log, fluoroscopy)
            rerun_scene.log_catheter(log)
            rerun_scene.log_bodies(log, robot_geoms)
            rerun_scene.log_contacts(log)
            _log_series(log)
            rerun_text.log_text(log)
            data = encoded.read()
            stream.disconnect()
        temporary.write_bytes(data or b"")
    return Path(path)


def _layout(
    log: Log, surface: Surface, geoms: Sequence[BodyGeom], planes: int
) -> rrb.Blueprint:
    """Return the layout: scene left, X-ray and text in the middle, series right."""
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
    images: list[rrb.View | rrb.Container] = [
        rrb.Spatial2DView(origin=origin, name=name)
        for origin, name in zip(FLUOROSCOPY[:planes], _PLANE_NAMES, strict=False)
    ]
    texts = rrb.TextLogView(origin=rerun_text.EVENTS, name="Events")
    page = rrb.TextDocumentView(origin=rerun_text.PAGE, name="Episode")
    images.append(rrb.Tabs(texts, page))
    left = rrb.Vertical(scene, rrb.Horizontal(*insets), row_shares=[3, 2])
    columns = left, rrb.Vertical(*images), rrb.Vertical(*_plots(log))
    return rrb.Blueprint(
        rrb.Horizontal(*columns, column_shares=[5, 3.4, 3]),
        rrb.TimePanel(
            state="collapsed",
            play_state="playing",
            timeline=TIMELINES[0],
            loop_mode="all",
        ),
        auto_views=False,
        auto_layout=False,
        collapse_panels=True,
    )


def _plots(log: Log) -> list[rrb.TimeSeriesView]:
    """Return the plots of the series that an episode has."""
    there = {
        "distance_mm": "distance" in log.episode.meta,
        "rotation_deg": log.coaxial is not None,
        "vessel": log.vessel is not None,
    }
    plots = []
    for name, entity, several in _PLOTS:
        if there.get(entity, True):
            legend = rrb.PlotLegend(corner="LeftTop", visible=several)
            look: Any = {"name": name, "plot_legend": legend}
            plots.append(rrb.TimeSeriesView(origin=f"series/{entity}", **look))
    return plots


def _world(
    name: str,
    target: np.ndarray,
    offset: Sequence[float],
    contents: Sequence[str] = ("+ $origin/**",),
    tracked: str | None = None,
    so_far: Sequence[str] = ("world/heat",),
) -> rrb.Spatial3DView:
    """Return a view of the world; the entities `so_far` show their past as well."""
    start = rrb.TimeRangeBoundary.infinite()
    end = rrb.TimeRangeBoundary.cursor_relative()
    ranges = [rrb.VisibleTimeRange(each, start=start, end=end) for each in TIMELINES]
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


def _log_series(log: Log) -> None:
    """Log reward with its terms, forces, distance, insertion, vessel and actions."""
    episode, meta = log.episode, log.episode.meta
    mm, mn = 1e3, 1e3
    wall_sum, wall_max = mn * episode.wall_force_sum, mn * episode.wall_force_max
    for entity, values, label, colour in (
        ("reward", episode.reward, "reward", [90, 160, 90]),
        ("force/wall_sum", wall_sum, "wall, sum", [230, 110, 40]),
        ("force/wall_max", wall_max, "wall, largest contact", [180, 20, 50]),
        ("force/push", mn * episode.push_force, "push", [80, 120, 210]),
        ("insertion_mm", mm * episode.insertion, "insertion, mm", [150, 90, 200]),
    ):
        log.series(entity, values, label, colour)
    for name, label in ("sum", "sum"), ("max", "largest contact"):
        if (means := meta.get(f"wall_force_mean_{name}")) is not None:
            label = f"wall, {label}, mean over the step"
            log.series(f"force/wall_mean_{name}", mn * np.array(means), label)
    if "distance" in meta:
        away = mm * np.array(meta["distance"])
        log.series("distance_mm", away, "distance to goal, mm", [60, 190, 90])
    for name, values in meta.get("reward_terms", {}).items():
        log.series(f"reward/{name}", values, name)
    if (coaxial := log.coaxial) is not None:
        for k, name in enumerate(coaxial.names):
            colour = np.resize(rerun_scene.DEVICE_COLOURS, (k + 1, 3))[k].tolist()
            for entity, values, label in (
                (f"insertion_mm/{name}", mm * coaxial.insertion, "mm"),
                (f"rotation_deg/{name}", np.degrees(coaxial.rotation), "base"),
                (f"rotation_deg/{name}_end", np.degrees(coaxial.tip_rotation), "end"),
            ):
                log.series(entity, values[:, k], f"{name}, {label}", colour)
    if log.vessel is not None:
        for name, (factor, label) in VESSEL_SERIES.items():
            log.series(f"vessel/{name}", factor * log.vessel.series[name], label)
    # The prefix, a device or an entity, is dropped where names stay unique without it.
    names = [str(name) for name in meta.get("action_names", ())]
    short = [name.rsplit("/", 1)[-1] for name in names]
    names = short if len(set(short)) == len(names) else names
    log.series("action", episode.action, names or None, rows=slice(0, -1))


def _log_frames(log: Log, frames: np.ndarray) -> None:
    """Log X-ray images (T+1, H, W, P) as JPEG, one entity for each of P planes."""
    from PIL import Image

    for plane, entity in enumerate(FLUOROSCOPY[: frames.shape[-1]]):
        blobs = []
        for frame in frames[..., plane]:
            buffer = io.BytesIO()
            Image.fromarray(frame).save(buffer, "JPEG", quality=JPEG_QUALITY)
            blobs.append(buffer.getvalue())
        log.static(entity, rr.EncodedImage.from_fields(media_type="image/jpeg"))
        log.columns(entity, rr.EncodedImage.columns(blob=blobs))
