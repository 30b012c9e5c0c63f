"""Goals at places of a scan's file, and how near to a goal counts as reached."""

from dataclasses import replace

import numpy as np
import pytest
from synthetic_scans import y_tree

from cathsim_dmc import suite
from cathsim_dmc.anatomy import Anatomy, phantoms
from cathsim_dmc.anatomy.centreline import Centreline, Vessel, VesselTree
from cathsim_dmc.anatomy.parts import FileFrame, Goal, Inlet
from cathsim_dmc.anatomy.reach import least_ahead, unreachable
from cathsim_dmc.cli.task_options import TaskOptions
from cathsim_dmc.tasks import objectives, placement

# The file is in cm, its x and y to the right and front.
FRAME = FileFrame("cm", 1e-2 * np.diag([-1.0, -1.0, 1.0]))


@pytest.fixture(scope="module")
def anatomy():
    branches = y_tree().vessels
    line = Centreline(np.array([(0, 0, 0), (0, 0, 70e-3)]), np.full(2, 6e-3))
    trunk = Vessel("trunk", line.resampled(1e-3))
    tree = VesselTree({**branches, "trunk": trunk})
    return replace(Anatomy.from_tree(tree, "y"), file=FRAME)


def place(anatomy, vessel, arc):
    """A place on a centreline as the file has it."""
    position = anatomy.tree.vessel(vessel).centreline.at(arc).position
    return np.linalg.solve(FRAME.to_lps, position)


def test_a_goal_at_a_place_of_the_file(anatomy, tmp_path):
    own = place(anatomy, "left", 38e-3)
    goal = anatomy.goal_at(own)
    assert goal.vessel == "left" and goal.name.endswith(" cm")
    assert goal.arc_length == pytest.approx(38e-3, abs=1e-4)
    again = Anatomy.load(anatomy.save(tmp_path / "y"))
    assert again.file.unit == "cm"
    np.testing.assert_array_equal(again.file.to_lps, FRAME.to_lps)
    np.testing.assert_array_equal(again.goal_at(own).position, goal.position)
    # Without a file it is in metres, LPS.
    plain = replace(anatomy, file=None)
    assert plain.goal_at(goal.position).arc_length == goal.arc_length
    assert "file" not in vars(Anatomy.load(plain.save(tmp_path / "p"))) or (
        Anatomy.load(tmp_path / "p").file is None
    )


def test_a_place_that_is_no_goal_is_refused(anatomy):
    words = r"outside the lumen of 'y', which reaches from \(.*\) to \(.*\) cm"
    with pytest.raises(ValueError, match=words):
        anatomy.goal_at((9.0, 9.0, 9.0))
    for bad in ((1.0, 2.0), (1.0, np.nan, 2.0), "1,2,3"):
        with pytest.raises(ValueError, match="goal"):
            anatomy.goal_at(bad)
    with pytest.raises(ValueError, match="a Goal, or"):
        placement.resolve_goal(anatomy, 7)
    with pytest.raises(ValueError, match="before the inlet, where a device starts"):
        placement.resolve_goal(moved(anatomy), place(anatomy, "trunk", 10e-3))
    with pytest.raises(ValueError, match="5 mm past the inlet, where a device starts"):
        placement.resolve_goal(moved(anatomy), place(anatomy, "trunk", 25e-3))


def moved(anatomy):
    """The anatomy entered 20 mm farther in."""
    line = anatomy.tree.root.centreline
    inlet = replace(anatomy.inlet, position=line.at(20e-3).position)
    return replace(anatomy, inlet=inlet)


def test_a_route_begins_at_an_inlet_within_its_vessel(anatomy):
    entered = moved(anatomy)
    goal = anatomy.tree.vessel("left").centreline.at(30e-3).position
    route = entered.route(entered.goal_at(place(anatomy, "left", 30e-3)))
    np.testing.assert_allclose(route.points[0], entered.inlet.position, atol=1e-9)
    np.testing.assert_allclose(route.points[-1], goal, atol=1e-9)


def test_a_branch_begins_at_its_ostium(anatomy):
    """Its centreline before it lies in the parent, however near to the wall."""
    ostium = anatomy.tree.vessel("left").ostium
    assert anatomy.goal_at(place(anatomy, "left", ostium - 0.3e-3)).vessel == "trunk"
    assert anatomy.goal_at(place(anatomy, "left", ostium + 0.3e-3)).vessel == "left"


def test_a_task_takes_a_place_as_its_goal(anatomy):
    own = place(anatomy, "right", 30e-3).tolist()
    task = suite.make_task("navigate", anatomy=anatomy, goal=own, random=0)
    assert task.scene.goal.vessel == "right"
    np.testing.assert_allclose(task.objective.goal, FRAME.to_lps @ own)
    near = place(anatomy, "right", 12e-3).tolist()
    close = suite.make_task("navigate", anatomy=anatomy, goal=near, random=0)
    # The ostium is 3 mm behind it.
    assert close.objective.goal_radius == pytest.approx(3e-3, abs=0.2e-3)
    given = suite.make_task(
        "navigate", anatomy=anatomy, goal=near, random=0, goal_radius=5e-3
    )
    assert given.objective.goal_radius == 5e-3


def test_a_goal_beyond_a_fork_is_reached_by_the_branch_that_the_inlet_passes():
    """The branch leaves 5 mm ahead of the inlet; the twig forks off higher up."""

    def line(start, end, radius):
        share = np.linspace(0.0, 1.0, 41)[:, None]
        way = np.subtract(end, start)
        return Centreline(start + share * way, np.full(41, radius))

    aorta = line([0, 0, 0.055], [0, 0, 0.2], 8e-3)
    branch = line([0, 0, 0.05], [0.06, 0, 0.11], 4e-3)
    twig = line([0.04, 0, 0.09], [0.04, 0.05, 0.09], 2e-3)
    ostium = 0.01 * 2**0.5
    vessels = (
        Vessel("aorta", aorta),
        Vessel("branch", branch, "aorta", ostium),
        Vessel("twig", twig, "branch", 4e-3),
    )
    tree = VesselTree({one.name: one for one in vessels})
    start = Inlet("aorta", aorta.points[0], [0, 0, 1.0], 8e-3)
    goals = {
        name: Goal(name, name, tree.vessel(name).centreline.at(0.03).position, 0.03)
        for name in ("branch", "twig")
    }
    found = unreachable(Anatomy("fork", tree, start, goals))
    assert found == {"branch leaves aorta 5 mm past the inlet": ["branch", "twig"]}


@pytest.mark.parametrize("text", ["1.5,-2,30", "[1.5, -2, 30]", "(1.5,-2,30)"])
def test_the_command_line_takes_a_place(text):
    assert TaskOptions(goal=text).given == {"goal": [1.5, -2.0, 30.0]}
    assert TaskOptions(goal="lcca").given == {"goal": "lcca"}
    with pytest.raises(ValueError, match="goal .--goal. is '1,2'.*place x,y,z"):
        assert TaskOptions(goal="1,2").given
    assert TaskOptions(goal="lcca, any").given == {"goal": ["lcca", "any"]}


def test_a_goal_is_not_reached_at_the_one_before_it(anatomy):
    line = anatomy.tree.vessel("left").centreline
    goals = {
        name: Goal(name, "left", line.at(arc).position, arc)
        for name, arc in (("near", 13e-3), ("far", 15.6e-3), ("end", 45e-3))
    }
    both = replace(anatomy, goals=goals)
    rooms = {name: both.goal_room(goal) for name, goal in goals.items()}
    assert rooms == pytest.approx({"near": 4e-3, "far": 2.6e-3, "end": 29.4e-3})


@pytest.mark.parametrize("name", phantoms.PHANTOMS)
def test_goals_of_the_phantoms_are_reached_within_8_mm(name):
    anatomy = phantoms.load(name)
    for goal in anatomy.goals.values():
        objective = objectives.Cannulation.to(anatomy, goal)
        assert objective.goal_radius == objectives.GOAL_RADIUS == 8e-3
    assert least_ahead(anatomy.inlet) == 10e-3


@pytest.mark.parametrize("offset", [-2e-3, 0.0, 0.5e-3, 4e-3])
def test_a_place_near_a_named_goal_is_reached_as_it_is(offset):
    anatomy = phantoms.load("type1")
    named = anatomy.goal("lcca")
    line = anatomy.tree.vessel(named.vessel).centreline
    goal = anatomy.goal_at(line.at(named.arc_length + offset).position)
    assert objectives.Cannulation.to(anatomy, goal).goal_radius == 8e-3
