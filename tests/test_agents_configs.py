import json

import pytest

from cathsim_dmc.agents import ConfigError, PPOConfig, SACConfig, make_config
from cathsim_dmc.agents.learners import LEARNERS, check_usable, config_from_dict
from cathsim_dmc.recording.dataset import DatasetError


def test_ppo_defaults_are_the_published_settings():
    config = PPOConfig()
    published = {
        "minibatch_size": 32, "steps_per_update": 512, "epochs": 20, "gamma": 0.99,
        "gae_lambda": 0.95, "clip": 0.1, "entropy_coefficient": 5.85e-4,
        "value_coefficient": 0.872, "max_grad_norm": 1.0, "learning_rate": 3e-4,
        "hidden": (64, 64), "activation": "tanh", "total_frames": 600_000,
    }  # fmt: skip
    assert {name: getattr(config, name) for name in published} == published


@pytest.mark.parametrize(
    ("algorithm", "preset"),
    [(name, preset) for name, a in LEARNERS.items() for preset in a.config.presets],
)
def test_configs_survive_json(algorithm, preset):
    config = make_config(algorithm, preset, seed=7, task_kwargs={"links": [1, 2]})
    again = config_from_dict(json.loads(json.dumps(config.to_dict())))
    assert again == config
    assert again.seed == 7
    # Two minutes of work are lost at most, whatever is not said.
    assert config.checkpoint_seconds <= 120


@pytest.mark.parametrize(
    ("kind", "settings", "message"),
    [
        (PPOConfig, {"num_envs": 7}, "num_envs is 7; .*divisor.*steps_per_update=512"),
        (PPOConfig, {"minibatch_size": 100}, "minibatch_size is 100"),
        (PPOConfig, {"task_kwargs": {"a": float("inf")}}, "task_kwargs.*finite"),
        (SACConfig, {"random_frames": 10}, "random_frames is 10.*256"),
        (SACConfig, {"replay_frames": 32}, "replay_frames is 32"),
        (PPOConfig, {"hidden": ()}, "hidden is .*one entry or more"),
        (
            PPOConfig,
            {"training_start": (0.1, 0.2, 0.3)},
            "training_start .*two fractions",
        ),
    ],
)
def test_bad_values_are_named(kind, settings, message):
    with pytest.raises(ConfigError, match=message):
        kind(**settings)


def test_a_setting_that_is_no_more_does_not_hinder_an_older_run():
    assert config_from_dict({**PPOConfig().to_dict(), "tensorboard": True}) == (
        PPOConfig()
    )


def test_what_is_missing_is_told_before_the_environment_is_made():
    with pytest.raises(DatasetError, match="no dataset in nowhere"):
        check_usable(make_config("sac", demonstrations="nowhere"))
    with pytest.raises(ValueError, match="--import no_such_module"):
        check_usable(make_config(task="own_task", modules=["no_such_module"]))


def test_options_of_the_evaluation_alone_are_checked_before_a_training():
    own, path = {"reward": {"paht": -1.0}}, {"path": -1.0}
    config = make_config(task="simple1_bca", training_reward=path, task_kwargs=own)
    with pytest.raises(ValueError, match="reward is {'paht': -1.0}"):
        check_usable(config)
    check_usable(config.replace(task_kwargs={"reward": path}))


def test_unknown_names_list_the_valid_ones():
    with pytest.raises(ConfigError, match="ppo.*sac"):
        make_config("dqn")
    with pytest.raises(ConfigError, match="published.*demo"):
        make_config("ppo", "fastest")
    with pytest.raises(ConfigError, match="learning_rate"):
        make_config("ppo", learn_rate=1.0)


def test_an_observation_of_policy_and_critic_is_collected_once():
    config = PPOConfig(observation="image", critic_observation=("internal", "image"))
    assert config.collected_observation == ("image", "internal")


def test_what_is_for_the_training_replaces_the_options_of_the_task():
    own = {"training_reward": {"path": -1.0}, "training_max_steps": 120}
    given = {"max_steps": 300, "reward": {"time": -1.0}, "goal_radius": 0.01}
    found = PPOConfig(task_kwargs=given, training_start=(0.0, 0.5), **own)
    assert found.training_kwargs == {
        "max_steps": 120, "reward": {"path": -1.0}, "goal_radius": 0.01,
        "start_along_route": (0.0, 0.5),
    }  # fmt: skip


def test_only_settings_that_learning_does_not_depend_on_may_change():
    config = PPOConfig()
    longer = config.replace(
        total_frames=1_000_000, num_threads=1, torch_threads=2, torch_device="cuda",
        simulation_device="cuda", torch_compile=True, checkpoint_frames=1,
        checkpoint_seconds=1.0, keep_checkpoints=1, metrics_frames=1, logger="csv",
        modules=["own"], collector="ray", collectors=4,
    )  # fmt: skip
    assert config.changed_for_resume(longer) == {}
    other = config.replace(clip=0.2, seed=3)
    assert config.changed_for_resume(other) == {"clip": (0.1, 0.2), "seed": (0, 3)}
    annealed = config.replace(anneal=True)
    assert "total_frames" in annealed.changed_for_resume(
        annealed.replace(total_frames=1_000)
    )
    assert config.resumable - annealed.resumable == {"total_frames"}
    assert "demonstrations" not in config.resumable  # PPO has none
    shown = make_config("sac", demonstrations="here")
    assert shown.changed_for_resume(shown.replace(demonstrations="moved")) == {}
    alone = shown.replace(demonstrations=None)
    assert shown.changed_for_resume(alone) == {"demonstrations": ("here", None)}
    assert alone.changed_for_resume(shown) == {"demonstrations": (None, "here")}
