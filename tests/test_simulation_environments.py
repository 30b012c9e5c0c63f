import functools
import types

import numpy as np
import pytest
import torch
from conftest import twin
from dm_env.specs import BoundedArray
from tensordict import TensorDict
from torchrl.data import Bounded
from torchrl.envs import DMControlEnv, check_env_specs

from cathsim_dmc import suite
from cathsim_dmc.agents import evaluate, make_config, make_env, train
from cathsim_dmc.agents.networks import NetworkShapes
from cathsim_dmc.agents.policies import TrainedPolicy
from cathsim_dmc.simulation import environments, episodes
from cathsim_dmc.simulation.torchrl import BatchedEnv
from cathsim_dmc.tasks import rehearsal
from cathsim_dmc.tasks.rollout import Rollout

TASK = "simple1_bca"


def test_every_face_takes_its_specs_from_the_table_without_an_episode(monkeypatch):
    gymnasium = pytest.importorskip("gymnasium")
    import cathsim_dmc.gym  # noqa: F401  registers the ids

    task_name = f"{TASK}_pair"
    task = suite.make_task(task_name)
    monkeypatch.setattr(
        suite, "make_task", lambda name, random=0, **options: twin(task, **options)
    )
    monkeypatch.setattr(Rollout, "begin", None)
    # An episode in a copy may compile loops, of which specs know nothing.
    monkeypatch.setattr(rehearsal, "is_due", lambda config: False)
    options = {"observation": ("image", "route", "tracking_2d", "force")}
    table = twin(task, **options).observation_specs
    assert {"image", "device_points"} < table.keys()
    composer = suite.load("cathsim", task_name, options)
    assert dict(composer.observation_spec()) == table
    single = gymnasium.make(f"cathsim/{task_name}-v0", **options).unwrapped
    spaces = dict(single.observation_space)
    assert spaces.keys() == table.keys()
    batched = BatchedEnv(task_name, 2, num_threads=1, **options)
    assert set(batched.observation_spec.keys()) == {*table, "info"}
    assert list(batched.observation_spec["info"].keys()) == list(task.info_types)
    of_composer = DMControlEnv("cathsim", task_name, **options).observation_spec
    for key, spec in table.items():
        box, bounded = spaces[key], isinstance(spec, BoundedArray)
        ends = (spec.minimum, spec.maximum) if bounded else (-np.inf, np.inf)
        assert box.shape == spec.shape
        assert (box.low == np.float32(ends[0])).all()
        assert (box.high == np.float32(ends[1])).all()
        for tensors in (batched.observation_spec[key][0], of_composer[key]):
            assert tensors.shape == spec.shape
            assert isinstance(tensors, Bounded) == bounded
            if bounded:
                assert (tensors.space.low == float(ends[0])).all()
                assert (tensors.space.high == float(ends[1])).all()
    monkeypatch.undo()
    assert tuple(batched.reset()["info"].keys()) == tuple(task.info_types)


def test_a_task_satisfies_torchrl_and_gives_what_was_asked(tmp_path):
    env = make_env(
        TASK, observation=("sequential", "tracking"), num_envs=2, num_threads=1,
        task_kwargs={"max_steps": 5},
    )  # fmt: skip
    check_env_specs(env)
    shapes = NetworkShapes.of(env.observation_spec, env.action_spec)
    assert shapes.pixels == (3, 128, 128)
    assert shapes.actions == 21
    steps = env.rollout(7, break_when_any_done=False)
    assert steps["pixels"].dtype == torch.uint8
    assert steps["pixels"].float().std() > 1
    assert steps["observation_vector"].dtype == torch.float32
    assert steps["observation_vector"].isfinite().all()
    ended = steps["next", "truncated"][:, :, 0]
    assert ended.nonzero()[:, 1].tolist() == [4, 4]
    assert not steps["next", "terminated"].any()
    assert not steps["next", "info", "physics_error"].any()
    # The new episode begins with a history of its own: three equal images.
    fresh = steps["pixels"][:, 5]
    assert torch.equal(fresh[:, 0], fresh[:, 2])
    environments.record_errors(env, tmp_path)
    assert env.base_env.simulation.error_files.folder == tmp_path


def test_a_task_trains_and_evaluates(tmp_path):
    config = make_config(
        "ppo", task=TASK, task_kwargs={"max_steps": 8}, num_envs=4, num_threads=1,
        steps_per_update=64, epochs=1, total_frames=64, normalisation_frames=16,
    )  # fmt: skip
    result = train(config, tmp_path, progress=False)
    assert result.metrics["episodes"] == 8
    assert result.metrics["mean_force"] is not None
    outcome = evaluate(tmp_path, episodes=2, num_threads=1, out_dir=tmp_path)
    assert outcome.task == TASK
    assert [episode.length for episode in outcome.episodes] == [8, 8]


def test_images_of_different_sizes_are_refused_by_name():
    with pytest.raises(
        ValueError, match=r"endoluminal 128 x 128, image 64 x 64 pixels"
    ):
        environments.make_env(
            "type1_bca",
            observation=["image", "endoluminal"],
            task_kwargs={"fluoroscopy": {"size": 64}},
        )


def test_images_become_the_channels_in_the_order_of_their_names():
    images = {
        name: torch.full((1, 8, 6, n), n).byte() for n, name in ((2, "b"), (1, "a"))
    }
    seen = environments.standard(images, 1)[environments.PIXELS]
    assert seen.shape == (1, 3, 8, 6) and seen[0, :, 0, 0].tolist() == [1, 2, 2]


def test_a_policy_of_images_names_those_of_another_size():
    policy = object.__new__(TrainedPolicy)
    policy.name, policy.task, policy.task_kwargs = "looks", "type1_bca", {}
    policy.network = types.SimpleNamespace(in_keys=[environments.PIXELS])
    policy.shapes = types.SimpleNamespace(pixels=(1, 48, 48))
    for shape, words in (((1, 47, 47), r"\(1, 47, 47\)"), (None, "None")):
        seen = {} if shape is None else {environments.PIXELS: torch.zeros(1, *shape)}
        with pytest.raises(ValueError, match=rf"\(1, 48, 48\) as .* gives {words}"):
            policy._answer(TensorDict(seen, [1]))


def test_episodes_that_are_ended_early_begin_anew_while_others_go_on():
    """The first by who looks on, the second by itself; the third ends all."""
    none, second, third = [0, 0, 0], [0, 1, 0], [0, 0, 1]
    ends, begun, reset = iter([none, second, none, third, none]), [], []

    def step(action=None):
        ended = np.zeros(3, bool) if action is None else np.array(next(ends), bool)
        none = np.zeros(3, bool)
        return types.SimpleNamespace(observation={}, terminated=ended, truncated=none)

    def restart(indices=None):
        reset.append(None if indices is None else indices.tolist())
        return step()

    simulation = types.SimpleNamespace(num_simulations=3, step=step, reset=restart)
    play = functools.partial(
        episodes.play, simulation, lambda observation: np.zeros((3, 1)),
        lambda mask: begun.append([*mask]),
    )  # fmt: skip
    played = []
    for turn in play():
        played.append(turn.running.tolist())
        if len(played) == 2:
            turn.running[0] = False
    assert reset == [None, [0], [1]]
    assert begun == [[True] * 3, [True, False, False], [False, True, False]]
    assert played[2:] == [[False, True, True], *[[False, False, True]] * 2]
    turns = play()
    next(turns).running[0] = False  # before its first step
    next(turns)
    assert begun[3:] == [[True] * 3]
