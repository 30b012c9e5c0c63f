"""The aorta of an arch: its end at the heart, its sides, and whether it is upright."""

import numpy as np
import pytest

from cathsim_dmc.anatomy.arch.arch import ArchSeed
from cathsim_dmc.anatomy.arch.tree import arch_tree
from cathsim_dmc.anatomy.scan.aorta import Bend, heart_odds, mirrored
from cathsim_dmc.anatomy.scan.arches import Arch


def arches():
    for seed, kind in enumerate(("I", "II", "III"), start=9_300_000):
        yield arch_tree(ArchSeed(seed, kind).parameters())


def evidence(tree, matrix=None):
    """Log odds that the heart is at the last point, seen from either end."""
    line_ = tree.root.centreline
    points = line_.points if matrix is None else line_.points @ matrix.T
    out = []
    for turn in (1, -1):
        bend = Bend.of(points[::turn])
        s = np.linspace(0.0, line_.length, len(bend.line))[::turn]
        places = [
            1e-3 * abs(s - tree.origin(k)).argmin()
            for k in tree.vessels
            if k != "aorta"
        ]
        out.append(heart_odds(bend, line_.at(s).radius, places))
    return out


def test_the_heart_is_found_from_either_end_and_in_a_turned_scan():
    turn = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    for tree in arches():
        for matrix in (None, turn):
            from_heart, to_heart = evidence(tree, matrix)
            assert from_heart < -1.0 and to_heart > 1.0


def test_an_arch_that_is_cut_short_stands_upright_by_its_branches():
    """What is left of the descending limb leads to the back more than down."""
    for tree in arches():
        branches = [v.centreline for v in tree.vessels.values() if v.parent]
        far = max(tree.origin(k) for k, v in tree.vessels.items() if v.parent)
        cut = tree.root.centreline.slice(0.0, far + 25e-3).points
        bend = Bend.of(cut, [b.slice(20e-3, b.length).points for b in branches])
        assert bend.upright and mirrored(bend.azimuth(heart_last=False)) is None


@pytest.mark.parametrize("axis", [0, 1])
def test_a_mirrored_arch_leads_to_the_wrong_side(axis):
    flip = np.ones(3)
    flip[axis] = -1.0
    for tree in arches():
        points = tree.root.centreline.points
        assert mirrored(Bend.of(points).azimuth(heart_last=False)) is None
        assert mirrored(Bend.of(points[::-1]).azimuth(heart_last=True)) is None
        wrong = mirrored(Bend.of(points * flip).azimuth(heart_last=False))
        assert wrong is not None and "mirrored" in wrong


def test_a_right_sided_arch_is_taken_where_heart_and_axes_are_given():
    flip = np.diag([-1.0, 1.0, 1.0])
    for tree in arches():
        line_ = tree.root.centreline.points[::-1] @ flip
        arch = Arch(None, (), None, [], Bend.of(line_), np.empty(0), [], 1.0)
        assert arch.on_its_side(certain=True).right
        with pytest.raises(ValueError, match="right-sided arch, give its heart and"):
            arch.on_its_side(certain=False)
        # With the heart at the other end, or front for back, it is none.
        for wrong in (line_[::-1], line_ @ np.diag([1.0, -1.0, 1.0])):
            arch = Arch(None, (), None, [], Bend.of(wrong), np.empty(0), [], 1.0)
            with pytest.raises(ValueError, match="mirrored"):
                arch.on_its_side(certain=True)
