"""What an interrupt or an error in the middle of a reset or other work leaves."""

import dataclasses
import os
import signal
import subprocess
import sys
import time

import mujoco
import numpy as np
import pytest

from cathsim_dmc import suite
from cathsim_dmc.simulation.batch import BatchSimulation
from cathsim_dmc.tasks import cases
from cathsim_dmc.tasks.objectives import Cannulation

ACTUATION = mujoco.mjtDisableBit.mjDSBL_ACTUATION.value


def interrupt(*_, **__):
    raise KeyboardInterrupt


def push(simulation, steps=3):
    """Positions after so many steps of a push, of an environment or a batch."""
    batched = isinstance(simulation, BatchSimulation)
    action = np.zeros((simulation.num_simulations, simulation.num_actions) if batched
                      else simulation.action_spec().shape)  # fmt: skip
    action[..., -1] = 1.0
    for _ in range(steps):
        simulation.step(action)
    arrays = simulation.stepper.arrays if batched else simulation.task.stepper.arrays
    return arrays.qpos[0].copy()


def make(kind):
    """An environment or a batch of the same task and seed."""
    task = suite.make_task("type1_bca", random=0)
    return suite.environment(task) if kind == "composer" else BatchSimulation(task, 1)


@pytest.mark.parametrize("kind", ["composer", "batch"])
def test_a_reset_restores_actuation_and_time_step(kind):
    """An interrupt may come between a change of an option and its return."""
    simulation = make(kind)
    simulation.reset()
    expected = push(simulation)
    stepper = simulation.stepper if kind == "batch" else simulation.task.stepper
    stepper._change(np.arange(1), "disableflags", lambda flags: flags | ACTUATION)
    stepper._shortened = True
    stepper._change(np.arange(1), "timestep", lambda timestep: timestep / 8)
    again = simulation.random_state if kind == "composer" else None
    if again is not None:
        again.seed(0)
    else:
        simulation.seed(0)
    simulation.reset()
    np.testing.assert_array_equal(push(simulation), expected)


def test_an_interrupt_in_a_reset_leaves_actuation_enabled(monkeypatch):
    batch = make("batch")
    batch.reset()
    expected = push(batch)
    with monkeypatch.context() as patch:
        patch.setattr(type(batch.stepper), "_forward", interrupt)
        batch.seed(0)
        with pytest.raises(KeyboardInterrupt):
            batch.reset()
    assert not (batch.batch.expand("opt.disableflags") & ACTUATION).any()
    with pytest.raises(RuntimeError, match=r"\[0\] have no episode; call reset"):
        push(batch)
    batch.seed(0)
    batch.reset()
    np.testing.assert_array_equal(push(batch), expected)


def test_after_an_interrupted_reset_a_step_starts_an_episode(monkeypatch):
    environment = make("composer")
    environment.reset()
    with monkeypatch.context() as patch:
        patch.setattr(environment.task.rollout, "begin", interrupt)
        with pytest.raises(KeyboardInterrupt):
            environment.reset()
    first = environment.step(np.zeros(environment.action_spec().shape))
    assert first.first() and environment.task.rollout.steps == 0


class Failing(Cannulation):
    """Raises an error in the step that somebody asks for."""

    fails = False

    def success(self, measurement):
        if self.fails:
            raise ZeroDivisionError("in the objective")
        return super().success(measurement)


@pytest.mark.parametrize("kind", ["composer", "batch"])
def test_a_step_after_a_failed_one_is_refused_until_a_reset(kind, monkeypatch):
    definition = dataclasses.replace(suite.TASKS["type1_bca"], objective=Failing.to)
    monkeypatch.setitem(suite.TASKS, "failing", definition)
    task = suite.make_task("failing", random=0)
    whole = kind == "composer"
    simulation = suite.environment(task) if whole else BatchSimulation(task, 1)
    simulation.reset()
    expected = push(simulation)
    stepper = task.stepper if whole else simulation.stepper
    monkeypatch.setattr(Failing, "fails", True)
    with pytest.raises(ZeroDivisionError):
        push(simulation)
    monkeypatch.setattr(Failing, "fails", False)
    places = stepper.arrays.qpos.copy()
    with pytest.raises(RuntimeError, match=r"simulations \[0\] half done; call reset"):
        push(simulation)
    np.testing.assert_array_equal(stepper.arrays.qpos, places)
    (simulation.random_state if whole else simulation).seed(0)
    simulation.reset()
    np.testing.assert_array_equal(push(simulation), expected)


def test_a_bad_action_does_not_end_an_episode():
    environment, batch = make("composer"), make("batch")
    for simulation in (environment, batch):
        simulation.reset()
        with pytest.raises(ValueError, match="the action"):
            simulation.step(np.full(3, np.nan))
        push(simulation)


@pytest.mark.parametrize("kind", ["composer", "batch"])
def test_an_anatomy_whose_writing_was_interrupted_is_written_again(kind, monkeypatch):
    options = {"pool": 2, "randomisation": {"friction": (0.05, 0.05)}, "random": 0}
    task = suite.make_task("arch_bca", **options)
    whole = kind == "composer"
    simulation = suite.environment(task) if whole else BatchSimulation(task, 1)
    simulation.reset()
    rollout = task.rollout if whole else simulation.rollout
    stepper = task.stepper if whole else simulation.stepper
    number, model = rollout._case_of[0], stepper._model_of(0)
    before = model.body_pos.copy()
    written = cases.Case.write

    def half(self, model):
        written(self, model)
        interrupt()

    with monkeypatch.context() as patch:
        patch.setattr(cases.Case, "write", half)
        with pytest.raises(KeyboardInterrupt):
            stepper.load(0, rollout._cases[1 - number])
    assert not np.array_equal(model.body_pos, before)
    stepper.load(0, rollout._cases[number])
    np.testing.assert_array_equal(stepper._model_of(0).body_pos, before)


def test_a_deep_link_copies_its_own_state_only(monkeypatch):
    """Each suspect once copied the states of all simulations."""
    batch = BatchSimulation(suite.make_task("type1_lcca"), 16, num_threads=1)
    batch.reset()
    batch.batch.qvel[:4, batch.rollout.index.dofs.start] = 1.0
    copied, states = [], type(batch.stepper).states

    def count(self, *indices):
        found = states(self, *indices)
        copied.append(len(found))
        return found

    monkeypatch.setattr(type(batch.stepper), "states", count)
    depth, warned = np.full(16, 2.9e-4), np.zeros(16, bool)
    way, _ = batch.stepper._way(np.zeros(16), depth, 3e-4)
    batch.stepper._depth_at_end(depth, way, warned, 3e-4)
    assert copied == [4]


LOST = """
import signal, time
from cathsim_dmc.cli.interrupts import Interrupts

interrupts, began = Interrupts(), time.monotonic()
try:
    try:
        signal.raise_signal(signal.SIGINT)
    except BaseException:
        pass  # as an import does
    assert interrupts.came
    try:
        while time.monotonic() < began + 20:
            time.sleep(0.05)
    finally:
        time.sleep(2.5)  # saves
        print("saved")
except KeyboardInterrupt:
    interrupts.handled()
    time.sleep(1.5)
    print("once", time.monotonic() - began < 10)
"""


@pytest.mark.slow
def test_an_interrupt_that_is_lost_comes_again_until_it_is_handled():
    done = subprocess.run([sys.executable, "-c", LOST], capture_output=True, text=True)
    assert done.stdout.split() == ["saved", "once", "True"], done.stderr


OVER = """
import sys, time
from cathsim_dmc.recording import image_set
if __name__ == "__main__":
    for _ in image_set._over(time.sleep, [0, 0, 60, 60, 60], 2):
        print("begun", flush=True)
"""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="other signals")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_processes_of_a_dataset_end_with_the_one_that_began_them(tmp_path, number):
    (tmp_path / "over.py").write_text(OVER)
    run = subprocess.Popen(
        [sys.executable, tmp_path / "over.py"], stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
    )  # fmt: skip
    assert run.stdout.readline() == b"begun\n"
    began = time.monotonic()
    run.send_signal(number)
    # All processes hold the pipe; it ends with the last one.
    assert run.stdout.read().count(b"begun") < 2
    run.wait()
    assert time.monotonic() - began < 30
