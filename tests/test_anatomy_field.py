"""The lumen as a field: distances to the wall, and what is kept of them."""

import numpy as np
import pytest
import trimesh

from cathsim_dmc.anatomy.arch import arch
from cathsim_dmc.anatomy.centreline import Centreline, Vessel, VesselTree
from cathsim_dmc.anatomy.field import Field
from cathsim_dmc.anatomy.parts import End, Surface
from cathsim_dmc.anatomy.surface_depth import SurfaceDepth
from cathsim_dmc.anatomy.tree_depth import TreeDepth
from cathsim_dmc.laws.field import FREE
from cathsim_dmc.tasks import placement

RADIUS, LENGTH = 4e-3, 40e-3
UP = np.array([0.0, 0.0, 1.0])


def line(first, last, radius, count=41):
    share = np.linspace(0.0, 1.0, count)[:, None]
    points = (1 - share) * np.asarray(first) + share * np.asarray(last)
    return Centreline(points, np.broadcast_to(radius, count))


def tree_of(*vessels):
    return VesselTree({vessel.name: vessel for vessel in vessels})


@pytest.fixture(scope="module")
def tube():
    """A straight tube along z, open at z = 0."""
    tree = tree_of(Vessel("root", line((0, 0, 0), (0, 0, LENGTH), RADIUS)))
    ends = (
        End("root", np.zeros(3), -UP, RADIUS, True),
        End("root", LENGTH * UP, UP, RADIUS, False),
    )
    return tree, ends, Field.of(tree, ends)


@pytest.fixture(scope="module")
def fork():
    """Tubes of 5 and 2.5 mm that meet at a right angle."""
    return tree_of(
        Vessel("root", line((0, 0, -25e-3), (0, 0, 25e-3), 5e-3)),
        Vessel("branch", line((0, 0, 0), (25e-3, 0, 0), 2.5e-3), "root", 5e-3),
    )


def dense_wall(tree):
    """Points (n, 3) all over the wall, 0.2 mm apart, by what a tree says of itself."""
    parts = []
    for name, vessel in tree.vessels.items():
        place = vessel.centreline.at(np.arange(0.0, vessel.centreline.length, 0.15e-3))
        across = np.cross(place.tangent, np.roll(place.tangent, 1, axis=1) + (0, 0, 1))
        across /= np.linalg.norm(across, axis=1, keepdims=True)
        other = np.cross(place.tangent, across)
        angle = np.linspace(0, 2 * np.pi, 180, endpoint=False)[:, None, None]
        spokes = np.cos(angle) * across + np.sin(angle) * other
        points = (place.position + place.radius[:, None] * spokes).reshape(-1, 3)
        others = [v for key, v in tree.depths(points).items() if key != name]
        parts.append(points[np.all(np.less(others, 1e-9), axis=0)])
    return np.concatenate(parts)


def test_the_depth_at_a_junction_is_the_distance_to_the_wall(fork):
    """Where the radius less the distance from a centreline is not."""
    from scipy.spatial import cKDTree

    random = np.random.default_rng(0)
    points = random.uniform((3e-3, -4e-3, -4e-3), (9e-3, 4e-3, 4e-3), (4000, 3))
    distance, _ = cKDTree(dense_wall(fork)).query(points)
    old = np.max(list(fork.depths(points).values()), axis=0)
    inside = old > 0.0
    exact = np.where(inside, distance, -distance)
    measured = TreeDepth(fork)(points)
    # The reference's points are 0.2 mm apart.
    clear = distance > 0.3e-3
    np.testing.assert_allclose(measured[clear], exact[clear], atol=0.06e-3)
    assert np.abs(old - exact)[clear].max() > 0.5e-3
    field = Field.of(fork)(points)
    close = np.abs(measured) < 1e-3
    assert np.quantile(np.abs(field - measured)[close], 0.99) < 0.06e-3


def test_the_wall_of_a_taper_is_nearer_than_its_radius():
    """A cone of 45°: the distance is that to its flank."""
    cone = tree_of(
        Vessel("root", line((0, 0, 0), (0, 0, 8e-3), np.linspace(2, 10, 41) / 1e3))
    )
    depth = TreeDepth(cone)(np.array([[3e-3, 0.0, 4e-3]]))
    assert depth[0] == pytest.approx(3e-3 / np.sqrt(2), abs=1e-6)


def test_a_closed_end_is_a_wall_where_the_vessel_narrows_behind_it():
    """The nearest cross-section of a place on it lies farther inside."""
    radii = np.linspace(6, 4, 41) / 1e3
    root = Vessel("root", line((0, 0, 0), (0, 0, LENGTH), radii))
    above = np.linspace(-2e-3, 2e-3, 41)
    for x in (0.0, 2e-3, 4e-3):
        places = np.stack([0 * above + x, 0 * above, above], axis=-1)
        flank = (6e-3 - x - 0.05 * above) / np.hypot(1, 0.05)  # of the cone
        exact = np.where(above < 0, above, np.minimum(above, flank))
        np.testing.assert_allclose(TreeDepth(tree_of(root))(places), exact, atol=1e-5)


def test_a_vessel_that_ends_in_others_leaves_no_wall_in_them():
    """The end of one lies in the crossing lumen of the other, at any angle."""
    for angle in np.radians((0, 20, 45)):
        way = np.array([np.cos(angle), 0, np.sin(angle)])
        tree = tree_of(
            Vessel("root", line((0, 0, -25e-3), (0, 0, 0), 5e-3)),
            Vessel("over", line(-20e-3 * way, 20e-3 * way, 4e-3), "root", 6e-3),
        )
        # On a lattice, whose blocks leave out what is far from all of their places.
        along = np.linspace(-2e-3, 2e-3, 9)
        block = np.stack(np.meshgrid(along, along, along, indexing="ij"), -1)
        block, middle = block.reshape(-1, 3), np.zeros((1, 3))
        together = TreeDepth(tree).around(middle, block)[0]
        alone = TreeDepth(tree)(block)
        np.testing.assert_array_equal(together, alone)
        assert (alone > 0.3e-3).all()


def test_a_crease_is_found_where_a_wall_bends():
    """The divider of two branches of a random arch; its walls meet at 45°."""
    anatomy = arch.build_seed(arch.arch_set("test")[1])
    places = (
        np.array([-7e-3, 17.4e-3, 98.3e-3])
        + np.array([(0.3, -0.3, -0.4), (0.5, -0.5, -0.5), (0.8, -0.6, -0.9)]) / 1e3
    )
    from scipy.spatial import cKDTree

    distance, _ = cKDTree(dense_wall(anatomy.tree)).query(places)
    np.testing.assert_allclose(TreeDepth(anatomy.tree)(places), distance, atol=0.1e-3)


def test_the_field_of_a_tube_is_exact_at_its_ends(tube):
    _, _, field = tube
    x = RADIUS - 0.7e-3
    places = [(x, 0, 0.01e-3), (x, 0, 20e-3), (x, 0, LENGTH - 0.5e-3), (0, x, 5e-3)]
    np.testing.assert_allclose(
        field(places), [0.7e-3, 0.7e-3, 0.5e-3, 0.7e-3], atol=0.02e-3
    )
    # Behind the open end a device is free; the lumen it has left.
    behind = np.array([(x, 0, -0.01e-3), (0, 0, -20e-3)])
    assert (field(behind, free=True) == FREE).all()
    np.testing.assert_allclose(field(behind), [-0.01e-3, -20e-3])
    assert field((0, 0, -80e-3), free=True) == FREE
    beyond = field([(0, 0, LENGTH + 2e-3), (RADIUS + 1e-3, 0, -1e-3)], free=True)
    assert (beyond < 0).all()


def test_a_hole_in_the_cap_of_the_inlet_is_all_that_lets_a_device_out(tube):
    _, _, field = tube
    capped = field.with_hole(2e-3)
    assert capped((0, 0, -5e-3), free=True) == FREE
    places = [(1.5e-3, 0, 0.01e-3), (3e-3, 0, 0.4e-3), (3e-3, 0, -0.3e-3)]
    np.testing.assert_allclose(
        capped(places, free=True), [0.5e-3, 0.4e-3, -0.3e-3], atol=0.01e-3
    )
    assert (capped.gradient(places[1:]) @ UP > 0.9).all()
    assert (field(places, free=True)[:2] > 0.9e-3).all()


def test_the_rim_of_the_hole_pushes_back_along_the_way_to_it(tube):
    """A plate with a hole: also beside its plane, where a difference reaches behind."""
    hole = 2e-3
    capped = tube[2].with_hole(hole)
    rng = np.random.default_rng(0)
    angle = rng.uniform(0, 2 * np.pi, 400)
    away, level = rng.uniform(0.3e-3, 1.2e-3, 400), rng.uniform(0, 0.5 * np.pi, 400)
    # On circles around the rim, in front of the plate.
    across, up = hole - away * np.cos(level), away * np.sin(level) + 1e-9
    spokes = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=-1)
    places = across[:, None] * spokes + up[:, None] * UP
    np.testing.assert_allclose(capped(places, free=True), away, atol=0.01e-3)
    back = -np.cos(level)[:, None] * spokes + np.sin(level)[:, None] * UP
    gradient = capped.gradient(places)
    gradient /= np.linalg.norm(gradient, axis=1, keepdims=True)
    # The rim is sharp, and the differences reach 0.25 mm.
    assert np.vecdot(gradient, back).min() > 0.95
    # In the hole and in the plate it points to the middle of the hole.
    inside = (hole + np.array([-0.5e-3, 0.4e-3]))[:, None] * spokes[:2] - 1e-3 * UP
    gradient = capped.gradient(inside)
    np.testing.assert_allclose(gradient, -spokes[:2], atol=0.05)


def test_a_vessel_that_passes_behind_the_inlet_keeps_its_wall():
    """60 mm behind it, in the straight continuation of the lumen."""
    turn = np.linspace(0.0, np.pi, 40)
    arch = np.stack([30e-3 * (1 - np.cos(turn)), 0 * turn, 30e-3 * np.sin(turn)], -1)
    down = np.linspace((60e-3, 0, -2e-3), (60e-3, 0, -59e-3), 40)
    back = np.linspace((58e-3, 0, -60e-3), (-20e-3, 0, -60e-3), 60)
    points = np.concatenate([arch, down, back])
    tree = tree_of(Vessel("root", Centreline(points, np.full(len(points), RADIUS))))
    field = Field.of(tree, [End("root", np.zeros(3), -UP, RADIUS, True)])
    wall = np.array(
        [(0, 0, -60e-3 + RADIUS - 0.5e-3), (0, 0, -60e-3 + RADIUS + 0.5e-3)]
    )
    assert field((0, 0, -20e-3), free=True) == FREE
    # A cap with a hole, as a sheath leaves it, ends at the inlet, too.
    for each in (field, field.with_hole(2e-3)):
        np.testing.assert_allclose(
            each(wall, free=True), [0.5e-3, -0.5e-3], atol=0.02e-3
        )
        # In the shadow of the cap, not of its hole.
        aside = wall + (RADIUS - 1e-3, 0, 0)
        np.testing.assert_allclose(
            each(aside, free=True), [0.5e-3, -0.5e-3], atol=0.02e-3
        )
        np.testing.assert_allclose(
            each.gradient(np.concatenate([wall, aside])), [-UP] * 4, atol=0.01
        )


def test_a_tilted_sheath_stands_free_behind_the_inlet():
    """It stands beside the straight continuation of the hole, 5 mm from the aorta."""
    anatomy = arch.build_seed(arch.arch_set("test")[39])
    way = placement.sheath_direction(anatomy)
    assert way @ anatomy.inlet.direction < np.cos(np.radians(10))
    behind = np.arange(6e-3, 0.1, 0.5e-3)[:, None]
    places = anatomy.inlet.position - behind * way
    assert (anatomy.lumen.with_hole(3e-3)(places, free=True) == FREE).all()


def test_the_gradient_points_away_from_the_wall(tube):
    _, _, field = tube
    angle = np.linspace(0, 2 * np.pi, 50)
    spokes = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=-1)
    gradient = field.gradient(3.2e-3 * spokes + (0, 0, 21e-3))
    np.testing.assert_allclose(gradient, -spokes, atol=0.03)
    # An impact is pushed back whatever its depth.
    deep = field.gradient(12e-3 * spokes[::10] + (0, 0, 21e-3))
    assert (np.vecdot(deep, -spokes[::10]) > 0.7).all()


def box(side):
    import trimesh

    mesh = trimesh.creation.box(extents=side)
    return Surface(mesh.vertices, mesh.faces)


def test_a_surface_gives_the_same_field_by_libigl():
    """A box, open at z = -10 mm."""
    end = End("root", -10e-3 * UP, -UP, 5e-3, True)
    field = Field.of(box((12e-3, 12e-3, 20e-3)), [end])
    points = [(5.2e-3, 0, 0), (0, -6.4e-3, 3e-3), (0, 0, 9.5e-3), (4e-3, 0, -9.9e-3)]
    np.testing.assert_allclose(
        field(points), [0.8e-3, -0.4e-3, 0.5e-3, 2e-3], atol=0.02e-3
    )
    assert field((0, 0, -11e-3), free=True) == FREE


def test_a_surface_knows_inside_from_outside():
    """By normals and winding numbers; trimesh's ray test is the reference."""
    import trimesh

    mesh = trimesh.creation.annulus(3e-3, 6e-3, 10e-3)
    random = np.random.default_rng(0)
    points = random.uniform(-8e-3, 8e-3, (2000, 3))
    depth = SurfaceDepth(Surface(mesh.vertices, mesh.faces))(points)
    across = np.linalg.norm(points[:, :2], axis=1)
    inside = (across > 3e-3) & (across < 6e-3) & (np.abs(points[:, 2]) < 5e-3)
    clear = np.abs(depth) > 0.2e-3  # the annulus has 32 sides
    assert ((depth > 0) == inside)[clear].all()


def test_points_that_are_not_finite_have_no_depth():
    def measure(blocks, points):
        return 0.01 - np.linalg.norm(blocks[:, None] + points, axis=-1)

    ball = Field.sampled(measure, np.full(3, -0.01), np.full(3, 0.01))
    points = [[0.0, 0.0, 0.009], [np.nan, 0.0, 0.0], [0.0, np.inf, 0.0]]
    found, slope = ball(points), ball.gradient(points)
    assert found[0] > 0.0 and np.isnan(found[1:]).all()
    assert slope[0, 2] == pytest.approx(-1.0, abs=0.1) and np.isnan(slope[1:]).all()


def test_a_surface_goes_on_as_a_tube_beyond_its_open_end():
    mesh = trimesh.creation.cylinder(4e-3, 0.04, sections=64)
    surface = Surface(mesh.vertices, mesh.faces)
    entry = End("tube", [0, 0, -0.02], [0, 0, -1], 4e-3, True)
    closed = End("tube", [0, 0, 0.02], [0, 0, 1], 4e-3, False)
    depth = SurfaceDepth(surface, [entry, closed])
    aside = np.array([0.0, 2e-3, 5e-3])
    places = np.zeros((3, 3))
    places[:, 0] = aside
    for height in (0.0, -0.023):
        places[:, 2] = height
        np.testing.assert_array_equal(depth(places) > 0.0, aside < 4e-3)
    places[:, 2] = 0.023
    assert (depth(places) < 0.0).all()
