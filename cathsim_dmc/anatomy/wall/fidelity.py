"""How well the wall pieces stand for the lumen: intrusion, leaks, patency.

Everything is measured on the wall pieces as MuJoCo gets them, against the tubes
of the vessel tree. Metres throughout.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from cathsim_dmc.anatomy.anatomy import Anatomy
from cathsim_dmc.anatomy.centreline import Array, VesselTree
from cathsim_dmc.anatomy.wall.pieces import INLET_HOLE_RADIUS

if TYPE_CHECKING:
    import mujoco

# A ray that ends this far (m) outside the lumen has passed through a slit: the
# recession of a good wall is below 1 mm, its thickness 4 mm.
_LEAK_DEPTH = 1.5e-3
# Rays that leave through the inlet are no leaks; the hole is a polygon whose corners
# lie up to a tenth beyond its radius.
_INLET_RADIUS = 1.1 * INLET_HOLE_RADIUS
# Largest lumen radius (m) looked for in a scan.
_WIDEST = 30e-3
# Pieces are grown by this much (m) when lines are cut with them.
_SEAM = 1e-7
# Rays start within this share of the lumen radius from a centreline.
_OFF_AXIS = 0.7


@dataclass(frozen=True)
class Distribution:
    """Mean, 95th percentile and maximum of a sample of lengths, metres."""

    mean: float
    p95: float
    max: float
    count: int

    @classmethod
    def of(cls, values: Array) -> Distribution:
        """Summary of `values` (n,), n >= 1."""
        if not len(values):
            raise ValueError("no samples: reduce the spacing.")
        return cls(
            float(values.mean()),
            float(np.percentile(values, 95)),
            float(values.max()),
            len(values),
        )


@dataclass(frozen=True)
class Intrusion:
    """Deviation of the wall from the lumen surface.

    Attributes:
        inside: how far the wall stands in the lumen, 0 where it does not.
        recession: how far the wall stays behind the lumen surface, 0 where it
            reaches it; at most the search distance.
        deviation: the larger of the two, that is the distance between the surfaces.
        position: (3,) of the sample with the largest intrusion, LPS.
    """

    inside: Distribution
    recession: Distribution
    deviation: Distribution
    position: tuple[float, float, float]


@dataclass(frozen=True)
class Coverage:
    """Share of rays from within the lumen that the wall stops.

    Attributes:
        rays: number of rays, without those through the inlet's hole.
        leaks: rays that hit nothing, or only something far outside the lumen.
        fraction: 1 - leaks / rays.
        leak_positions: (leaks, 3) where the leaking rays leave the lumen, LPS.
    """

    rays: int
    leaks: int
    fraction: float
    leak_positions: Array


@dataclass(frozen=True)
class Patency:
    """Whether a sphere passes along each centreline without touching the wall.

    Attributes:
        radius: of the sphere.
        positions: number of places tried.
        contacts: number of places with a contact.
        blocked: vessels in which contacts occurred.
    """

    radius: float
    positions: int
    contacts: int
    blocked: tuple[str, ...]

    @property
    def passed(self) -> bool:
        """True when there was no contact."""
        return self.contacts == 0


class SurfaceSamples(NamedTuple):
    """Points (n, 3) of the lumen surface, unit normals out of it, lumen radii."""

    points: Array
    outward: Array
    radii: Array


def tube_samples(tree: VesselTree, spacing: float) -> SurfaceSamples:
    """Nearly uniform points on the lumen surface of a vessel tree.

    Points of one vessel's tube inside another vessel are left out, as are the
    flat ends. The normal is radial: it ignores the taper.
    """
    if not spacing > 0.0:
        raise ValueError(f"spacing is {spacing:g} m; it must be > 0.")
    points, outward, radii = [], [], []
    for vessel in tree.vessels.values():
        line = vessel.centreline
        count = max(2, round(line.length / spacing))
        place = line.at((np.arange(count) + 0.5) * line.length / count)
        axis = np.eye(3)[np.abs(place.tangent).argmin(axis=1)]
        u = np.cross(place.tangent, axis)
        u /= np.linalg.norm(u, axis=1)[:, None]
        v = np.cross(place.tangent, u)
        for i in range(count):
            around = max(8, round(2.0 * math.pi * place.radius[i] / spacing))
            # A different start on each ring, or samples would line up.
            angle = 2.0 * math.pi * (np.arange(around) + (i * 0.618) % 1.0) / around
            spokes = np.cos(angle)[:, None] * u[i] + np.sin(angle)[:, None] * v[i]
            points.append(place.position[i] + place.radius[i] * spokes)
            outward.append(spokes)
            radii.append(np.full(around, place.radius[i]))
    joined = SurfaceSamples(
        np.concatenate(points), np.concatenate(outward), np.concatenate(radii)
    )
    # Inside any tube, the own one included on the inner side of a bend.
    free = tree.depth(joined.points) < 1e-5
    return SurfaceSamples(*(values[free] for values in joined))


def mesh_samples(anatomy: Anatomy, spacing: float, *, seed: int = 0) -> SurfaceSamples:
    """Random points on the surface of an anatomy that is no union of tubes.

    There is one point per square of `spacing` (m), none on the open ends. The radius
    is how far the depth grows along the inward normal.
    """
    rng = np.random.default_rng(seed)
    corners = anatomy.surface.vertices[anatomy.surface.faces]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = 0.5 * np.linalg.norm(cross, axis=1)
    count = max(1, round(area.sum() / spacing**2))
    face = rng.choice(len(area), count, p=area / area.sum())
    cut = np.sort(rng.uniform(size=(count, 2)), axis=1)
    weights = np.stack([cut[:, 0], cut[:, 1] - cut[:, 0], 1.0 - cut[:, 1]], axis=1)
    points = np.einsum("nk,nkj->nj", weights, corners[face])
    outward = 0.5 * cross[face] / area[face, None]
    for end in anatomy.ends:
        if end.open:
            flat = np.abs((points - end.position) @ end.direction) < 1e-5
            near = np.linalg.norm(points - end.position, axis=1) < 4.0 * end.radius
            points, outward = points[~(flat & near)], outward[~(flat & near)]
    radii = np.zeros(len(points))
    growing = np.ones(len(points), dtype=bool)
    step = 0.25e-3
    while growing.any() and radii.max() < _WIDEST:
        ahead = points[growing] - (radii[growing] + step)[:, None] * outward[growing]
        # Half a step of slack for the field's interpolation.
        deeper = anatomy.depth(ahead) > radii[growing] + 0.5 * step
        growing[growing] = deeper
        radii[growing] += step
    # A normal near an open end may run through it; what lies behind is no wall.
    for end in anatomy.ends:
        if end.open:
            near = np.linalg.norm(points - end.position, axis=1) < 4.0 * end.radius
            with np.errstate(divide="ignore", invalid="ignore"):
                way = (points - end.position) @ end.direction
                way /= outward @ end.direction
            near &= way > 0.0
            radii[near] = np.minimum(radii[near], way[near] - 1e-5)
    return SurfaceSamples(points, outward, np.maximum(radii, 0.0))


def half_spaces(piece: Array) -> tuple[Array, Array]:
    """Outward unit normals (f, 3) and offsets (f,) of a convex piece (n, 3), m."""
    from scipy.spatial import ConvexHull

    # Qhull's tolerances suit coordinates of order one: use millimetres.
    hull = ConvexHull((piece - piece[0]) * 1e3)
    equations = np.unique(np.round(hull.equations, 9), axis=0)
    normals = equations[:, :3]
    return normals, -equations[:, 3] * 1e-3 + normals @ piece[0]


def wall_intervals(
    wall: Sequence[Array], samples: SurfaceSamples, search: float
) -> tuple[Array, Array]:
    """Where a wall stands on the normals of the lumen surface, both (n,), metres.

    A line through each sample along its normal runs from one lumen radius inside
    to `search` (m) outside. The first result is the depth of the innermost piece
    that is met on the inner part; the second is the distance to the first piece on
    the outer part, 0 when the sample itself lies in a piece.
    """
    points, outward, radii = samples
    inside = np.zeros(len(points))
    recession = np.full(len(points), search)
    for piece in wall:
        reach = radii.max()
        low, high = piece.min(axis=0) - reach, piece.max(axis=0) + reach
        near = np.flatnonzero(((points > low) & (points < high)).all(axis=1))
        if not len(near):
            continue
        normals, offsets = half_spaces(piece)
        slope = outward[near] @ normals.T
        # Grown by a hair: a line along the seam of two pieces meets both.
        room = offsets + _SEAM - points[near] @ normals.T
        with np.errstate(divide="ignore", invalid="ignore"):
            t = room / slope
        parallel = np.abs(slope) < 1e-12
        enter = np.where(slope < 0.0, t, -np.inf)
        leave = np.where(slope > 0.0, t, np.inf)
        enter[parallel] = -np.inf
        leave[parallel] = np.where(room[parallel] >= 0.0, np.inf, -np.inf)
        first = np.maximum(enter.max(axis=1), -radii[near])
        last = np.minimum(leave.min(axis=1), search)
        met = first <= last
        near, first, last = near[met], first[met], last[met]
        inside[near] = np.maximum(inside[near], -first)
        behind = last >= 0.0
        recession[near[behind]] = np.minimum(
            recession[near[behind]], np.maximum(first[behind], 0.0)
        )
    return inside, recession


def intrusion(
    anatomy: Anatomy, spacing: float = 1e-3, *, search: float = 4e-3
) -> Intrusion:
    """Distance between the wall and the lumen surface of an anatomy.

    Samples lie on the lumen surface about `spacing` (m) apart. At each one the
    intrusion is how far, along the inward normal and up to the centreline, the
    wall still stands in the lumen: the largest depth at which a piece is met, 0 if
    none is. Recession is how far outside the lumen the wall is first met along the
    outward normal. Statistics are over all samples.
    """
    if anatomy.field is None:
        samples = tube_samples(anatomy.tree, spacing)
    else:
        samples = mesh_samples(anatomy, spacing)
    inside, outside = wall_intervals(anatomy.wall, samples, search)
    # At the edge of an ostium a normal may graze the other vessel's surface, so the
    # recession is the depth of the place met, not the way to it.
    met = samples.points + outside[:, None] * samples.outward
    recession = np.clip(-anatomy.depth(met), 0.0, outside)
    worst = samples.points[inside.argmax()]
    return Intrusion(
        inside=Distribution.of(inside),
        recession=Distribution.of(recession),
        deviation=Distribution.of(np.maximum(inside, recession)),
        position=(float(worst[0]), float(worst[1]), float(worst[2])),
    )


def wall_model(wall: Sequence[Array], probe: float = 1e-3) -> mujoco.MjModel:
    """Compiled model of the wall pieces and a sphere of radius `probe` (m).

    The sphere moves on three slide joints (x, y, z), so qpos is its position.
    """
    import mujoco

    spec = mujoco.MjSpec()
    spec.compiler.boundmass = 1e-9
    spec.compiler.boundinertia = 1e-15
    body = spec.worldbody.add_body(name="wall")
    for index, piece in enumerate(wall):
        spec.add_mesh(name=f"wall_{index}", uservert=np.ravel(piece).tolist())
        body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_MESH,
            meshname=f"wall_{index}",
            contype=1,
            conaffinity=0,
        )
    sphere = spec.worldbody.add_body(name="probe")
    for axis in np.eye(3):
        sphere.add_joint(type=mujoco.mjtJoint.mjJNT_SLIDE, axis=axis.tolist())
    sphere.add_geom(
        type=mujoco.mjtGeom.mjGEOM_SPHERE,
        size=[probe, 0.0, 0.0],
        mass=1e-3,
        contype=0,
        conaffinity=1,
    )
    return spec.compile()


def coverage(anatomy: Anatomy, n_rays: int = 100_000, *, seed: int = 0) -> Coverage:
    """Shoot rays from around the centrelines in all directions at the wall's triangles.

    A ray leaks when it hits nothing, or hits first at more than 1.5 mm outside the
    lumen, which means that it went through a slit. Rays that cross the inlet's
    hole are not counted.
    """
    import mujoco

    rng = np.random.default_rng(seed)
    model = wall_model(anatomy.wall)
    data = mujoco.MjData(model)
    # The sphere must not stop a ray.
    data.qpos[:] = 10.0
    mujoco.mj_forward(model, data)
    lines = [vessel.centreline for vessel in anatomy.tree.vessels.values()]
    share = np.array([line.length for line in lines])
    share /= share.sum()
    per_origin = 250
    origins = []
    for line, part in zip(lines, share, strict=True):
        count = max(1, round(part * n_rays / per_origin))
        # Not on the end planes themselves, where rays graze the caps; off the axis,
        # because slits hide from one point of view.
        place = line.at(rng.uniform(1e-4, line.length - 1e-4, count))
        offset = np.cross(place.tangent, rng.normal(size=(count, 3)))
        offset /= np.linalg.norm(offset, axis=1)[:, None]
        reach = _OFF_AXIS * place.radius * rng.uniform(size=count)
        origins.append(place.position + reach[:, None] * offset)
    inlet = anatomy.inlet
    leaks, rays = [], 0
    geom = np.empty(per_origin, np.int32)
    distance = np.empty(per_origin)
    one = np.empty(1, np.int32)
    for origin in np.concatenate(origins):
        direction = rng.normal(size=(per_origin, 3))
        direction /= np.linalg.norm(direction, axis=1)[:, None]
        mujoco.mj_multiRay(
            model, data, origin, direction.ravel(), None, 1, -1, geom, distance,
            None, per_origin, mujoco.mjMAXVAL,
        )  # fmt: skip
        with np.errstate(divide="ignore", invalid="ignore"):
            t = (
                (inlet.position - origin)
                @ inlet.direction
                / (direction @ inlet.direction)
            )
            crossing = origin + t[:, None] * direction - inlet.position
            hole = (t > 0.0) & (np.linalg.norm(crossing, axis=1) < _INLET_RADIUS)
        # Near a geom that lies all around the origin mj_multiRay passes rays by that
        # mj_ray stops (MuJoCo 3.17).
        for k in np.flatnonzero(geom < 0):
            found = mujoco.mj_ray(model, data, origin, direction[k], None, 1, -1, one)
            if found >= 0.0:
                geom[k], distance[k] = one[0], found
        missed = geom < 0
        end = origin + np.where(missed, 0.1, distance)[:, None] * direction
        leak = ~hole & (missed | (anatomy.depth(end) < -_LEAK_DEPTH))
        rays += int((~hole).sum())
        leaks.append(_exits(anatomy.tree, origin, direction[leak]))
    positions = np.concatenate(leaks)
    return Coverage(rays, len(positions), 1.0 - len(positions) / rays, positions)


def _exits(tree: VesselTree, origin: Array, direction: Array) -> Array:
    """Where rays (n, 3) from `origin` (3,) first leave the lumen, within 0.4 m."""
    if not len(direction):
        return np.empty((0, 3))
    t = np.linspace(0.0, 0.4, 1601)
    points = origin + t[:, None, None] * direction
    first = (tree.depth(points) < 0.0).argmax(axis=0)
    return points[first, np.arange(len(direction))]


def patency(
    anatomy: Anatomy, radius: float = 1e-3, *, spacing: float = 0.5e-3
) -> Patency:
    """Move a sphere of `radius` (m) along each centreline and count contacts.

    It starts and stops one radius from closed ends, and at the inlet itself.
    """
    import mujoco

    model = wall_model(anatomy.wall, radius)
    data = mujoco.MjData(model)
    contacts, total, blocked = 0, 0, []
    for name, vessel in anatomy.tree.vessels.items():
        line = vessel.centreline
        margin = 1.5 * radius
        s = np.arange(margin, line.length - margin, spacing)
        found = 0
        for position in line.at(s).position:
            data.qpos[:] = position
            mujoco.mj_fwdPosition(model, data)
            found += data.ncon > 0
        contacts += found
        total += len(s)
        if found:
            blocked.append(name)
    return Patency(radius, total, contacts, tuple(blocked))
