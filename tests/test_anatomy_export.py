"""Convex wall pieces of an exported anatomy: intrusion, gaps, passage, MJCF."""

import dataclasses
import json
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


def test_pieces_surround_the_lumen(tube, pieces):
    found = export.fidelity(tube, pieces)
    assert found["places"] > 200
    assert found["open_places"] == 0 and not found["closed_to_5fr"]
    mean, p95, largest = found["intrusion_mm"].values()
    assert mean <= 0.05 and p95 <= 0.2 and largest <= 0.4
    assert found["recession_mm"]["p95"] <= 0.3
    assert min(ConvexHull(piece * 1e3).volume for piece in pieces) > 1e-3


def test_a_missing_piece_and_a_plug_are_found(tube, pieces):
    gap = [piece for piece in pieces if abs(piece[:, 2].mean() - 0.02) > 5e-3]
    assert export.fidelity(tube, gap)["open_places"] > 5
    plug = 2e-3 * np.stack(np.meshgrid(*[(-1, 1)] * 3), -1).reshape(-1, 3)
    found = export.fidelity(tube, [*pieces, plug + (0, 0, 0.02)])
    assert found["closed_to_5fr"] == ["tube"]


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
    assert not found["closed_to_5fr"]
    assert found["intrusion_mm"]["mean"] <= 0.02 and found["intrusion_mm"]["max"] <= 0.4


def test_a_thin_wall_between_two_lumens_stays_out_of_both():
    def line(*points):
        steps = np.linspace(0.0, 1.0, 30)[:, None]
        parts = [(1 - steps) * a + steps * b for a, b in pairwise(points)]
        joined = np.concatenate([parts[0], *(part[1:] for part in parts[1:])])
        return Centreline(joined * 1e-3, np.full(len(joined), 2e-3))

    trunk = line(np.array([0, 0, -20.0]), np.array([0, 0, 20.0]))
    arm = line(np.zeros(3), np.array([5.0, 0, 3]), np.array([5.0, 0, 20]))
    tree = VesselTree(
        {"a": Vessel("a", trunk), "b": Vessel("b", arm, "a", ostium=3e-3)}
    )
    anatomy = Anatomy.from_tree(tree, "two", goals={})
    found = export.fidelity(anatomy, export.wall_pieces(anatomy))
    assert not found["closed_to_5fr"] and found["intrusion_mm"]["p95"] < 0.4
