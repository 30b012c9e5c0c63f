"""The speed benchmark: what it measures, not how fast this machine is."""

import mujoco
import numpy as np
import pytest
import speed as script

from cathsim_dmc.validation import pace as speed


@pytest.fixture(scope="module")
def environment():
    loaded = speed.load()
    yield loaded
    loaded.close()


def test_a_pace_has_a_time_for_every_control_step(environment):
    run = speed.pace(environment, "push", 20)
    assert run.seconds.shape == run.insertion.shape == run.contacts.shape == (20,)
    assert (run.seconds > 0).all() and (np.diff(run.insertion)[1:] > 0).all()
    assert run.factor == pytest.approx(20 * 0.04 / run.seconds.sum())


@pytest.mark.parametrize("policy", ["random", "push"])
def test_bare_steps_do_the_physics_of_the_control_steps(environment, policy):
    """They once took the action as the control, which drives compute of it."""
    stepper, begun, after = environment.task.stepper, [], []
    act = speed.in_environment(speed.make_policy(policy, 0), environment)
    timestep, repeated = environment.reset(), stepper.repeated.sum()
    for _ in range(30):
        timestep = environment.step(act(timestep))
        begun.append(speed.Begun.last(environment))
        after.append(stepper.states()[0])
    assert stepper.repeated.sum() == repeated
    seconds, found = speed.bare_steps(environment, begun)
    np.testing.assert_array_equal(found, after)
    np.testing.assert_array_equal(stepper.states()[0], after[-1])
    assert seconds > 0.0


@pytest.mark.slow
def test_the_account_adds_up_and_leaves_nothing_behind(environment):
    # The last part is a difference of two measurements: the median of several runs.
    # In 100 steps of a push the device comes to the wall: 0.78 is physics.
    table = script.account("push", steps=100, runs=7)
    assert list(table)[-1] == "composer and observation"
    assert all(part > 0 for part in table.values()), table
    physics = sum(list(table.values())[:5])
    assert physics > 0.5 * sum(table.values())
    assert mujoco.get_mjcb_time() is None


def test_the_overhead_is_the_suite_over_mujoco_without_the_first_run(monkeypatch):
    pairs = iter([(9.0, 1.0), (3.0, 2.0), (2.0, 2.0)])
    monkeypatch.setattr(speed, "RATIOS", 2)
    monkeypatch.setattr(speed, "load", lambda: None)
    monkeypatch.setattr(speed, "against_bare_steps", lambda *_: next(pairs))
    assert speed.suite_overhead("push") == [1.5, 1.0]


def test_calibrated_speed_is_the_product_of_factor_and_humanoid(monkeypatch):
    monkeypatch.setattr(speed, "BARS", {"random": (1.0, 1e9)})
    monkeypatch.setattr(speed, "RUNS", 1)
    monkeypatch.setattr(speed, "STEPS", 3)
    # Before the first scene, between the two and after the second.
    steps = iter((30.0, 10.0, 20.0))
    monkeypatch.setattr(speed, "humanoid_step", lambda: next(steps))
    checks, table = speed.calibrated_speeds()
    for check, scene, around in zip(checks, speed.SCENES, (20, 15), strict=True):
        factor = table[scene]["random"]["real_time_factor"]
        assert check.value == pytest.approx(around * factor)
        assert check.unit == "µs"
    assert [check.passed for check in checks] == [True, False]
