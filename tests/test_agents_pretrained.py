"""Policies that ship: what their files hold, and that they keep their promises."""

import json

import export
import judgement
import numpy as np
import pytest
import synthetic_env

from cathsim_dmc import agents
from cathsim_dmc.agents import Checkpoint, CheckpointError, load_policy, pretrained
from cathsim_dmc.agents.learners import make_config
from cathsim_dmc.agents.training import train
from cathsim_dmc.analysis.intervals import success_interval
from cathsim_dmc.tasks.config import MAX_STEPS

SHIPPED = pretrained.pretrained_names()
LARGEST_SIZE = 3 * 2**20  # bytes, of all together


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """(Checkpoint, path of the weights) of a policy of the small environment."""
    directory = tmp_path_factory.mktemp("exported")
    config = make_config(
        "ppo", "demo", total_frames=512, num_envs=8, steps_per_update=256, hidden=[8],
        normalisation_frames=16, clip=0.3, task_kwargs={"max_steps": 20},
    )  # fmt: skip
    run = directory / "run"
    train(config, run, progress=False, make_env=synthetic_env.make_env)

    def judge(policy, task, task_kwargs, episodes, name):
        found = agents.evaluate(
            policy, task, episodes, name=name, task_kwargs={},
            make_env=synthetic_env.make_env,
        )  # fmt: skip
        return found, None

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(judgement, "judge", judge)
        weights = export.export(run, "small", directory / "ship", episodes=4)
    return Checkpoint.open(run), weights


def test_the_card_says_what_was_trained_and_reached(exported):
    checkpoint, weights = exported
    card = pretrained.read_card(weights.with_suffix(".json"))
    assert card["name"] == "small" and card["task"] == "type1_bca"
    assert card["task_kwargs"] == {"max_steps": MAX_STEPS}
    assert card["training"]["frames"] == checkpoint.frames == 512
    assert card["evaluation"]["summary"]["episodes"] == 4
    assert len(card["evaluation"]["episodes"]["success"]) == 4
    listed = (weights.parent / "README.md").read_text()
    assert "`pretrained:small`" in listed and card["config"]["clip"] == 0.3


def test_a_file_acts_as_its_checkpoint(exported):
    checkpoint, weights = exported
    env = synthetic_env.make_env("", num_envs=5, seed=3)
    observation = env.reset()
    first, second = load_policy(checkpoint), load_policy(weights)
    assert second.name == "pretrained:small"
    assert (second.task, second.observation) == ("type1_bca", "internal")
    assert second.task_kwargs == {"max_steps": MAX_STEPS}
    actions = second.act(observation)
    assert actions.shape == (5, synthetic_env.ACTIONS)
    assert (first.act(observation) == actions).all()


def test_the_file_holds_tensors_and_no_pickle(exported):
    _, weights = exported
    data = weights.read_bytes()
    header = json.loads(data[8 : 8 + int.from_bytes(data[:8], "little")])
    assert all(entry["dtype"].startswith("F") for entry in header.values())


def test_an_unknown_name_lists_those_that_ship():
    with pytest.raises(CheckpointError, match="pretrained:nonsense; there are"):
        load_policy("pretrained:nonsense")


@pytest.mark.parametrize("name", ["", "a/b", "../up", "Upper", "a b"])
def test_a_name_that_is_no_file_name_is_refused(exported, name, tmp_path):
    with pytest.raises(ValueError, match="lower-case"):
        export.export(exported[0].path, name, tmp_path)
    assert not list(tmp_path.iterdir())


def _copied(exported, tmp_path):
    weights = tmp_path / exported[1].name
    for suffix in (".safetensors", ".json"):
        source = exported[1].with_suffix(suffix)
        weights.with_suffix(suffix).write_bytes(source.read_bytes())
    return weights


def test_a_missing_file_is_named_as_given(tmp_path):
    (tmp_path / "bare.safetensors").write_bytes(b"weights")
    with pytest.raises(CheckpointError, match="has no card: put bare.json, which was"):
        load_policy(tmp_path / "bare.safetensors")
    with pytest.raises(CheckpointError, match=r"no policy .*none\.safetensors: it is"):
        load_policy(tmp_path / "none.safetensors")


def test_damaged_weights_are_refused(exported, tmp_path):
    weights = _copied(exported, tmp_path)
    data = bytearray(weights.read_bytes())
    data[-1] ^= 1
    weights.write_bytes(data)
    with pytest.raises(CheckpointError, match="damaged"):
        load_policy(weights)
    weights.unlink()
    with pytest.raises(CheckpointError, match="no policy .*it is no file"):
        load_policy(weights)


@pytest.mark.parametrize(
    ("part", "value", "word"),
    [
        ("format", 2, "format"),
        ("sha256", 3, "sha256"),
        ("task", None, "task"),
        ("config", {"algorithm": "none"}, "cannot be used"),
        ("shapes", {"vector": 3, "pixels": None, "actions": 2}, "does not fit"),
        ("shapes", {"vector": 3, "pixels": None, "actions": 1e9}, "actions"),
    ],
)
def test_a_card_that_does_not_fit_is_refused(exported, tmp_path, part, value, word):
    weights = _copied(exported, tmp_path)
    card = weights.with_suffix(".json")
    values = json.loads(card.read_text())
    card.write_text(json.dumps({**values, part: value}))
    with pytest.raises(CheckpointError, match=word):
        load_policy(weights)


# Those that ship.


def test_all_policies_together_are_small():
    sizes = [path.stat().st_size for path in pretrained.DIRECTORY.glob("*")]
    assert sum(sizes) < LARGEST_SIZE


@pytest.mark.parametrize("name", SHIPPED[::3])  # the slow test plays the others
def test_a_policy_that_ships_reaches_its_goal(name):
    """On the seed of its card on which it did so fastest."""
    policy = load_policy(f"pretrained:{name}")
    evaluation = policy.card["evaluation"]
    episodes = evaluation["episodes"]
    index = int(np.where(episodes["success"], episodes["length"], np.inf).argmin())
    played = agents.evaluate(policy, episodes=1, seed=evaluation["seed"] + index)
    assert played.successes == 1
    assert played.settings["task_kwargs"]["max_steps"] == MAX_STEPS


@pytest.mark.slow
@pytest.mark.parametrize("name", SHIPPED)
def test_a_policy_that_ships_meets_its_card(name):
    policy = load_policy(f"pretrained:{name}")
    expected = policy.card["evaluation"]["summary"]
    played = agents.evaluate(policy, episodes=10).summary()
    low, high = success_interval(
        round(expected["success"] * expected["episodes"]), expected["episodes"]
    )
    assert low <= played["success"]
    # All of ten may succeed where the card has a little less.
    least, _ = success_interval(round(10 * played["success"]), 10)
    assert least <= high
    for quantity, statistic in (("sum", "mean"), ("max", "maximum")):
        said = expected["forces"][quantity][statistic]
        seen = played["forces"][quantity][statistic]["mean"]
        assert abs(seen - said["mean"]) <= 3 * said["sd"]
