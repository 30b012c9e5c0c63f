import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from cathsim_dmc.anatomy.parts import Surface
from cathsim_dmc.imaging import VIEWS, CArm, surface_thickness


def unproject(carm, pixels, depth):
    """World points (..., 3) at pixels (..., 2) and depths (...), m."""
    rows, columns = carm.resolution
    centre = 0.5 * np.array([columns - 1, rows - 1])
    x, y = np.moveaxis((pixels - centre) / carm.focal_length, -1, 0)
    direction = np.stack([x, y, np.ones_like(x)], axis=-1) @ carm.axes
    return carm.source + np.asarray(depth)[..., None] * direction


def rays(carm, supersample):
    """Unit directions (rows * s, columns * s, 3) from the source."""
    rows, columns = carm.resolution
    x = (np.arange(columns * supersample) + 0.5) / supersample - 0.5
    y = (np.arange(rows * supersample) + 0.5) / supersample - 0.5
    pixels = np.stack(np.meshgrid(x, y), axis=-1)
    direction = unproject(carm, pixels, np.ones(pixels.shape[:2])) - carm.source
    return direction / np.linalg.norm(direction, axis=-1, keepdims=True)


def pixel_mean(image, supersample):
    rows, columns = (n // supersample for n in image.shape)
    return image.reshape(rows, supersample, columns, supersample).mean(axis=(1, 3))


def tube(line, radius, sides=48):
    """Triangle tube round a polyline, closed by fans."""
    line = np.asarray(line, dtype=float)
    radius = np.broadcast_to(radius, len(line))
    tangent = np.gradient(line, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    helper = np.eye(3)[np.argmin(np.abs(tangent).max(axis=0))]
    u = np.cross(tangent, helper)
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    v = np.cross(tangent, u)
    angle = np.arange(sides) * 2 * np.pi / sides
    # Outer polygon of the area of the circle: chords then agree in the mean.
    size = radius * np.sqrt(2 * np.pi / sides / np.sin(2 * np.pi / sides))
    ring = line[:, None] + size[:, None, None] * (
        np.cos(angle)[:, None] * u[:, None] + np.sin(angle)[:, None] * v[:, None]
    )
    vertices = ring.reshape(-1, 3)
    i, j = np.meshgrid(np.arange(len(line) - 1), np.arange(sides), indexing="ij")
    a, b = i * sides + j, i * sides + (j + 1) % sides
    c, d = a + sides, b + sides
    faces = np.concatenate(
        [np.stack([a, b, d], -1).reshape(-1, 3), np.stack([a, d, c], -1).reshape(-1, 3)]
    )
    last = (len(line) - 1) * sides
    k = np.arange(sides)
    n = len(vertices)
    vertices = np.concatenate([vertices, line[[0, -1]]])
    fans = [
        np.stack([np.full(sides, n), (k + 1) % sides, k], -1),
        np.stack([np.full(sides, n + 1), last + k, last + (k + 1) % sides], -1),
    ]
    return Surface(vertices, np.concatenate([faces, *fans]))


def ball(centre, radius, subdivisions=5):
    mesh = trimesh.creation.icosphere(subdivisions, radius)
    return Surface(mesh.vertices + centre, mesh.faces)


@pytest.mark.parametrize("view", VIEWS)
def test_sphere(view):
    carm = CArm.view(view, isocentre=(0.0, 0.01, 0.0))
    centre, radius = np.array([0.02, -0.01, 0.03]), 0.03
    offset = centre - carm.source
    along = rays(carm, 3) @ offset
    half = np.sqrt(np.maximum(radius**2 - (offset @ offset - along**2), 0.0))
    truth = pixel_mean(2.0 * half, 3)
    image = surface_thickness(carm, ball(centre, radius), 3)
    assert np.abs(image - truth).sum() < 0.01 * truth.sum()
    assert image.max() == pytest.approx(2 * radius, rel=2e-3)


@settings(max_examples=40)
@given(
    st.floats(-3.0, 3.0),
    st.floats(-1.3, 1.3),
    st.floats(-0.03, 0.03),
    st.floats(-0.03, 0.03),
    st.integers(1, 3),
)
def test_volume_is_seen_from_everywhere(primary, secondary, x, z, supersample):
    carm = CArm(primary, secondary)
    centre, radius = np.array([x, 0.01, z]), 0.025
    surface = ball(centre, radius, subdivisions=3)
    image = surface_thickness(carm, surface, supersample)
    # A ray through a pixel stands for the solid angle of the pixel.
    depth = (centre - carm.source) @ carm.axes[2]
    area = (depth / carm.focal_length) ** 2 / carm.slant()
    # Depth varies inside the ball: (1 + r²/5d²) of the volume at most.
    assert (image * area).sum() == pytest.approx(surface.volume, rel=0.01)
    assert image.min() >= 0.0


def test_no_ray_slips_between_triangles():
    # A lattice that falls exactly on ray positions: every vertex and edge is hit.
    carm = CArm(resolution=(32, 32))
    n = 17
    grid = np.linspace(4, 20, n)
    x, y = np.meshgrid(grid, grid)
    pixels = np.stack([x, y], axis=-1).reshape(-1, 2)
    front = unproject(carm, pixels, np.full(len(pixels), 0.80))
    back = unproject(carm, pixels, np.full(len(pixels), 0.70))
    vertices = np.concatenate([front, back])
    i, j = np.meshgrid(np.arange(n - 1), np.arange(n - 1), indexing="ij")
    a = (i * n + j).ravel()
    b, c, d = a + 1, a + n, a + n + 1
    # Rows run down: seen from the detector (front), a, c, b is counter-clockwise.
    sheet = np.concatenate([np.stack([a, c, b], -1), np.stack([b, c, d], -1)])
    faces = np.concatenate([sheet, sheet[:, ::-1] + n * n])
    vertices, faces = closed_sides(vertices, faces)
    image = surface_thickness(carm, Surface(vertices, faces), 1)
    inside = image[4:20, 4:20] / carm.slant()[4:20, 4:20]
    np.testing.assert_allclose(inside, 0.10, rtol=1e-9)
    image[4:21, 4:21] = 0.0
    assert (image == 0.0).all()


def closed_sides(vertices, faces):
    """Join the rims of two sheets by a band of triangles."""
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    known = {tuple(e) for e in edges.tolist()}
    half = len(vertices) // 2
    rim = [(a, b) for a, b in known if (b, a) not in known and a < half]
    band = []
    for a, b in rim:
        band += [(b, a, a + half), (b, a + half, b + half)]
    return vertices, np.concatenate([faces, np.array(band)])


def test_two_bodies_add_and_a_hollow_one_subtracts():
    carm = CArm.view("AP")
    outer, inner = ball([0, 0, 0], 0.03), ball([0, 0, 0], 0.02)
    a, b = surface_thickness(carm, outer), surface_thickness(carm, inner)
    faces = [outer.faces, inner.faces[:, ::-1] + len(outer.vertices)]
    vertices = np.concatenate([outer.vertices, inner.vertices])
    shell = Surface(vertices, np.concatenate(faces))
    np.testing.assert_allclose(surface_thickness(carm, shell), a - b, atol=1e-12)


def test_parts_outside_the_image_are_cut_off():
    line = np.linspace([0, 0, -0.4], [0, 0, 0.4], 60)
    image = surface_thickness(CArm.view("AP"), tube(line, 0.01))
    middle = surface_thickness(CArm.view("AP"), tube(line[10:50], 0.01))
    np.testing.assert_allclose(image, middle, atol=1e-6)


def test_bad_surfaces_are_refused():
    good = ball([0, 0, 0], 0.03, subdivisions=2)
    vertices, faces = good.vertices, good.faces
    for part in (faces[:, ::-1], faces[:0]):
        with pytest.raises(ValueError, match="outwards"):
            surface_thickness(CArm(), Surface(vertices, part))
    with pytest.raises(ValueError, match="supersample"):
        surface_thickness(CArm(), good, 0)
    with pytest.raises(ValueError, match="source"):
        surface_thickness(CArm(), Surface(vertices + [0.0, 0.75, 0.0], faces))
    with pytest.raises(ValueError, match="faces name vertices"):
        Surface(vertices, faces + 5)
    with pytest.raises(ValueError, match=r"shape \(n, 3\)"):
        Surface(vertices[:, :2], faces)
