import logging

import mujoco
import numpy as np
import pytest

from cathsim_dmc import suite
from cathsim_dmc.anatomy.arch import arch
from cathsim_dmc.simulation import batch
from cathsim_dmc.tasks import physics_errors as physics_errors


@pytest.fixture
def dumps(tmp_path, monkeypatch):
    monkeypatch.setenv("CATHSIM_DUMP_DIR", str(tmp_path))
    return tmp_path


def _load(**options):
    return suite.load("cathsim", "type1_bca", task_kwargs={"random": 3, **options})


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
    dumps, monkeypatch, caplog
):
    monkeypatch.setattr(physics_errors, "MAX_FORCE", 1e-5)
    environment = _load()
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


def test_a_dump_replays_the_episode(dumps, monkeypatch):
    monkeypatch.setattr(physics_errors, "MAX_FORCE", 1e-5)
    environment = _load()
    timestep = environment.reset()
    while not timestep.last():
        timestep = environment.step(_push(environment))
    final = environment.physics.data.qpos.copy()
    (path,) = dumps.glob("*.npz")
    meta, state, actions = physics_errors.load(path)
    assert meta["reason"] == physics_errors.EXPLODED
    assert meta["task"]["goal"] == "bca"
    again = _load()
    again.reset()
    model, data = again.physics.model.ptr, again.physics.data.ptr
    mujoco.mj_setState(model, data, state, mujoco.mjtState.mjSTATE_INTEGRATION)
    for action in actions:
        again.task.rollout.pose_robot(data.qpos[None])
        data.ctrl[:] = action
        for _ in range(again.task.substeps):
            mujoco.mj_step(model, data)
    np.testing.assert_array_equal(data.qpos, final)


def test_the_batch_reports_the_same_error(dumps, monkeypatch):
    monkeypatch.setattr(physics_errors, "MAX_FORCE", 1e-5)
    environment = _load()
    timestep, steps = environment.reset(), 0
    while not timestep.last():
        timestep, steps = environment.step(_push(environment)), steps + 1
    simulation = batch.BatchSimulation(_load().task, 2, seeds=[3, 3])
    simulation.reset()
    for count in range(1, steps + 1):
        step = simulation.step(np.tile(_push(environment), (2, 1)))
        assert step.physics_error.all() == (count == steps)
    assert step.terminated.all()
    assert not step.truncated.any()
    assert (step.outcome.reward == 0).all()


def test_a_diverging_simulation_is_a_physics_error(dumps):
    simulation = batch.BatchSimulation(_load().task, 2, seeds=3)
    simulation.reset()
    simulation.batch.qvel[1] = 1e12
    step = simulation.step(np.zeros((2, simulation.num_actions)))
    assert step.physics_error.tolist() == [False, True]
    (path,) = dumps.glob("*.npz")
    assert physics_errors.load(path)[0]["reason"] == physics_errors.DIVERGED


def test_composer_reports_divergence(dumps):
    environment = _load()
    environment.reset()
    environment.physics.data.ptr.qvel[:] = 1e12
    timestep = environment.step(np.zeros(21))
    assert timestep.last()
    assert timestep.discount == 0.0
    assert environment.task.termination == "physics_error"
    assert environment.task.error == physics_errors.DIVERGED


def test_a_file_that_is_no_dump_is_refused(tmp_path):
    np.savez(tmp_path / "other.npz", a=np.zeros(3))
    with pytest.raises(ValueError, match="no dump"):
        physics_errors.load(tmp_path / "other.npz")
