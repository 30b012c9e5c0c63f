"""Wall pieces and the surface: intrusion, leaks, patency, cost."""

import time

import numpy as np
import pytest
from conftest import assert_wall_fits
from scipy.spatial import ConvexHull

from cathsim_dmc.anatomy import surface, tube
from cathsim_dmc.anatomy.arch import arch
from cathsim_dmc.anatomy.centreline import Centreline, Vessel, VesselTree
from cathsim_dmc.anatomy.wall import fidelity, polytope
from cathsim_dmc.anatomy.wall import pieces as wall


def cylinder(radius=0.01, length=0.1):
    line = Centreline([[0, 0, 0], [0, 0, length / 2], [0, 0, length]], [radius] * 3)
    return VesselTree({"aorta": Vessel("aorta", line)})


@pytest.mark.parametrize("name", arch.ARCHES)
def test_presets_keep_the_lumen_free_and_closed(name):
    assert_wall_fits(arch.load(name))


def test_femoral_access_is_closed_but_for_its_inlet():
    assert_wall_fits(arch.load("simple1", access="descending"))


def test_pieces_are_convex_with_few_vertices():
    for piece in arch.load("simple2").wall:
        hull = ConvexHull(piece * 1e3)
        assert hull.volume > 1e-3
        assert len(piece) <= 40


def test_mujoco_compiles_every_piece_quietly(capfd):
    start = time.process_time()
    model = fidelity.wall_model(arch.load("simple2").wall)
    # A twentieth of this is usual; the bound only catches a wrong order.
    assert time.process_time() - start < 2.0
    assert model.nmesh == len(arch.load("simple2").wall)
    output = capfd.readouterr()
    assert "WARNING" not in output.out + output.err
    # MuJoCo's hulls have the volume of ours: no piece was dropped or degenerate.
    assert np.all(model.geom_rbound[:-1] > 0.0)


def test_wall_of_a_cylinder_has_the_predicted_chord():
    radius, tolerance = 0.01, 0.4e-3
    pieces = wall.build_wall(cylinder(radius), tolerance=tolerance)
    samples = fidelity.tube_samples(cylinder(radius), 0.5e-3)
    inside, recession = fidelity.wall_intervals(pieces, samples, 2e-3)
    around = tube.polyhedral_tube(
        cylinder(radius).vessel("aorta").centreline, tolerance=tolerance
    ).inner.shape[1]
    sagitta = radius * (1.0 - np.cos(np.pi / around))
    assert sagitta <= tolerance
    assert inside.max() == pytest.approx(sagitta / 2, rel=0.1)
    assert recession.max() == pytest.approx(sagitta / 2, rel=0.1)


def test_fidelity_sees_a_wall_that_stands_in_the_lumen():
    pieces = wall.build_wall(cylinder())
    block = np.array(np.meshgrid([0.007, 0.02], [-0.002, 0.002], [0.04, 0.05]))
    pieces = (*pieces, block.reshape(3, -1).T)
    samples = fidelity.tube_samples(cylinder(), 1e-3)
    inside, _ = fidelity.wall_intervals(pieces, samples, 2e-3)
    assert inside.max() == pytest.approx(3e-3, abs=0.1e-3)


def test_fidelity_sees_a_missing_piece_and_a_blocked_branch():
    from dataclasses import replace

    anatomy = arch.load("simple1")
    lsa = anatomy.goal("lsa").position
    away = [np.linalg.norm(piece.mean(axis=0) - lsa) for piece in anatomy.wall]
    holed = list(anatomy.wall)
    del holed[int(np.argmin(away))]
    leaking = fidelity.coverage(replace(anatomy, wall=holed), 20_000)
    assert leaking.leaks > 0
    near = np.linalg.norm(leaking.leak_positions - lsa, axis=1)
    assert np.median(near) < 20e-3
    plug = lsa + 2e-3 * (np.array(np.meshgrid(*[[-1, 1]] * 3)).reshape(3, -1).T)
    blocked = fidelity.patency(replace(anatomy, wall=(*anatomy.wall, plug)), 1e-3)
    assert blocked.blocked == ("lsa",)


def test_too_large_a_sphere_touches():
    # The LCCA of type I has a radius of 3 mm.
    found = fidelity.patency(arch.load("simple1"), 3.2e-3, spacing=4e-3)
    assert "lcca" in found.blocked


def test_clipping_a_cube_gives_the_known_volumes():
    cube = np.array(np.meshgrid(*[[0.0, 1.0]] * 3)).reshape(3, -1).T
    half = polytope.clip(cube, np.array([1.0, 0, 0]), 0.25)
    assert polytope.volume_and_width(half)[0] == pytest.approx(0.75)
    corner = polytope.clip(cube, np.full(3, 3**-0.5), 2.0 / 3**0.5)
    assert len(corner) == 4
    assert polytope.volume_and_width(corner)[0] == pytest.approx(1.0 / 6.0)
    assert polytope.clip(cube, np.array([1.0, 0, 0]), 1.0) is None
    assert polytope.clip(cube, np.array([1.0, 0, 0]), 0.0) is cube


def test_two_halves_of_a_clipped_piece_fill_it():
    rng = np.random.default_rng(0)
    for _ in range(20):
        points = rng.normal(size=(30, 3)) * 1e-2
        points = points[ConvexHull(points).vertices]
        normal = rng.normal(size=3)
        normal /= np.linalg.norm(normal)
        parts = [
            polytope.clip(points, sign * normal, sign * 1e-3) for sign in (1.0, -1.0)
        ]
        volumes = [polytope.volume_and_width(part)[0] for part in parts]
        whole = polytope.volume_and_width(points)[0]
        assert sum(volumes) == pytest.approx(whole, rel=1e-9)


@pytest.mark.parametrize("name", ["simple1", "bovine"])
def test_surface_is_closed_points_outwards_and_follows_the_lumen(name):
    anatomy = arch.load(name)
    found = anatomy.surface
    assert len(found.faces) <= 30_000
    edges = np.sort(found.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    _, counts = np.unique(edges, axis=0, return_counts=True)
    assert (counts == 2).all()
    assert found.volume > 0.0
    depth = anatomy.tree.depth(found.vertices, closed=True)
    assert np.percentile(np.abs(depth), 99) < 0.3e-3
    # Volume of the tubes from Monte Carlo points in the bounding box.
    low, high = found.vertices.min(axis=0), found.vertices.max(axis=0)
    points = np.random.default_rng(0).uniform(low, high, (40_000, 3))
    share = (anatomy.tree.depth(points, closed=True) > 0.0).mean()
    expected = share * np.prod(high - low)
    assert found.volume == pytest.approx(expected, rel=0.05)


def test_surface_spacing_must_be_positive():
    with pytest.raises(ValueError, match="spacing"):
        surface.lumen_surface(cylinder(), 0.0)
