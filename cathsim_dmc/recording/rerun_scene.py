"""Static parts of the scene, and the moving bodies, as Rerun entities."""

from typing import Any

import numpy as np
import rerun as rr
from scipy.spatial.transform import Rotation

from cathsim_dmc.recording.drawing import Drawing
from cathsim_dmc.recording.geometry import xyzw
from cathsim_dmc.recording.living import MESH_EVERY, VesselRecord
from cathsim_dmc.recording.rerun_stream import Log
from cathsim_dmc.recording.scene import BodyGeom

VESSEL_COLOUR = (225, 140, 130, 60)
GOAL_COLOUR = (60, 190, 90, 110)
BLOOD_COLOUR = (200, 30, 40)
BLOOD_SCALE = 0.02  # s; an arrow of 20 mm is 1 m/s
# Entities that would hide the device inside them, and how opaque they are drawn.
SEE_THROUGH = {"sheath": 0.3}


def log_static(log: Log, drawing: Drawing) -> None:
    """Log vessel, goal and directions."""
    surface = drawing.surface
    # Patient frame LPS: x to the patient's left, y to the back, z up.
    log.static("world", rr.ViewCoordinates.LBU)
    record = VesselRecord.of(log.episode)
    moves = record is not None and not record.still
    log.static(
        "world/vessel",
        rr.Mesh3D.from_fields(
            # What is static hides what moves.
            vertex_positions=None if moves else surface.vertices.astype(np.float32),
            vertex_normals=surface.normals.astype(np.float32),
            triangle_indices=surface.faces.astype(np.uint32),
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


def log_vessel(log: Log, drawing: Drawing) -> None:
    """Log heart, breathing, blood and wall of a vessel that lives, and its motion."""
    record = VesselRecord.of(log.episode)
    if record is None:
        return
    for name, (values, label) in record.curves().items():
        log.series(f"series/vessel/{name}", values, slice(None), label)
    log.static("world/blood", rr.Arrows3D.from_fields(colors=[BLOOD_COLOUR]))
    arrows = rr.Arrows3D.columns(
        origins=log.episode.head, vectors=BLOOD_SCALE * record.blood_velocity
    )
    log.columns("world/blood", arrows)
    if drawing.goal is not None:
        log.columns(
            "world/goal",
            rr.Transform3D.columns(translation=record.goal - drawing.goal[0]),
        )
    if record.still:
        return
    rest = drawing.surface
    rows = np.arange(0, log.episode.steps + 1, MESH_EVERY)
    moved = [
        record.surface(rest, log.episode, state).vertices.astype(np.float32)
        for state in rows.tolist()
    ]
    columns = rr.Mesh3D.columns(vertex_positions=np.concatenate(moved))
    columns = columns.partition(np.full(len(rows), len(rest.vertices)))
    log.columns("world/vessel", columns, rows)


def log_bodies(log: Log, geoms: tuple[BodyGeom, ...]) -> None:
    """Log the shapes of the bodies and how they move."""
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
        moves = np.ptp(position, axis=0).any() or np.ptp(quaternion, axis=0).any()
        if moves:
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
    rgba = np.array([g.rgba for g in parts], dtype=np.float64)
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
    along = Rotation.from_quat(turn, scalar_first=True).apply([0.0, 0.0, 1.0])
    lower = centre - size[:, 1:] * along
    return rr.Capsules3D(radii=radii, lengths=lengths, translations=lower, **common)
