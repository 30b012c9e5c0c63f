"""Parts of the exported wall: cap of the inlet, hulls, merging, two lumens."""

from itertools import pairwise

import numpy as np
import pytest
from scipy.spatial import cKDTree

from cathsim_dmc.anatomy import Anatomy, export
from cathsim_dmc.anatomy.centreline import Centreline, Vessel, VesselTree
from cathsim_dmc.anatomy.merging import hull_points, merged
from cathsim_dmc.anatomy.parts import INLET_HOLE_RADIUS, Inlet

AXIS = np.array([2.0, -1.0, 2.0]) / 3.0
PLACE = np.array([0.01, -0.02, 0.03])


def around(axis, radius, angle, along=0.0):
    """Points (n, 3) around an axis through `PLACE`."""
    across = np.linalg.svd(axis[None])[2][1:]
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=-1) @ across
    return PLACE + np.asarray(radius)[..., None] * ring + along * axis


def test_the_cap_closes_the_inlet_but_for_its_hole():
    reach, count = 6e-3, 62
    turns = (
        2 * np.pi * (np.arange(count) + 0.3) / count
    )  # no edge ends where a sector does
    rim = around(AXIS, np.full(count, reach), turns)
    cap = export._inlet_cap(np.stack([rim, np.roll(rim, -1, 0)], 1), inlet(reach))
    angle = np.random.default_rng(0).uniform(0.0, 2 * np.pi, 2000)

    def covered(radius, along):
        return export._within(around(AXIS, np.full(2000, radius), angle, along), cap)

    behind = -0.1e-3
    assert not covered(INLET_HOLE_RADIUS - 1e-6, behind).any()
    for radius in (1.08 * INLET_HOLE_RADIUS, 3e-3, reach, reach + 1.8e-3):
        assert covered(radius, behind).all(), radius
        assert covered(radius, 0.1e-3 - export.THICKNESS).all()
        assert not covered(radius, 0.1e-3).any()
    # A rim within the hole leaves nothing to close; one partly within it does.
    small = around(AXIS, np.full(count, 0.9 * INLET_HOLE_RADIUS), turns)
    small = np.stack([small, np.roll(small, -1, 0)], 1)
    assert not export._inlet_cap(small, inlet(INLET_HOLE_RADIUS))
    oval = np.where(np.arange(count) % 2, 0.9 * INLET_HOLE_RADIUS, reach)
    oval = around(AXIS, oval, turns)
    oval = np.stack([oval, np.roll(oval, -1, 0)], 1)
    assert len(export._inlet_cap(oval, inlet(reach))) == export.CAP_SECTORS


def inlet(radius):
    return Inlet("root", PLACE, AXIS, radius)


def test_the_depth_at_an_open_end_is_that_ahead_of_it():
    angle = np.linspace(0.0, 2 * np.pi, 9)
    for along, moved in ((0.0, True), (-5e-3, True), (-7e-3, False), (2e-3, False)):
        points = around(AXIS, np.full(9, 4e-3), angle, along)
        found = export._before(points, PLACE, AXIS, 3e-3)
        height = export._AHEAD if moved else along
        np.testing.assert_allclose((found - PLACE) @ AXIS, height, atol=1e-12)
        np.testing.assert_allclose(
            found - points, np.outer(np.full(9, height - along), AXIS), atol=1e-12
        )
    aside = around(AXIS, np.full(9, 4.6e-3), angle, -1e-3)
    assert np.array_equal(export._before(aside, PLACE, AXIS, 3e-3), aside)


def box(*sides):
    corners = np.stack(np.meshgrid(*[(-0.5, 0.5)] * 3), -1).reshape(-1, 3)
    return corners * sides


@pytest.mark.parametrize(
    ("sides", "gap"), [((12, 12, 1), 1.45), ((2, 2, 1), 0.45)], ids=["long", "short"]
)
def test_the_points_of_a_hull_leave_no_wide_gap(sides, gap):
    points, corners = hull_points(1e-3 * box(*sides))
    assert len(corners) == 8
    random = np.random.default_rng(0)
    places = random.uniform(-0.5, 0.5, (3000, 3))
    axis = random.integers(3, size=3000)
    places[np.arange(3000), axis] = np.sign(places[np.arange(3000), axis]) / 2
    far, _ = cKDTree(points).query(1e-3 * places * sides)
    assert far.max() < 1e-3 * gap


def test_the_hull_of_flat_points_is_found_too():
    flat = 1e-3 * box(4.0, 3.0, 0.0)[::2]
    points, corners = hull_points(np.unique(flat, axis=0))
    assert np.isfinite(points).all() and len(corners) == 4


def piece(first, last):
    """A piece of wall around a lumen of 5 mm radius between two of 60 steps."""
    ends = [(r * np.cos(t), r * np.sin(t)) for t in (first, last) for r in (5, 7)]
    return 1e-3 * np.concatenate(
        [np.column_stack([ends, np.full(4, z)]) for z in (0.0, 2.0)]
    )


def depth(points):
    return 5e-3 - np.linalg.norm(points[:, :2], axis=1)


def test_pieces_merge_while_their_hull_stays_out_of_the_lumen():
    """Around a round lumen of 5 mm radius: a chord of n steps is so deep."""
    count, tolerance = 60, 0.25e-3
    turn = 2 * np.pi * np.arange(count + 1) / count

    pieces = [piece(a, b) for a, b in pairwise(turn)]
    pairs = [(k, (k + 1) % count) for k in range(count)]

    found = merged(pieces, pairs, depth, tolerance)
    deepest = [depth(hull_points(one)[0]).max() for one in found]
    assert max(deepest) <= tolerance
    # Six steps of 6 degrees are 0.24 mm deep, seven 0.33 mm.
    most = [round(np.ptp(np.unwrap(angles(one))) / turn[1]) for one in found]
    assert sum(most) == count and max(most) <= 6
    assert 10 <= len(found) <= 20


def test_pieces_with_the_shallowest_hull_merge_first():
    turn = 2 * np.pi * np.array([0, 3, 6, 7]) / 60
    pieces = [piece(a, b) for a, b in pairwise(turn)]
    alone, both = merged(pieces, [(0, 1), (1, 2)], depth, 0.25e-3)
    assert np.array_equal(alone, pieces[0])  # six steps in one would be deeper
    assert np.ptp(angles(both)) == pytest.approx(turn[3] - turn[1])


def angles(piece):
    order = np.arctan2(piece[:, 1], piece[:, 0])
    return np.sort((order - order[0] + np.pi) % (2 * np.pi))


def two_lumens(radius, *points):
    """A trunk of 2 mm radius and a narrow arm; points in mm."""

    def line(radius, *points):
        steps = np.linspace(0.0, 1.0, 20)[:, None]
        ways = pairwise(np.array(points, dtype=float))
        parts = [(1 - steps) * a + steps * b for a, b in ways]
        joined = np.concatenate([parts[0], *(part[1:] for part in parts[1:])])
        return Centreline(joined * 1e-3, np.full(len(joined), radius))

    trunk = line(2e-3, (0, 0, -10), (0, 0, 16))
    arm = line(radius, (0, 0, 0), *points)
    tree = VesselTree(
        {"a": Vessel("a", trunk), "b": Vessel("b", arm, "a", ostium=3e-3)}
    )
    return Anatomy.from_tree(tree, "two", goals={})


def test_the_wall_between_two_lumens_ends_before_the_other_one():
    shell = export._shell(two_lumens(1.1e-3, (4.1, 0, 3), (4.1, 0, 16)))
    used = np.unique(shell.faces)
    inner, outer = shell.inner[used], shell.outer[used]
    thick = np.linalg.norm(outer - inner, axis=1)
    assert thick.min() > 0.99 * export.THINNEST
    assert thick.max() > 3e-3  # away from the other lumen
    share = np.linspace(0.0, 1.0, 30)[:, None, None]
    deepest = shell.depth(inner + share * (outer - inner)).max(axis=0)
    # But for the fold where the lumens part.
    assert (deepest > 0.0).sum() < 5
    corners = shell.inner[shell.faces]
    middles = (corners + np.roll(corners, 1, axis=1)) / 2
    assert np.percentile(shell.depth(middles.reshape(-1, 3)), 99) < 0.09e-3


def test_a_vessel_that_ends_behind_the_inlet_keeps_its_length():
    """What is behind the plane of the inlet, but not at it, is no part of its cap."""
    shell = export._shell(two_lumens(1.5e-3, (7, 0, 5), (14, 0, 0), (14, 0, -16)))
    used = np.unique(shell.faces)
    assert shell.inner[used, 2].min() == pytest.approx(-16e-3, abs=1e-3)
    assert np.abs(shell.depth(shell.inner[used])).max() < 1.1 * export.MOVE
