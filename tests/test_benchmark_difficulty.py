"""How hard tasks are: ends of episodes, independence, bounds, bad input."""

import subprocess
import sys
from pathlib import Path

import difficulty
import numpy as np
import pytest
from difficulty import Limit, Trial

from cathsim_dmc import policies, suite
from cathsim_dmc.analysis.force_statistics import EpisodeForces, Statistics
from cathsim_dmc.simulation.batch import BatchSimulation


class PushSome(policies.Policy):
    """Pushes in the simulations of a mask, is idle in the others."""

    def __init__(self, mask):
        self._mask = np.array(mask)

    def reset(self, view, which):
        self._action = np.zeros((view.num_simulations, view.num_actions))
        self._action[self._mask, len(view.task.scene.catheter.tip_motors)] = 1.0

    def act(self, observation):
        return self._action


def simulations(count, **options):
    task = suite.make_task("simple1_bca", observation="tracking", **options)
    return BatchSimulation(task, count, num_threads=1)


@pytest.fixture(scope="module")
def three():
    return simulations(3)


def test_who_does_not_advance_is_stuck_and_the_others_go_on(three):
    limit = Limit(steps=14, stuck_steps=6)
    trial = difficulty.play(three, PushSome([True, False, True]), 5, limit)
    assert trial.ends == ("cut", "stuck", "cut")
    assert trial.steps == (14, 6, 14)


def test_an_episode_does_not_depend_on_what_runs_beside_it(three):
    push = policies.make_policy("push")
    limit = Limit(steps=110, stuck_steps=50)
    together = difficulty.play(three, push, 20, limit)
    assert difficulty.play(three, push, 20, limit) == together
    # The second is stopped early and begins anew; the others must not notice.
    mixed = difficulty.play(three, PushSome([True, False, True]), 20, limit)
    for index in (0, 2):
        assert mixed.steps[index] == together.steps[index]
        assert mixed.forces[index] == together.forces[index]
    assert together.forces[0] != together.forces[2]
    assert max(f.max.maximum for f in together.forces) > 0


def test_the_expert_succeeds_where_random_actions_do_not():
    report = difficulty.difficulty(
        ["simple1_bca"], 2, 3, players=["random", "expert"], num_threads=1
    )
    found = report.findings["tasks"]["simple1_bca"]
    assert found["expert"]["successes"] == 2
    assert found["random"]["ends"] == {"cut": 2}
    assert found["random"]["steps"] == difficulty.LIMITS["random"].steps
    assert report.passed and len(report.checks) == 1


def trial(successes, count):
    """Episodes of which some succeed."""
    ends = ["success"] * successes + ["stuck"] * (count - successes)
    force = Statistics(mean=0.002, mean_in_contact=0.004, maximum=0.05)
    forces = (EpisodeForces(force, force, force, force),) * count
    return Trial(tuple(ends), (100,) * count, forces)


@pytest.mark.parametrize(
    "task, pushed, steered, failures",
    [
        ("femoral_type1_bca", 3, 29, set()),
        ("femoral_type1_bca", 4, 29, {"femoral_type1_bca, straight push"}),
        ("type1_lcca", 4, 28, {"type1_lcca, straight push", "type1_lcca, expert"}),
        # The published BCA is ahead of a straight device.
        ("type1_bca", 30, 30, set()),
    ],
)
def test_bounds(monkeypatch, task, pushed, steered, failures):
    trials = {"push": trial(pushed, 30), "expert": trial(steered, 30)}
    monkeypatch.setattr(difficulty, "_trials", lambda *_: trials)
    kept = []
    report = difficulty.difficulty([task], keep=kept.append)
    assert {one.name for one in report.checks if not one.passed} == failures
    assert kept == [report]
    low, high = report.findings["tasks"][task]["push"]["success_ci95"]
    assert low < pushed / 30 < high or pushed == 30


def test_every_task_with_an_anatomy_of_its_own_is_judged():
    names = difficulty.tasks()
    left_out = set(suite.SUITE) - set(names)
    assert "navigate" in left_out
    for name in left_out - {"navigate"}:
        task = suite.TASKS[name]
        assert task.random_arch or "devices" in task.options
    steered = {name for name in names if difficulty.asks_for_steering(name)}
    from_the_groin = ("femoral_", "neck_")
    asking = {n for n in names if n.startswith(from_the_groin) or "lcca" in n}
    assert steered == asking - {"femoral_type1_lsa", "femoral_type2_lsa"}


def test_the_page_of_the_test_arches_is_made_with_the_benchmark():
    """The folder of its script has a difficulty.py, too."""
    scripts = Path(__file__).parents[1] / "docs" / "scripts"
    code = "import test_arches; print(sorted(test_arches.difficulty.LIMITS))"
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=scripts, capture_output=True, text=True
    )
    assert "random_curl" in done.stdout, done.stderr
