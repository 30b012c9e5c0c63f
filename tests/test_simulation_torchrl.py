"""TorchRL sees the tasks through dm_control and through the batched simulation."""

import numpy as np
import pytest
import torch
from conftest import SHORT_EPISODE, twin
from tensordict import TensorDict
from torchrl.envs import DMControlEnv, FrameSkipTransform, TransformedEnv
from torchrl.envs.utils import check_env_specs

from cathsim_dmc import suite
from cathsim_dmc.physics.effects import Effect
from cathsim_dmc.simulation.batch import BatchSimulation
from cathsim_dmc.simulation.torchrl import BatchedEnv

ENVS = 3


@pytest.fixture(scope="module")
def batched():
    place = torch.device("cpu")  # as good as its name
    return BatchedEnv("type1_lcca", ENVS, num_threads=1, seed=5, device=place)


def test_dm_control_env():
    env = DMControlEnv("cathsim", "type1_lcca", max_steps=SHORT_EPISODE)
    check_env_specs(env)
    assert env.action_spec.shape == (21,)

    # The same seed, the same episode; another seed, another one.
    def rollout(seed):
        env.set_seed(seed)
        torch.manual_seed(0)
        return env.rollout(2 * SHORT_EPISODE)

    first, again, other = rollout(3), rollout(3), rollout(4)
    for key in ("position", "velocity", "external_force"):
        assert torch.equal(first["next", key], again["next", key]), key
    assert not torch.equal(first["position"][0], other["position"][0])
    # The time limit truncates; it terminates nothing.
    ends = first["next", "truncated"].flatten()
    assert ends.tolist() == [False] * (SHORT_EPISODE - 1) + [True]
    assert not first["next", "terminated"].any()
    env.close()


def test_seed_of_dm_control_env_is_that_of_the_suite():
    env = DMControlEnv("cathsim", "simple1_bca", max_steps=SHORT_EPISODE)
    env.set_seed(11)
    expected = suite.load("cathsim", "simple1_bca", task_kwargs={"random": 11})
    expected.reset()  # as set_seed does
    position = expected.reset().observation["position"]
    np.testing.assert_array_equal(env.reset()["position"].numpy(), position)
    env.close()
    expected.close()


def test_an_ended_simulation_stays_as_it_ended_until_its_reset():
    env = BatchedEnv("simple1_bca", 2, num_threads=1, task_kwargs={"max_steps": 3})
    push = TensorDict({"action": torch.ones(2, 21)}, batch_size=[2])

    def steps(count):
        return torch.stack([env.step(push.clone())["next"] for _ in range(count)], 1)

    env.reset()
    once = steps(2)
    second = torch.tensor([[False], [True]])
    env.reset(TensorDict({"_reset": second}, batch_size=[2]))
    then = steps(4)
    ends = [[True, True, True, True], [False, False, True, True]]
    assert then["done"][..., 0].tolist() == then["truncated"][..., 0].tolist() == ends
    assert (then[0, 1:].exclude("reward") == then[0, :1].exclude("reward")).all()
    assert (then["reward"][..., 0] == 0).tolist() == [
        [False, True, True, True],
        [False, False, False, True],
    ]
    env.set_seed(0)
    skipping = TransformedEnv(env, FrameSkipTransform(5))
    skipping.reset()
    first = skipping.step(push.clone())["next", "reward"][0]
    assert first == once["reward"][0, 0] + once["reward"][0, 1] + then["reward"][0, 0]
    with pytest.raises(ValueError, match="of 1 simulations, 2 are to be restored"):
        env.restore(env.snapshot(np.array([0])))
    assert not steps(1)["reward"][0].any()
    env.reset()
    assert not steps(1)["done"].any() and steps(1)["reward"].all()


def test_a_snapshot_of_an_end_is_restored_as_ended():
    options = {"num_threads": 1, "observation": ["tracking", "image"], "seed": 4}
    env = BatchedEnv("simple1_bca", 2, task_kwargs={"max_steps": 3}, **options)
    push = TensorDict({"action": torch.ones(2, 21)}, batch_size=[2])
    second = TensorDict({"_reset": torch.tensor([[False], [True]])}, batch_size=[2])
    env.reset()
    env.step(push.clone())
    env.reset(second)
    for _ in range(2):
        env.step(push.clone())
    end = env.snapshot()
    assert env.ended.tolist() == [True, False]
    then = env.step(push.clone())["next"]  # the second ends here
    env.step(push.clone())
    assert env.ended.all()
    both = env.snapshot()
    for name, array in end.arrays.items():
        np.testing.assert_array_equal(both.arrays[name][0], array[0])
    for snapshot, ended in ((end, [True, False]), (both, [True, True])):
        env.restore(snapshot)
        assert env.ended.tolist() == ended
        again = env.step(push.clone())["next"]
        assert (again.exclude("reward") == then.exclude("reward")).all()
        assert (again["reward"][:, 0] == 0).tolist() == ended
    # The next episode does not depend on how long a simulation has waited.
    begun = env.reset()
    env.restore(both)
    assert (env.reset()["image"] == begun["image"]).all()
    longer = BatchedEnv("simple1_bca", 2, task_kwargs={"max_steps": 4}, **options)
    longer.restore(both)
    assert not longer.ended.any() and longer.step(push)["next", "reward"].all()


@pytest.mark.parametrize("option", ["observation", "random"])
def test_what_is_an_argument_is_no_option(option):
    with pytest.raises(ValueError, match=f"without {option}, for which there is"):
        BatchedEnv("simple1_bca", 2, task_kwargs={option: 3})


@pytest.mark.parametrize(
    ("name", "value"), [("num_envs", 0), ("num_envs", 2.0), ("seed", "3"), ("seed", -1)]
)
def test_a_wrong_number_is_told_by_the_name_of_its_argument(name, value, batched):
    given = {"num_envs": 2, name: value}
    with pytest.raises(ValueError, match=f"^{name} is {value!r}; it must be an int"):
        BatchedEnv("simple1_bca", **given)
    if name == "seed":
        with pytest.raises(ValueError, match=f"^seed is {value!r}; it must be an int"):
            batched.set_seed(value)


def test_batched_env(batched):
    check_env_specs(batched)
    assert batched.batch_size == (ENVS,)
    assert batched.action_spec.shape == (ENVS, 21)
    info = batched.reset()["info"]
    assert list(info.keys()) == list(batched.simulation.reset().info())
    for name in ("reward_distance", "reward_success", "wall_force_peak_max"):
        assert info[name].shape == (ENVS, 1) and info[name].dtype == torch.float32
    for name in ("success", "physics_error"):
        assert info[name].dtype == torch.bool


def test_figures_have_their_names(batched):
    task = twin(batched.simulation.task)
    simulation = BatchSimulation(task, ENVS, num_threads=1, seeds=4)
    batched.set_seed(4)
    state, own = batched.reset(), simulation.reset()
    action = torch.zeros(ENVS, 21)
    action[:, -1] = 1.0
    for _ in range(3):
        state = batched.step(state.set("action", action))["next"]
        own = simulation.step(action.numpy())
    for name, values in own.info().items():
        found = state["info", name][:, 0].numpy()
        np.testing.assert_array_equal(found, values.astype(found.dtype), name)
    assert torch.equal(state["reward"][:, 0], torch.tensor(own.outcome.reward).float())


def test_batched_seeds(batched):
    def start(seed):
        batched.set_seed(seed)
        return batched.reset()["position"]

    first, again, other = start(1), start(1), start(9)
    assert torch.equal(first, again)
    assert not torch.equal(first, other)
    # Each simulation has a seed of its own, counting up.
    assert len({tuple(row.tolist()) for row in first}) == ENVS
    assert torch.equal(start(2)[:-1], first[1:])


def test_a_reset_has_no_seed(batched):
    with pytest.raises(TypeError, match=r"not seed; set_seed\(seed\)"):
        batched.reset(seed=3)


def test_only_what_is_done_is_reset(batched):
    batched.set_seed(0)
    tensordict = batched.reset()
    for _ in range(3):
        tensordict["action"] = batched.action_spec.rand()
        tensordict = batched.step(tensordict)["next"]
    before = tensordict["position"].clone()
    tensordict["_reset"] = torch.tensor([[True], [False], [True]])
    after = batched.reset(tensordict)["position"]
    assert torch.equal(after[1], before[1])
    assert not torch.equal(after[0], before[0])
    assert not torch.equal(after[2], before[2])
    assert batched.simulation.rollout.steps.tolist() == [0, 3, 0]
    # Where nothing is to be reset, all stay as they are.
    tensordict["_reset"] = torch.zeros(ENVS, 1, dtype=torch.bool)
    assert torch.equal(batched.reset(tensordict)["position"], after)
    assert batched.simulation.rollout.steps.tolist() == [0, 3, 0]


def test_an_action_of_half_precision(batched):
    def reward(dtype):
        batched.set_seed(0)
        action = torch.full((ENVS, 21), 0.5, dtype=dtype)
        return batched.step(batched.reset().set("action", action))["next", "reward"]

    assert torch.equal(reward(torch.bfloat16), reward(torch.float32))


def test_an_action_of_a_network_that_learns(batched):
    """A rollout does not turn gradients off."""
    action = torch.zeros(ENVS, 21, requires_grad=True)
    after = batched.step(batched.reset().set("action", action))
    assert after["action"].requires_grad and not after["next", "reward"].requires_grad


def test_success_is_terminated_in_torchrl():
    from cathsim_dmc.anatomy import phantoms
    from cathsim_dmc.anatomy.parts import Goal

    anatomy = phantoms.load("simple1")
    place = anatomy.tree.vessel("aorta").centreline.at(0.09)
    goal = Goal("near", "aorta", place.position, 0.09)
    env = DMControlEnv("cathsim", "navigate", anatomy=anatomy, goal=goal)
    forward = torch.zeros(21, dtype=torch.float64)
    forward[-1] = 1.0
    rollout = env.rollout(60, policy=lambda td: td.set("action", forward.clone()))
    last = rollout[-1]["next"]
    assert last["terminated"].item() and not last["truncated"].item()
    assert last["reward"].item() == 10.0
    assert len(rollout) < 60
    env.close()


def test_an_ended_simulation_without_a_snapshot_is_stepped_on():
    class Odd(Effect):
        """Its state becomes one that no snapshot can keep."""

        state = ("numbers",)

        def bind(self, world):
            self.numbers = np.zeros(world.num_simulations)

        def act(self, action, state):
            self.numbers = 1.0
            return action

    options = {"max_steps": 1, "effects": [Odd()]}
    env = BatchedEnv("simple1_bca", 1, num_threads=1, task_kwargs=options)
    state = env.reset().update({"action": torch.zeros(1, 21)})
    env.step(state.clone())
    found = env.step(state)["next"]
    assert found["done"].all() and not found["reward"].any()
