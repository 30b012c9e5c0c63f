"""The tasks as Gymnasium environments."""

import runpy
import warnings
from pathlib import Path

import numpy as np
import pytest

gymnasium = pytest.importorskip("gymnasium")
from gymnasium.utils.env_checker import check_env  # noqa: E402

import cathsim_dmc.gym  # noqa: E402
from cathsim_dmc import suite  # noqa: E402
from cathsim_dmc.simulation.gymnasium import CathSimEnv  # noqa: E402

TASK = "cathsim/simple1_bca-v0"
EXAMPLE = Path(__file__).parents[1] / "examples" / "sb3_ppo.py"


def run(env, steps, seed):
    env.action_space.seed(seed)
    rows = [env.reset(seed=seed)[0]]
    rewards = []
    for _ in range(steps):
        observation, reward, *_ = env.step(env.action_space.sample())
        rows.append(observation)
        rewards.append(reward)
    return rows, rewards


def test_every_task_has_an_id():
    named = set(cathsim_dmc.gym.IDS.values())
    # Another test may have registered the task of the example since.
    assert set(suite.SUITE) - named <= {"gentle_type1_lcca"}
    assert named <= set(suite.SUITE)
    assert set(cathsim_dmc.gym.IDS) <= set(gymnasium.registry)


@pytest.mark.parametrize(
    "options",
    [
        pytest.param({}, marks=pytest.mark.slow),
        {
            "observation": ["image", "tracking_2d", "force"],
            "fluoroscopy": {"size": 32},
            "randomisation": True,
        },
        pytest.param(
            {"dtype": "float64", "observation": "segmentation"}, marks=pytest.mark.slow
        ),
    ],
)
def test_check_env_has_nothing_to_say(options):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # Numbers have no bounds of their own; Gymnasium would like some.
        warnings.filterwarnings("ignore", message=".*infinity.*")
        env = gymnasium.make(TASK, render_mode="rgb_array", **options)
        check_env(env.unwrapped)
    env.close()


def test_a_seed_is_the_suites_seed():
    env = gymnasium.make(TASK, observation="internal", dtype="float64")
    rows, _ = run(env, 5, seed=7)
    again, _ = run(env, 5, seed=7)
    other, _ = run(env, 5, seed=8)
    plain = suite.load("cathsim", "simple1_bca", {"random": 7})
    timestep = plain.reset()
    for key in rows[0]:
        np.testing.assert_array_equal(rows[0][key], timestep.observation[key])
        np.testing.assert_array_equal(rows[-1][key], again[-1][key])
    assert not np.array_equal(rows[0]["position"], other[0]["position"])


def test_time_truncates_and_does_not_terminate():
    env = gymnasium.make(TASK, max_steps=3)
    env.reset(seed=0)
    ends = [env.step(env.action_space.sample())[2:4] for _ in range(3)]
    assert ends == [(False, False), (False, False), (False, True)]
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.step(env.action_space.sample())


def _everywhere(objective):
    import dataclasses

    wide = dataclasses.replace(objective.route, radii=objective.route.radii + 1.0)
    return dataclasses.replace(objective, branch=wide, ostium=-1.0)


def test_render_shows_the_image_of_the_episodes_machine():
    drawn = {"view": [4, 5], "gain": [0.85, 0.9]}
    options = {"observation": "image", "randomisation": drawn}
    env = gymnasium.make(TASK, render_mode="rgb_array", **options)
    image = env.reset(seed=3)[0]["image"]
    np.testing.assert_array_equal(env.render(), np.repeat(image, 3, axis=-1))


@pytest.mark.slow
def test_render_shows_the_device_as_it_goes():
    env = gymnasium.make(TASK, render_mode="rgb_array", fluoroscopy={"size": 96})
    env.reset(seed=0)
    first = env.render()
    assert first.shape == (96, 96, 3) and first.dtype == np.uint8
    push = np.zeros(21, np.float32)
    push[-1] = 1
    for _ in range(15):
        env.step(push)
    darker = (first.astype(int) - env.render())[..., 0]
    task = env.unwrapped.environment.task
    carm = task.rollout.case().angiograph.planes()[0].carm
    (column, row), _ = carm.project(task.readings.head)
    # The tip has come here: the picture is darker, and nowhere far from the device.
    top, left = round(row) - 1, round(column) - 1
    near = darker[top : top + 3, left : left + 3]
    assert near.max() > 10
    assert (np.abs(darker) > 5).sum() < 60
    with pytest.raises(ValueError, match="rgb_array"):
        CathSimEnv(render_mode="human")
    biplane = gymnasium.make(
        TASK, render_mode="rgb_array", fluoroscopy={"size": 32, "biplane": "LATERAL"}
    )
    biplane.reset(seed=0)
    assert biplane.render().shape == (32, 64, 3)


def test_torchrl_takes_the_id():
    torchrl_envs = pytest.importorskip("torchrl.envs")
    from torchrl.envs.utils import check_env_specs

    env = torchrl_envs.GymEnv(TASK, observation=["image", "force"], max_steps=5)
    check_env_specs(env)
    rollout = env.rollout(20)
    assert rollout["next", "truncated"].flatten().tolist() == [False] * 4 + [True]
    assert rollout["image"].shape == (5, 128, 128, 1)


def test_success_terminates():
    env = gymnasium.make(TASK, goal_radius=1.0)
    env.reset(seed=0)
    task = env.unwrapped.environment.task
    # Any place in the branch counts with such a goal, so the branch is moved here.
    task.rollout.objectives[0] = _everywhere(task.objective), slice(None)
    _, reward, terminated, truncated, info = env.step(np.zeros(21, np.float32))
    assert (reward, terminated, truncated) == (10.0, True, False)
    assert info["success"] and not info["physics_error"]


@pytest.fixture(scope="module")
def example():
    """What examples/sb3_ppo.py defines."""
    pytest.importorskip("stable_baselines3")
    return runpy.run_path(str(EXAMPLE))


@pytest.mark.slow
def test_the_example_of_stable_baselines_trains_and_keeps_its_policy(example, tmp_path):
    from cathsim_dmc import agents

    settings = example["PPO_SETTINGS"]
    settings |= {"n_steps": 64, "batch_size": 64}
    model, normalise = example["untrained"]("type1_bca", 2, 0)
    model.learn(256)
    single = normalise.venv.envs[0]
    policy = example["policy_of"](model, normalise, example["groups_of"](single))
    # What the network reads is in the order in which it was trained.
    entries = single.unwrapped.observation_space.spaces
    assert list(entries) == sorted(entries)
    result = agents.evaluate(
        policy, "simple1_bca", 2, observation=example["OBSERVATION"],
        task_kwargs={"max_steps": 5},
    )  # fmt: skip
    assert result.policy == "sb3_ppo" and result.values("length").tolist() == [5, 5]
    path = tmp_path / "policy.safetensors"
    example["save"](path, model, normalise, task="type1_bca", seed=0)
    again, statistics, about = example["load"](path)
    assert about == {"task": "type1_bca", "seed": 0}
    seen = np.random.RandomState(0).normal(size=(4, *model.observation_space.shape))
    expected, _ = model.predict(normalise.normalize_obs(seen), deterministic=True)
    found, _ = again.predict(statistics.normalize_obs(seen), deterministic=True)
    np.testing.assert_array_equal(found, expected)


@pytest.mark.slow
def test_the_policy_beside_the_example_of_stable_baselines_reaches_its_goal(example):
    from cathsim_dmc import agents

    path = EXAMPLE.with_suffix(".safetensors")
    assert path.stat().st_size < 2**20
    model, normalise, about = example["load"](path)
    groups = example["groups_of"](normalise.venv.envs[0])
    policy = example["policy_of"](model, normalise, groups)
    result = agents.evaluate(
        policy, about["task"], 2, observation=example["OBSERVATION"],
        task_kwargs={"max_steps": 200},
    )  # fmt: skip
    assert result.summary()["success"] == 1.0
