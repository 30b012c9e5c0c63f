"""Parametric arches: published figures, validation, sampling."""

import math
from dataclasses import replace

import numpy as np
import pytest

from cathsim_dmc.anatomy import measures, phantoms
from cathsim_dmc.anatomy.arch import arch
from cathsim_dmc.anatomy.arch.tree import _septa, arch_tree


def test_type_one_has_the_published_figures():
    anatomy = phantoms.load("simple1")
    plane = arch.TYPE_I.plane_rotation
    along = np.array([math.sin(plane), math.cos(plane), 0.0])
    vertices = anatomy.surface.vertices
    assert np.ptp(vertices @ along) == pytest.approx(91e-3, abs=1.5e-3)
    descending = anatomy.tree.vessel("aorta").centreline.points[-1, 2]
    assert vertices[:, 2].max() - descending == pytest.approx(186e-3, abs=1.5e-3)
    bca, lcca = (anatomy.goal(name).position for name in ("bca", "lcca"))
    assert np.linalg.norm(bca - lcca) == pytest.approx(15e-3, abs=1e-3)
    tip = anatomy.inlet.position + arch.INLET_TUBE * anatomy.inlet.direction
    away = np.linalg.norm([bca - tip, lcca - tip], axis=1)
    assert away.mean() == pytest.approx(130e-3, abs=3e-3)
    aorta = anatomy.tree.vessel("aorta").centreline
    assert aorta.radii[-1] == pytest.approx(9.1e-3)
    assert aorta.radii.max() == pytest.approx(13.8e-3)


@pytest.mark.parametrize("name", ["type3", "bovine"])
def test_steep_arches_curve_as_the_measured_phantoms_do(name):
    tree = arch_tree(arch.ARCHES[name])
    found = measures.measure(tree)
    assert found["arch_type"] == "III"
    # The phantoms turn by 105 and 48 degrees up to the BCA.
    assert 45 < found["ascending_turn_deg"] < 110
    points = tree.root.centreline.points
    # No plane holds the aorta; those of the straight presets lie in one.
    offsets = points - points.mean(0)
    assert np.linalg.svd(offsets)[1][-1] / math.sqrt(len(points)) > 0.8e-3
    for branch in found["branches"].values():
        assert branch["tortuosity"] > 1.005
    bca = tree.vessel("bca")
    level = tree.root.centreline.locate(bca.mouth.position)
    # Within one standard deviation of 62.6 ± 11.4 mm.
    assert level == pytest.approx(62.6e-3, abs=11.4e-3)


@pytest.mark.parametrize("name", arch.ARCHES)
def test_branches_start_on_their_parent_and_leave_it(name):
    tree = arch_tree(arch.ARCHES[name])
    for vessel in tree.vessels.values():
        if vessel.parent is None:
            continue
        parent = tree.vessel(vessel.parent).centreline
        line = vessel.centreline
        start = parent.project(line.points[0])
        assert start.distance < 1e-6
        ostium = parent.project(vessel.mouth.position)
        assert ostium.distance == pytest.approx(ostium.radius, abs=0.3e-3)
        # The ostium is flared and the branch free of its parent further up.
        assert vessel.mouth.radius > line.radii[-1]
        assert line.length - vessel.ostium >= 40e-3
        goal = line.at(vessel.ostium + 27e-3).position
        depths = tree.depths(goal)
        assert depths[vessel.name] > 0.0
        assert depths[vessel.parent] < 0.0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"descending_radius": 0.05}, "descending_radius is 0.05; it must be"),
        ({"bca_drop": 9.0}, "LCCA diameters"),
        ({"bca_lcca_spacing": 5e-3}, "bca_lcca_spacing"),
        ({"arch_height": 0.015}, "Enlarge arch_radius"),
        ({"ascending_length": math.nan}, "ascending_length is nan"),
        ({"bovine": True, "bca_lcca_spacing": 60e-3}, "bca_lcca_spacing"),
    ],
)
def test_bad_parameters_are_refused(change, message):
    with pytest.raises(ValueError, match=message):
        replace(arch.TYPE_II, **change)


def test_branches_that_cross_are_refused():
    leaning = replace(arch.TYPE_II.lcca, take_off=1.0)
    upright = replace(arch.TYPE_II.bca, take_off=-0.3)
    with pytest.raises(ValueError, match="come within|leaves at"):
        arch_tree(replace(arch.TYPE_II, lcca=leaning, bca=upright))


def test_the_wall_between_ostia_is_what_their_radii_leave_of_the_spacings():
    radii = {"bca": 6e-3, "lcca": 4e-3, "lsa": 5e-3}
    branches = {n: replace(getattr(arch.TYPE_II, n), radius=r, end_radius=r)
                for n, r in radii.items()}  # fmt: skip
    spacings = {"bca_lcca_spacing": 21e-3, "lcca_lsa_spacing": 12e-3}
    params = replace(arch.TYPE_II, **branches, **spacings)
    assert _septa(params) == pytest.approx([11e-3, 3e-3, 3e-3])
    # An LCCA on the BCA has no neighbour; that of the BCA is the LSA.
    trunk = replace(params, bovine=True, lcca_lsa_spacing=30e-3)
    assert _septa(trunk) == pytest.approx([math.inf, 19e-3, 19e-3])
    last = replace(branches["lsa"], radius=4.5e-3, end_radius=4.5e-3)
    rsa = replace(params, aberrant=last, lsa_aberrant_spacing=12e-3)
    assert _septa(rsa) == pytest.approx([11e-3, 3e-3, 2.5e-3, 2.5e-3])


def test_a_branch_that_is_wider_than_its_parent_is_refused():
    levels = ("bca_level", "lcca_level", "lsa_level", "descending")
    thin = {f"{level}_radius": 10e-3 for level in levels}
    wide = replace(arch.TYPE_II.bca, radius=11.9e-3)
    with pytest.raises(ValueError, match="'bca' has a radius of 0.014. m.*0.95 of its"):
        arch_tree(replace(arch.TYPE_II, bca=wide, bca_lcca_spacing=35e-3, **thin))


def test_limbs_bend_and_the_plane_tilts_and_sways():
    straight = arch_tree(arch.TYPE_II).root.centreline
    bent = replace(
        arch.TYPE_II, ascending_bend=0.4, plane_tilt=0.2, sway=5e-3, bow=2e-3
    )
    line = arch_tree(bent).root.centreline
    # The root leans by the bend, away from the descending limb and in a tilted plane.
    first = line.at(0.0).tangent
    along = np.array(
        [math.sin(bent.plane_rotation), math.cos(bent.plane_rotation), 0.0]
    )
    assert first @ along == pytest.approx(-math.sin(0.4), abs=0.03)
    assert line.length == pytest.approx(straight.length, rel=0.02)
    aside = np.cross([0, 0, 1.0], along)
    assert np.ptp(straight.points @ aside) < 1e-9
    # Tilted by 0.2 over a height of 160 mm, and 5 mm to either side.
    assert np.ptp(line.points @ aside) == pytest.approx(35e-3, abs=8e-3)


def test_second_bend_makes_an_s():
    bca = replace(arch.TYPE_II.bca, bend_radius=30e-3, bend_azimuth=0.0, length=60e-3)
    turned = []
    for azimuth in (0.0, math.pi):
        bent = replace(bca, second_bend_radius=30e-3, second_bend_azimuth=azimuth)
        line = arch_tree(replace(arch.TYPE_II, bca=bent)).vessel("bca").centreline
        first, last = (line.at(s).tangent for s in (0.0, line.length))
        turned.append(math.acos(np.clip(first @ last, -1, 1)))
    assert turned[0] > 0.8 and turned[1] < 0.4 * turned[0]


def test_branches_lean_out_of_the_plane():
    lcca = replace(arch.TYPE_II.lcca, lean=math.radians(20.0))
    tree = arch_tree(replace(arch.TYPE_II, lcca=lcca))
    found = measures.measure(tree)["branches"]["lcca"]
    assert found["lean_deg"] == pytest.approx(20.0, abs=2.8)
    assert found["out_of_plane_mm"] > 8


def test_aberrant_subclavian_leaves_last_and_passes_behind():
    params = arch.sample(np.random.RandomState(1), "II", variant="aberrant")
    tree = arch_tree(params)
    assert list(tree.vessels) == ["aorta", "rcca", "lcca", "lsa", "rsa"]
    branches = list(tree.vessels.values())[1:]
    levels = [tree.root.centreline.locate(one.mouth.position) for one in branches]
    assert levels == sorted(levels)
    rsa = tree.vessel("rsa").centreline
    way = rsa.points[-1] - rsa.at(tree.vessel("rsa").ostium).position
    assert way[0] < 0.0 or way[1] > 0.0  # to the right or back
    assert measures.measure(tree)["branches"]["rsa"]["lean_deg"] > 25.0
    goals = arch.build_arch(params).goals
    assert list(goals) == ["rcca", "lcca", "lsa", "rsa", "descending"]
