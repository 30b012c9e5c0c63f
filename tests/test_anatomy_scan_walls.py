"""Walls with a thickness, open ends of any rim, and where messages say that it is."""

import numpy as np
import pytest
import trimesh
from synthetic_scans import write_obj

from cathsim_dmc.anatomy.parts import Surface
from cathsim_dmc.anatomy.scan import repair, topology
from cathsim_dmc.anatomy.scan.lumen import read_lumen
from cathsim_dmc.anatomy.scan.repair import mend
from cathsim_dmc.anatomy.scan.topology import edge_counts

RADIUS, LENGTH = 6.0, 120.0  # mm, of a tube along z from 0 on
STEP = 2.5
CLOSED = (0.0, 0.0), (RADIUS, 0.0), (RADIUS, LENGTH), (0.0, LENGTH)


def revolved(*corners, closed=False):
    """Surface of a profile of corners (radius, z) that turns about z; mm."""
    corners = [*corners, corners[0]] if closed else list(corners)
    profile = [corners[0]]
    for one, other in zip(corners[:-1], corners[1:], strict=True):
        count = max(1, round(np.hypot(*np.subtract(other, one)) / STEP))
        profile += [
            tuple(np.add(one, np.subtract(other, one) * (k + 1) / count))
            for k in range(count)
        ]
    mesh = trimesh.creation.revolve(np.array(profile), sections=20)
    return np.asarray(mesh.vertices), np.asarray(mesh.faces)


def mended(vertices, faces):
    surface, notes, _ = mend("tube", 1e-3 * np.asarray(vertices), np.asarray(faces))
    assert set(edge_counts(surface.faces)[1]) == {2} and surface.volume > 0.0
    return surface.volume * 1e9, " | ".join(notes)


@pytest.mark.parametrize("left", [0.0, 0.5, 1.5, -1.0], ids="{:g} mm".format)
def test_an_end_that_kept_a_rim_of_its_cap_is_an_end(left):
    """The triangles at the rim lie in its plane, as those around a hole do."""
    corners = [(RADIUS, 0.0), (RADIUS, LENGTH), (0.0, LENGTH)]
    if left:
        corners.insert(0, (RADIUS - left, 0.0))
    volume, notes = mended(*revolved(*corners))
    assert "1 open vessel ends capped" in notes
    assert volume == pytest.approx(np.pi * RADIUS**2 * LENGTH, rel=0.03)


@pytest.mark.parametrize("wide", [9.5, 12.0, 16.0], ids="{:g} mm".format)
def test_a_hole_in_the_side_is_no_end(wide):
    vertices, faces = revolved(*CLOSED)
    middles = vertices[faces].mean(axis=1)
    gone = np.linalg.norm(middles - (RADIUS, 0.0, 70.0), axis=1) < 0.5 * wide
    with pytest.raises(ValueError, match="mm wide in the side of a vessel"):
        mended(vertices, faces[~gone])


@pytest.mark.parametrize(
    ("free", "end"), [([0, 1, 2, 3, 4], True), ([0, 1, 15, 16, 17], False)]
)
def test_a_branch_may_leave_right_behind_an_end(monkeypatch, free, end):
    """Behind a hole in the side the vessel goes on both ways, of 32 directions."""
    far = np.isin(np.arange(repair.DIRECTIONS), free)
    monkeypatch.setattr(repair._Work, "_far_behind", lambda *_: far)
    vertices, faces = revolved((RADIUS, 0.0), (RADIUS, LENGTH), (0.0, LENGTH))
    if end:
        assert "1 open vessel ends capped" in mended(vertices, faces)[1]
    else:
        with pytest.raises(ValueError, match="in the side of a vessel"):
            mended(vertices, faces)


@pytest.mark.parametrize("radii", [(6.0, 8.0), (8.0, 6.0)], ids="{0[0]:g}".format)
def test_of_the_two_surfaces_of_a_wall_the_inner_one_is_taken(radii):
    """Whichever comes first, and the outer one inside out in one of the orders."""
    both = [trimesh.creation.capsule(height=80.0, radius=r) for r in radii]
    if radii[0] > radii[1]:
        both[0].invert()
    whole = trimesh.util.concatenate(both)
    volume, notes = mended(whole.vertices, whole.faces)
    assert volume == pytest.approx(both[radii.index(6.0)].volume, rel=0.01)
    assert "the inner of two surfaces taken" in notes


def test_triangles_turn_as_most_of_their_part_are_given():
    """Of two boxes a quarter is turned, of the first in, of the second out."""
    box = trimesh.creation.box().faces
    inwards = np.arange(24) % 12 < np.repeat([3, 9], 12)
    given = np.concatenate([box, box + 8])
    given[inwards] = given[inwards, ::-1]
    found, turned = topology.oriented(given)
    corners = trimesh.creation.box().vertices
    volumes = [Surface(corners, one).volume for one in (found[:12], found[12:] - 8)]
    np.testing.assert_allclose(volumes, [1.0, -1.0])
    assert turned == 6


def test_a_surface_with_many_shared_edges_is_refused():
    """As of two bodies that are glued together; a few are cut out."""
    tube = trimesh.creation.capsule(height=80.0, radius=6.0, count=[32, 32])
    some = tube.faces[::40]
    tops = tube.vertices[some].mean(axis=1) + 0.4
    fins = np.column_stack([some[:, :2], len(tube.vertices) + np.arange(len(some))])
    vertices = np.concatenate([tube.vertices, tops])
    mended(vertices, np.concatenate([tube.faces, fins[:1]]))
    with pytest.raises(ValueError, match=f"{len(fins)} edges shared .* too many to"):
        mended(vertices, np.concatenate([tube.faces, fins]))


def wall(*, ends=2, patch=False):
    """A bent tube of 5 mm inner radius with a wall, open at one end or both (mm)."""
    thick, length = 0.8, 40.0 * np.pi
    outer, inner = 5.0 + thick, length - (thick if ends == 1 else 0.0)
    corners = [(5.0, 0.0), (outer, 0.0), (outer, length)]
    if ends == 1:
        corners += [(0.0, length), (0.0, inner), (5.0, inner)]
        vertices, faces = revolved(*corners[1:4])
        more, others = revolved(*corners[4:], *corners[:2])
        faces = np.concatenate([faces, others + len(vertices)])
        vertices = np.concatenate([vertices, more])
    else:
        vertices, faces = revolved(*corners, (5.0, length), closed=True)
    if patch:
        # A spike that stands up from a triangle of the inner side.
        middles = vertices[faces].mean(axis=1)
        face = int(np.linalg.norm(middles - (-5.0, 0.0, 60.0), axis=1).argmin())
        a, b, c = faces[face]
        top = middles[face] * (0.8, 0.8, 1.0)
        count = len(vertices)
        vertices = np.concatenate([vertices, top[None]])
        more = [(a, b, count), (b, c, count), (c, a, count)]
        faces = np.concatenate([np.delete(faces, face, axis=0), more])
    x, y, angle = (vertices / (1.0, 1.0, 40.0)).T
    return np.stack([(40 + x) * np.cos(angle), y, (40 + x) * np.sin(angle)], 1), faces


@pytest.mark.parametrize(
    "options", [{}, {"ends": 1}, {"patch": True}], ids=["open", "one open", "patch"]
)
def test_the_lumen_of_a_wall_is_its_inner_side(options):
    """Open at one end only and turned inside out, or with a small patch inside."""
    vertices, faces = wall(**options)
    inverted = options == {"ends": 1}
    volume, notes = mended(vertices, faces[:, ::-1] if inverted else faces)
    assert "thick wall: its inner surface taken" in notes
    assert "holes" not in notes and ("inside out" in notes) == inverted
    assert volume == pytest.approx(np.pi * 5.0**2 * 40 * np.pi, rel=0.04)


def test_a_wall_whose_inner_side_is_not_found_whole_is_told(monkeypatch):
    """A closed surface has no holes to fill; flanges may hide where its lumen ends."""
    vertices, faces = revolved(*CLOSED)
    middles = vertices[faces].mean(axis=1)
    inner = np.linalg.norm(middles - (RADIUS, 0.0, 70.0), axis=1) > 6.0
    monkeypatch.setattr(topology, "lumen_of_wall", lambda *surface: inner)
    with pytest.raises(ValueError, match="taken for that of a thick wall.*lumen alone"):
        mended(vertices, faces)


@pytest.mark.parametrize("factor", [1.0, 0.1])
def test_the_lumen_of_a_wall_is_measured_without_the_wall(tmp_path, factor):
    """Its thickness, and what is between two walls, are no width of a lumen."""
    vertices, faces = wall()
    path = write_obj(tmp_path / "wall.obj", factor * vertices, faces)
    lumen = read_lumen(path, "mm" if factor == 1.0 else "cm")
    assert lumen.scale == pytest.approx(12.0 / 5.0, rel=0.1)


def test_places_of_mending_are_those_of_the_file(tmp_path):
    """A hole is told in the unit and frame in which the file has it."""
    vertices, faces = revolved(*CLOSED)
    middles = vertices[faces].mean(axis=1)
    gone = np.linalg.norm(middles - (RADIUS, 0.0, 70.0), axis=1) < 6.0
    path = write_obj(tmp_path / "hole.obj", 0.1 * vertices, faces[~gone])
    with pytest.raises(
        ValueError, match=r"vessel at \(-?0\.[456], -?0\.0, [67]\.\d\) cm"
    ):
        read_lumen(path, frame="RAS")
    few = np.linalg.norm(middles - (RADIUS, 0.0, 70.0), axis=1) < 2.0
    path = write_obj(tmp_path / "few.obj", 0.1 * vertices, faces[~few])
    notes = read_lumen(path, frame="RAS", axes="ILA").notes
    (filled,) = (note for note in notes if "holes filled" in note)
    assert filled.endswith(" cm")


def with_sheet(profile, height, radius, missing=0):
    """A profile that turns about z, and a sheet of triangles across it; mm."""
    vertices, faces = revolved(*profile)
    x, y, z = vertices.T
    rim = np.flatnonzero((abs(z - height) < 1e-6) & (np.hypot(x, y) > 0.9 * radius))
    rim = rim[np.argsort(np.arctan2(y[rim], x[rim]))]
    middle = np.full(len(rim), len(vertices))
    fan = np.stack([rim, np.roll(rim, -1), middle], axis=1)
    fan[::2] = fan[::2, ::-1]  # the order of corners does not matter
    vertices = np.concatenate([vertices, [(0.0, 0.0, height)]])
    return vertices, np.concatenate([faces, fan[missing:]])


@pytest.mark.parametrize("height", [60.0, 117.5])
def test_a_cap_that_a_join_left_across_the_lumen_is_taken_out(height):
    """Also near an end, where the body behind it is short."""
    whole, _ = mended(*revolved(*CLOSED))
    volume, notes = mended(*with_sheet(CLOSED, height, RADIUS))
    assert volume == pytest.approx(whole, rel=1e-6)
    assert "1 sheets across the lumen taken out" in notes


def test_a_thin_branch_that_mending_cuts_through_is_not_dropped(monkeypatch):
    """A sheet with a gap is cut out with its rim; beyond it are 2 % of the area."""
    monkeypatch.setattr(repair, "NON_MANIFOLD", 0.05)
    profile = (0, 0), (40, 0), (40, 100), (3, 100), (3, 160), (0, 160)
    with pytest.raises(ValueError, match="2 separate parts"):
        mended(*with_sheet(profile, 130.0, 3.0, missing=1))


def test_a_body_in_the_lumen_is_no_inner_surface_of_a_wall():
    """Such as a graft: the lumen around it is not taken for the outer surface."""
    vessel = trimesh.creation.capsule(height=120.0, radius=8.0)
    graft = trimesh.creation.capsule(height=30.0, radius=5.0)
    whole = trimesh.util.concatenate([vessel, graft])
    with pytest.raises(ValueError, match="2 separate parts.*Keep the largest island"):
        mended(whole.vertices, whole.faces)
