"""The endoluminal camera against closed forms, in a vessel at rest and a moving one."""

import numpy as np
import pytest

from cathsim_dmc.anatomy import phantoms
from cathsim_dmc.imaging import endoluminal
from cathsim_dmc.validation import motion, rig

SIZE = 32
RADIUS = 8e-3


def rays(frame):
    """Unit vectors (SIZE, SIZE, 3) through the pixels of a view of 90 degrees."""
    side = (np.arange(SIZE) + 0.5) / (SIZE / 2) - 1.0
    u, v = np.meshgrid(side, side)
    local = np.stack([u, v, np.ones_like(u)], axis=-1)
    local /= np.linalg.norm(local, axis=-1, keepdims=True)
    return local @ frame.T


def seen(anatomy, head, frame, warp=endoluminal.AT_REST):
    lumens, size = [anatomy.lumen], (SIZE, SIZE)
    views = endoluminal.views(lumens, [warp], head[None], frame[None], size)
    return (view[0, ..., 0] for view in views)


@pytest.mark.parametrize("tilt", [0.0, 0.6])
def test_a_straight_tube_is_seen_as_the_closed_form_says(tilt):
    """Distance r / sin(angle to the axis), cosine of the incidence sin(angle)."""
    tube = rig.tube(0.2, RADIUS)
    line = tube.tree.root.centreline.points
    axis = (line[-1] - line[0]) / np.linalg.norm(line[-1] - line[0])
    across = np.cross(axis, [0.3, 0.5, 0.8])
    across /= np.linalg.norm(across)
    other = np.cross(axis, across)
    forward = np.cos(tilt) * axis + np.sin(tilt) * across
    frame = np.stack([np.cross(other, forward), other, forward], axis=1)
    grey, distance = seen(tube, 0.5 * (line[0] + line[-1]), frame)
    sine = np.linalg.norm(np.cross(rays(frame), axis), axis=-1)
    expected = RADIUS / sine
    wall = expected < 20e-3  # nearer than the ends
    assert wall.mean() > 0.7
    error = np.abs(distance - expected)[wall]
    assert error.max() < 60e-6  # the field is true to 8 µm, across the ray
    level = np.minimum(255 * endoluminal.WHITE / expected * np.sqrt(sine), 255)
    assert np.abs(grey - level)[wall].max() < 5.0


def test_rays_end_on_the_wall_of_a_moving_vessel():
    arch = phantoms.load("simple1")
    warp = arch.motion.lattice, motion.parameters(5.5e-3, 1.0, 0.02), 2.2
    place = arch.tree.root.centreline.at(0.06)
    (head,), _ = arch.motion.to_space(*warp[1:], place.position[None])
    assert np.linalg.norm(head - place.position) > 3e-3
    frame = np.linalg.qr(np.column_stack([place.tangent, np.eye(3)[:, :2]]))[0]
    frame = frame[:, [1, 2, 0]] * np.sign(frame[:, 0] @ place.tangent)
    _, distance = seen(arch, head, frame, warp)
    met = head + distance[..., None] * rays(frame)
    rest = arch.motion.to_rest(*warp[1:], met)
    _, growth = arch.motion.to_space(*warp[1:], rest)
    assert np.percentile(np.abs(arch.lumen(rest) + growth), 99) < 20e-6


def test_a_wider_image_shows_more_on_both_sides():
    """The vertical angle of the view is fixed."""
    tube = rig.tube(0.2, RADIUS)
    line = tube.tree.root.centreline
    head = line.at(0.5 * line.length).position[None]
    frame = np.linalg.qr(np.random.RandomState(0).normal(size=(3, 3)))[0][None]
    square, wide = (
        endoluminal.views([tube.lumen], [endoluminal.AT_REST], head, frame, size)
        for size in ((SIZE, SIZE), (SIZE, SIZE + 16))
    )
    for one, other in zip(square, wide, strict=True):
        np.testing.assert_array_equal(other[:, :, 8:-8], one)
        assert (other[:, :, :8] != one[:, :, :8]).any()
