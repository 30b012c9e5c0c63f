"""Submissions to the leaderboard: what they hold, and what is refused."""

import hashlib
import importlib.util
import json
from pathlib import Path

import numpy as np
import pytest

from cathsim_dmc import __version__
from cathsim_dmc.agents import evaluation, pretrained, submission
from cathsim_dmc.agents.episodes import EpisodeOutcome
from cathsim_dmc.analysis.force_statistics import EpisodeForces, Statistics

SCRIPTS = Path(__file__).parents[1] / "docs/scripts"


@pytest.fixture
def played(monkeypatch):
    """Evaluations are not played; every second episode succeeds, with 0.6 N."""

    def evaluate(policy, task, episodes, *, protocol, num_threads):
        assert protocol == "varied"
        statistics = Statistics(mean=0.1, mean_in_contact=0.2, maximum=0.6)
        forces = EpisodeForces(*[statistics] * 4)
        outcomes = tuple(
            EpisodeOutcome(n, 1.0, 50, True, n % 2 == 0, forces, False, 1.0)
            for n in range(100)
        )
        settings = {"protocol": protocol, "task_kwargs": {}}
        seeds = tuple(range(100))
        return evaluation.EvaluationResult(task, policy, seeds, outcomes, settings)

    monkeypatch.setattr(evaluation, "evaluate", evaluate)


@pytest.fixture
def script(monkeypatch):
    """The module docs/scripts/leaderboard.py."""
    monkeypatch.syspath_prepend(str(SCRIPTS))
    spec = importlib.util.spec_from_file_location(
        "leaderboard", SCRIPTS / "leaderboard.py"
    )
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_a_submission_holds_hashes_and_every_episode(played, script, tmp_path):
    name = "pretrained:type1_lcca"
    path = tmp_path / "sub" / "one.json"
    submission.submit(name, path, "type1_lcca")
    found = script.read(path)
    lines = len(path.read_text().splitlines())
    assert lines == 100 + len(found) + 3  # a line for each episode and entry
    card = json.loads(pretrained.pretrained_path(name).with_suffix(".json").read_text())
    assert found["policy_sha256"] == card["sha256"]
    assert found["package"] == __version__ and found["commit"]
    assert len(found["episodes"]) == 100 and found["summary"]["success"] == 0.5
    assert found["summary"]["safe_success"] == {"0.5 N": 0, "1 N": 0.5, "2 N": 0.5}
    *_, row = script.table([found])
    assert "| 50 (40–60) | 0 | 2.0 | 100.0 |" in row and card["sha256"][:12] in row


def test_an_edited_or_a_short_submission_is_refused(played, script, tmp_path):
    path = tmp_path / "one.json"
    values = submission.submit("push", path, "type1_lcca")
    assert values["policy_sha256"] is None
    values["summary"]["success"] = 1.0
    path.write_text(json.dumps(values))
    with pytest.raises(ValueError, match="changed after"):
        script.read(path)
    values["settings"]["task_kwargs"] = {"goal_radius": 0.02}
    path.write_text(json.dumps({**values, "sha256": submission.seal(values)}))
    with pytest.raises(ValueError, match="changes the options"):
        script.read(path)
    values["episodes"] = values["episodes"][:3]
    path.write_text(json.dumps({**values, "sha256": submission.seal(values)}))
    with pytest.raises(ValueError, match="not the 100 episodes"):
        script.read(path)


@pytest.mark.parametrize(
    "out, task, message",
    [("one.txt", "type1_lcca", r"give a \.json file"), ("one.json", "none", "task is")],
)
def test_bad_submissions_are_refused_before_they_are_played(out, task, message):
    with pytest.raises(ValueError, match=message):
        submission.submit("push", out, task)


def test_the_page_lists_the_submissions(script):
    rows = script.table([script.read(path) for path in script.FOLDER.glob("*.json")])
    text = script.PAGE.read_text()
    assert all(row in text for row in rows), "run docs/scripts/leaderboard.py"


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """(file of the actions of four episodes, their evaluation)."""
    path = tmp_path_factory.mktemp("recorded") / "mine.npz"
    options = {"observation": "tracking", "task_kwargs": {"max_steps": 12}}
    return path, submission.record_actions(
        "random", path, "type1_lcca", episodes=4, **options
    )


def test_recorded_actions_give_the_same_episodes(recorded, tmp_path):
    path, expected = recorded
    found = submission.submit(str(path), tmp_path / "one.json", episodes=4)
    again = json.loads(json.dumps(expected.to_dict()))
    assert found["episodes"] == again["episodes"]
    assert found["policy"] == "random, recorded actions"
    assert found["settings"] == again["settings"]
    assert found["policy_sha256"] == hashlib.sha256(path.read_bytes()).hexdigest()


@pytest.mark.parametrize(
    "changed, given, message",
    [
        ({}, {"episodes": None}, "holds 4 episodes, not the 100 of the varied"),
        ({}, {"task": "type1_bca"}, "actions of type1_lcca, not of type1_bca"),
        ({"actions": np.full((4, 12, 21), np.nan, np.float32)}, {}, "finite numbers"),
        ({"actions": np.zeros(48)}, {}, "float64 of shape"),
        ({"seeds": np.arange(4)}, {}, "not the 4 of the varied protocol"),
        ({"header": np.array("{}")}, {}, "holds no recorded actions"),
    ],
)
def test_actions_of_other_episodes_are_refused(
    recorded, tmp_path, changed, given, message
):
    path = tmp_path / "mine.npz"
    np.savez(path, **{**np.load(recorded[0]), **changed})
    with pytest.raises(ValueError, match=message):
        submission.submit(str(path), tmp_path / "one.json", **{"episodes": 4, **given})
