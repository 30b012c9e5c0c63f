"""Triangles of the lumen surface, from the depth field of the vessel tree."""

import numpy as np

from cathsim_dmc import bounds
from cathsim_dmc.anatomy.centreline import Array, VesselTree
from cathsim_dmc.anatomy.parts import Surface

SPACING = 2.2e-3  # m: at most 20,000 triangles on an aortic arch with its branches
_NARROW = 0.9  # of the least radius; a wider step would leave gaps
_LEAST_SPACING = 1e-3  # m


def _depth_grid(tree: VesselTree, spacing: float) -> tuple[Array, Array]:
    """Depths (nx, ny, nz) m, far outside -2 spacing, and the first point (3,), m."""
    lines = [(one.centreline, one.parent is None) for one in tree.vessels.values()]
    margin = 3.0 * spacing
    low = np.min([(x.points - x.radii[:, None]).min(0) for x, _ in lines], axis=0)
    high = np.max([(x.points + x.radii[:, None]).max(0) for x, _ in lines], axis=0)
    origin = low - margin
    shape = np.ceil((high - low + 2.0 * margin) / spacing).astype(int) + 1
    axes = [origin[i] + spacing * np.arange(shape[i]) for i in range(3)]
    grid = np.full(shape, -2.0 * spacing)
    for line, is_root in lines:
        # Short pieces have small boxes: few grid points meet few segments.
        count = max(1, round(line.length / 10e-3))
        stops = np.linspace(0.0, line.length, count + 1)
        for s0, s1 in zip(stops[:-1], stops[1:], strict=True):
            part = line.slice(s0, s1)
            reach = part.radii.max() + margin
            box = []
            for axis, places in zip(axes, part.points.T, strict=True):
                ends = places.min() - reach, places.max() + reach
                first, last = np.searchsorted(axis, ends)
                box.append(slice(first, last))
            near_x, near_y, near_z = (a[b] for a, b in zip(axes, box, strict=True))
            x, y, z = np.meshgrid(near_x, near_y, near_z, indexing="ij")
            near = part.project(np.stack([x, y, z], axis=-1))
            depth = near.radius - near.distance
            # Pieces have round ends, which lie in the neighbouring piece; a piece that
            # reaches beyond a flat end of the vessel is cut there.
            for s, side, reaches in (
                (line.length, 1.0, line.length - s1 < reach),
                (0.0, -1.0, s0 < reach and is_root),
            ):
                if reaches:
                    end = line.at(s)
                    way = side * end.tangent
                    along = x * way[0] + y * way[1] + z * way[2]
                    depth = np.minimum(depth, float(way @ end.position) - along)
            view = grid[tuple(box)]
            np.maximum(view, depth, out=view)
    return grid, origin


def lumen_surface(tree: VesselTree, spacing: float | None = None) -> Surface:
    """Closed triangulated surface of the lumen with flat ends, normals outwards.

    ``spacing`` is the grid step (m) of the marching cubes; None adapts it to the
    narrowest lumen, so that there are no gaps.
    """
    from scipy.ndimage import binary_fill_holes
    from skimage.measure import marching_cubes

    if spacing is None:
        radii = [vessel.centreline.radii.min() for vessel in tree.vessels.values()]
        spacing = min(SPACING, max(_NARROW * float(min(radii)), _LEAST_SPACING))
    bounds.number("spacing", spacing, positive=True)
    grid, origin = _depth_grid(tree, spacing)
    # Vessels that meet may leave a grid point outside both by less than a micrometre.
    grid[binary_fill_holes(grid > 0.0) & (grid <= 0.0)] = 0.1 * spacing
    vertices, faces, _, _ = marching_cubes(
        grid, level=0.0, spacing=(spacing,) * 3, gradient_direction="ascent"
    )
    return Surface(vertices + origin, faces)


def sampled(surface: Surface, count: int) -> tuple[Array, Array]:
    """Random points (n, 3) m, uniform on a surface, and outward unit normals (n, 3)."""
    import trimesh

    mesh = trimesh.Trimesh(surface.vertices, surface.faces, process=False)
    points, face = trimesh.sample.sample_surface(mesh, count, seed=0)[:2]
    return np.asarray(points), np.asarray(mesh.face_normals[face])
