"""Episodes as Rerun recordings.

One file holds one episode: the scene in 3D, the fluoroscopy if there is any, every
series over simulated time, the metadata as text, and the layout that opens them.
Whole series are sent as columns, so the cost does not grow with calls per step.
"""

from __future__ import annotations

import io
import os
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
from rerun.blueprint import Blueprint
from rerun.error_utils import catch_and_log_exceptions

from cathsim_dmc.files import atomic_path
from cathsim_dmc.recording.blueprint import (
    TIMELINE_STEP,
    TIMELINE_TIME,
    episode_blueprint,
)
from cathsim_dmc.recording.drawing import Drawing, action_layout, goal_distance
from cathsim_dmc.recording.episode import Episode
from cathsim_dmc.recording.geometry import (
    force_colours,
    rotate,
    vertex_normals,
    xyzw,
    z_to,
)
from cathsim_dmc.recording.scene import BodyGeom
from cathsim_dmc.recording.summary import episode_markdown

APPLICATION_ID = "cathsim"
SUFFIX = ".rrd"

# Drawing only: 1 N is an arrow of 100 mm, so the usual 0-0.2 N span 0-20 mm.
ARROW_METRES_PER_NEWTON = 0.1
ARROW_RADIUS = 0.6e-3
TRAIL_RADIUS = 0.25e-3
HEAD_SCALE = 2.0
# At this quality noisy frames take about half of what the exact PNG takes.
JPEG_QUALITY = 90

VESSEL_COLOUR = (225, 140, 130, 60)
SHAFT_COLOUR = (215, 228, 255)
HEAD_COLOUR = (255, 200, 0)
GOAL_COLOUR = (60, 190, 90, 110)
TRAIL_COLOUR = (255, 200, 0, 160)
# Entities that would hide the device inside them, and how opaque they are drawn.
SEE_THROUGH = {"sheath": 0.3}


def write_rrd(
    episode: Episode,
    surface: Any,
    path: str | os.PathLike[str],
    *,
    robot_geoms: Iterable[BodyGeom] = (),
    goal_position: Sequence[float] | None = None,
    goal_radius: float | None = None,
    catheter_radius: float | Sequence[float] | None = None,
    fluoroscopy: np.ndarray | None = None,
    lossless: bool = False,
) -> Path:
    """Write one episode as a Rerun recording, whole or not at all.

    Args:
        episode: What to draw.
        surface: The vessel, ``(vertices, faces)`` or an object with these, metres.
        path: Target, ``*.rrd``; an existing file is replaced.
        robot_geoms: Primitives that the body poses of the episode move.
        goal_position: (3,) world; from ``meta['goal_position']`` if not given.
        goal_radius: Metres; from ``meta['goal_radius']`` if not given.
        catheter_radius: One radius or (L,) radii in metres; from
            ``meta['catheter_radius']`` if not given, else ``CATHETER_RADIUS``.
        fluoroscopy: (T+1, H, W, 1) uint8 frames, one per state.
        lossless: Store the frames as PNG instead of JPEG.

    Returns:
        The path.

    Raises:
        ValueError: on frames, radii or geoms that do not fit the episode.
        RuntimeError: if Rerun is switched off by the ``RERUN`` environment variable.
    """
    drawing = Drawing.of(
        episode,
        surface,
        robot_geoms=robot_geoms,
        goal_position=goal_position,
        goal_radius=goal_radius,
        catheter_radius=catheter_radius,
        fluoroscopy=fluoroscopy,
    )
    with atomic_path(path, SUFFIX) as temporary:
        stream = rr.RecordingStream(APPLICATION_ID)
        if not stream.is_enabled():
            raise RuntimeError(
                "Rerun is switched off; unset the environment variable RERUN"
            )
        # Rerun turns mistakes into warnings unless it is told to be strict.
        with catch_and_log_exceptions(strict=True):
            stream.set_log_tick_enabled(False)
            stream.set_log_time_enabled(False)
            # Not `save`, which never comes back from a full disk.
            encoded = stream.binary_stream()
            stream.send_blueprint(
                _layout(episode, drawing), make_active=False, make_default=True
            )
            stream.send_recording_name(_title(episode))
            log = _Log(stream, episode)
            _log_static(log, drawing)
            _log_catheter(log, drawing.radii)
            _log_bodies(log, drawing.geoms)
            _log_contacts(log)
            _log_series(log)
            if drawing.frames is not None:
                _log_frames(log, drawing.frames, lossless)
            data = encoded.read()
            stream.disconnect()
        temporary.write_bytes(data or b"")
    return Path(path)


def _layout(episode: Episode, drawing: Drawing) -> Blueprint:
    low, high = drawing.vertices.min(0), drawing.vertices.max(0)
    return episode_blueprint(
        centre=(low + high) / 2,
        extent=float((high - low).max()),
        fluoroscopy=drawing.frames is not None,
        distance=goal_distance(episode) is not None,
    )


class _Log:
    """A stream together with the times of one episode's states."""

    def __init__(self, stream: rr.RecordingStream, episode: Episode) -> None:
        self.stream = stream
        self.episode = episode
        # Rounded here, since Rerun truncates 0.12 s to 119,999,999 ns.
        nanoseconds = np.round(episode.time * 1e9).astype("timedelta64[ns]")
        self._times = nanoseconds
        self._steps = np.arange(episode.steps + 1)

    def static(self, entity: str, *archetypes: Any) -> None:
        for archetype in archetypes:
            self.stream.log(entity, archetype, static=True, strict=True)

    def columns(self, entity: str, columns: Any, rows: slice = slice(None)) -> None:
        """Send one row per state in ``rows``; nothing at all for no rows."""
        times = self._times[rows]
        if not len(times):
            return
        indexes = [
            rr.TimeColumn(TIMELINE_TIME, duration=times),
            rr.TimeColumn(TIMELINE_STEP, sequence=self._steps[rows]),
        ]
        self.stream.send_columns(entity, indexes, columns, strict=True)

    def series(
        self, entity: str, values: np.ndarray, rows: slice, names: Any, **style: Any
    ) -> None:
        """Send (n,) or (n, C) values as one plot entity of C lines."""
        self.static(entity, rr.SeriesLines(names=names, **style))
        columns = rr.Scalars.columns(scalars=values.ravel())
        if values.ndim == 2:
            columns = columns.partition(np.full(len(values), values.shape[1]))
        self.columns(entity, columns, rows)


def _log_static(log: _Log, drawing: Drawing) -> None:
    vertices, faces = drawing.vertices, drawing.faces
    # Patient frame LPS: x to the patient's left, y to the back, z up.
    log.static("world", rr.ViewCoordinates.LBU)
    log.static(
        "world/vessel",
        rr.Mesh3D(
            vertex_positions=vertices.astype(np.float32),
            vertex_normals=vertex_normals(vertices, faces).astype(np.float32),
            triangle_indices=faces.astype(np.uint32),
            albedo_factor=VESSEL_COLOUR,
        ),
    )
    if drawing.goal is not None:
        position, radius = drawing.goal
        log.static(
            "world/goal",
            rr.Ellipsoids3D(
                centers=[position],
                half_sizes=[[radius] * 3],
                colors=[GOAL_COLOUR],
                fill_mode="solid",
            ),
        )
    text = rr.TextDocument(episode_markdown(log.episode), media_type="text/markdown")
    log.static("info", text)


def _log_catheter(log: _Log, radii: np.ndarray) -> None:
    joints = log.episode.catheter
    states, links = joints.shape[0], joints.shape[1] - 1
    along = np.diff(joints, axis=1)
    log.static(
        "world/catheter",
        rr.Capsules3D.from_fields(
            radii=radii, colors=[SHAFT_COLOUR] * links, fill_mode="solid"
        ),
    )
    capsules = rr.Capsules3D.columns(
        lengths=np.linalg.norm(along, axis=-1).ravel(),
        translations=joints[:, :-1].reshape(-1, 3),
        quaternions=xyzw(z_to(along)).reshape(-1, 4),
    )
    log.columns("world/catheter", capsules.partition(np.full(states, links)))
    head = log.episode.head
    log.static(
        "world/catheter/head",
        rr.Points3D.from_fields(colors=[HEAD_COLOUR], radii=[HEAD_SCALE * radii[-1]]),
    )
    log.columns("world/catheter/head", rr.Points3D.columns(positions=head))
    if log.episode.steps:
        log.static(
            "world/catheter/trail",
            rr.LineStrips3D.from_fields(colors=[TRAIL_COLOUR], radii=[TRAIL_RADIUS]),
        )
        pieces = np.stack([head[:-1], head[1:]], axis=1)
        log.columns(
            "world/catheter/trail",
            rr.LineStrips3D.columns(strips=pieces),
            slice(1, None),
        )


def _log_bodies(log: _Log, geoms: tuple[BodyGeom, ...]) -> None:
    episode = log.episode
    bodies: dict[int, list[BodyGeom]] = {}
    for geom in geoms:
        bodies.setdefault(geom.body, []).append(geom)
    for body, parts in bodies.items():
        entity = f"world/{parts[0].body_name.strip('/')}"
        for kind in sorted({g.kind for g in parts}):
            log.static(f"{entity}/{kind}", _shape([g for g in parts if g.kind == kind]))
        position = episode.body_pos[:, body]
        quaternion = xyzw(episode.body_quat[:, body])
        if np.ptp(position, axis=0).any() or np.ptp(quaternion, axis=0).any():
            log.columns(
                entity,
                rr.Transform3D.columns(translation=position, quaternion=quaternion),
            )
        else:
            log.static(
                entity,
                rr.Transform3D(
                    translation=position[0],
                    quaternion=rr.Quaternion(xyzw=quaternion[0]),
                ),
            )


def _shape(parts: list[BodyGeom]) -> Any:
    size = np.stack([g.size for g in parts])
    centre = np.stack([g.position for g in parts])
    turn = np.stack([g.quaternion for g in parts])
    rgba = np.stack([g.rgba for g in parts])
    rgba[:, 3] *= SEE_THROUGH.get(parts[0].body_name.split("/", 1)[0], 1.0)
    common = {
        "quaternions": xyzw(turn),
        "colors": np.round(255 * rgba).astype(np.uint8),
        "fill_mode": "solid",
    }
    kind = parts[0].kind
    if kind == "box":
        return rr.Boxes3D(half_sizes=size, centers=centre, **common)
    if kind == "sphere":
        return rr.Ellipsoids3D(
            half_sizes=np.repeat(size, 3, axis=1), centers=centre, **common
        )
    radii, lengths = size[:, 0], 2 * size[:, 1]
    if kind == "cylinder":
        return rr.Cylinders3D(radii=radii, lengths=lengths, centers=centre, **common)
    # MuJoCo centres a capsule, Rerun starts it at its lower end.
    lower = centre + rotate(turn, size[:, 1:] * [0.0, 0.0, -1.0])
    return rr.Capsules3D(radii=radii, lengths=lengths, translations=lower, **common)


def _log_contacts(log: _Log) -> None:
    episode = log.episode
    magnitude = np.linalg.norm(episode.contact_force, axis=-1)
    log.static("world/contacts", rr.Arrows3D.from_fields(radii=[ARROW_RADIUS]))
    arrows = rr.Arrows3D.columns(
        vectors=ARROW_METRES_PER_NEWTON * episode.contact_force,
        origins=episode.contact_position,
        colors=force_colours(magnitude),
    )
    # A step without contact is an empty row, which takes the old arrows away.
    log.columns(
        "world/contacts", arrows.partition(episode.contact_counts), slice(1, None)
    )


def _log_series(log: _Log) -> None:
    episode = log.episode
    every, measured, commanded = slice(None), slice(1, None), slice(0, episode.steps)
    log.series(
        "series/reward", episode.reward, measured, "reward", colors=[90, 160, 90]
    )
    for name, values in episode.meta.get("reward_terms", {}).items():
        log.series(f"series/reward/{name}", np.array(values), measured, name)
    distance = goal_distance(episode)
    if distance is not None:
        log.series(
            "series/distance_mm",
            1e3 * distance,
            every,
            "distance to goal, mm",
            colors=[60, 190, 90],
        )
    forces = {
        "wall_sum": (episode.wall_force_sum, "wall, sum, N", [230, 110, 40]),
        "wall_max": (episode.wall_force_max, "wall, largest contact, N", [180, 20, 50]),
        "push": (episode.push_force, "push, N", [80, 120, 210]),
    }
    for name, (values, label, colour) in forces.items():
        log.series(f"series/force/{name}", values, measured, label, colors=colour)
    log.series(
        "series/insertion_mm",
        1e3 * episode.insertion,
        every,
        "insertion, mm",
        colors=[150, 90, 200],
    )
    names, tip = action_layout(episode)
    for index in np.flatnonzero(~tip):
        log.series(
            f"series/action/{names[index]}",
            episode.action[:, index],
            commanded,
            names[index],
        )
    if tip.any():
        bend = np.sqrt(np.mean(episode.action[:, tip] ** 2, axis=1))
        log.series("series/action/tip_bend", bend, commanded, "tip bend, rms")
    log.series("series/action_all", episode.action, commanded, names)


def _log_frames(log: _Log, frames: np.ndarray, lossless: bool) -> None:
    from PIL import Image

    kind, options = ("PNG", {}) if lossless else ("JPEG", {"quality": JPEG_QUALITY})
    blobs = []
    for frame in frames:
        buffer = io.BytesIO()
        Image.fromarray(frame[..., 0]).save(buffer, kind, **options)
        blobs.append(buffer.getvalue())
    log.static(
        "fluoroscopy", rr.EncodedImage.from_fields(media_type=f"image/{kind.lower()}")
    )
    log.columns("fluoroscopy", rr.EncodedImage.columns(blob=blobs))


def _title(episode: Episode) -> str:
    seed = "unseeded" if episode.seed is None else f"seed {episode.seed}"
    return f"{episode.task}, {seed}, {episode.termination}"
