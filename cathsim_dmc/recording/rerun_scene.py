"""The scene in 3D as Rerun entities: vessel, goal, device, contacts, bodies."""

import itertools
from collections.abc import Iterable, Iterator
from typing import Any, NamedTuple

import numpy as np
import rerun as rr
from scipy.spatial.transform import Rotation

from cathsim_dmc.anatomy.parts import Surface
from cathsim_dmc.recording.episode import Episode
from cathsim_dmc.recording.geometry import force_colours, force_scale, force_text
from cathsim_dmc.recording.records import MESH_EVERY, CoaxialRecord, VesselRecord

TIMELINES = ("sim_time", "step")
SHAFT_COLOUR = (215, 228, 255)
# Coaxial devices from the innermost outwards, repeated: a guidewire is teal, the
# catheter around it has the colour of a single device.
DEVICE_COLOURS = np.array([(90, 220, 190), SHAFT_COLOUR, (200, 170, 255)], np.uint8)
# Rows of a series: all states; the states after a step, at which forces are measured.
EVERY, MEASURED = slice(None), slice(1, None)
VESSEL_COLOUR = (225, 140, 130, 60)
GOAL_COLOUR = (60, 190, 90, 110)
BLOOD_COLOUR, BLOOD_SCALE = (200, 30, 40), 0.02  # s; an arrow of 20 mm is 1 m/s
HEAD_COLOUR, TRAIL_COLOUR = (255, 200, 0), (255, 200, 0, 160)
SHEATH_OPACITY = 0.3  # shows the device inside
LONGEST_ARROW = 25e-3  # m, approximately
ARROW_RADIUS, HEAT_RADIUS, TRAIL_RADIUS = 0.7e-3, 0.9e-3, 0.25e-3
HEAD_SCALE = 1.8
# Text of the largest force of a step: legible on light and dark backgrounds.
LABEL_COLOUR = (186, 58, 0)
# Geoms that bodies collide with are not drawn, as in MuJoCo's own viewers.
_VISIBLE_GROUPS = 3
# MuJoCo geom types that a recording can draw, and how many sizes each one uses:
# capsule and cylinder (radius, half length), box (half extents), sphere (radius) and
# ellipsoid (radii).
SIZES = {"capsule": 2, "cylinder": 2, "box": 3, "sphere": 1, "ellipsoid": 3}
# Entities whose bodies are drawn otherwise: as links of an episode, and as a surface.
_APART = "catheter", "phantom"


class Log:
    """Logs entities of an episode, static or as whole series."""

    def __init__(self, stream: rr.RecordingStream, episode: Episode) -> None:
        """Takes the stream, and the times of the episode."""
        self._stream, self.episode = stream, episode
        self.coaxial, self.vessel = CoaxialRecord.of(episode), VesselRecord.of(episode)
        # Rounded here, since Rerun truncates 0.12 s to 119,999,999 ns.
        self._times = np.round(episode.time * 1e9).astype("timedelta64[ns]")

    def static(self, entity: str, archetype: Any) -> None:
        """Logs an entity that never changes."""
        self._stream.log(entity, archetype, static=True, strict=True)

    def flush(self) -> None:
        """Writes all entities so far before later ones; Rerun keeps no order itself."""
        self._stream.flush()

    def columns(self, entity: str, columns: Any, rows: Any = EVERY) -> None:
        """Sends one row per state in ``rows``; nothing at all for no rows."""
        times, steps = self._times[rows], np.arange(len(self._times))[rows]
        if len(steps):
            time, step = TIMELINES
            seconds = rr.TimeColumn(time, duration=times)
            indexes = [seconds, rr.TimeColumn(step, sequence=steps)]
            self._stream.send_columns(entity, indexes, columns, strict=True)

    def series(
        self, entity: str, values: Any, names: Any, colour: Any = None, rows: Any = None
    ) -> None:
        """Plots values (n,) or (n, C) as C lines; by default, T rows are `MEASURED`."""
        values = np.asarray(values)
        rows = rows or (EVERY if len(values) > self.episode.steps else MEASURED)
        self.static(f"series/{entity}", rr.SeriesLines(names=names, colors=colour))
        columns = rr.Scalars.columns(scalars=values.ravel())
        if values.ndim == 2:
            columns = columns.partition(np.full(len(values), values.shape[1]))
        self.columns(f"series/{entity}", columns, rows)


def log_vessel(log: Log, surface: Surface) -> None:
    """Log vessel, goal, directions and blood, and how vessel and goal move."""
    record, meta = log.vessel, log.episode.meta
    moves = record is not None and record.motion is not None
    # Patient frame LPS: x to the patient's left, y to the back, z up.
    log.static("world", rr.ViewCoordinates.LBU)
    mesh = rr.Mesh3D.from_fields(
        # A static component would hide the moving one.
        vertex_positions=None if moves else surface.vertices.astype(np.float32),
        vertex_normals=surface.normals.astype(np.float32),
        triangle_indices=surface.faces.astype(np.uint32),
        albedo_factor=VESSEL_COLOUR,
    )
    log.static("world/vessel", mesh)
    if "goal_position" in meta:
        goal = rr.Ellipsoids3D(
            centers=[meta["goal_position"]],
            half_sizes=[[meta["goal_radius"]] * 3],
            colors=[GOAL_COLOUR],
            fill_mode="solid",
        )
        log.static("world/goal", goal)
    if record is None:
        return
    log.static("world/blood", rr.Arrows3D.from_fields(colors=[BLOOD_COLOUR]))
    vectors = BLOOD_SCALE * record.series["blood_velocity"]
    arrows = rr.Arrows3D.columns(origins=log.episode.head, vectors=vectors)
    log.columns("world/blood", arrows)
    if "goal_position" in meta:
        way = record.series["goal"] - meta["goal_position"]
        log.columns("world/goal", rr.Transform3D.columns(translation=way))
    if moves:
        rows = np.arange(0, log.episode.steps + 1, MESH_EVERY)
        states = (record.surface(surface, row) for row in rows.tolist())
        vertices = np.concatenate([each.vertices for each in states]).astype("f4")
        columns = rr.Mesh3D.columns(vertex_positions=vertices)
        columns = columns.partition(np.full(len(rows), len(surface.vertices)))
        log.columns("world/vessel", columns, rows)


def log_catheter(log: Log) -> None:
    """Log the device as capsules coloured by contact force, its head and its path."""
    entity, coaxial, joints = "world/catheter", log.coaxial, log.episode.catheter
    radii = log.episode.radii
    states, links = joints.shape[0], joints.shape[1] - 1
    along = np.diff(joints, axis=1)
    colours = np.broadcast_to(np.array(SHAFT_COLOUR, np.uint8), (states, links, 3))
    thickness = np.broadcast_to(radii, (states, links))
    if coaxial is not None:
        outermost = coaxial.outermost(joints)
        own = np.resize(DEVICE_COLOURS, (len(coaxial.names), 3))
        colours, thickness = own[outermost], coaxial.radii[outermost]
        ends = np.moveaxis(coaxial.ends(joints), 1, 0)
        for name, colour, radius, end in zip(
            coaxial.names, own, coaxial.radii, ends, strict=True
        ):
            _log_point(log, f"{entity}/{name}", end, colour, radius)
    log.static(entity, rr.Capsules3D.from_fields(fill_mode="solid"))
    # Azimuth and inclination that turn +z onto the links.
    x, y, z = along.reshape(-1, 3).T
    angles = np.stack([np.arctan2(y, x), np.arctan2(np.hypot(x, y), z)], axis=-1)
    turns = Rotation.from_euler("ZY", angles)
    capsules = rr.Capsules3D.columns(
        lengths=np.linalg.norm(along, axis=-1).ravel(),
        radii=thickness.ravel(),
        translations=joints[:, :-1].reshape(-1, 3),
        quaternions=turns.as_quat(),
        colors=link_colours(log.episode, colours).reshape(-1, 3),
    )
    log.columns(entity, capsules.partition(np.full(states, links)))
    head = log.episode.head
    _log_point(log, f"{entity}/head", head, HEAD_COLOUR, radii[-1])
    look = rr.LineStrips3D.from_fields(colors=[TRAIL_COLOUR], radii=[TRAIL_RADIUS])
    log.static(f"{entity}/trail", look)
    pieces = rr.LineStrips3D.columns(strips=np.stack([head[:-1], head[1:]], axis=1))
    log.columns(f"{entity}/trail", pieces, MEASURED)


def _log_point(log: Log, entity: str, places, colour, radius: float) -> None:
    look = rr.Points3D.from_fields(colors=[colour], radii=[HEAD_SCALE * radius])
    log.static(entity, look)
    log.columns(entity, rr.Points3D.columns(positions=places))


def link_colours(episode: Episode, colours: np.ndarray) -> np.ndarray:
    """Return link colours (T+1, L, 3) uint8 by largest force; `colours` without one."""
    pressed = np.zeros(colours.shape[:2])
    magnitude = np.linalg.norm(episode.contact_force, axis=-1)
    row = episode.contact_step + 1
    middle = (episode.catheter[row, :-1] + episode.catheter[row, 1:]) / 2
    away = np.linalg.norm(middle - episode.contact_position[:, None], axis=-1)
    np.maximum.at(pressed, (row, away.argmin(axis=1)), magnitude)
    hot = force_colours(pressed, force_scale(magnitude))
    return np.where(pressed[..., None] > 0, hot, colours)


def arrow_scale(episode: Episode) -> float:
    """Return the length of an arrow per newton, m/N."""
    return LONGEST_ARROW / force_scale(np.linalg.norm(episode.contact_force, axis=-1))


def log_contacts(log: Log) -> None:
    """Log contact forces as arrows, the largest of a step as text, and the places."""
    episode = log.episode
    magnitude = np.linalg.norm(episode.contact_force, axis=-1)
    colours = force_colours(magnitude, force_scale(magnitude))
    places, counts = episode.contact_position, episode.contact_counts
    log.static("world/contacts", rr.Arrows3D.from_fields(radii=[ARROW_RADIUS]))
    vectors = arrow_scale(episode) * episode.contact_force
    arrows = rr.Arrows3D.columns(vectors=vectors, origins=places, colors=colours)
    # A step without contact is an empty row, which removes the old arrows.
    log.columns("world/contacts", arrows.partition(counts), MEASURED)
    if len(magnitude):
        log.static("world/heat", rr.Points3D.from_fields(radii=[HEAT_RADIUS]))
        heat = rr.Points3D.columns(positions=places, colors=colours)
        log.columns("world/heat", heat.partition(counts), MEASURED)
        order = np.lexsort((magnitude, episode.contact_step))
        top = order[np.flatnonzero(np.diff(episode.contact_step[order], append=-1))]
        look = {"colors": [LABEL_COLOUR], "radii": [0.0], "show_labels": True}
        log.static("world/contacts/largest", rr.Points3D.from_fields(**look))
        texts = [force_text(force) for force in magnitude[top]]
        ends = (places + vectors)[top]
        labels = rr.Points3D.columns(positions=ends, labels=texts)
        labels = labels.partition(np.minimum(counts, 1))
        log.columns("world/contacts/largest", labels, MEASURED)


class BodyGeom(NamedTuple):
    """One primitive fixed to a body, in the frame of the body; lengths in metres."""

    body: int  # row in `Episode.body_pos`: the MuJoCo id
    body_name: str  # in full, such as "robot/carriage"
    kind: str  # one of `SIZES`
    size: np.ndarray  # MuJoCo's, see `SIZES`
    position: np.ndarray  # (3,) of the centre
    quaternion: np.ndarray  # (4,) wxyz
    rgba: np.ndarray  # (4,) in [0, 1]


def body_geoms(physics: Any) -> Iterator[BodyGeom]:
    """Yield the visible primitives of a dm_control ``Physics``.

    Those of robot and sheath, and of bodies that a task has beside the device.
    """
    import mujoco

    model = physics.model
    kinds = {int(getattr(mujoco.mjtGeom, f"mjGEOM_{k.upper()}")): k for k in SIZES}
    for geom in range(model.ngeom):
        kind, body = kinds.get(int(model.geom_type[geom])), int(model.geom_bodyid[geom])
        name, material = model.id2name(body, "body"), int(model.geom_matid[geom])
        rgba = model.mat_rgba[material] if material >= 0 else model.geom_rgba[geom]
        visible = rgba[3] > 0 and model.geom_group[geom] < _VISIBLE_GROUPS
        if visible and kind and name.partition("/")[0] not in _APART:
            size = model.geom_size[geom][: SIZES[kind]]
            place, turn = model.geom_pos[geom], model.geom_quat[geom]
            yield BodyGeom(body, name, kind, size, place, turn, rgba)


def log_bodies(log: Log, geoms: Iterable[BodyGeom]) -> None:
    """Log the poses of the bodies, then their shapes.

    A viewer draws a shape that it reads before its pose at the origin, in the arch.
    """
    by_body = sorted(geoms, key=lambda geom: (geom.body, geom.kind))
    for body, parts in itertools.groupby(by_body, lambda geom: geom.body):
        entity = _entity(next(parts))
        place = log.episode.body_pos[:, body]
        turn = np.roll(log.episode.body_quat[:, body], -1, axis=-1)  # xyzw
        if np.ptp(place, axis=0).any() or np.ptp(turn, axis=0).any():
            moved = rr.Transform3D.columns(translation=place, quaternion=turn)
            log.columns(entity, moved)
        else:
            still = rr.Quaternion(xyzw=turn[0])
            log.static(entity, rr.Transform3D(translation=place[0], quaternion=still))
    log.flush()
    for _, parts in itertools.groupby(by_body, lambda geom: (geom.body, geom.kind)):
        same = list(parts)
        kind = same[0].kind
        log.static(f"{_entity(same[0])}/{kind}", _shape(kind, same))


def _entity(geom: BodyGeom) -> str:
    """Path of a body; bodies beside the device are apart from all other entities."""
    parts = geom.body_name.strip("/").split("/")
    if parts[0] not in ("robot", "sheath"):
        parts = ["bodies", "/".join(parts) or str(geom.body)]
    return "/".join(["world", *map(rr.escape_entity_path_part, parts)])


def _shape(kind: str, parts: list[BodyGeom]) -> Any:
    _, _, _, *rows = zip(*parts, strict=True)
    size, centre, turn, rgba = (np.array(row, np.float64) for row in rows)
    rgba[:, 3] *= SHEATH_OPACITY if parts[0].body_name.startswith("sheath/") else 1.0
    colours = np.round(255 * rgba).astype(np.uint8)
    look: dict[str, Any] = {"quaternions": np.roll(turn, -1, axis=-1)}
    look |= {"colors": colours, "fill_mode": "solid"}
    if kind == "box":
        return rr.Boxes3D(half_sizes=size, centers=centre, **look)
    if kind in ("sphere", "ellipsoid"):
        sizes = np.broadcast_to(size, (len(size), 3))  # of a sphere one radius
        return rr.Ellipsoids3D(half_sizes=sizes, centers=centre, **look)
    look |= {"radii": size[:, 0], "lengths": 2 * size[:, 1]}
    if kind == "cylinder":
        return rr.Cylinders3D(centers=centre, **look)
    # MuJoCo centres a capsule, Rerun starts it at its lower end.
    along = Rotation.from_quat(turn, scalar_first=True).apply([0.0, 0.0, 1.0])
    return rr.Capsules3D(translations=centre - size[:, 1:] * along, **look)
