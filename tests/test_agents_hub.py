"""Policies and datasets by hf:OWNER/NAME, against a folder with the hub's layout.

The hub's own client reads them, from its cache; what it uploads lands in that cache.
"""

import hashlib
import json
import shutil
import types

import numpy as np
import pytest
from test_play_hands import by_hand  # noqa: F401

from cathsim_dmc import __version__, agents
from cathsim_dmc.agents import hub, sharing
from cathsim_dmc.analysis.force_statistics import millinewtons

huggingface_hub = pytest.importorskip("huggingface_hub", reason="needs the extra hub")
COMMIT = "0123456789abcdef0123456789abcdef01234567"


@pytest.fixture
def local(tmp_path, monkeypatch):
    """Folder that stands for the hub; `made` has what was asked of it."""
    from huggingface_hub import constants, file_download

    cache = tmp_path / "hub"
    cache.mkdir()
    for module in (constants, file_download):
        if hasattr(module, "HF_HUB_CACHE"):
            monkeypatch.setattr(module, "HF_HUB_CACHE", str(cache))
    monkeypatch.setattr(constants, "HF_HUB_OFFLINE", True)
    made = []

    def folder(repo_id, repo_type):
        owner, name = repo_id.split("/")
        return cache / f"{repo_type}s--{owner}--{name}"

    class Api:
        def create_repo(self, repo_id, repo_type, private, exist_ok):
            made.append((repo_id, repo_type, private))
            (folder(repo_id, repo_type) / "snapshots").mkdir(
                parents=True, exist_ok=exist_ok
            )

        def upload_folder(self, repo_id, repo_type, folder_path, commit_message):
            shutil.copytree(
                folder_path, folder(repo_id, repo_type) / "snapshots" / COMMIT
            )
            return types.SimpleNamespace(oid=COMMIT)

    monkeypatch.setattr(huggingface_hub, "HfApi", Api)
    return types.SimpleNamespace(cache=cache, made=made)


def test_a_policy_comes_back_as_it_went(local, cathsim):
    code, out, _ = cathsim("upload", "pretrained:femoral_type1_lcca", "hf:me/lcca")
    reference = out.strip()
    assert code == 0 and reference == f"hf:me/lcca@{COMMIT}"
    assert local.made == [("me/lcca", "model", True)]
    first = agents.load_policy("pretrained:femoral_type1_lcca")
    second = agents.load_policy(reference)
    assert second.task == first.task and second.card["evaluation"]
    for name, tensor in first.network.state_dict().items():
        assert (second.network.state_dict()[name] == tensor).all()
    snapshot = local.cache / "models--me--lcca" / "snapshots" / COMMIT
    assert sorted(one.name for one in snapshot.iterdir()) == [
        "README.md", "lcca.json", "lcca.safetensors",
    ]  # fmt: skip
    page = (snapshot / "README.md").read_text()
    assert "Success 100 % of 30 episodes" in page and "cathsim eval hf:me/lcca@" in page
    forces = second.card["evaluation"]["summary"]["forces"]
    shown = millinewtons(forces["mean_max"]["maximum"]["mean"])
    assert f"max force {shown} mN" in page
    assert shown != millinewtons(forces["max"]["maximum"]["mean"])


@pytest.mark.parametrize("by", ["cathsim eval", "evaluate", "an earlier checkpoint"])
def test_a_run_is_uploaded_with_what_it_reached(local, trained, tmp_path, by):
    run = tmp_path / "run"
    shutil.copytree(trained / "ppo", run)
    frames = agents.Checkpoint.open(run).frames - (by == "an earlier checkpoint")
    settings = {"frames": frames, "protocol": "varied", "task_kwargs": {"lead": 0.1}}
    reached = {"settings": settings, "policy": "ppo", "task": "type2_lcca"}
    reached["summary"] = {"episodes": 4, "success": 0.5}
    written = reached if by == "evaluate" else {"policy": reached}
    (run / "evaluation.json").write_text(json.dumps(written))
    reference = sharing.upload(run, "hf:me/all#ppo_small", private=False)
    assert reference == f"hf:me/all@{COMMIT}#ppo_small" and not local.made[0][2]
    policy, same = agents.load_policy(reference), agents.load_policy(run)
    assert policy.card["training"]["frames"] == same.checkpoint.frames
    early = by.startswith("an")
    assert policy.card["evaluation"] == ({} if early else reached)
    (page,) = local.cache.rglob("README.md")
    where = 'of `type2_lcca`, protocol varied, options `{"lead": 0.1}`'
    shown = "Not evaluated." if early else f"Success 50 % of 4 episodes {where}."
    assert shown in page.read_text()
    for name, tensor in same.network.state_dict().items():
        assert (policy.network.state_dict()[name] == tensor).all()


def test_a_shared_card_has_the_versions_of_the_training(local, trained, tmp_path):
    run = tmp_path / "run"
    shutil.copytree(trained / "ppo", run)
    path = agents.Checkpoint.open(run).path / "checkpoint.json"
    values = json.loads(path.read_text())
    assert values["versions"]["cathsim-dmc"] == __version__
    values["versions"]["mujoco"] = "3.0.0"
    path.write_text(json.dumps(values))
    card = agents.load_policy(sharing.upload(run, "hf:me/old")).card
    assert card["versions"] == values["versions"]


def test_damaged_weights_and_those_that_are_not_there_are_refused(local):
    reference = sharing.upload("pretrained:navigator", "hf:me/nav")
    (weights,) = local.cache.rglob("*.safetensors")
    data = bytearray(weights.read_bytes())
    data[-1] ^= 1
    weights.write_bytes(data)
    with pytest.raises(agents.CheckpointError, match="damaged"):
        agents.load_policy(reference)
    with pytest.raises(ValueError, match=f"hf:me/none@{COMMIT}, none.json"):
        agents.load_policy(f"hf:me/none@{COMMIT}")
    assert hashlib.sha256(data).hexdigest()


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("hf:me/nav", "names no commit.*hf:me/nav@"),
        ("hf:me/nav@main", "no repository on the hub"),
        (f"hf:nav@{COMMIT}", "no repository on the hub"),
        (f"hf:me/../nav@{COMMIT}", "no repository on the hub"),
        (f"hf:me/nav@{COMMIT}#../x", "no repository on the hub"),
    ],
)
def test_only_a_pinned_commit_is_fetched(local, text, said):
    for fetch in (agents.load_policy, hub.dataset):
        with pytest.raises(ValueError, match=said):
            fetch(text)
    with pytest.raises(ValueError):
        sharing.upload("pretrained:navigator", text if "@" in text else "me/nav")
    assert not local.made


@pytest.mark.parametrize(
    "text", ["hf:me", "me/nav", f"hf:me@{COMMIT}", f"hf:me/nav@{COMMIT}"]
)
def test_an_upload_asks_for_no_commit(local, text):
    words = "give hf:OWNER/NAME, without a commit|makes a commit of its own; leave @"
    with pytest.raises(ValueError, match=words):
        sharing.upload("pretrained:navigator", text)
    assert not local.made


def test_weights_and_card_of_two_commits_are_refused(monkeypatch, tmp_path):
    def download(repository, file, revision):
        return tmp_path / file.rpartition(".")[2] / file

    monkeypatch.setattr(huggingface_hub, "hf_hub_download", download)
    with pytest.raises(ValueError, match="weights and card are not of one commit"):
        hub.policy(f"hf:me/nav@{COMMIT}")


def test_episodes_of_a_hand_are_learnt_from_where_they_lie(local, by_hand, tmp_path):  # noqa: F811
    shutil.copytree(by_hand, tmp_path / "hand")
    (tmp_path / "hand" / "notes.py").write_text("raise SystemExit")
    reference = sharing.upload(tmp_path / "hand", "hf:me/hand")
    assert local.made == [("me/hand", "dataset", True)]
    assert reference == f"hf:me/hand@{COMMIT}"
    folder = hub.dataset(reference)
    assert not list(folder.glob("*.py")) and len(list(folder.glob("*.npz"))) == 2
    env = agents.make_env("simple1_bca", observation="tracking")
    from cathsim_dmc.agents.demonstrations import load_transitions
    from cathsim_dmc.agents.networks import NetworkShapes

    shapes = NetworkShapes.of(env.observation_spec, env.action_spec)
    far, near = (
        load_transitions(place, "tracking", shapes, task="simple1_bca")
        for place in (reference, by_hand)
    )
    np.testing.assert_array_equal(far["action"], near["action"])
