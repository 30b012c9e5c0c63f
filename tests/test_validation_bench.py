"""Guidewires on a bench: a folder of measured wires, and their simulation."""

import json

import numpy as np
import pytest
import trimesh

from cathsim_dmc.cli.measurements import validate
from cathsim_dmc.entities.arena import BLOOD_DENSITY, GRAVITY
from cathsim_dmc.validation import bench, bench_data
from cathsim_dmc.validation.bench_data import MESH, WIRES, Wire
from cathsim_dmc.validation.checks import Report

ENTRY = np.array([3.0, 0.0, 0.0])  # mm, off the middle of the tube


def tube():
    """A tube of 7 mm, straight along +y for 25 mm, then bent; mm."""
    angle = np.linspace(0.0, 0.9, 18)
    arc = 50.0 * np.stack([1 - np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    line = np.vstack([[[0, -5.0, 0], [0, 5, 0], [0, 15, 0]], arc + (0, 25, 0)])
    tangent = np.gradient(line, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1)[:, None]
    up = np.array([0.0, 0.0, 1.0])
    round_ = np.linspace(0, 2 * np.pi, 20, endpoint=False)[:, None, None]
    side = np.cross(tangent, up)
    rings = line + 7.0 * (np.cos(round_) * side + np.sin(round_) * up)
    points = rings.transpose(1, 0, 2).reshape(-1, 3)
    hull = []
    for k in range(len(line) - 1):
        for i in range(20):
            a, b = 20 * k + i, 20 * k + (i + 1) % 20
            hull += [(a, b, a + 20), (b, b + 20, a + 20)]
    last = len(points)
    for i in range(20):
        j = (i + 1) % 20
        hull += [(i, last, j), (last - 20 + i, last - 20 + j, last + 1)]
    mesh = trimesh.Trimesh(np.vstack([points, line[[0, -1]]]), hull)
    mesh.fix_normals()
    return mesh, line[-1]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Data in the bench's format, of a wire that was simulated."""
    path = tmp_path_factory.mktemp("bench")
    mesh, far = tube()
    mesh.export(path / MESH)
    marks = {
        "entry": {"point_mm": [0, 0, 0], "outward_normal": [0, -1, 0], "radius_mm": 7},
        "ascending_aorta_root_mm": far.tolist(),
        "patient_axes": {
            "superior": [0, -1, 0], "left_about": [0, 0, 1],
            "posterior_about": [1, 0, 0],
        },
    }  # fmt: skip
    row = {
        "run": "made", "frame": 1, "wire": "straight", "tip_region": "arch",
        "recommended": True, "inserted_length_mm": 60.0,
        "entry_point_mm": ENTRY.tolist(), "entry_direction": [0.0, 1.0, 0.0],
        "centreline_mm": [[3.0, 60.0 - y, 0.0] for y in range(0, 70, 2)],
    }  # fmt: skip
    write(path, marks, row)
    made = bench_data.read(path)
    experiment = bench.Experiment(made)
    (wire,) = made.wires
    shape = 1e3 * experiment.held(wire, experiment.field()).push()
    beyond = [[3.0, -1.0, 0.0], [3.0, -3.0, 0.0]]
    measured = row | {"centreline_mm": [*shape[::-1].tolist(), *beyond]}
    write(path, marks, measured, row | {"frame": 2, "inserted_length_mm": 50.0})
    return path, marks, row, experiment.field()


def write(path, marks, *rows):
    (path / WIRES).write_text(json.dumps({"wires": rows, "landmarks": marks}))


def test_a_simulated_wire_is_found_again_from_another(folder, monkeypatch):
    path, _, _, lumen = folder
    # The same for every reading of the folder; it takes seconds to make.
    monkeypatch.setattr(bench_data.Bench, "field", lambda self, scale: lumen)
    lines = []
    report = bench.validate_bench(path, lines.append)
    row, other = report.findings["frames"]
    assert row["pushed"]["rms"] < 0.05
    assert row["laid"]["rms"] < 0.3
    assert row["led"]["rms"] < 0.3 < 1.0 < row["nearest"]["rms"]
    assert row["centreline"]["rms"] > 2.0
    assert row["hull"]["rms"] > 2.0
    assert not row["folded"]
    assert (row["half"], other["half"]) == ("fit", "test")
    assert lines[0].startswith("made, 1 (straight, arch): pushed 0.0")


def test_the_command_gives_the_report(monkeypatch, capsys):
    monkeypatch.setattr(bench, "validate_bench", lambda data, say: Report(data, []))
    assert validate("bench", data="there", json=True) == 0
    assert json.loads(capsys.readouterr().out)["title"] == "there"
    for part, data in (("bench", None), ("rod", "there")):
        with pytest.raises(ValueError, match="--data DIR, a folder with phantom.stl"):
            validate(part, data=data)


def test_wires_that_fold_back_are_told():
    angle = np.linspace(0.0, 1.2 * np.pi, 60)
    bow = 0.01 * np.stack([1 - np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    straight = np.array([[0.0, y, 0.0] for y in np.linspace(-0.1, -1e-3, 50)])

    def wire(points):
        return Wire("w", "straight", "arch", True, points, np.array([0.0, 1.0, 0.0]))

    assert wire(np.vstack([straight, bow])).folded
    assert not wire(np.vstack([straight, bow[:30]])).folded


def test_a_wire_has_its_weight_in_blood(folder):
    path, _, _, lumen = folder
    experiment = bench.Experiment(bench_data.read(path))
    wire = experiment.bench.wires[0]
    rig = experiment.held(wire, lumen, down="left")._rig
    weight = rig.model.body_mass.sum() * rig.model.opt.gravity / rig.lengths.sum()
    device = bench.DEVICES["straight"]
    displaced = BLOOD_DENSITY * np.pi * device.outer_radius**2
    expected = GRAVITY * (device.linear_density - displaced)
    # The device lies along +z of its frame, across gravity.
    np.testing.assert_allclose(np.linalg.norm(weight), expected, rtol=0.01)
    assert abs(weight[2]) < 1e-9
