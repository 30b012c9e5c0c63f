import logging
import os

import numpy as np
import pytest
from conftest import twin

from cathsim_dmc import suite
from cathsim_dmc.anatomy.arch import arch
from cathsim_dmc.simulation import batch
from cathsim_dmc.tasks import physics_errors as physics_errors
from cathsim_dmc.tasks.snapshot import Snapshot


@pytest.fixture
def dumps(tmp_path, monkeypatch):
    monkeypatch.setenv("CATHSIM_DUMP_DIR", str(tmp_path))
    return tmp_path


@pytest.fixture(scope="module")
def task():
    """A task that environments and batches compile, each for itself."""
    return suite.make_task("type1_bca")


@pytest.fixture
def load(task):
    """Returns a function that makes an environment of the task, with seed 3."""
    return lambda: suite.environment(twin(task, 3))


def _push(environment):
    action = np.zeros(environment.action_spec().shape)
    action[0], action[-1] = 1.0, 1.0
    return action


def test_a_device_in_lumen_and_sheath_has_not_escaped():
    anatomy = arch.load("simple1")
    inlet = anatomy.inlet
    way = np.linspace(-0.3, 0.1, 81)[:, None]
    straight = inlet.position + way * inlet.direction
    assert not physics_errors.escaped(anatomy, straight)
    aside = straight + [0.03, 0, 0]
    assert physics_errors.escaped(anatomy, aside)
    assert physics_errors.escaped(anatomy, np.stack([straight, aside])).tolist() == [
        0,
        1,
    ]


def test_exploding_force_ends_the_episode_as_a_physics_error(
    dumps, load, monkeypatch, caplog
):
    monkeypatch.setattr(physics_errors, "MAX_FORCE", 1e-5)
    environment = load()
    timestep = environment.reset()
    with caplog.at_level(logging.ERROR):
        while not timestep.last():
            timestep = environment.step(_push(environment))
    task = environment.task
    assert (task.termination, task.error) == ("physics_error", physics_errors.EXPLODED)
    assert timestep.reward == 0.0
    assert timestep.discount == 0.0
    (path,) = dumps.glob("*.npz")
    assert str(path) in caplog.text
    assert environment.reset().first()
    assert task.error is None


def replay(environment, start, actions):
    """Steps an environment through the episode of a dump."""
    environment.restore(start)
    for action in actions:
        environment.step(action)


@pytest.mark.parametrize("randomised", [False, True])
def test_a_dump_replays_the_episode(randomised, dumps, monkeypatch):
    monkeypatch.setattr(physics_errors, "MAX_FORCE", 1e-5)
    task = suite.make_task("type1_bca", randomisation=randomised)
    environment = suite.environment(twin(task, 3))
    timestep = environment.reset()
    while not timestep.last():
        timestep = environment.step(_push(environment))
    final = environment.physics.data.qpos.copy()
    (path,) = dumps.glob("*.npz")
    reason, start, actions = physics_errors.load(path)
    assert reason == physics_errors.EXPLODED
    assert start.task["goal"] == "bca"
    again = suite.environment(twin(task, 4))  # not what it drew
    replay(again, start, actions)
    np.testing.assert_array_equal(again.physics.data.qpos, final)


def test_the_batch_reports_the_same_error(dumps, task, load, monkeypatch):
    monkeypatch.setattr(physics_errors, "MAX_FORCE", 1e-5)
    environment = load()
    timestep, steps = environment.reset(), 0
    while not timestep.last():
        timestep, steps = environment.step(_push(environment)), steps + 1
    simulation = batch.BatchSimulation(task, 2, seeds=[3, 3])
    simulation.reset()
    for count in range(1, steps + 1):
        step = simulation.step(np.tile(_push(environment), (2, 1)))
        assert step.physics_error.all() == (count == steps)
    assert step.terminated.all()
    assert not step.truncated.any()
    assert (step.outcome.reward == 0).all()


def test_a_diverging_simulation_is_a_physics_error(dumps, task):
    simulation = batch.BatchSimulation(task, 2, num_threads=1, seeds=3)
    simulation.reset()
    simulation.batch.qvel[1] = 1e12
    step = simulation.step(np.zeros((2, simulation.num_actions)))
    assert step.physics_error.tolist() == [False, True]
    (path,) = dumps.glob("*.npz")
    assert physics_errors.load(path)[0] == physics_errors.DIVERGED


def test_an_episode_is_dumped_once_and_a_folder_keeps_the_last_few(dumps, load):
    environment = load()
    for episode in range(physics_errors.KEPT_DUMPS + 2):
        environment.reset()
        before = set(dumps.iterdir())
        for _ in range(3):
            environment.physics.data.ptr.qvel[:] = 1e12
            if environment.step(np.zeros(21)).last():
                environment._reset_next_step = False  # composer steps on
        (path,) = set(dumps.iterdir()) - before
        os.utime(path, ns=(episode, episode))
    ages = sorted(path.stat().st_mtime_ns for path in dumps.iterdir())
    assert ages == list(range(2, physics_errors.KEPT_DUMPS + 2))


def test_what_is_kept_of_a_simulation_is_bounded_and_its_own(task, monkeypatch, caplog):
    """One that is never reset keeps nothing of the others."""
    monkeypatch.setattr(physics_errors, "LONGEST_REPLAY", 10)
    monitor = physics_errors.PhysicsMonitor(task.scene, 2)
    monitor.restart(0, task.scene)

    def take(indices):
        return Snapshot({}, {"state": np.zeros((len(indices), 1))})

    def kept():
        return [len(one.actions or b"") // 8 for one in monitor._watched]

    for _ in range(10):
        monitor.restart(1, task.scene)
        for _ in range(4):
            monitor.before_step(take, np.zeros((2, 1)))
        assert kept()[0] <= 10 and kept()[1] == 4
    assert kept() == [0, 4]
    steps, nodes = np.array([40, 4]), np.zeros((2, 1, 3))
    errors = monitor.errors([True, False], steps, nodes, np.zeros(2))
    assert errors == (physics_errors.DIVERGED, None)
    assert "more steps than a dump holds" in caplog.text


# Factor of the springs of all joints: they push away from rest, so nothing is stable.
_WILD = -1e3


def _unstable(task, wild, steps=12):
    """States (T, N, nq) and errors (N,) of three simulations, one of them wild."""
    simulation = batch.BatchSimulation(task, 3, num_threads=1, seeds=3)
    simulation.reset()
    simulation.batch.expand("jnt_stiffness")[wild] *= _WILD
    action = np.tile(np.linspace(-1, 1, simulation.num_actions), (3, 1))
    states, errors = [], [None] * 3
    for _ in range(steps):
        step = simulation.step(action)
        states.append(simulation.batch.qpos.copy())
        errors = [old or new for old, new in zip(errors, step.errors, strict=True)]
    return np.array(states), errors


def test_an_unstable_model_ends_with_a_reason_and_disturbs_nobody(dumps, task):
    disturbed, errors = _unstable(task, wild=[1])
    assert errors[1] in (physics_errors.DIVERGED, physics_errors.EXPLODED)
    assert errors[0] is errors[2] is None
    alone, none = _unstable(task, wild=[])
    assert none == [None] * 3
    np.testing.assert_array_equal(disturbed[:, [0, 2]], alone[:, [0, 2]])
    assert (disturbed[0, 1] != alone[0, 1]).any()


def test_trainings_keep_dumps_in_their_folder(tmp_path, monkeypatch):
    monkeypatch.delenv("CATHSIM_DUMP_DIR")
    with physics_errors.dumps_in(tmp_path / "errors"):
        start = Snapshot({}, {"state": np.zeros((1, 3))})
        path = physics_errors.dump("tried", start, np.zeros((2, 3)))
    assert path.parent == tmp_path / "errors"
    assert "CATHSIM_DUMP_DIR" not in os.environ


def test_a_full_disk_does_not_end_the_other_simulations(
    dumps, task, small_disk, caplog
):
    simulation = batch.BatchSimulation(task, 2, num_threads=1, seeds=3)
    simulation.reset()
    simulation.batch.qvel[1] = 1e12
    with small_disk(100):
        step = simulation.step(np.zeros((2, simulation.num_actions)))
    assert step.physics_error.tolist() == [False, True]
    assert "lost" in caplog.text and "File too large" in caplog.text
    assert not list(dumps.iterdir())
