import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from cathsim_dmc.anatomy.parts import Surface
from cathsim_dmc.imaging.carm import VIEWS, CArm
from cathsim_dmc.imaging.thickness import surface_thickness


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
    box = trimesh.creation.box().subdivide().subdivide().subdivide().subdivide()
    places = 12 + 16 * box.vertices[:, :2], 0.75 + 0.1 * box.vertices[:, 2]
    # Rows run down: columns, rows and depth are a left-handed frame.
    lattice = Surface(unproject(carm, *places), box.faces[:, ::-1])
    image = surface_thickness(carm, lattice, 1)
    inside = image[4:20, 4:20] / carm.slant()[4:20, 4:20]
    np.testing.assert_allclose(inside, 0.10, rtol=1e-9)
    image[4:21, 4:21] = 0.0
    assert (image == 0.0).all()


def test_two_bodies_add_and_a_hollow_one_subtracts():
    carm = CArm.view("AP")
    outer, inner = ball([0, 0, 0], 0.03), ball([0, 0, 0], 0.02)
    a, b = surface_thickness(carm, outer), surface_thickness(carm, inner)
    faces = [outer.faces, inner.faces[:, ::-1] + len(outer.vertices)]
    vertices = np.concatenate([outer.vertices, inner.vertices])
    shell = Surface(vertices, np.concatenate(faces))
    np.testing.assert_allclose(surface_thickness(carm, shell), a - b, atol=1e-12)


def test_parts_outside_the_image_are_cut_off():
    image, middle = (
        surface_thickness(CArm.view("AP"), Surface(rod.vertices, rod.faces))
        for rod in (trimesh.creation.cylinder(0.01, height) for height in (0.8, 0.5))
    )
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
