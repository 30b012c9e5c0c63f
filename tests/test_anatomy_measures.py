"""Figures of an arch, against trees whose figures are known, and the check command."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cathsim_dmc.anatomy import measures, phantoms
from cathsim_dmc.anatomy.arch import arch
from cathsim_dmc.anatomy.arch.tree import arch_tree
from cathsim_dmc.anatomy.centreline import Centreline, Vessel, VesselTree
from cathsim_dmc.anatomy.scan.check import check_tree
from cathsim_dmc.validation import wall


def half_ring(radius=40e-3, lumen=10e-3, tilt=0.0):
    """An aorta that is half a ring over straight limbs of 50 mm, in the x-z plane."""
    angle = np.linspace(0.0, math.pi, 400)
    ring = np.stack(
        [radius * (1 - np.cos(angle)), 0 * angle, radius * np.sin(angle)], axis=1
    )
    up = np.linspace(-50e-3, 0.0, 40)[:-1]
    rise = np.stack([0 * up, 0 * up, up], axis=1)
    fall = np.stack([0 * up + 2 * radius, 0 * up, up[::-1]], axis=1)
    points = np.concatenate([rise, ring, fall])
    points = Rotation.from_euler("y", tilt).apply(points)
    return Centreline(points, np.full(len(points), lumen))


def with_branches(aorta, drop_angle, lumen=3e-3):
    """BCA and LCCA that stand upright on the ring; the BCA `drop_angle` before it."""
    vessels = {"aorta": Vessel("aorta", aorta)}
    for name, angle in (("bca", drop_angle), ("lcca", math.pi / 2)):
        start = np.array([40e-3 * (1 - math.cos(angle)), 0.0, 40e-3 * math.sin(angle)])
        line = Centreline(
            start + np.linspace(0, 60e-3, 61)[:, None] * [0, 0, 1.0], [lumen] * 61
        )
        depth = aorta.project(line.points)
        ostium = float(np.interp(0.0, depth.distance - depth.radius, line.arc_length))
        vessels[name] = Vessel(name, line, "aorta", ostium)
    return VesselTree(vessels)


@pytest.mark.parametrize(
    ("angle", "expected"), [(1.5, "I"), (0.77, "II"), (0.5, "III")]
)
def test_type_is_the_drop_of_the_ostium_in_diameters(angle, expected):
    found = measures.measure(with_branches(half_ring(), angle))
    # The branch stands over x = R (1 - cos); the tube's upper side is at radius 50.
    x = 40e-3 * (1 - math.cos(angle)) - 40e-3
    ostium = math.sqrt(50e-3**2 - x**2)
    drop = (50e-3 - ostium) / 6e-3
    assert found["drop"] == pytest.approx(drop, abs=0.05)
    assert found["arch_type"] == expected


def test_bends_and_angles_of_a_half_ring():
    found = measures.measure(with_branches(half_ring(), 1.0))
    assert found["tightest_bend_mm"] == pytest.approx(40, rel=0.01)
    assert found["span_mm"] == pytest.approx(80, rel=0.01)
    assert found["height_mm"] == pytest.approx(90, rel=0.01)
    assert found["ascending_tilt_deg"] == pytest.approx(0.0, abs=0.5)
    # The centreline's nearest place to the ostium, which stands upright over 1.0 rad.
    x = 40e-3 * (1 - math.cos(1.0)) - 40e-3
    level = math.acos(-x / 50e-3)
    turn = math.radians(found["ascending_turn_deg"])
    assert turn == pytest.approx(level, abs=0.02)
    assert found["diameters"]["ascending"] == 20.0
    up = 50 + 40 * level  # mm, along the axis to the BCA
    assert found["bend_radius_mm"] == pytest.approx(up / turn, rel=0.01)
    bca = found["branches"]["bca"]
    assert bca["take_off_deg"] == bca["lean_deg"] == 0.0
    offset = 40 * (1 - math.cos(1.0))
    assert bca["axis_offset_mm"] == pytest.approx(offset, abs=0.1)
    assert bca["diameter_mm"] == 6.0 and bca["tortuosity"] == 1.0
    # Along the arch is +x, the patient's left: 90 degrees from the sagittal plane.
    assert found["plane_deg"] == pytest.approx(90, abs=0.5)


def test_an_aorta_that_only_rises_is_as_high_as_its_end():
    """It narrows from 24 to 16 mm; branches leave it level, at 60 and 80 mm."""

    def straight(start, way, first, last):
        share = np.linspace(0.0, 1.0, 201)[:, None]
        radii = first + share[:, 0] * (last - first)
        return Centreline(np.array(start) + share * way, radii)

    aorta = straight([0, 0, 0], [0, 0, 0.2], 12e-3, 8e-3)
    vessels = {"aorta": Vessel("aorta", aorta)}
    for name, height, way in (
        ("bca", 0.06, [0.06, 0, 0]),
        ("lcca", 0.08, [0, 0.06, 0]),
    ):
        line = straight([0, 0, height], way, 3e-3, 3e-3)
        vessels[name] = Vessel(name, line, "aorta", 12e-3 - 0.02 * height)
    found = measures.measure(VesselTree(vessels))
    assert found["drop"] == pytest.approx((200 - 60) / 6)
    # At the branches; half-way up to the first, and from the last to the end.
    wanted = {"ascending": 30, "bca": 60, "lcca": 80, "descending": 140}
    wanted = {name: 24 - 8 * height / 200 for name, height in wanted.items()}
    assert found["diameters"] == pytest.approx(wanted, abs=0.01)


def test_a_branch_that_leans_back_and_upstream_is_measured_along_its_own_lumen():
    """It is narrowest past its ostium; what lies in the aorta does not count."""
    way = np.array([-0.2, 0.3, 1.0])
    way /= np.linalg.norm(way)
    line = np.array([40e-3, 0.0, 40e-3]) + np.linspace(0, 80e-3, 81)[:, None] * way
    radii = np.full(81, 3e-3)
    radii[:5], radii[60:] = 1e-3, 2e-3
    aorta = half_ring()
    depth = aorta.project(line)
    ostium = float(np.interp(0.0, depth.distance - depth.radius, np.arange(81) * 1e-3))
    lcca = Vessel("lcca", Centreline(line, radii), "aorta", ostium)
    tree = VesselTree({"aorta": Vessel("aorta", aorta), "lcca": lcca})
    found = measures.measure(tree)["branches"]["lcca"]
    assert found["take_off_deg"] == pytest.approx(math.degrees(math.atan(0.2)), abs=0.1)
    assert found["lean_deg"] == pytest.approx(math.degrees(math.atan(0.3)), abs=0.1)
    assert found["out_of_plane_mm"] == pytest.approx(40 * way[1], abs=0.1)
    assert found["narrowest_mm"] == 4.0 and found["diameter_mm"] == 6.0
    assert found["length_mm"] == pytest.approx(80 - 1e3 * ostium, abs=0.01)


def test_tilt_of_the_root_is_seen():
    tree = VesselTree({"aorta": Vessel("aorta", half_ring(tilt=-0.3))})
    found = measures.measure(tree)
    tilt = math.radians(found["ascending_tilt_deg"])
    assert tilt == pytest.approx(0.3, abs=0.01)
    assert found["arch_type"] is None and found["branches"] == {}


def test_take_offs_are_those_of_the_parameters():
    found = measures.measure(arch_tree(arch.TYPE_II))
    for name in ("bca", "lcca", "lsa"):
        expected = math.degrees(getattr(arch.TYPE_II, name).take_off)
        take_off = found["branches"][name]["take_off_deg"]
        assert take_off == pytest.approx(expected, abs=3.4)
    plane = math.degrees(arch.TYPE_II.plane_rotation)
    assert found["plane_deg"] == pytest.approx(plane, abs=0.5)


def test_phantoms_are_of_the_type_they_are_named_after():
    names = ("type1", "type2", "simple1", "simple2", "type3", "bovine")
    drops = [measures.bca_drop(phantoms.load(name).tree) for name in names]
    assert [*map(measures.arch_type, drops)] == ["I", "II", "I", "II", "III", "III"]


def test_measured_phantoms_are_as_was_measured():
    """Beside the figures taken from the scans themselves."""
    one, two = (measures.measure(phantoms.load(n).tree) for n in ("type1", "type2"))
    assert one["drop"] == pytest.approx(0.3, abs=0.2)
    assert two["drop"] == pytest.approx(1.9, abs=0.35)
    for name, expected, atol in (
        ("ascending_turn_deg", [107, 47], 6),
        ("ascending_tilt_deg", [25, 13], 5),
        ("span_mm", [69, 69], 5),
        ("height_mm", [66, 62], 4),
    ):
        values = [found[name] for found in (one, two)]
        np.testing.assert_allclose(values, expected, atol=atol)
    branches = [one["branches"][name] for name in ("bca", "lcca", "lsa")]
    radii = [0.5 * branch["diameter_mm"] for branch in branches]
    np.testing.assert_allclose(radii, [4.2, 2.9, 4.7], atol=0.5)


@pytest.mark.slow
def test_check_measures_and_draws_into_a_directory(cathsim, tmp_path):
    phantoms.load("simple1").save(tmp_path / "one")
    code, out, err = cathsim("phantom", "check", tmp_path / "one", "--json")
    assert code == 0
    report = json.loads(out)
    assert report["passed"]
    found = report["findings"]["simple1"]["measures"]
    assert found["arch_type"] == "I"
    assert found["branches"]["lcca"]["diameter_mm"] == pytest.approx(6.1, abs=0.2)
    assert (tmp_path / "one/check.png").stat().st_size > 20_000
    assert "check.png" in err


def test_check_fails_where_a_branch_begins_outside_of_its_parent():
    anatomy, name = phantoms.load("type2"), "branches begin in other vessels"
    assert not check_tree(anatomy)[name]
    lsa = anatomy.tree.vessel("lsa")
    late = lsa.centreline.slice(lsa.ostium - 1e-3, lsa.centreline.length)
    late = replace(lsa, centreline=late, ostium=1e-3)
    tree = VesselTree({**anatomy.tree.vessels, "lsa": late})
    wrong = check_tree(replace(anatomy, tree=tree))[name]
    assert "lsa" in wrong and "outside of aorta: begin it deeper" in wrong


def test_check_fails_where_a_goal_is_in_another_vessel():
    anatomy = phantoms.load("type2")
    astray = replace(anatomy.goal("lcca"), position=anatomy.goal("lsa").position)
    wrong = replace(anatomy, goals={"lcca": astray})
    failed = [one for one in wall.lumen_checks(wrong) if not one.passed]
    assert len(failed) == 1
    assert "lcca" in failed[0].note
