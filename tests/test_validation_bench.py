"""Guidewires on a bench: a folder of measured wires, and their simulation."""

import json
import types

import numpy as np
import pytest
import trimesh

from cathsim_dmc.cli.checks import validate
from cathsim_dmc.entities.arena import BLOOD_DENSITY, GRAVITY
from cathsim_dmc.validation import bench, bench_data
from cathsim_dmc.validation.bench_data import MESH, WIRES, Wire
from cathsim_dmc.validation.checks import Report
from cathsim_dmc.validation.rig import tube

ENTRY = [3.0, 0.0, 5.0]  # mm, off the middle of the tube


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Data in the bench's format, of a wire that was simulated."""
    path = tmp_path_factory.mktemp("bench")
    # Straight along +z, then bent towards +x.
    surface = tube(0.03, 7e-3, 0.05).surface
    trimesh.Trimesh(1e3 * surface.vertices, surface.faces).export(path / MESH)
    marks = {
        "entry": {"point_mm": [0, 0, 5], "outward_normal": [0, 0, -1], "radius_mm": 7},
        "ascending_aorta_root_mm": [50.0, 0.0, 80.0],
        "patient_axes": {
            "superior": [0, 0, -1], "left_about": [0, 1, 0],
            "posterior_about": [1, 0, 0],
        },
    }  # fmt: skip
    row = {
        "run": "made", "frame": 1, "wire": "straight", "tip_region": "arch",
        "recommended": True, "inserted_length_mm": 60.0,
        "entry_point_mm": ENTRY, "entry_direction": [0.0, 0.0, 1.0],
        "centreline_mm": [[3.0, 0.0, 65.0 - z] for z in range(0, 70, 2)],
    }  # fmt: skip
    write(path, marks, row)
    made = bench_data.read(path)
    experiment = bench.Experiment(made)
    (wire,) = made.wires
    shape = 1e3 * experiment.held(wire, experiment.field()).push()
    beyond = [[3.0, 0.0, 4.0], [3.0, 0.0, 2.0]]
    measured = row | {"centreline_mm": [*shape[::-1].tolist(), *beyond]}
    write(path, marks, measured, row | {"frame": 2, "inserted_length_mm": 50.0})
    return path, marks, row, experiment.field()


def write(path, marks, *rows):
    (path / WIRES).write_text(json.dumps({"wires": rows, "landmarks": marks}))


@pytest.mark.slow
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


def test_an_angled_wire_has_its_best_turn_unless_an_operator_turned_it():
    turns = np.arange(bench.TURNS)
    rms = {"pushed": 4.0, "steered": 2.0, "led": 3.0, "laid": 1.0}

    def result(value, count=1):
        """A turn of 90 degrees is the best one."""
        worse = 0.1 * np.abs(turns[:count] - 3 * (count > 1))
        return bench.Result(value + worse, 2 * (value + worse))

    experiment = types.SimpleNamespace(
        compare=lambda wire, way, angles: result(rms[way], len(angles)),
        centreline=lambda wire: result(9.0), nearest=lambda wire: result(8.0),
        hull=lambda wire: result(7.0),
    )  # fmt: skip
    points = np.linspace([0, 0, 0], [0, 0, 0.1], 11)
    wire = Wire("w", "angled", "arch", True, points, np.array([0, 0, 1.0]))
    row = bench._row(experiment, wire, "test")
    assert row["led"]["turn"] == pytest.approx(np.pi / 2)
    assert row["inserted_mm"] == pytest.approx(100.0)
    found = {check.name: check for check in bench._checks([row])}
    values = {
        way: found[f"angled wires, {way}: median RMS"].value
        for way in ("pushed", "steered", bench.EITHER, "laid")
    }
    median = float(np.median(rms["steered"] + 0.1 * np.abs(turns - 3)))
    assert values == {"pushed": 4.0, "steered": median, bench.EITHER: 3.0, "laid": 1.0}
    name = "angled wires, pushed: median RMS"
    assert not found[name].passed and found[f"{name}, test half"].value == 4.0
    beaten = found[f"{name}, against the best baseline"]
    assert beaten.passed and beaten.bound == "<= 7"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("{", "wires.json cannot be read as JSON in UTF-8: Expecting"),
        ("[]", "wires.json is not as `bench_data.read` describes"),
        (
            '{"wires": [], "landmarks": {"entry": {"point_mm": [1, 2]}}}',
            r"wires.json: point_mm is \[1, 2\]; it must be 3 numbers",
        ),
    ],
)
def test_a_damaged_file_of_wires_is_named(tmp_path, text, words):
    trimesh.creation.icosphere(1, 10.0).export(tmp_path / MESH)
    (tmp_path / WIRES).write_text(text)
    with pytest.raises(ValueError, match=words):
        bench_data.read(tmp_path)


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
    rig = experiment.held(wire, lumen, down="left").rig
    weight = rig.model.body_mass.sum() * rig.model.opt.gravity / rig.lengths.sum()
    device = bench.DEVICES["straight"]
    displaced = BLOOD_DENSITY * np.pi * device.outer_radius**2
    expected = GRAVITY * (device.linear_density - displaced)
    # The device lies along +z of its frame, across gravity.
    np.testing.assert_allclose(np.linalg.norm(weight), expected, rtol=0.01)
    assert abs(weight[2]) < 1e-9


def test_sides_of_the_patient_are_six_directions(folder):
    """The head is at -z, the left at +y and the back at +x in this phantom."""
    down = bench_data.read(folder[0]).down
    z, y, x = ("inferior", "superior"), ("left", "right"), ("posterior", "front")
    for axis, names in enumerate((x, y, z)):
        for name, sign in zip(names, (1.0, -1.0), strict=True):
            np.testing.assert_array_equal(down[name], sign * np.eye(3)[axis])
    assert not down["none"].any() and len(down) == 7


def test_an_operator_pulls_back_and_turns_where_the_tip_is_astray(folder):
    path, _, _, lumen = folder
    experiment = bench.Experiment(bench_data.read(path))
    wire, seen = experiment.bench.wires[0], []

    def astray(tip):
        seen.append(tip[2])
        return len(seen) == 5

    held = experiment.held(wire, lumen, overshoot=5e-3)
    shape = held.steer(astray)
    back = np.diff(seen).min()
    assert back < -0.015 and len(seen) > 13  # an advance of 65 mm once takes 13 looks
    turned = held.rig.data.joint(f"{held.rig.name}/rotation").qpos[0]
    assert turned == pytest.approx(np.radians(137.5), abs=0.02)
    # A straight wire is none the worse for it, at the length that was measured.
    np.testing.assert_allclose(shape[-1], wire.points[-1], atol=1e-3)


def test_a_tip_is_in_a_branch_past_its_ostium_alone():
    pieces = 1e-3 * np.array(
        [[[0, 0, 0], [0, 0, 40]], [[0, 0, 40], [30, 0, 70]]], dtype=float
    )
    branch = bench_data.Branch(pieces, 3e-3)
    for point, inside in [
        ((0, 0, 3), False), ((0, 0, 10), True), ((11, 0, 20), True),
        ((13, 0, 20), False), ((20, 0, 60), True), ((40, 0, 90), False),
        ((0, 0, -10), False),
    ]:  # fmt: skip
        assert branch.has(1e-3 * np.array(point)) is inside, point
