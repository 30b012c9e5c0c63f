"""Convex wall pieces of an exported anatomy: intrusion, gaps, passage, MJCF."""

import dataclasses
import io
import json
import sys
from itertools import pairwise

import mujoco
import numpy as np
import pytest
from scipy.spatial import ConvexHull

from cathsim_dmc.anatomy import Anatomy, export, phantoms
from cathsim_dmc.anatomy.centreline import Centreline, Vessel, VesselTree
from cathsim_dmc.validation.rig import tube as straight_tube


@pytest.fixture(scope="module")
def tube():
    return straight_tube(0.04, 4e-3)


@pytest.fixture(scope="module")
def pieces(tube):
    return export.wall_pieces(tube)


@pytest.mark.slow
def test_pieces_surround_the_lumen(tube, pieces):
    found = export.fidelity(tube, pieces)
    assert found["places"] > 200
    assert found["open_places"] == 0 and not found["closed_to_5fr"]
    mean, p95, largest = found["intrusion_mm"].values()
    assert mean <= 0.05 and p95 <= 0.2 and largest <= 0.4
    assert found["recession_mm"]["p95"] <= 0.3
    assert min(ConvexHull(piece * 1e3).volume for piece in pieces) > 1e-3


@pytest.mark.parametrize(("near", "blocked"), [(0.8, []), (0.74, ["tube"])])
def test_pieces_far_behind_the_wall_leave_it_open(tube, monkeypatch, near, blocked):
    """Four plates around a tube of 4 mm, and an edge beside its axis (mm)."""
    monkeypatch.setattr(export, "_PLACES", 500)
    cube = np.stack(np.meshgrid(*[(-1, 1)] * 3), -1).reshape(-1, 3)
    plate, turn = cube * [1, 6, 30] + [5, 0, 20], np.array([[0, 1, 0], [-1, 0, 0]])
    turn = np.vstack([turn, [[0, 0, 1]]])
    plates = [plate @ np.linalg.matrix_power(turn, k) for k in range(4)]
    edge = cube + [1 + near, 0, 20]
    found = export.fidelity(tube, [1e-3 * piece for piece in (*plates, edge)])
    # On the diagonals the plates are 1.66 mm behind the wall.
    assert 0 < found["open_places"] < 0.2 * found["places"]
    assert 1.2 < found["recession_mm"]["max"] <= 1.5
    assert found["closed_to_5fr"] == blocked


@pytest.mark.slow
def test_the_command_writes_a_model_that_other_engines_read(tube, tmp_path, cathsim):
    tube.save(tmp_path / "tube")
    path = tmp_path / "tube.xml"
    code, told, _ = cathsim("phantom", "export", tmp_path / "tube", "--out", path)
    assert not code
    told = json.loads(told)
    model = mujoco.MjModel.from_xml_path(str(path))
    assert model.ngeom == told["pieces"] and told["open_places"] == 0
    np.testing.assert_allclose(model.site("end").pos, tube.goals["end"].position)
    # A sphere at rest in the middle touches nothing, one at the wall does.
    spec = mujoco.MjSpec.from_file(str(path))
    for name, x in (("free", 0.0), ("held", 3.6e-3)):
        body = spec.worldbody.add_body(name=name, pos=[x, 0, 0.02])
        body.add_freejoint()
        body.add_geom(name=name, size=[0.8e-3, 0, 0], mass=1e-3)
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    touched = {model.geom(i).name for pair in data.contact.geom for i in pair}
    assert "held" in touched and "free" not in touched


@pytest.mark.slow
def test_merging_opens_no_gap_and_stays_out_of_the_lumen(tube, pieces):
    prisms = export.wall_pieces(tube, "prisms")
    assert len(pieces) < len(prisms) / 3
    found, before = (export.fidelity(tube, one) for one in (pieces, prisms))
    assert found["open_places"] == before["open_places"] == 0
    assert found["intrusion_mm"]["max"] <= 1e3 * export.TOLERANCE + 0.05
    # Every prism lies in a piece.
    grown = [piece + 1e-9 * (piece - piece.mean(axis=0)) for piece in pieces]
    middles = np.stack([prism.mean(axis=0) for prism in prisms])
    assert export._within(middles, grown).all()


@pytest.mark.slow
def test_the_inlet_is_free_of_pieces_and_looked_at(tube, pieces):
    inlet = tube.inlet
    turn = np.linspace(0, 2 * np.pi, 60, endpoint=False)
    first = np.cross(inlet.direction, [1.0, 0, 0])
    second = np.cross(inlet.direction, first)
    ring = np.cos(turn)[:, None] * first + np.sin(turn)[:, None] * second
    for ahead in (0.1e-3, 0.5e-3, 1e-3):
        places = inlet.position + ahead * inlet.direction
        free = places + (inlet.radius - 0.35e-3) * ring
        assert not export._within(free, pieces).any()
    # A ring that narrows the inlet is found.
    points, _ = export._wall_places(tube)
    height = (points - inlet.position) @ inlet.direction
    assert (height < 0.5e-3).sum() > 5
    block = 0.5e-3 * np.stack(np.meshgrid(*[(-1, 1)] * 3), -1).reshape(-1, 3)
    near = inlet.position + 0.5e-3 * inlet.direction + (inlet.radius - 0.5e-3) * ring
    narrowed = export.fidelity(tube, [*pieces, *(block + place for place in near)])
    assert narrowed["intrusion_mm"]["max"] > 0.8


@pytest.mark.slow
def test_coacd_divides_the_wall_too(tmp_path):
    pytest.importorskip("coacd")
    anatomy = straight_tube(0.02, 4e-3)
    found = export.write_mjcf(anatomy, tmp_path / "tube.xml", "coacd")
    assert found["open_places"] == 0 and not found["closed_to_5fr"]
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "tube.xml"))
    assert model.ngeom == found["pieces"]


def test_without_coacd_the_extra_is_named(tube, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "coacd", None)
    with pytest.raises(ModuleNotFoundError, match=r"\.\[export\]"):
        export.write_mjcf(tube, tmp_path / "tube.xml", "coacd")
    with pytest.raises(ValueError, match="one of merged, prisms, coacd"):
        export.write_mjcf(tube, tmp_path / "tube.xml", "boxes")
    assert not list(tmp_path.iterdir())


def test_the_ending_is_checked_before_any_work(tube, tmp_path):
    with pytest.raises(ValueError, match=r"must end in .xml, got 'tube.obj'"):
        export.write_mjcf(dataclasses.replace(tube, name="x"), tmp_path / "tube.obj")


@pytest.mark.slow
@pytest.mark.parametrize("name", phantoms.MEASURED)
def test_the_walls_of_the_phantoms(name):
    anatomy = phantoms.load(name)
    pieces = export.wall_pieces(anatomy)
    found = export.fidelity(anatomy, pieces)
    # At an edge between two branches the wall is thinner than what is looked through.
    assert found["open_places"] < 5e-4 * found["places"]
    assert not found["closed_to_5fr"] and len(pieces) < 800
    assert found["intrusion_mm"]["mean"] <= 0.05 and found["intrusion_mm"]["max"] <= 0.3


def parallel(apart, radius, first, low, high):
    """A vessel of 2 mm radius along z and a branch beside it, from z = first on, mm."""

    def line(wide, *points):
        steps = np.linspace(0.0, 1.0, 30)[:, None]
        parts = [(1 - steps) * a + steps * b for a, b in pairwise(np.array(points))]
        joined = np.concatenate([parts[0], *(part[1:] for part in parts[1:])])
        return Centreline(joined * 1e-3, np.full(len(joined), wide * 1e-3))

    trunk = line(2.0, (0.0, 0, low), (0.0, 0, high))
    bend = apart, 0, first + 3.0
    arm = line(radius, (0.0, 0, first), bend, (apart, 0, high))
    vessels = {"a": Vessel("a", trunk)}
    vessels["b"] = Vessel("b", arm, "a", ostium=1.5e-3 * radius)
    return Anatomy.from_tree(VesselTree(vessels), "two", goals={})


@pytest.mark.slow
def test_a_thin_wall_between_two_lumens_stays_out_of_both():
    anatomy = parallel(5.0, 2.0, 0.0, -20.0, 20.0)
    found = export.fidelity(anatomy, export.wall_pieces(anatomy))
    assert not found["closed_to_5fr"] and found["intrusion_mm"]["p95"] < 0.4


def test_a_wall_ends_before_a_lumen_beside_it():
    """Also where it could go on behind, as behind one of 1.2 mm in its 4 mm."""
    for gap, deepest in ((1.0, -0.15), (0.8, 0.5 * 1e3 * export.THINNEST)):
        anatomy = parallel(2.6 + gap, 0.6, -8.0, -12.0, 16.0)
        shell = export._shell(anatomy)
        own = np.unique(shell.faces)
        own = own[np.abs(shell.inner[own, 2] - 6e-3) < 6e-3]
        assert len(own) > 100
        inner, outer = shell.inner[own], shell.outer[own]
        assert anatomy.lumen(inner).max() <= 1e-3 * deepest
        if gap == 1.0:
            way = np.linspace(inner, outer, 15).reshape(-1, 3)
            assert anatomy.lumen(way).max() <= 1e-3 * deepest


def test_a_model_holds_names_and_places_as_they_are(tube, tmp_path, monkeypatch):
    """In UTF-8 whatever the locale is, as readers of XML take it."""
    monkeypatch.setattr(io, "text_encoding", lambda given, *_: given or "ascii")
    name = "Müller & <Söhne>"
    folder = tmp_path / "mö del"
    folder.mkdir()
    found = export.write_mjcf(
        dataclasses.replace(tube, name=name), folder / "a b.xml", "prisms"
    )
    model = mujoco.MjModel.from_xml_path(str(folder / "a b.xml"))
    assert model.names.split(b"\0")[0].decode() == name
    places = {"inlet": tube.inlet, **tube.goals}
    assert model.nsite == len(places) and model.nmesh == found["pieces"]
    for key, place in places.items():
        assert np.array_equal(model.site(key).pos, place.position)
    assert [file.name for file in folder.iterdir()] == ["a b.xml"]
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    for index, piece in enumerate(export.wall_pieces(tube, "prisms")):
        start, count = model.mesh_vertadr[index], model.mesh_vertnum[index]
        turn = data.geom_xmat[index].reshape(3, 3)
        places = model.mesh_vert[start : start + count] @ turn.T + data.geom_xpos[index]
        np.testing.assert_allclose(np.sort(places, 0), np.sort(piece, 0), atol=1e-6)


def test_deviations_are_summed_up_in_millimetres():
    lengths = np.random.RandomState(0).permutation(np.arange(101)) * 1e-3
    assert export._summary(lengths) == {"mean": 50.0, "p95": 95.0, "max": 100.0}


def test_capped_ends_are_wall_and_the_inlet_is_none(tube):
    points, inward = export._wall_places(tube)
    assert sorted(end.open for end in tube.ends) == [False, True]
    for end in tube.ends:
        away = points - end.position
        flat = np.abs(away @ end.direction) < 0.1e-3
        flat &= np.linalg.norm(away, axis=1) < 0.7 * end.radius
        assert (flat.sum() > 50) == (not end.open)
        assert (inward[flat] @ end.direction < -0.9).all()
