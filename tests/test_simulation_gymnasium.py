"""The tasks as Gymnasium environments."""

import functools
import importlib
import re
import runpy
import warnings
from pathlib import Path

import numpy as np
import pytest

gymnasium = pytest.importorskip("gymnasium")
from gymnasium.utils.env_checker import check_env  # noqa: E402

import cathsim_dmc.gym  # noqa: E402
from cathsim_dmc import suite  # noqa: E402
from cathsim_dmc.simulation.gymnasium import (  # noqa: E402
    CathSimEnv,
    CathSimVectorEnv,
    env_spec,
)
from cathsim_dmc.tasks import physics_errors  # noqa: E402

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
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # such as that an id is overridden
        importlib.reload(cathsim_dmc.gym)  # without the tasks that tests have forgotten
    ids = cathsim_dmc.gym.IDS
    assert set(ids.values()) == set(suite.SUITE)
    assert {env_spec(name).id for name in ids.values()} == set(ids)
    assert set(ids) <= set(gymnasium.registry)


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


@pytest.mark.parametrize("end", [2, 3], ids=["terminated", "truncated"])
def test_an_episode_that_had_ended_waits_for_a_reset_when_it_is_restored(
    monkeypatch, end
):
    """By an error of the physics, or by the time limit."""
    single = CathSimEnv("simple1_bca", max_steps=2)
    many = CathSimVectorEnv(
        2, "simple1_bca", num_threads=1, max_steps=2, autoreset_mode="Disabled"
    )
    for env in (single, many):
        env.reset(seed=1)
        env.step(env.action_space.sample())
        running = env.snapshot()
        with monkeypatch.context() as patch:
            if end == 2:
                patch.setattr(physics_errors, "MAX_FORCE", -1.0)
            assert np.all(env.step(env.action_space.sample())[end])
        ended = env.snapshot()
        env.reset()
        env.restore(ended)
        with pytest.raises(gymnasium.error.ResetNeeded):
            env.step(env.action_space.sample())
        if env is many:  # one that is left waits on
            env.reset(options={"reset_mask": np.array([True, False])})
            with pytest.raises(gymnasium.error.ResetNeeded, match=r"of \[1\] have"):
                env.step(env.action_space.sample())
        env.restore(running)
        assert np.all(env.step(env.action_space.sample())[3])


def _everywhere(objective):
    import dataclasses

    wide = dataclasses.replace(objective.route, radii=objective.route.radii + 1.0)
    return dataclasses.replace(objective, branch=wide, ostium=-1.0)


def test_render_shows_the_image_of_the_episodes_machine():
    drawn = {"view": [4, 5], "gain": [0.85, 0.9]}
    options = {"observation": "image", "randomisation": drawn}
    options["fluoroscopy"] = {"size": 32, "biplane": "LATERAL"}
    env = gymnasium.make(TASK, render_mode="rgb_array", **options)
    image = env.reset(seed=3)[0]["image"]
    row = np.concatenate([image[..., 0], image[..., 1]], axis=1)
    np.testing.assert_array_equal(env.render(), np.stack([row] * 3, axis=-1))
    assert env.metadata["render_fps"] == 25  # a control step takes 40 ms


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


def vector(mode, vectorization="vector_entry_point", count=3, **options):
    sync = vectorization == "sync"
    return gymnasium.make_vec(
        TASK, count, vectorization, {"autoreset_mode": mode} if sync else None,
        **({} if sync else {"autoreset_mode": mode}), **options,
    )  # fmt: skip


def assert_alike(found, expected, path=""):
    """Nested dictionaries and arrays of the same values and kinds."""
    if isinstance(expected, dict):
        assert found.keys() == expected.keys(), path
        for key, value in expected.items():
            assert_alike(found[key], value, f"{path}/{key}")
    elif isinstance(expected, tuple) or (
        isinstance(expected, np.ndarray) and expected.dtype.kind == "O"
    ):
        for one, other in zip(found, expected, strict=True):
            assert_alike(one, other, path)
    else:
        assert type(found) is type(expected), path
        np.testing.assert_array_equal(found, expected, err_msg=path, strict=True)


LIVELY = {
    "randomisation": {"friction": (0.5, 1.5), "delay": (0, 2), "tracking_noise": 1e-3},
    "observation": ["internal", "force", "tracking"],
    "max_steps": 4,
}


def test_a_flat_observation_is_the_vector_of_networks():
    from cathsim_dmc.simulation.environments import VECTOR, make_env

    seen = ["tracking", "force"]
    vector = make_env("simple1_bca", observation=seen, seed=3).reset()[VECTOR]
    flat = gymnasium.wrappers.FlattenObservation(gymnasium.make(TASK, observation=seen))
    np.testing.assert_array_equal(flat.reset(seed=3)[0], vector[0].numpy())


@pytest.mark.parametrize("mode", list(gymnasium.vector.AutoresetMode))
def test_make_vec_is_the_batch_and_equals_the_single_environments(mode):
    many, single = vector(mode, **LIVELY), vector(mode, "sync", **LIVELY)
    assert isinstance(many, CathSimVectorEnv)
    assert many.metadata["autoreset_mode"] is mode
    for name in ("observation_space", "action_space", "single_observation_space"):
        assert getattr(many, name) == getattr(single, name)
    assert_alike(many.reset(seed=5), single.reset(seed=5))
    assert many.np_random_seed == 5
    many.action_space.seed(0)
    ended = np.zeros(3, bool)
    for index in range(11):
        masks = []
        if index == 2:  # episodes that end at different times
            masks = [np.array([True, True, False])]
        elif mode is gymnasium.vector.AutoresetMode.DISABLED and ended.any():
            masks = [ended]
            text = str(np.flatnonzero(ended).tolist())
            with pytest.raises(gymnasium.error.ResetNeeded, match=re.escape(text)):
                many.step(many.action_space.sample())
        for mask in masks:
            seed = [7, None, 9] if index == 2 else None
            options = [{"reset_mask": mask.copy()} for _ in range(2)]
            results = [
                env.reset(seed=seed, options=own)
                for env, own in zip((many, single), options, strict=True)
            ]
            assert_alike(*results)
        action = many.action_space.sample()
        results = [env.step(action) for env in (many, single)]
        assert_alike(*results)
        assert many.observation_space.contains(results[0][0])
        masks = [v for k, v in results[0][4].items() if k.startswith("_")]
        assert len({id(each) for each in masks}) == len(masks)  # each may be changed
        ended = results[0][2] | results[0][3]


def test_a_physics_error_ends_an_episode_of_a_vector_as_of_a_single_one(monkeypatch):
    nxt = gymnasium.vector.AutoresetMode.NEXT_STEP
    many, single = vector(nxt, count=2), vector(nxt, "sync", 2)
    many.reset(seed=0), single.reset(seed=0)
    many.simulation.batch.qvel[1] = np.nan
    single.envs[1].unwrapped.environment.physics.data.qvel[:] = np.nan
    ends = []
    usual = physics_errors.MAX_FORCE
    for limit in (usual, -1.0, usual):  # an error in both while the second one waits
        monkeypatch.setattr(physics_errors, "MAX_FORCE", limit)
        action = many.action_space.sample()
        results = [env.step(action) for env in (many, single)]
        assert_alike(*results)
        ends.append(results[0][2].tolist())
    assert ends == [[False, True], [True, False], [False, False]]


@pytest.mark.parametrize(
    "options, word",
    [
        ({"render_mode": "human"}, "render_mode"),
        ({"render_mode": ""}, "render_mode"),
        ({"autoreset_mode": "Never"}, "SameStep"),
        ({"dtype": "int8"}, "dtype"),
        ({"num_envs": 0}, "num_envs"),
        ({"num_threads": -1}, "num_threads"),
        ({"max_episode_steps": 3, "max_steps": 4}, "max_episode_steps is 3; .*be 4"),
        ({"max_episode_steps": 0}, "max_steps is 0"),
        ({"task_kwargs": {"max_steps": 3}}, "'task_kwargs'.*options themselves"),
    ],
)
def test_wrong_arguments_of_a_vector_are_refused(options, word):
    with pytest.raises(ValueError, match=word):
        CathSimVectorEnv(**{"num_envs": 2, "task": "simple1_bca", **options})


def test_a_vector_refuses_wrong_seeds_and_masks_and_shows_each_simulation():
    # Two anatomies, which breathe in different phases.
    options = {
        "fluoroscopy": {"size": 32, "biplane": "LATERAL"},
        "vessel": {"motion": {"breath_phase": (0, 1)}},
        "numbers": [10, 11],
    }
    many = CathSimVectorEnv(2, "arch_any", "rgb_array", **options)
    with pytest.raises(RuntimeError, match="reset"):
        many.step(many.action_space.sample())
    with pytest.raises(gymnasium.error.ResetNeeded):
        many.render()
    for seed in (-1, [1], [1, "a"], 1.5):
        with pytest.raises(ValueError, match="seed"):
            many.reset(seed=seed)
    for mask in ([True], np.zeros(2, bool), np.ones(2)):
        with pytest.raises(ValueError, match="reset_mask"):
            many.reset(options={"reset_mask": mask})
    first = many.reset(seed=1)[0]["position"]
    assert not np.array_equal(first, many.reset()[0]["position"])
    one = CathSimEnv("arch_any", "rgb_array", **options)
    many.reset(seed=4)
    one.reset(seed=5)
    assert len({each.anatomy for each in many.conditions}) == 2
    for _ in range(15):  # until the motion has its full amplitude
        many.step(np.zeros_like(many.action_space.low))
        one.step(np.zeros_like(one.action_space.low))
    for env in (many, one):
        env.render_mode = None
        with pytest.warns(UserWarning, match="without a render_mode"):
            assert env.render() is None
        env.render_mode = "rgb_array"
    shown = many.render()
    assert len(shown) == 2 and shown[0].shape == (32, 64, 3)
    np.testing.assert_array_equal(shown[1], one.render())
    state = one.snapshot()
    many.close()
    for _ in range(2):  # the second time, nothing is left to free
        one.close()
        assert one.environment._physics is None
    with pytest.raises(gymnasium.error.ClosedEnvironmentError, match="make another"):
        one.reset()
    step = functools.partial(many.step, many.action_space.sample())
    alone = functools.partial(one.step, one.action_space.sample())
    restore = functools.partial(one.restore, state)
    for use in (many.reset, step, alone, many.snapshot, one.snapshot, restore):
        with pytest.raises(gymnasium.error.ClosedEnvironmentError, match="another"):
            use()


def test_a_vector_takes_the_seed_of_its_task():
    def start(**options):
        return CathSimVectorEnv(2, "simple1_bca", num_threads=1, **options).reset

    reset = start()
    drawn, seen = (reset(seed=seed)[0]["position"] for seed in (None, 0))
    for random in (np.int64(0), [0, 1]):
        np.testing.assert_array_equal(start(random=random)()[0]["position"], seen)
    assert not np.array_equal(start()()[0]["position"], drawn)
    with pytest.raises(ValueError, match="random is 1.5"):
        start(random=1.5)


def test_gymnasiums_vector_wrappers_take_the_batch():
    wrappers = gymnasium.wrappers.vector
    env = gymnasium.make_vec(TASK, 2, max_episode_steps=3)
    env = wrappers.RecordEpisodeStatistics(wrappers.FlattenObservation(env))
    observation, _ = env.reset(seed=0)
    assert observation.shape == (2, *env.single_observation_space.shape)
    for _ in range(3):
        *_, info = env.step(env.action_space.sample())
    assert info["episode"]["l"].tolist() == [3, 3]


def test_torchrl_takes_the_id():
    torchrl_envs = pytest.importorskip("torchrl.envs")
    from torchrl.envs.utils import check_env_specs

    env = torchrl_envs.GymEnv(TASK, observation=["image", "force"], max_steps=5)
    check_env_specs(env)
    rollout = env.rollout(20)
    assert rollout["next", "truncated"].flatten().tolist() == [False] * 4 + [True]
    assert rollout["image"].shape == (5, 128, 128, 1)
    repeats = torchrl_envs.GymEnv(TASK, max_steps=4, frame_skip=2)
    assert len(repeats.rollout(9)) == 2


def test_torchrl_takes_the_vector():
    torchrl_envs = pytest.importorskip("torchrl.envs")
    env = gymnasium.make_vec(TASK, 2, max_steps=3, autoreset_mode="Disabled")
    rollout = torchrl_envs.GymWrapper(env).rollout(7, break_when_any_done=False)
    ends = rollout["next", "truncated"][..., 0].nonzero()
    assert ends.tolist() == [[0, 2], [0, 5], [1, 2], [1, 5]]
    last = rollout["next", "position"][:, 2]
    assert last.any() and (last != rollout["position"][:, 3]).any()


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


def test_the_batch_of_the_example_tells_stable_baselines_where_episodes_end(example):
    batch = example["Batch"]("simple1_bca", 2, max_steps=2, observation="internal")
    batch.seed(3)
    first, (size,) = batch.reset(), batch.observation_space.shape
    assert first.shape == (2, size) and batch.action_space.shape == (3,)
    alone = gymnasium.make(TASK, observation="internal", max_steps=2)
    flat = gymnasium.wrappers.FlattenObservation(alone)
    np.testing.assert_array_equal(first[1], flat.reset(seed=4)[0])
    actions = np.full((2, 3), 0.5, np.float32)
    for last in (False, True):
        observation, _, done, infos = batch.step(actions)
        row = flat.step(actions[1][batch.groups])
        assert done.tolist() == [last, last]
    np.testing.assert_array_equal(infos[1]["terminal_observation"], row[0])
    assert infos[1]["TimeLimit.truncated"]
    np.testing.assert_array_equal(observation[1], flat.reset()[0])


@pytest.mark.slow
def test_the_example_of_stable_baselines_trains_and_keeps_its_policy(example, tmp_path):
    from cathsim_dmc import agents

    settings = example["PPO_SETTINGS"]
    settings |= {"n_steps": 64, "batch_size": 64}
    model, normalise = example["untrained"]("type1_bca", 2, 0)
    model.learn(256)
    batch = normalise.venv.venv
    assert isinstance(batch.env.unwrapped, CathSimVectorEnv)
    policy = example["policy_of"](model, normalise, batch.groups)
    # What the network reads is in the order in which it was trained.
    entries = batch.env.unwrapped.single_observation_space.spaces
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
    policy = example["policy_of"](model, normalise, normalise.venv.venv.groups)
    result = agents.evaluate(
        policy, about["task"], 2, observation=example["OBSERVATION"],
        task_kwargs={"max_steps": 200},
    )  # fmt: skip
    assert result.summary()["success"] == 1.0
