"""The domain is known to dm_control and to TorchRL, and registering it is safe."""

import dataclasses

import pytest
from dm_control import suite as dm_suite

from cathsim_dmc import suite
from cathsim_dmc.tasks.objectives import Cannulation


def test_dm_control_knows_the_tasks():
    assert dm_suite._DOMAINS["cathsim"] is suite
    pairs = {("cathsim", name) for name in suite.SUITE}
    assert pairs <= set(dm_suite.ALL_TASKS)
    # Benchmarking means rewards in [0, 1] in dm_control; ours are distances.
    assert pairs.isdisjoint(dm_suite.BENCHMARKING)
    assert pairs <= set(dm_suite.EXTRA)
    assert set(dm_suite.TASKS_BY_DOMAIN["cathsim"]) == set(suite.SUITE)


def test_the_other_domains_stay():
    assert ("cartpole", "balance") in dm_suite.BENCHMARKING
    assert set(dm_suite.TASKS_BY_DOMAIN["cartpole"]) >= {"balance", "swingup"}


def test_registering_twice_changes_nothing():
    names = "ALL_TASKS", "BENCHMARKING", "EXTRA", "TASKS_BY_DOMAIN"
    before = {name: getattr(dm_suite, name) for name in names}
    suite._register_domain()
    assert {name: getattr(dm_suite, name) for name in names} == before
    assert len(dm_suite.ALL_TASKS) == len(set(dm_suite.ALL_TASKS))


def test_torchrl_lists_the_domain():
    from torchrl.envs import DMControlEnv

    available = dict(DMControlEnv.available_envs)
    assert set(available["cathsim"]) == set(suite.SUITE)


def test_an_objective_whose_options_would_not_reach_it_is_refused():
    def slippery(anatomy, goal, *, friction=0.1, first=0):
        return Cannulation.to(anatomy, goal)

    known = suite.TASKS["type1_lcca"]
    with pytest.raises(ValueError, match="'slippery' has the options first, friction"):
        suite.register("slippery", dataclasses.replace(known, objective=slippery))
    assert "slippery" not in suite.TASKS
