"""Snapshots: an episode goes on bit for bit, elsewhere and later."""

import subprocess
import sys

import numpy as np
import pytest
from conftest import twin

from cathsim_dmc import suite
from cathsim_dmc.simulation.batch import BatchSimulation
from cathsim_dmc.simulation.gymnasium import CathSimEnv
from cathsim_dmc.tasks.snapshot import Snapshot

TASKS = {
    "steered": (
        "simple1_bca",
        {
            "observation": ["internal", "sequential", "route"],
            "fluoroscopy": {"noise": True, "size": 32},
        },
    ),
    "pair": ("simple1_bca_pair", {"observation": ["tracking", "force"]}),
    "pool": ("arch_bca", {"pool": 2, "observation": "route"}),
}


@pytest.fixture(scope="module")
def make():
    """Returns a function that makes a randomised task, of one scene for each name."""
    tasks = {}

    def task(name, seed=0):
        if name not in tasks:
            chosen, options = TASKS[name]
            tasks[name] = suite.make_task(chosen, randomisation=True, **options)
        return twin(tasks[name], seed)

    return task


def actions(count, steps=6, seed=0):
    return np.random.default_rng(seed).uniform(-1, 1, (steps, count))


def play(environment, chosen):
    return [environment.step(action) for action in chosen]


def assert_equal(one, other):
    assert one.step_type == other.step_type
    assert (one.reward, one.discount) == (other.reward, other.discount)
    assert list(one.observation) == list(other.observation)
    for key, value in one.observation.items():
        np.testing.assert_array_equal(value, other.observation[key], err_msg=key)


@pytest.mark.parametrize("name", TASKS)
def test_an_episode_goes_on_in_a_fresh_environment(make, name, tmp_path):
    task = make(name, 3)
    environment, count = suite.environment(task), task.num_actions
    environment.reset()
    (*_, last) = play(environment, actions(count))
    path = environment.snapshot().save(tmp_path / "state.npz")
    expected = play(environment, actions(count, seed=1))
    expected += [environment.reset(), *play(environment, actions(count, 2))]
    info, devices = task.info(), task.devices

    fresh = suite.environment(make(name, 99))
    assert_equal(fresh.restore(Snapshot.load(path)), last)
    seen = play(fresh, actions(count, seed=1))
    seen += [fresh.reset(), *play(fresh, actions(count, 2))]
    for one, other in zip(seen, expected, strict=True):
        assert_equal(one, other)
    assert fresh.task.info() == info
    if devices is not None:
        np.testing.assert_array_equal(fresh.task.devices.points, devices.points)


@pytest.mark.parametrize("name", TASKS)
def test_a_batch_goes_on_from_an_environment_and_back(make, name):
    task = make(name, 3)
    environment, count = suite.environment(task), task.num_actions
    environment.reset()
    play(environment, actions(count))
    batch = BatchSimulation(make(name), 3, num_threads=2, seeds=7)
    batch.restore(environment.snapshot(), [1])
    batch.reset([0, 2])  # which leaves the restored one alone
    for action in actions(count, seed=1):
        timestep = environment.step(action)
        step = batch.step(np.tile(action, (3, 1)))
        for key, value in timestep.observation.items():
            np.testing.assert_array_equal(step.observation[key][1], value, err_msg=key)
        assert step.outcome.reward[1] == timestep.reward
    state = batch.snapshot([1, 2])
    fresh = BatchSimulation(make(name), 2, num_threads=1, seeds=50)
    again = fresh.restore(state)
    np.testing.assert_array_equal(again.distance, step.distance[1:])
    environment.restore(state[:1])
    for action in actions(count, 3, seed=2):
        step, later = batch.step(np.tile(action, (3, 1))), fresh.step([action] * 2)
        timestep = environment.step(action)
        for key, value in step.observation.items():
            np.testing.assert_array_equal(later.observation[key], value[1:])
            np.testing.assert_array_equal(timestep.observation[key], value[1])
        assert step.path_ratio[1:].tolist() == later.path_ratio.tolist()


_ELSEWHERE = """
import sys, numpy as np
from cathsim_dmc import suite
from cathsim_dmc.tasks.snapshot import Snapshot
environment = suite.load("cathsim", "simple1_bca", {"randomisation": True})
environment.restore(Snapshot.load(sys.argv[1]))
for action in np.random.default_rng(1).uniform(-1, 1, (6, 21)):
    timestep = environment.step(action)
print(environment.physics.data.qpos.tobytes().hex(), timestep.reward.hex())
"""


def test_an_episode_goes_on_in_another_process(tmp_path):
    options = {"randomisation": True, "random": 3}
    environment = suite.load("cathsim", "simple1_bca", options)
    environment.reset()
    play(environment, actions(21))
    path = environment.snapshot().save(tmp_path / "state.npz")
    timestep = play(environment, actions(21, seed=1))[-1]
    done = subprocess.run(
        [sys.executable, "-c", _ELSEWHERE, path], capture_output=True, text=True
    )
    qpos = environment.physics.data.qpos.tobytes().hex()
    assert done.stdout.split() == [qpos, timestep.reward.hex()], done.stderr


def test_gymnasium_goes_on_too():
    environments = [CathSimEnv("simple1_bca") for _ in range(2)]
    environments[0].reset(seed=5)
    observation, *_ = environments[0].step(np.ones(21))
    again, info = environments[1].restore(environments[0].snapshot())
    assert info["distance"] > 0
    for key, value in observation.items():
        np.testing.assert_array_equal(again[key], value)
    one, other = (each.step(np.ones(21)) for each in environments)
    assert one[1:] == other[1:]


def test_a_snapshot_that_does_not_fit_is_refused_in_a_line(make, tmp_path):
    environment = suite.environment(make("steered"))
    with pytest.raises(RuntimeError, match="reset"):
        environment.snapshot()
    environment.reset()
    snapshot = environment.snapshot()
    path = snapshot.save(tmp_path / "state.npz")
    pair = suite.environment(make("pair"))
    pair.reset()
    with pytest.raises(ValueError, match="of another task: its devices") as error:
        pair.restore(snapshot)
    assert "\n" not in str(error.value)
    plain = suite.environment(twin(make("steered"), observation="internal"))
    plain.reset()
    with pytest.raises(ValueError, match="with other options: it has images"):
        plain.restore(snapshot)
    batch = BatchSimulation(make("steered"), 2, seeds=0)
    with pytest.raises(RuntimeError, match="have no episode"):
        batch.snapshot()
    with pytest.raises(ValueError, match="of 1 simulations, 2 are"):
        batch.restore(snapshot)
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)
    with pytest.raises(ValueError, match="is no snapshot"):
        Snapshot.load(path)
