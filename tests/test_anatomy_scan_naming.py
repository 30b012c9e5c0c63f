"""Names of an arch's branches: hypotheses, confidence and questions, without a mesh."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree

from cathsim_dmc.anatomy.scan.aorta import Bend
from cathsim_dmc.anatomy.scan.arches import Arch
from cathsim_dmc.anatomy.scan.forks import leads
from cathsim_dmc.anatomy.scan.naming import (
    _unlisted,
    hypotheses,
    name_branches,
    neutral_names,
)
from cathsim_dmc.anatomy.scan.offshoots import Offshoot, offshoots, third_limb

FIRST, SPACE = 95e-3, 20e-3  # m of aorta up to the first ostium and between ostia


class Tubes:
    """What naming asks of a lattice: the depth at points of some lines."""

    nodes = np.empty(0, dtype=int)
    links = np.empty((0, 2), dtype=int)

    def __init__(self, lines, radii):
        self.points = np.concatenate(lines)
        self.depth = np.concatenate(
            [np.full(len(x), r) for x, r in zip(lines, radii, strict=True)]
        )
        self._tree = cKDTree(self.points)

    def depths(self, curve):
        return self.depth[self._tree.query(curve)[1]]


def line(*corners, step=1e-3):
    """Points of a polyline through corners in mm, m."""
    corners = 1e-3 * np.array(corners, dtype=float)
    parts = [
        a + np.arange(0.0, 1.0, step / np.linalg.norm(b - a))[:, None] * (b - a)
        for a, b in zip(corners[:-1], corners[1:], strict=True)
    ]
    return np.concatenate(parts)


@pytest.fixture(scope="module")
def bend():
    """From the heart, on the right, over the top to the left."""
    angle = np.linspace(0.0, np.pi, 60)
    arch = np.stack([-35 * np.cos(angle), 0 * angle, 35 * np.sin(angle)], axis=1)
    return Bend.of(line((-35, 0, -60), *arch, (35, 0, -160)))


def built(*branches):
    """Lattice, offshoots and curves of (radius, (radius, corners)...) in mm."""
    lines, radii, found, curves = [], [], [], []
    for place, branch in enumerate(branches):
        x = 20 * place - 20
        own = [line((x, 0, 45), *corners) for _, corners in branch[1:]]
        # Curves share the points up to their fork.
        for k, row in enumerate(own[1:], 1):
            shared = int(
                np.isclose(row[: len(own[0])], own[0][: len(row)]).all(1).sum()
            )
            own[k] = np.concatenate([own[0][:shared], row[shared:]])
        fork = None
        if len(own) > 1:
            fork = 1e-3 * min(
                int((a[: len(b)] == b[: len(a)]).all(1).argmin())
                for k, a in enumerate(own)
                for b in own[k + 1 :]
            )
        rows = tuple(range(len(curves), len(curves) + len(own)))
        found.append(
            Offshoot(
                # On the side of the aorta to which it leads.
                np.array([1e-3 * x, 0.5 * own[0][-1, 1] if own else 0.0, 45e-3]),
                FIRST + SPACE * place,
                1e-3 * branch[0],
                rows,
                fork,
                tuple(own),
            )
        )
        curves += own
        lines += own
        radii += [1e-3 * r for r, _ in branch[1:]]
    return Tubes(lines, radii) if lines else None, found, curves


def named(bend, *branches):
    """Names of the curves of such branches, and the notes."""
    ways, found, curves = built(*branches)
    out = name_branches(ways, bend, 1.0, found, curves, False)
    return out.names, " ".join(out.notes)


BCA = (6.2, (6.0, [(-30, 0, 85)]))
LCCA = (4.0, (3.5, [(5, 0, 95)]))
LSA = (5.0, (4.5, [(40, 0, 85)]))
STUB = (3.6,)
NECK = (6.2, (3.2, [(-22, 0, 87), (-24, 0, 180)]), (3.5, [(-22, 0, 87), (-90, 0, 95)]))
BOVINE = (6.4, (5.8, [(-20, 0, 57), (-40, 0, 95)]), (3.6, [(-20, 0, 57), (0, 0, 95)]))
THIN = (1.9, (1.8, [(20, 0, 95)]))


def test_three_branches_are_a_usual_arch(bend):
    names, notes = named(bend, BCA, LCCA, LSA)
    assert names == ["bca", "lcca", "lsa"] and "question" not in notes
    assert "lcca 1.00" in notes


@pytest.mark.parametrize("missing", range(3))
def test_two_branches_without_a_fork_are_asked_for(bend, missing):
    """A branch that is cut off leaves no trace: any two may be what is left."""
    branches = [BCA, LCCA, LSA]
    del branches[missing]
    names, notes = named(bend, *branches)
    wrong = [("bca", "lcca", "lsa")[k] for k in range(3) if k != missing]
    for name, truth in zip(names, wrong, strict=True):
        assert name == truth or name.startswith("branch_")
    assert any(name.startswith("branch_") for name in names)
    assert "question: two branches leave the arch" in notes and "without its" in notes
    assert "at (" in notes  # the place of each


@pytest.mark.parametrize(("cut", "radius"), [(0, 3.6), (1, 3.6), (2, 3.6), (1, 1.6)])
def test_a_branch_that_is_cut_short_keeps_its_place(bend, cut, radius):
    """Also if its bump is much narrower than the artery."""
    branches = [BCA, LCCA, LSA]
    branches[cut] = (radius,)
    kept = [name for k, name in enumerate(("bca", "lcca", "lsa")) if k != cut]
    assert named(bend, *branches)[0] == kept


def test_a_bovine_arch_has_its_fork(bend):
    assert named(bend, BOVINE, LSA)[0] == ["bca", "lcca", "lsa"]


def test_what_parts_from_the_left_carotid_of_a_bovine_arch_is_the_bca(bend):
    """Too steep and narrow for a sure BCA, too short for a right carotid."""
    stem = [(-20, 0, 57)]
    steep = (6.4, (3.9, [*stem, (-24, 0, 95)]), (3.6, [*stem, (2, 0, 95)]))
    assert named(bend, steep, LSA)[0] == ["bca", "lcca", "lsa"]


def test_a_fork_far_up_is_no_bovine_arch(bend):
    names, notes = named(bend, NECK, LSA)
    assert "lcca" not in names
    assert "question" in notes


def test_a_trunk_is_known_where_its_branches_are_not(bend):
    up = [(-22, 0, 87)]
    twins = (6.2, (3.2, [*up, (-34, 0, 180)]), (3.2, [*up, (-12, 0, 180)]))
    names, notes = named(bend, twins, LCCA, LSA)
    assert names == ["branch_1", "branch_2", "lcca", "lsa"]
    assert "bca 0.9" in notes or "bca 1.0" in notes
    assert "leads to branch_1 and branch_2: which is which?" in notes


def test_subclavian_and_vertebral_arteries(bend):
    """A subclavian artery that goes up first and is narrowed is no vertebral."""
    up = [(-22, 0, 87)]
    arm = (2.2, [*up, (-40, 0, 95), (-110, 0, 100)])
    carotid = (3.2, [*up, (-24, 0, 180)])
    vertebral = (1.8, [*up, (-40, 0, 95), (-42, 8, 180)])
    names, _ = named(bend, (6.2, carotid, arm, vertebral), LCCA, LSA)
    assert names == ["rcca", "rsa", "rva", "lcca", "lsa"]


def test_an_arm_that_the_scan_shows_no_turn_of_is_told_from_its_vertebral(bend):
    """Its direction counts against its name, but only so much."""
    stem = [(40, 0, 70)]
    both = (5.0, (3.6, [*stem, (45, 0, 180)]), (1.9, [*stem, (55, 0, 180)]))
    ways, (one,), _ = built(both)
    found = leads(ways, bend, one, ("lsa", 1.0), 1.0, False)
    assert [found[k][0] for k in (0, 1)] == ["lsa", "lva"]


def test_branches_of_no_pattern_have_a_usual_distance():
    """18 mm in a usual aorta; its logarithm deviates by 0.8."""

    def weight(gap, scale=1.0):
        rows = np.zeros((1, 3)), gap * np.arange(3), scale * 4.2e-3
        seen = [Offshoot(rows[0], s, rows[2], (0,), None, ()) for s in rows[1]]
        return _unlisted(seen, 0.003, scale)

    far, near = (18e-3 * np.exp(0.8 * sign) for sign in (1, -1))
    for gap in (far, near):
        assert weight(18e-3) - weight(gap) == pytest.approx(2 * 0.5)
    assert weight(1.3 * far, 1.3) == pytest.approx(weight(far))
    assert np.isfinite(weight(0.0))


def test_a_name_is_no_surer_than_its_branch(bend):
    ways, found, _ = built(NECK, LCCA, LSA)
    sure = leads(ways, bend, found[0], ("bca", 1.0), 1.0, False)
    assert [sure[k][0] for k in (0, 1)] == ["rcca", "rsa"]
    assert min(surety for _, surety in sure.values()) > 0.95
    assert leads(ways, bend, found[0], ("bca", 0.94), 1.0, False) == {}


def test_a_vertebral_artery_far_along_the_subclavian_is_no_twin_of_it(bend):
    way = [(45, 0, 55), (95, 0, 60)]
    long = (5.0, (4.0, [*way, (170, 0, 62)]), (1.9, [*way, (96, 0, 140)]))
    assert named(bend, BCA, LCCA, long)[0] == ["bca", "lcca", "lsa", "lva"]


def test_a_vertebral_artery_that_leaves_with_the_carotid_parts_at_once(bend):
    def led(z):
        way, up = [(0, 0, z)], (3.8, [(0, 0, z), (-4, 0, 150)])
        return named(bend, BCA, (4.2, up, (1.9, [*way, (14, 0, 110)])), LSA)[0]

    assert led(50) == ["bca", "lcca", "lva", "lsa"]
    assert led(80) == ["bca", "lcca", "branch_1", "lsa"]


def test_branches_that_leave_in_one_lumen_are_one(bend):
    """They part where they leave, as in a bovine arch with a common ostium."""
    root = bend.line[: bend.apex]
    rows = [line(1e3 * root[-1], (0, 0, 50), (side, 0, 95)) for side in (-20, 20)]
    curves = [np.concatenate([root[:-1], row]) for row in rows]
    ways = Tubes(curves, [6e-3, 4e-3])
    found = offshoots(ways, bend, np.full(len(bend.line), 13e-3), curves)
    assert [one.curves for one in found] == [(0, 1)]


def test_the_fork_of_a_branch_is_its_first(bend):
    """It is a branch of the arch though one of its arms leads down."""
    root = bend.line[: bend.apex]
    ends = [(0, 0, 80), (10, 0, 120)], [(0, 0, 80), (-10, 0, 120)], [(0, 70, 20)]
    rows = [line(1e3 * root[-1], (0, 0, 60), *corners) for corners in ends]
    curves = [np.concatenate([root[:-1], row]) for row in rows]
    ways = Tubes(curves, [6e-3, 4e-3, 4e-3])
    (one,) = offshoots(ways, bend, np.full(len(bend.line), 13e-3), curves)
    assert one.curves == (0, 1, 2) and 5e-3 < one.fork < 15e-3
    # Where the scan shows one vessel of a bovine trunk, it is named after the wide one.
    (alone,) = built((6.4, (5.8, [(-40, 0, 95)])))[1]
    assert leads(ways, bend, alone, ("bovine", 0.99), 1.0, False) == {0: ("bca", 0.99)}


@pytest.mark.parametrize(("past", "limb"), [(0, True), (80, False)])
def test_a_wide_branch_is_a_third_limb_where_it_leaves_the_bend(bend, past, limb):
    root = bend.line[: bend.apex + past]
    curve = np.concatenate([root, line(1e3 * root[-1], 1e3 * root[-1] + (0, 70, 0))])
    width = np.full(len(bend.line), 13e-3)
    found = third_limb(Tubes([curve], [12.5e-3]), bend, width, [curve])
    assert (found is not None) is limb


def test_a_vertebral_artery_of_its_own_and_an_aberrant_subclavian(bend):
    assert named(bend, BCA, LCCA, THIN, LSA)[0] == ["bca", "lcca", "lva", "lsa"]
    aside = (1.9, (1.8, [(20, 30, 95)]))  # as no other artery between LCCA and LSA
    assert named(bend, BCA, LCCA, aside, LSA)[0] == ["bca", "lcca", "lva", "lsa"]
    carotid = (3.9, (3.6, [(-30, 0, 95)]))
    last = (4.8, (4.4, [(20, 20, 85)]))
    found = named(bend, carotid, LCCA, LSA, last)[0]
    assert found == ["rcca", "lcca", "lsa", "rsa"]


UP = [(-20, 0, 60)]
BICAROTID = (5.2, (3.7, [*UP, (-34, 0, 150)]), (3.7, [*UP, (-2, 0, 150)]))
ARM = [(12, 0, 80), (70, 0, 95)]
RIGHT_ARM = [(20, 24, 70), (-60, 30, 90)]
LEFT_VERTEBRAL = (1.9, [ARM[0], (30, 0, 84), (30, 8, 170)])
RIGHT_VERTEBRAL = (1.9, [RIGHT_ARM[0], (-10, 26, 78), (-10, 26, 165)])


@pytest.mark.parametrize("vertebrals", [False, True])
def test_a_trunk_of_both_carotids_is_no_brachiocephalic(bend, vertebrals):
    """It leads to no arm; the right subclavian artery leaves last."""
    last = (4.9, (4.6, ARM)), (4.8, (4.4, RIGHT_ARM))
    if vertebrals:
        last = ((*last[0], LEFT_VERTEBRAL), (*last[1], RIGHT_VERTEBRAL))
    wanted = ["rcca", "lcca", "lsa", *["lva"] * vertebrals]
    wanted += ["rsa", *["rva"] * vertebrals]
    names, notes = named(bend, BICAROTID, *last)
    assert names == wanted and "question" not in notes


@pytest.mark.parametrize("fork", [55, 68, 90])
@pytest.mark.parametrize("stub", [(), (STUB,)])
def test_a_carotid_artery_with_a_bypass_to_the_arm_is_asked_for(bend, fork, stub):
    """What is as wide as a carotid artery, beside an arm, is no vertebral artery."""
    up = [(0, 0, fork)]
    both = (
        4.0,
        (3.6, [*up, (10, 0, 150)]),
        (4.2, [*up, (20, 0, fork + 6), (75, 0, 99)]),
    )
    names, notes = named(bend, BCA, both, *stub)
    assert not {"lcca", "lsa", "lva"} & set(names)
    assert "question" in notes
    assert fork == 55 or "bypass, that leaves the arch" in notes


def test_a_wide_vertebral_artery_is_named_beside_a_left_carotid_of_its_own(bend):
    """A bypass from the LCCA is thought of only where no LCCA leaves the arch."""
    way = [(45, 0, 55), (95, 0, 60)]
    wide = (5.0, (3.1, [*way, (170, 0, 62)]), (2.9, [*way, (96, 0, 140)]))
    assert named(bend, BCA, LCCA, wide)[0] == ["bca", "lcca", "lsa", "lva"]


def test_an_arm_that_parts_at_once_from_a_carotid_artery_is_no_vertebral(bend):
    arm = (4.2, [(0, 0, 50), (20, 0, 58), (75, 0, 70)])
    names, notes = named(bend, BCA, (5.0, (3.6, [(0, 0, 50), (5, 0, 150)]), arm), STUB)
    assert not {"lcca", "lsa", "lva"} & set(names) and "question" in notes


def test_branches_that_fit_no_pattern_are_asked_for(bend):
    """Three arteries as wide as each other that leave to either side."""
    sides = [(-20, -60, 60), (0, 60, 60), (20, -60, 60)]
    names, notes = named(bend, *((4.2, (4.0, [end])) for end in sides))
    assert all(name.startswith("branch_") for name in names)
    assert "none of these (" in notes


def bent(bend, heart, *branches):
    """An aorta with branches of `built`, of whose heart so much is known."""
    ways, found, curves = built(*branches)
    width = np.full(len(bend.line), 13e-3)
    return Arch(ways, (), None, curves, bend, width, found, heart)


def test_a_kinked_aorta_with_visceral_branches_is_no_arch(bend):
    """They leave to either side, or all towards the feet; an arch's do not."""
    sides = [(2.8, (2.7, [(-20, 60, 50)])), (3.9, (3.6, [(0, -60, 40)]))]
    assert "no arch" in bent(bend, 0.7, *sides)._unlike()
    usual = (BCA, LCCA, LSA)
    assert bent(bend, 0.7, *usual)._unlike() == ""
    flip = np.diag([1.0, -1.0, -1.0])
    down = Bend(bend.line @ flip, bend.apex, bend.turn, bend.up @ flip, bend.along)
    arch = bent(bend, 0.7, *usual)
    turned = Arch(arch.ways, (), None, [], down, arch.width, arch.branches, 0.7)
    assert "towards the feet" in turned._unlike() and "--heart" in turned._unlike()


def test_an_arch_as_narrow_as_a_childs_is_asked_for(bend):
    """A subclavian artery bends, too, and its branches may be as wide by it."""
    arch = bent(bend, 1.0, BCA, LCCA, LSA)
    for width, given, asks in ((13, False, False), (5, False, True), (5, True, False)):
        one = replace(arch, width=0 * arch.width + 1e-3 * width, given=given)
        asked = "".join(one._young())
        assert ("is it an aortic arch? It is 10.0 mm wide" in asked) is asks


def test_a_thin_last_branch_is_the_subclavian_more_than_a_vertebral_artery(bend):
    thin = (2.0, (2.0, [(40, 0, 95)]))
    assert named(bend, BCA, LCCA, thin)[0] == ["bca", "lcca", "lsa"]


@pytest.mark.parametrize("first", [5.4, 6.0])
def test_a_wide_fourth_branch_is_hardly_one_without_a_name(bend, first):
    """Both are asked for if the first is as wide as a BCA and the last leads up."""
    radii = (first, 4.0, 5.0, 3.8)
    ways = [(20 * k - 20, (25 if first < 6.0 else 0) * (k == 3), 110) for k in range(4)]
    names = named(bend, *((r, (r, [w])) for r, w in zip(radii, ways, strict=True)))[0]
    if first == 6.0:
        assert not {"bca", "rcca", "rsa"} & set(names)
    else:
        assert names == ["rcca", "lcca", "lsa", "rsa"]


def aberrant(y):
    """An arch whose fourth branch leads y mm to the back."""
    ends = [(20 * k - 20, y * (k == 3), 90) for k in range(4)]
    return [(r, (r, [x])) for r, x in zip((4.2, 3.8, 3.4, 4.2), ends, strict=True)]


def test_an_aberrant_subclavian_artery_leads_to_the_right_and_back(bend):
    """A fourth branch in the plane of the arch, or to the left, is asked for."""
    assert named(bend, *aberrant(40))[0] == ["rcca", "lcca", "lsa", "rsa"]
    names, notes = named(bend, *aberrant(-10))
    assert names == [f"branch_{k}" for k in (1, 2, 3, 4)] and "question" in notes


@pytest.mark.parametrize(
    "branches",
    [(BCA, LCCA, LSA), (BOVINE, LSA), (NECK, LCCA, LSA), aberrant(40), aberrant(-10)],
    ids=["usual", "bovine", "neck", "aberrant", "to the front"],
)
def test_an_arch_has_the_same_names_from_its_other_end(bend, branches):
    ways, found, curves = built(*branches)
    turned, end = Bend.of(bend.line[::-1]), 1e-3 * (len(bend.line) - 1)
    back = [replace(one, s=end - one.s) for one in found[::-1]]
    there = hypotheses(bend, found, 1.0, {False: 0.0})
    again = hypotheses(turned, back, 1.0, {True: 0.0})
    for key, odds in there.items():
        assert again[key._replace(heart_last=True)] == pytest.approx(odds, abs=0.02)
    there = name_branches(ways, bend, 1.0, found, curves, False)
    again = name_branches(ways, turned, 1.0, back, curves, True)
    # Neutral names are numbered from the start of the line.
    neutral = there.names[0].startswith("branch")
    assert again.names == there.names[:: -1 if neutral else 1]
    assert again.right == there.right


def test_neutral_names_are_in_the_order_of_the_forks():
    ends = (
        ((0, 0, 90), (20, 0, 90)),
        ((0, 0, 90), (-20, 0, 90)),
        ((0, 0, 50), (9, 0, 90)),
    )
    curves = [line((0, 0, 0), *corners) for corners in ends]
    assert neutral_names(curves) == ["branch_2", "branch_3", "branch_1"]


def test_branches_that_are_alike_do_not_tell_the_heart(bend):
    _, found, _ = built(*((4.4, (4.2, [(20 * k - 20, 0, 95)])) for k in range(3)))
    share = hypotheses(bend, found, 1.0, {False: 0.0, True: 0.0})
    assert 0.05 < sum(p for key, p in share.items() if key.heart_last) < 0.95


@pytest.mark.parametrize(
    ("wide", "bottom", "top", "radius", "branch", "seen"),
    [
        (10, 13, 18, 3.0, -25, True),
        (10, 13, 18, 3.0, (25, 33), True),
        (10, 13, 18, 3.0, (25, 20), False),  # at the end of the aorta
        (60, 13, 18, 3.0, -33, False),  # along the aorta, as an aneurysm
        (10, 13, 13.4, 3.0, -25, False),  # too low
        (10, 13, 18, 1.1, -25, False),  # too thin
        (10, -13, -18, 3.0, -25, False),  # under the arch
        (10, 13, 18, 3.0, None, False),  # far from all branches
    ],
)
def test_a_bump_of_the_arch_is_a_branch_that_was_cut_short(
    bend, wide, bottom, top, radius, branch, seen
):
    """Its points lie so far from the axis of an aorta of 10 mm radius (mm).

    With a pair for its branch, the aorta begins so far before the bump.
    """
    if isinstance(branch, tuple):
        branch, begin = branch
        rest = bend.line[bend.apex - begin :]
        bend = Bend(rest, begin, bend.turn, bend.up, bend.along)
    x, y = np.arange(-wide / 2, wide / 2 + 1, 1.0), np.arange(-2, 3, 1.0)
    away = np.arange(min(bottom, top), max(bottom, top) + 0.01, 0.3)
    z = 1e3 * bend.line[:, 2].max() + away
    grid = np.stack(np.meshgrid(x, y, z, indexing="ij"), -1).reshape(-1, 3)
    if branch is None:
        curve = line((-35, 0, -50), (-80, 0, -40))
    else:
        curve = line((branch, 0, 25), (branch, 0, 90))
    ways = Tubes([curve, 1e-3 * grid], [4e-3, 1e-3 * radius])
    ways.nodes = np.arange(len(curve), len(ways.points))
    ways.links = cKDTree(ways.points).query_pairs(1.05e-3, output_type="ndarray")
    found = offshoots(ways, bend, np.full(len(bend.line), 10e-3), [curve])
    stubs = [one for one in found if not one.curves]
    assert len(stubs) == seen and len(found) == (branch is not None) + seen
    for one in stubs:
        assert one.radius == pytest.approx(1e-3 * radius, abs=0.3e-3)
        assert abs(one.s - 1e-3 * bend.apex) < 5e-3 and one.fork is None


@pytest.mark.parametrize(
    ("end", "fork", "aside"),
    [
        ((70, 0, 0), None, True),
        ((50, 0, 0), None, None),  # too short for an arm
        ((0, 0, 100), None, False),
        ((0, 0, 100), 60e-3, None),  # too short past its fork
    ],
)
def test_a_branch_leads_aside_where_it_is_long_enough_to_tell(end, fork, aside):
    rows = (line((0, 0, 0), end),)
    one = Offshoot(np.zeros(3), 0.1, 4e-3, (0,), fork, rows)
    assert one.aside(np.array([0.0, 0.0, 1.0])) is aside
