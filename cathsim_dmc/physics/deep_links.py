"""Displacement of links in a physics step: where contacts are computed again."""

import math
from typing import Any, NamedTuple

import mujoco
import numpy as np

from cathsim_dmc.compiled import compiled


class Motion(NamedTuple):
    """Views (N, ...) of MuJoCo's arrays that give the velocities of links."""

    qvel: Any
    cdof: Any
    xpos: Any
    subtree_com: Any


class Links(NamedTuple):
    """The M links that can touch a wall.

    Attributes:
        parents: (nv,), parent of each degree of freedom, -1 for none.
        bodies: (M,), bodies of the links.
        last: (M,), last degree of freedom that moves each link.
        roots: (M,), first bodies of their kinematic trees.
        reach: (M,), largest distance of the axis from the origin of the body, m.
    """

    parents: Any
    bodies: Any
    last: Any
    roots: Any
    reach: Any


def moving(model: mujoco.MjModel) -> Links:
    """The links of a model that move and can touch a wall."""
    touches = (model.geom_contype == 0) & (model.geom_conaffinity != 0)
    links = np.flatnonzero(touches & (last_dofs(model, model.geom_bodyid) >= 0))
    bodies = model.geom_bodyid[links]
    reach = np.linalg.norm(model.geom_pos[links], axis=1) + model.geom_size[links, 1]
    last, roots = last_dofs(model, bodies), model.body_rootid[bodies]
    return Links(model.dof_parentid.copy(), bodies, last, roots, reach)


def last_dofs(model: mujoco.MjModel, bodies: np.ndarray) -> np.ndarray:
    """Last degree of freedom (n,) that moves each of some bodies (n,); -1 for none."""
    moved = model.body_weldid[bodies]
    last = model.body_dofadr[moved] + model.body_dofnum[moved] - 1
    return np.where(model.body_dofnum[moved] > 0, last, -1)


@compiled
def in_doubt(peak, depth, limits, motion, links, way):
    """Whether one of N control steps was too coarse, or may end too deep.

    Args:
        peak: (N,), largest force of a contact in it, N.
        depth: (N,), depth of the deepest contact in it, m.
        limits: Limits of force, N, and of depth, m, and the physics step, s.
        motion: `Motion`.
        links: `Links`.
        way: (N,), written: largest displacement of the devices in a physics step,
            without its part along the devices, m.
    """
    hardest, deepest, timestep = limits
    total, doubt = np.empty((len(links.parents), 6)), False
    for i in range(len(peak)):
        way[i] = timestep * _speed(motion, links, i, total)
        doubt |= peak[i] > hardest or depth[i] + way[i] > deepest
    return doubt


@compiled
def _speed(motion, links, i, total):
    """Largest speed of one device across its axis, m/s; `total` (nv, 6) is scratch."""
    velocity, places, bodies = motion.qvel[i], motion.xpos[i], links.bodies
    parents, found = links.parents, 0.0
    for dof in range(len(parents)):
        for k in range(6):
            total[dof, k] = motion.cdof[i, dof, k] * velocity[dof]
            if parents[dof] >= 0:
                total[dof, k] += total[parents[dof], k]
    for n in range(len(bodies)):
        place, pole = places[bodies[n]], motion.subtree_com[i, links.roots[n]]
        a, b, c, u, v, w = total[links.last[n]]
        x, y, z = place[0] - pole[0], place[1] - pole[1], place[2] - pole[2]
        u, v, w = u + b * z - c * y, v + c * x - a * z, w + a * y - b * x
        along = 0.0
        if n + 1 < len(bodies):
            ahead = places[bodies[n + 1]]
            x, y, z = ahead[0] - place[0], ahead[1] - place[1], ahead[2] - place[2]
            along = (u * x + v * y + w * z) / (x * x + y * y + z * z)
        u, v, w = u - along * x, v - along * y, w - along * z
        speed = math.sqrt(u * u + v * v + w * w)
        speed += links.reach[n] * math.sqrt(a * a + b * b + c * c)
        found = max(found, speed)
    return found
