"""Primitive geoms of a compiled model, for drawing bodies that the record moves."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

# Geoms that bodies collide with are not drawn, as in MuJoCo's own viewers.
_VISIBLE_GROUPS = 3
# MuJoCo geom types that a recording can draw, and how many sizes each one uses:
# sphere (radius), capsule and cylinder (radius, half length), box (half extents).
SIZES = {"sphere": 1, "capsule": 2, "cylinder": 2, "box": 3}


@dataclass(frozen=True, eq=False)
class BodyGeom:
    """One primitive fixed to a body.

    Attributes:
        body: Row of the body in ``Episode.body_pos`` (the MuJoCo body id).
        body_name: Full name of the body, such as ``robot/carriage``.
        kind: "sphere", "capsule", "cylinder" or "box".
        size: MuJoCo half sizes in metres: (radius,), (radius, half length) or
            (half x, half y, half z).
        position: (3,) centre in the frame of the body, metres.
        quaternion: (4,) wxyz, orientation in the frame of the body.
        rgba: (4,) colour in [0, 1].
    """

    body: int
    body_name: str
    kind: str
    size: np.ndarray
    position: np.ndarray
    quaternion: np.ndarray
    rgba: np.ndarray


def body_geoms(physics: Any) -> Iterator[BodyGeom]:
    """The visible primitives of robot and sheath, in the order of the model.

    Args:
        physics: A dm_control ``Physics``.
    """
    import mujoco

    model = physics.model
    kinds = {int(getattr(mujoco.mjtGeom, f"mjGEOM_{k.upper()}")): k for k in SIZES}
    for geom in range(model.ngeom):
        kind, body = kinds.get(int(model.geom_type[geom])), int(model.geom_bodyid[geom])
        name, material = model.id2name(body, "body"), int(model.geom_matid[geom])
        rgba = model.mat_rgba[material] if material >= 0 else model.geom_rgba[geom]
        visible = rgba[3] > 0 and model.geom_group[geom] < _VISIBLE_GROUPS
        if visible and kind and name.split("/", 1)[0] in ("robot", "sheath"):
            size = model.geom_size[geom][: SIZES[kind]]
            pose = model.geom_pos[geom], model.geom_quat[geom]
            yield BodyGeom(body, name, kind, size, *pose, rgba)
