"""The folder of a run: one process writes it, and what is lost is named."""

import json
import shutil
import signal
import subprocess
import sys
import types

import pytest
import synthetic_env
import torch
from tensordict import TensorDict
from test_agents_training import run, small_ppo, small_sac

from cathsim_dmc.agents import Checkpoint, CheckpointError, ConfigError, evaluate
from cathsim_dmc.agents import checkpoint as checkpoints
from cathsim_dmc.agents.learners import make_config, make_policy
from cathsim_dmc.agents.networks import NetworkShapes
from cathsim_dmc.agents.policies import load_policy
from cathsim_dmc.agents.replay import ReplayError
from cathsim_dmc.agents.training_log import read_metrics
from cathsim_dmc.agents.warm_start import take_over
from cathsim_dmc.simulation import environments


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


def test_a_lock_that_is_removed_during_the_training_ends_it(tmp_path):
    remove = synthetic_env.calling((tmp_path / ".lock").unlink, at=40)
    with pytest.raises(RuntimeError, match="lock was removed.*resume the run"):
        run(small_ppo(), tmp_path, make_env=remove)
    assert not (tmp_path / "checkpoints").exists()
    assert run(small_ppo(), tmp_path, resume=True).frames == 1_024


def test_a_policy_is_not_played_with_another_device(trained):
    policy = load_policy(trained / "ppo")
    view = types.SimpleNamespace(num_actions=2)
    with pytest.raises(ValueError, match="21 entries, the task has 2.*reach"):
        policy.reset(view, None)


def test_a_replay_that_is_deleted_during_the_training_is_written_again(tmp_path):
    remove = synthetic_env.calling(lambda: shutil.rmtree(tmp_path / "replay"), at=40)
    result = run(small_sac(), tmp_path, make_env=remove)
    assert (tmp_path / "replay").is_dir()
    more = run(small_sac(total_frames=1_280), tmp_path, resume=True)
    assert more.metrics["replay_frames"] == result.metrics["replay_frames"] + 256


def test_a_run_without_its_replay_goes_on_if_asked(tmp_path, trained):
    shutil.copytree(trained / "sac", tmp_path / "run")
    shutil.rmtree(tmp_path / "run" / "replay")
    config = small_sac(total_frames=1_536)
    lost = "replay of 768 transitions is lost: .*--without-replay"
    with pytest.raises(ReplayError, match=lost):
        run(config, tmp_path / "run", resume=True)
    before = Checkpoint.open(tmp_path / "run").learning_state()["learner"]
    result = run(config, tmp_path / "run", resume=True, without_replay=True)
    assert result.metrics["replay_frames"] == 1_536 - 768
    assert result.metrics["gradient_steps"] > before["gradient_steps"]
    assert evaluate(tmp_path / "run", episodes=1, make_env=synthetic_env.make_env)


def edited(folder, change):
    """Change the description of a run's checkpoint."""
    path = Checkpoint.open(folder).path / "checkpoint.json"
    values = json.loads(path.read_text())
    change(values)
    path.write_text(json.dumps(values))


def test_weights_are_compared_before_networks_are_built(tmp_path, trained, monkeypatch):
    shutil.copytree(trained / "ppo", tmp_path / "run")
    huge = [16_384] * 16
    edited(tmp_path / "run", lambda v: v["config"].update(hidden=huge))
    made, make = [], checkpoints.make_policy

    def watched(*arguments):
        policy = make(*arguments)
        made.extend(p.device.type for p in policy.parameters())
        return policy

    monkeypatch.setattr(checkpoints, "make_policy", watched)
    with pytest.raises(CheckpointError, match="policy.pt does not fit the network"):
        Checkpoint.open(tmp_path / "run").policy()
    with pytest.raises(CheckpointError, match="policy.pt does not fit the network"):
        config = small_ppo(total_frames=1_024, hidden=huge)
        run(config, tmp_path / "run", resume=True, make_env=None)
    assert set(made) == {"meta"}


def test_weights_that_are_not_finite_are_refused(tmp_path, trained):
    shutil.copytree(trained / "ppo", tmp_path / "run")
    path = Checkpoint.open(tmp_path / "run").path / "policy.pt"
    state = torch.load(path, weights_only=True)
    name = next(iter(state))
    state[name] = state[name] * float("nan")
    torch.save(state, path)
    digest = checkpoints.hashlib.sha256(path.read_bytes()).hexdigest()
    edited(tmp_path / "run", lambda v: v["sha256"].update({"policy.pt": digest}))
    with pytest.raises(CheckpointError, match=f"policy.pt .* not finite .*{name}"):
        evaluate(tmp_path / "run", episodes=1, make_env=synthetic_env.make_env)


@pytest.mark.parametrize("change", [torch.Tensor.to_sparse, lambda w: w.to("meta")])
def test_weights_that_are_no_plain_arrays_are_refused(change):
    shapes, config = NetworkShapes(3, None, 2), small_ppo()
    state = make_policy(shapes, config).state_dict()
    checkpoints.require_fit("policy.pt", state, shapes, config)
    name = next(key for key, weight in state.items() if weight.ndim == 2)
    with pytest.raises(CheckpointError, match="policy.pt does not fit the network"):
        state[name] = change(state[name])
        checkpoints.require_fit("policy.pt", state, shapes, config)


@pytest.mark.parametrize(
    ("name", "full"), [("policy.pt", 20_000), ("config.json", 400)]
)
def test_a_full_disk_names_the_file_and_what_is_safe(
    tmp_path, trained, small_disk, name, full
):
    shutil.copytree(trained / "ppo", tmp_path / "run")
    before = Checkpoint.open(tmp_path / "run")
    safe = r".*: File too large; the first 512 frames are safe .*checkpoints.*--resume"
    with small_disk(full), pytest.raises(OSError, match=name + safe) as caught:
        run(small_ppo(total_frames=2_048), tmp_path / "run", resume=True)
    assert "\n" not in str(caught.value)
    assert Checkpoint.open(tmp_path / "run") == before
    assert run(small_ppo(), tmp_path / "run", resume=True).frames == 1_024


def test_a_policy_names_an_observation_of_another_size(trained):
    policy = load_policy(trained / "ppo")
    for entries in ({}, {environments.VECTOR: torch.zeros(1, 3)}):
        with pytest.raises(ValueError, match="reads 20 numbers, the task gives [03]:"):
            policy.act(TensorDict(entries, [1]))


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


def test_a_start_that_fails_leaves_no_folder(tmp_path):
    def broken(*arguments, **options):
        raise ValueError("no such task")

    with pytest.raises(ValueError, match="no such task"):
        run(small_ppo(), tmp_path / "run", make_env=broken)
    assert not list(tmp_path.iterdir())
