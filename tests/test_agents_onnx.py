"""Policies as ONNX: the same actions on the observations of an episode, and a card."""

import json
import subprocess
import sys

import numpy as np
import pytest

from cathsim_dmc import agents, suite
from cathsim_dmc.agents import onnx_export, onnx_selftest, pretrained
from cathsim_dmc.agents.networks import network_of
from cathsim_dmc.entities.chain import MAX_PUSH_SPEED

SHORT = {"max_steps": 25}
pytest.importorskip("onnxruntime", reason="needs the extra onnx")


def require_the_same(folder, steps):
    found = onnx_selftest.differences(folder)
    assert len(found) == steps and found.max() <= 1e-5
    # The episode moves: one answer to everything would not do.
    actions = np.load(folder / "selftest.npz")["action"]
    assert np.ptp(actions, axis=0).max() > 0.01
    card = json.loads((folder / "card.json").read_text())
    assert card["self_test"]["largest_difference"] == pytest.approx(found.max())
    return card


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    folder = tmp_path_factory.mktemp("onnx") / "deep" / "lcca"
    return onnx_export.write_onnx(
        "pretrained:femoral_type1_lcca", folder, task_kwargs=SHORT
    )


def test_the_model_acts_as_the_policy_and_says_what_it_reads(exported):
    card = require_the_same(exported, 25)
    assert card["task"]["name"] == "femoral_type1_lcca"
    assert card["control_timestep"] == 0.04 and card["training"]["seed"] == 0
    (entry,) = card["inputs"]
    assert entry["shape"] == ["N", 49] and len(entry["normaliser"]["scale"]) == 49
    stops = [one["stop"] for one in entry["entries"]]
    assert [0, *stops[:-1]] == [one["start"] for one in entry["entries"]]
    assert stops[-1] == 49 and all(one["meaning"] for one in entry["entries"])
    assert [one["key"] for one in entry["entries"]] == sorted(
        one["key"] for one in entry["entries"]
    )
    last = card["output"]["entries"][-1]
    assert (last["name"], last["scale"]) == ("insertion", MAX_PUSH_SPEED)
    assert len(card["output"]["entries"]) == 21
    assert card["evaluation"]["success"] == 1.0
    about = {"task": "femoral_type1_lcca", "options": {"max_steps": 2000}}
    assert about.items() <= card["evaluation"].items()  # not of the short episode
    assert card["evaluation"]["protocol"] == "published"
    assert card["versions"]["exported"]["onnxruntime"]


def test_the_card_of_a_run_has_the_versions_of_its_training(trained):
    player = agents.load_policy(trained / "ppo")
    task = suite.make_task("type1_bca")  # which the versions do not depend on
    card = onnx_export.card_of(player, task)
    kept = json.loads((player.checkpoint.path / "checkpoint.json").read_text())
    assert card["versions"]["trained"] == kept["versions"]
    assert card["evaluation"] is None


def test_the_self_test_runs_without_the_package_and_can_fail(exported, tmp_path):
    for file in exported.iterdir():
        (tmp_path / file.name).write_bytes(file.read_bytes())
    # -I: no PYTHONPATH, so that nothing of the checkout is found.
    command = [sys.executable, "-I", "-c", (
        "import sys; sys.modules['cathsim_dmc'] = sys.modules['torch'] = None; "
        f"sys.argv = ['x', {str(tmp_path)!r}]; import runpy; "
        f"runpy.run_path({str(tmp_path / 'selftest.py')!r}, run_name='__main__')"
    )]  # fmt: skip
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "agrees: 25 actions" in done.stdout
    held = dict(np.load(tmp_path / "selftest.npz"))
    held["action"][7, 3] += 1e-4
    np.savez(tmp_path / "selftest.npz", **held)
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 1 and "DIFFERS" in done.stdout


def test_a_batch_is_answered_and_the_card_travels_in_the_model(exported):
    onnx = pytest.importorskip("onnx")
    import onnxruntime

    session = onnxruntime.InferenceSession(str(exported / "policy.onnx"))
    rows = np.zeros((7, 49), np.float32)
    (action,) = session.run(None, {"observation_vector": rows})
    assert action.shape == (7, 21)
    (held,) = onnx.load(str(exported / "policy.onnx")).metadata_props
    card = json.loads(held.value)
    assert held.key == "card" and card["policy"] == "pretrained:femoral_type1_lcca"
    assert card == json.loads((exported / "card.json").read_text())


def test_what_cannot_be_exported_is_said(exported, tmp_path, cathsim):
    with pytest.raises(FileExistsError, match="exists"):
        onnx_export.write_onnx("pretrained:navigator", exported)
    code, _, told = cathsim("export", "expert", "--out", tmp_path / "a")
    assert code == 2 and "has no network" in told
    walls = "--out", tmp_path / "a", "--wall", "prisms"
    code, _, told = cathsim("export", "pretrained:navigator", *walls)
    assert code == 2 and "leave --wall out" in told
    code, _, told = cathsim("export", "type1_lca", "--out", tmp_path / "a")
    assert code == 2 and "type1_lcca" in told and "pretrained:NAME" in told
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_a_policy_of_random_arches_plays_the_arch_of_a_number(tmp_path):
    folder = onnx_export.write_onnx(
        "pretrained:navigator", tmp_path / "a", task_kwargs={"numbers": [3], **SHORT}
    )
    card = require_the_same(folder, 25)
    assert card["task"]["options"]["numbers"] == [3]
    assert "pool" not in card["task"]["options"]


@pytest.mark.slow
@pytest.mark.parametrize("name", pretrained.pretrained_names())
def test_every_policy_that_ships_is_the_same_as_onnx(name, tmp_path):
    folder = onnx_export.write_onnx(
        f"pretrained:{name}", tmp_path / name, task_kwargs={"max_steps": 64}
    )
    found = onnx_selftest.differences(folder)
    require_the_same(folder, len(found))


@pytest.mark.slow
@pytest.mark.parametrize("observation", ["image", ("sequential", "tracking")])
@pytest.mark.parametrize("subtract", [False, True])
def test_a_policy_that_reads_images_is_the_same(observation, subtract, tmp_path):
    config = agents.make_config(
        "ppo", task="type1_bca", observation=observation, total_frames=32, num_envs=2,
        steps_per_update=32, minibatch_size=16, epochs=1, normalisation_frames=16,
        subtract_background=subtract, convolutions=((8, 8, 4), (8, 4, 2)), hidden=(16,),
        cnn_features=32,
    )  # fmt: skip
    agents.train(config, tmp_path / "run", progress=False)
    player = agents.load_policy(tmp_path / "run")
    # It has hardly learnt, and would answer with nearly the same to every image.
    network_of(player.network).mean.weight.mul_(300.0)
    folder = onnx_export.write_onnx(player, tmp_path / "out", task_kwargs=SHORT)
    card = require_the_same(folder, 25)
    image = card["inputs"][-1]
    assert (image["name"], image["dtype"]) == ("pixels", "uint8")
    assert ("mean image" in image["normaliser"]["formula"]) is subtract
