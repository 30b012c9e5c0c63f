"""The folder of a run: one process writes it, and what is lost is named."""

import functools
import shutil
import signal
import subprocess
import sys
import types
from dataclasses import replace
from pathlib import Path

import pytest
import synthetic_env
import torch
from tensordict import TensorDict
from test_agents_training import run, small_ppo, small_sac
from torchrl.envs.utils import ExplorationType, set_exploration_type

from cathsim_dmc import suite
from cathsim_dmc.agents import (
    Checkpoint,
    ConfigError,
    PPOConfig,
    evaluate,
    pretrained,
)
from cathsim_dmc.agents.checkpoint import CheckpointError
from cathsim_dmc.agents.learners import make_config
from cathsim_dmc.agents.networks import NetworkShapes, make_policy
from cathsim_dmc.agents.policies import TrainedPolicy, load_policy
from cathsim_dmc.agents.replay import ReplayError
from cathsim_dmc.agents.training import take_over
from cathsim_dmc.agents.training_log import read_metrics
from cathsim_dmc.cli import agents, task_options
from cathsim_dmc.simulation import environments
from cathsim_dmc.tasks.observation_kind import Entry, ObservationKind
from cathsim_dmc.tasks.observations import OBSERVATIONS


def test_a_second_training_in_a_folder_is_refused(tmp_path):
    def second():
        refused = pytest.raises(ConfigError, match="another process trains in")
        with refused:
            run(small_ppo(), tmp_path, make_env=unused)
        with refused:
            run(small_ppo(), tmp_path, resume=True, make_env=unused)
        called.append(True)

    def unused(*arguments, **options):
        raise AssertionError("work was begun")

    called = []
    result = run(small_ppo(), tmp_path, make_env=synthetic_env.calling(second))
    assert called and result.frames == 1_024
    frames = [row["frames"] for row in read_metrics(tmp_path / "metrics.csv")]
    assert frames == sorted(set(frames))


def test_a_folder_is_free_again_after_a_kill(tmp_path):
    script = (
        "import os, signal, sys\n"
        "from filelock import FileLock\n"
        "FileLock(sys.argv[1]).acquire()\n"
        "os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    command = [sys.executable, "-c", script, str(tmp_path / ".lock")]
    assert subprocess.run(command).returncode == -signal.SIGKILL
    assert (tmp_path / ".lock").exists()
    assert run(small_ppo(total_frames=512), tmp_path).frames == 512


def test_a_run_without_its_replay_goes_on_if_asked(tmp_path, trained):
    shutil.copytree(trained / "sac", tmp_path / "run")
    shutil.rmtree(tmp_path / "run" / "replay")
    config = small_sac(total_frames=1_536)
    lost = "replay of 768 transitions is lost: .*--without-replay"
    with pytest.raises(ReplayError, match=lost):
        run(config, tmp_path / "run", resume=True)
    with pytest.raises(ConfigError, match="without_replay=True .* is for a run that"):
        run(config, tmp_path / "run", without_replay=True)
    before = Checkpoint.open(tmp_path / "run").learning_state()["learner"]
    result = run(config, tmp_path / "run", resume=True, without_replay=True)
    assert result.metrics["replay_frames"] == 1_536 - 768
    assert result.metrics["gradient_steps"] > before["gradient_steps"]
    assert evaluate(tmp_path / "run", episodes=1, make_env=synthetic_env.make_env)


def test_a_replay_that_was_begun_anew_is_not_that_of_the_checkpoint(tmp_path, trained):
    shutil.copytree(trained / "sac", tmp_path / "run")
    killed = {"make_env": synthetic_env.calling(lambda: 1 / 0, at=9), "resume": True}
    config = small_sac(total_frames=1_536)
    with pytest.raises(ZeroDivisionError):
        run(config, tmp_path / "run", without_replay=True, **killed)
    assert list((tmp_path / "run" / "replay").glob("*.npy"))
    with pytest.raises(ReplayError, match="they are those of another process"):
        run(config, tmp_path / "run", resume=True)


@pytest.mark.parametrize(
    ("name", "full"), [("policy.pt", 20_000), ("config.json", 400)]
)
def test_a_full_disk_names_the_file(tmp_path, trained, small_disk, name, full):
    shutil.copytree(trained / "ppo", tmp_path / "run")
    before = Checkpoint.open(tmp_path / "run")
    with small_disk(full), pytest.raises(OSError, match="File too large.*" + name):
        run(small_ppo(total_frames=2_048), tmp_path / "run", resume=True)
    assert Checkpoint.open(tmp_path / "run") == before
    assert run(small_ppo(), tmp_path / "run", resume=True).frames == 1_024


@pytest.mark.parametrize("name", ["checkpoint.json", "policy.pt"])
def test_a_checkpoint_that_is_deleted_while_it_is_read_is_read_from_the_next(
    tmp_path, trained, monkeypatch, name
):
    run_folder = shutil.copytree(trained / "ppo", tmp_path / "run")
    (old,) = (run_folder / "checkpoints").iterdir()
    new = old.with_name(f"{10**6:010d}")

    def saved(self, *given, read, **options):
        if self == old / name and not new.exists():
            shutil.move(shutil.copytree(old, old.with_name("copy")), new)
            shutil.rmtree(old)  # as keep_checkpoints=1 does
        return read(self, *given, **options)

    for method in "read_text", "read_bytes":
        read = getattr(Path, method)
        monkeypatch.setattr(Path, method, functools.partialmethod(saved, read=read))
    assert load_policy(str(run_folder)).checkpoint.path == new
    (new / "policy.pt").write_bytes(b"damaged")
    with pytest.raises(CheckpointError, match="policy.pt is damaged"):
        load_policy(str(run_folder))
    with pytest.raises(CheckpointError, match="no checkpoint in"):
        load_policy(str(run_folder / "checkpoints"))


def test_what_is_no_function_is_refused_before_the_work(tmp_path):
    with pytest.raises(ConfigError, match="on_checkpoint is 'x'; it must be a functi"):
        run(small_ppo(), tmp_path / "run", on_checkpoint="x")
    assert not (tmp_path / "run").exists()
    made = synthetic_env.make_env("any", num_envs=1)
    for wrong in (made, None):
        with pytest.raises(ValueError, match="make_env is .*; it must be a function"):
            evaluate("push", "simple1_bca", 1, make_env=wrong)
        with pytest.raises(ValueError, match="make_env is .*; it must be a function"):
            run(small_ppo(), tmp_path / "run", make_env=wrong)
    with pytest.raises(ValueError, match="of make_env is None; it must be an EnvBase"):
        evaluate("push", "simple1_bca", 1, make_env=lambda *_, **options: None)


@pytest.mark.parametrize("content", [b"", b"\xff", b"seconds\n1\n", b"frames\nmany\n"])
def test_metrics_that_cannot_be_read_stop_a_run(tmp_path, trained, content):
    shutil.copytree(trained / "ppo", tmp_path / "run")
    (tmp_path / "run" / "metrics.csv").write_bytes(content)
    with pytest.raises(ConfigError, match="metrics.csv holds no metrics"):
        run(small_ppo(), tmp_path / "run", resume=True)
    assert (tmp_path / "run" / "metrics.csv").read_bytes() == content


def test_a_policy_names_a_device_and_an_observation_of_another_size(trained):
    policy = load_policy(trained / "ppo")
    with pytest.raises(ValueError, match="21 numbers, the task gives 2:.*h with obs"):
        policy.reset(types.SimpleNamespace(num_actions=2), None)
    for entries in ({}, {environments.VECTOR: torch.zeros(1, 3)}):
        with pytest.raises(ValueError, match="reads 20 numbers, the task gives [03]:"):
            policy.act(TensorDict(entries, [1]))


def test_another_number_of_actions_is_refused_before_the_task_is_made(monkeypatch):
    monkeypatch.setattr(suite, "make_task", lambda *_, **__: pytest.fail("work lost"))
    turned, text = task_options.task_kind()(rotation=True), "the task gives 22: play it"
    policy, given = "pretrained:type1_lcca", {"options": turned}
    for play in (
        lambda: agents.evaluate(policy, **given),
        lambda: agents.record(policy, out=Path("one.npz"), **given),
        lambda: agents.play("type1_lcca", policy=policy, **given),
    ):
        with pytest.raises(ValueError, match=f"has actions of 21 numbers, {text}"):
            play()


def test_a_policy_that_ships_starts_a_training():
    source = load_policy("pretrained:type1_bca")
    settings = {**source.config.to_dict(), "initial_policy": "pretrained:type1_bca"}
    config = make_config(settings.pop("algorithm"), **settings)
    policy = make_policy(source.shapes, config)
    take_over(policy, config, source.shapes)
    state = policy.state_dict()
    for name, value in source.network.state_dict().items():
        torch.testing.assert_close(state[name], value, rtol=0, atol=0)
    with pytest.raises(ConfigError, match="does not fit .*sizes"):
        take_over(policy, config, NetworkShapes(3, None, 21))
    with pytest.raises(ConfigError, match="'expert' has no network"):
        take_over(policy, config.replace(initial_policy="expert"), source.shapes)


def test_a_policy_that_observes_less_starts_a_training():
    """At first the new one acts as it does, whatever the new entries are."""
    source = load_policy("pretrained:femoral_type1_lcca_living")
    assert isinstance(source, TrainedPolicy)
    wider = {"observation": ("route", "route_retry")}
    name = {"initial_policy": "pretrained:femoral_type1_lcca_living"}
    config = source.config.replace(**wider, **name)
    shapes = replace(source.shapes, vector=source.shapes.vector + 11)
    policy = make_policy(shapes, config)
    take_over(policy, config, shapes)
    seen, more = torch.randn(5, source.shapes.vector), torch.rand(5, 11)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        expected = source.network(TensorDict({environments.VECTOR: seen}, [5]))
        both = {environments.VECTOR: torch.cat([seen, more], -1)}
        found = policy(TensorDict(both, [5]))
    torch.testing.assert_close(found["action"], expected["action"])
    # Those that come first, or take others away, are refused.
    for other in (("force", "route"), ("tracking", "route_retry")):
        with pytest.raises(ConfigError, match="does not fit .*observation: it has"):
            take_over(policy, config.replace(observation=other), shapes)


def test_entries_of_other_names_start_no_training(tmp_path, monkeypatch):
    """Only those of the route and of its reconstruction stand for each other."""
    for name in ("tip_speed", "base_speed"):
        row = ObservationKind(lambda frame: {}, (Entry(name, 3, "m/s", ""),))
        monkeypatch.setitem(OBSERVATIONS, name, row)
    config, shapes = make_config("ppo", hidden=(8,)), NetworkShapes(3, None, 2)
    policy = make_policy(shapes, config)

    def start(observation, other):
        own = config.replace(observation=observation).to_dict()
        card = {"task": config.task, "config": own, "shapes": shapes.to_dict()}
        card |= {"task_kwargs": {}, "training": {}, "evaluation": {}}
        weights = pretrained.write(tmp_path, "source", policy.state_dict(), card)
        changes = {"observation": other, "initial_policy": str(weights)}
        take_over(policy, config.replace(**changes), shapes)

    start("tip_speed", "tip_speed")
    start("route", "biplane")
    with pytest.raises(ConfigError, match="observation: it has 'tip_speed', given is"):
        start("tip_speed", "base_speed")


def test_what_a_policy_of_images_observes_besides_may_grow(tmp_path):
    """Networks read numbers that are new before the features of the images."""
    config = make_config(
        "ppo", hidden=(8,), cnn_features=4, convolutions=((2, 8, 8),),
        observation=("image", "route", "route_retry"),
    )  # fmt: skip
    wider = NetworkShapes(7, (1, 16, 16), 2)
    policy = make_policy(wider, config)

    def started_from(observation, vector):
        own = config.replace(observation=observation)
        shapes = replace(wider, vector=vector)
        source = make_policy(shapes, own)
        card = {"task": own.task, "config": own.to_dict(), "shapes": shapes.to_dict()}
        card |= {"task_kwargs": {}, "training": {}, "evaluation": {}}
        weights = pretrained.write(tmp_path, "source", source.state_dict(), card)
        take_over(policy, config.replace(initial_policy=str(weights)), wider)
        return source

    source = started_from(("image", "route"), 5)
    images = {environments.PIXELS: torch.randint(256, (3, 1, 16, 16)).byte()}
    seen, more = torch.randn(3, 5), torch.rand(3, 2)
    expected = source(TensorDict({environments.VECTOR: seen, **images}, [3]))
    both = {environments.VECTOR: torch.cat([seen, more], -1), **images}
    torch.testing.assert_close(policy(TensorDict(both, [3]))["loc"], expected["loc"])
    # Hidden layers come with numbers alone.
    with pytest.raises(ConfigError, match=r"does not fit .*sizes: .*\(vector=0"):
        started_from("image", 0)


@pytest.mark.parametrize("config", ["ppo", {"task": "reach"}, PPOConfig])
def test_what_is_no_settings_is_refused(tmp_path, config):
    with pytest.raises(ConfigError, match="config is .*as make_config"):
        run(config, tmp_path / "run")


def test_a_start_that_fails_leaves_no_folder(tmp_path):
    def broken(*arguments, **options):
        raise ValueError("no such task")

    with pytest.raises(ValueError, match="no such task"):
        run(small_ppo(), tmp_path / "run", make_env=broken)
    assert not list(tmp_path.iterdir())


def test_a_run_whose_length_cannot_change_says_why(tmp_path):
    run(small_ppo(anneal=True), tmp_path)
    with pytest.raises(ConfigError, match="learning rate of this run falls") as error:
        run(small_ppo(anneal=True, total_frames=2_048), tmp_path, resume=True)
    assert "total_frames" not in str(error.value).split("may change")[1]
