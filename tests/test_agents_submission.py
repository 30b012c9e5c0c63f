"""Submissions to the leaderboard: what they hold, and what is refused."""

import copy
import hashlib
import importlib.util
import json
import shutil
import sys
import types
from html import unescape
from pathlib import Path

import mujoco
import numpy as np
import pytest

from cathsim_dmc import __version__
from cathsim_dmc.agents import (
    entries,
    evaluation,
    pretrained,
    protocols,
    results,
    submission,
)
from cathsim_dmc.agents.episodes import EpisodeOutcome
from cathsim_dmc.analysis.force_statistics import EpisodeForces, Statistics

SCRIPTS = Path(__file__).parents[1] / "docs/scripts"


@pytest.fixture
def played(monkeypatch):
    """Evaluations are not played; every second episode succeeds, with 0.6 N."""

    def evaluate(policy, task, episodes=None, *, protocol, num_threads, **options):
        assert protocol == "varied"
        statistics = Statistics(mean=0.1, mean_in_contact=0.2, maximum=0.6)
        forces = EpisodeForces(*[statistics] * 4)
        outcomes = tuple(
            EpisodeOutcome(n, float(n), 50, True, n % 2 == 0, forces, False, 1.0)
            for n in range(100)
        )
        settings = {"protocol": protocol, "task_kwargs": {}, "observation": "internal"}
        seeds = tuple(submission.protocol_seeds(task, {}, 100))
        return evaluation.EvaluationResult(
            task, policy, seeds, outcomes, settings, versions=results.versions()
        )

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


def sealed(path, values):
    """Write a submission as a forger would, with a digest that fits."""
    path.write_text(json.dumps({**values, "sha256": submission.seal(values)}))
    return path


def summed(values):
    """A submission whose summary is that of its episodes."""
    episodes = tuple(entries._episode(n, e) for n, e in enumerate(values["episodes"]))
    seeds = tuple(row["seed"] for row in values["episodes"])
    result = evaluation.EvaluationResult("", "", seeds, episodes, {})
    return {**values, "summary": json.loads(json.dumps(result.summary()))}


def test_a_submission_holds_hashes_and_every_episode(played, script, tmp_path):
    name = "pretrained:type1_lcca"
    path = tmp_path / "sub" / "one.json"
    submission.submit(name, path, "type1_lcca")
    entry = entries.read(path)
    found = entry.values
    lines = len(path.read_text().splitlines())
    assert lines == 100 + len(found) + 3  # a line for each episode and entry
    card = json.loads(pretrained.pretrained_path(name).with_suffix(".json").read_text())
    assert found["policy_sha256"] == card["sha256"]
    assert found["package"] == __version__
    in_git = (Path(__file__).parents[1] / ".git").exists()  # not in the container
    assert bool(found["commit"]) is in_git
    assert found["versions"]["cathsim-dmc"] == __version__
    assert found["versions"]["mujoco"] == mujoco.__version__
    assert len(found["episodes"]) == 100 and found["summary"]["success"] == 0.5
    assert found["summary"]["safe_success"] == {"0.5 N": 0, "1 N": 0.5, "2 N": 0.5}
    # The digests of those that were submitted before are still computed alike.
    entries.read(min(script.FOLDER.glob("*.json")))
    *_, row = script.table([(entry, None)])
    assert "| 50 (40–60) | 0 | 2.0 | 100.0 |" in row and card["sha256"][:12] in row
    assert row.endswith("| no |")


def copied(values):
    """One episode has the outcome of another."""
    first, second, *others = values["episodes"]
    values["episodes"] = [first, {**first, "seed": second["seed"]}, *others]


# What a forger changes, beside the digest, and what is said of it.
FORGERIES = {
    "its summary is not": lambda v: v["summary"].update(success=0.5 + 1e-6),
    "summary is not that": lambda v: v["episodes"][1].update(success=True),
    "copies of others": copied,
    "its seeds are not": lambda v: v["episodes"].reverse(),
    "seeds are not those": lambda v: v["episodes"][3].update(seed=7),
    "changes the options": lambda v: v["settings"].update(
        task_kwargs={"max_steps": 100, "goal_radius": 0.02}
    ),
    "it has 3 episodes": lambda v: v.update(episodes=v["episodes"][:3]),
    "protocol is 'published'": lambda v: v["settings"].update(protocol="published"),
    "task is 'easy'": lambda v: v.update(task="easy"),
    "length is 0": lambda v: v["episodes"][0].update(length=0),
    "reward is inf": lambda v: v["episodes"][0].update(reward=float("inf")),
    "sum.mean is nan": lambda v: v["episodes"][0]["forces"]["sum"].update(
        mean=float("nan")
    ),
    "episode 0 succeeds, but": lambda v: v["episodes"][0].update(physics_error=True),
    "0 succeeds, but was not": lambda v: v["episodes"][0].update(terminated=False),
    "episode 1 is cut off": lambda v: v["episodes"][1].update(terminated=False),
    "policy is": lambda v: v.update(policy="a" * 300),
    "commit is 3": lambda v: v.update(commit=3),
    "'versions'|'package'": lambda v: v.pop("package"),
    "settings is": lambda v: v.update(settings=[]),
}


@pytest.mark.parametrize("message", FORGERIES)
def test_a_forged_submission_is_refused(played, tmp_path, message):
    path = tmp_path / "one.json"
    values = submission.submit("push", path, "type1_lcca")
    assert values["policy_sha256"] is None
    entries.read(path)
    FORGERIES[message](values)
    path.write_text(json.dumps(values))
    with pytest.raises(ValueError, match="one.json is not listed: it was changed"):
        entries.read(path)
    with pytest.raises(ValueError, match=f"one.json is not listed: .*{message}"):
        entries.read(sealed(path, values))


@pytest.mark.parametrize("text", ["", "{}", "[]", "[" * 10**6, " " * 2**22 + "{}"])
def test_what_is_no_submission_is_refused_in_one_line(tmp_path, text):
    (tmp_path / "one.json").write_text(text)
    with pytest.raises(ValueError, match="one.json is not listed") as caught:
        entries.read(tmp_path / "one.json")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "name",
    [
        "<script>alert(1)</script>",
        "a` | 100 | `b",
        "[a](javascript:alert(1))",
        "![a](https://a.b/c.png)",
        "a\n\n# b",
        "a \u202e b",
        "*a*",
    ],
)
def test_a_name_is_no_markup(played, script, tmp_path, name):
    path = tmp_path / "one.json"
    values = submission.submit("push", path, "type1_lcca")
    plain, forged = values, {**values, "policy": name, "commit": name}
    rows = [
        script.table([(entries.read(sealed(path, one)), None)])[-1]
        for one in (plain, forged)
    ]
    assert rows[0].count("|") == rows[1].count("|")
    assert not set("<>[]()*`!\n\u202e") & set(rows[1].split("|")[2])
    markdown = pytest.importorskip("markdown")
    table = [*script.table([])[:2], rows[1]]
    html = markdown.markdown("\n".join(table), extensions=["tables"])
    assert html.count("<td") == 9
    assert not any(f"<{tag}" in html for tag in ("script", "a ", "img", "em", "h1"))
    if name.isprintable():
        assert name in unescape(html)


def test_a_replay_compares_every_figure_of_every_episode(played, tmp_path):
    path = tmp_path / "one.json"
    values = submission.submit("push", path, "type1_lcca")
    assert entries.replay(entries.read(path))[1:] == (100, "policy")
    whole = copy.deepcopy(values["episodes"][3]["forces"])
    values["episodes"][3]["forces"]["sum"]["maximum"] = 0.5
    seed = values["episodes"][3]["seed"]
    with pytest.raises(ValueError, match=f"1 of its 100 .* are others .*seed {seed};"):
        entries.replay(entries.read(sealed(path, summed(values))))
    other = {**values, "versions": {**values["versions"], "mujoco": "3.0.0"}}
    assert entries.replay(entries.read(sealed(path, summed(other)))).equal == 99
    # Another processor rounds otherwise; files from before name none.
    other = {**values, "processor": "another one"}
    assert entries.replay(entries.read(sealed(path, summed(other)))).equal == 99
    del other["processor"]
    with pytest.raises(ValueError, match="1 of its 100"):
        entries.replay(entries.read(sealed(path, summed(other))))
    for episode in values["episodes"]:
        del episode["start_insertion"]  # as in older files
    values["episodes"][3]["forces"] = whole
    assert entries.replay(entries.read(sealed(path, summed(values)))).equal == 100
    values["policy_sha256"] = "a" * 64
    with pytest.raises(ValueError, match="its weights are not those of push"):
        entries.replay(entries.read(sealed(path, summed(values))))


@pytest.fixture
def short(monkeypatch):
    """The protocol has four episodes."""
    own = protocols.PROTOCOLS["varied"]._replace(episodes=4)
    monkeypatch.setitem(protocols.PROTOCOLS, "varied", own)


@pytest.mark.slow
def test_a_replay_finds_what_was_not_played(short, script, tmp_path):
    path = tmp_path / "one.json"
    values = submission.submit("push", path, "type1_bca")
    entry = entries.read(path)
    again = entries.replay(entry)
    assert again.equal == 4 and again.source == "policy"
    *_, row = script.table([(entry, again)])
    assert (
        row.endswith("| policy: 4 of 4 equal |")
        and not path.with_suffix(".npz").exists()
    )
    for episode in values["episodes"]:
        episode["forces"]["mean_sum"]["maximum"] = 0.01
    forged = entries.read(sealed(path, summed(values)))
    assert forged.result.safe_success(0.5) == 1.0
    with pytest.raises(ValueError, match="4 of its 4 episodes are others .*seed 10000"):
        entries.replay(forged)
    # Of other versions the figures are those of the replay.
    values["versions"]["mujoco"] = "3.0.0"
    forged = entries.read(sealed(path, summed(values)))
    again = entries.replay(forged)
    assert again.equal == 0
    assert script.table([(forged, again)])[-1] == row.replace("4 of 4", "0 of 4")


@pytest.mark.slow
def test_a_policy_that_does_not_ship_is_replayed_by_its_actions(short, tmp_path):
    mine, out = tmp_path / "mine.npz", tmp_path / "one.json"
    submission.record_actions("push", mine, "type1_bca")
    values = submission.submit(str(mine), out)
    beside = out.with_suffix(".npz")
    assert beside.read_bytes() == mine.read_bytes()
    entry = entries.read(out)
    again = entries.replay(entry)
    assert again.equal == 4 and again.source == "actions"
    changed = {**np.load(mine)}
    changed["actions"] = -changed["actions"]
    np.savez_compressed(beside, **changed)
    with pytest.raises(ValueError, match="one.npz is not the file of actions"):
        entries.replay(entry)
    values["actions_sha256"] = submission.file_digest(beside)
    with pytest.raises(ValueError, match="4 of its 4 episodes are others"):
        entries.replay(entries.read(sealed(out, values)))
    wrong = {
        "seeds": (np.arange(4), "not the 4 of the varied"),
        "actions": (changed["actions"][..., :7], "has actions of 7 numbers"),
        "header": (
            json.dumps({**json.loads(str(changed["header"])), "task": "type1_lcca"}),
            "not the 4 of the varied protocol on type1_bca",
        ),
    }
    for name, (value, message) in wrong.items():
        np.savez_compressed(beside, **{**changed, name: value})
        values["actions_sha256"] = submission.file_digest(beside)
        with pytest.raises(ValueError, match=message):
            entries.replay(entries.read(sealed(out, values)))
    beside.unlink()
    assert entries.replay(entry) is None


@pytest.mark.slow
def test_weights_that_do_not_ship_leave_their_actions(short, tmp_path):
    for path in pretrained.DIRECTORY.glob("navigator.*"):
        shutil.copy(path, tmp_path)
    card = tmp_path / "navigator.json"
    card.write_text(json.dumps({**json.loads(card.read_text()), "name": "mine"}))
    out = tmp_path / "one.json"
    submission.submit(str(tmp_path / "navigator.safetensors"), out, "type1_bca")
    entry = entries.read(out)
    assert out.with_suffix(".npz").is_file()
    again = entries.replay(entry)
    assert again.equal == 4 and again.source == "actions"


def without_figures(row):
    cells = row.split("|")
    return cells[1:3] + cells[7:9]


@pytest.mark.slow
def test_the_page_lists_the_submissions(script):
    """Rows that were replayed with other versions have the figures of the replay."""
    found = [(entries.read(path), None) for path in script.FOLDER.glob("*.json")]
    text = script.PAGE.read_text()
    rows = [row for row in text.splitlines() if row.startswith("| `")]
    told = " in docs/leaderboard.md: run docs/scripts/leaderboard.py"
    assert len(rows) == len(found), f"{len(rows)} rows{told}"
    for line in script.table(found)[2:]:
        (row,) = [r for r in rows if without_figures(r) == without_figures(line)]
        if row.rstrip(" |").endswith(("no", "100 of 100 equal")):
            assert row.split("|")[:-2] == line.split("|")[:-2], row + told
    entry, _ = found[0]
    force = 1e3 * np.mean([one.forces.mean_sum.mean for one in entry.result.episodes])
    assert f"| {force:.1f} |" in script.table(found[:1])[2]


def test_the_page_is_written_without_what_is_refused(
    played, script, tmp_path, monkeypatch, capsys
):
    for name, task in (("a", "type1_lcca"), ("b", "type1_bca")):
        submission.submit("push", tmp_path / f"{name}.json", task)
    written = []
    monkeypatch.setattr(script, "FOLDER", tmp_path)
    monkeypatch.setattr(script.figures, "put", lambda page, **own: written.append(own))
    monkeypatch.setattr(sys, "argv", ["leaderboard", "--no-replay"])
    assert script.main() == 0
    (tmp_path / "c.json").write_text("{}")
    assert script.main() == 1 and "c.json is not listed" in capsys.readouterr().err
    first, second = written
    assert first == second
    tasks = [row.split("|")[1].strip(" `") for row in first["leaderboard"][2:]]
    assert tasks == ["type1_bca", "type1_lcca"]


@pytest.mark.parametrize(
    "out, task, message",
    [("one.txt", "type1_lcca", r"give a \.json file"), ("one.json", "none", "task is")],
)
def test_bad_submissions_are_refused_before_they_are_played(
    monkeypatch, out, task, message
):
    monkeypatch.setattr(submission.evaluation, "evaluate", None)
    with pytest.raises(ValueError, match=message):
        submission.submit("push", out, task)
    with pytest.raises(ValueError, match=r"give a \.npz file"):
        submission.record_actions("push", out, task)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """(file of the actions of four episodes, their evaluation)."""
    path = tmp_path_factory.mktemp("recorded") / "mine.npz"
    options = {"observation": "tracking", "task_kwargs": {"max_steps": 12}}
    return path, submission.record_actions(
        "random", path, "type1_lcca", episodes=4, **options
    )


def test_episodes_are_recorded_as_they_are_evaluated(recorded):
    _, expected = recorded
    options = {"observation": "tracking", "task_kwargs": {"max_steps": 12}}
    found = evaluation.evaluate("random", "type1_lcca", 4, protocol="varied", **options)
    assert found.episodes == expected.episodes


def test_recorded_actions_give_the_same_episodes(recorded, tmp_path):
    path, expected = recorded
    (tmp_path / "one.npz").write_bytes(b"of an earlier submission")
    found = submission.submit(str(path), tmp_path / "one.json", episodes=4)
    again = json.loads(json.dumps(expected.to_dict()))
    assert found["episodes"] == again["episodes"]
    assert found["policy"] == "random, recorded actions"
    assert found["settings"] == again["settings"]
    assert (tmp_path / "one.npz").read_bytes() == path.read_bytes()
    assert found["policy_sha256"] == hashlib.sha256(path.read_bytes()).hexdigest()
    with pytest.raises(ValueError, match="not the 4 of the varied .* on type1_bca"):
        submission.RecordedActions(path).require("type1_bca", 4)


@pytest.mark.parametrize(
    "changed, given, message",
    [
        ({}, {"episodes": None}, "are 4 episodes, not the 100 of the varied"),
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


def test_actions_are_kept_up_to_the_ends_of_episodes_and_played_from_there(tmp_path):
    """Two batches of two and one episodes; the last action goes on past the file."""
    taken = np.random.RandomState(0).uniform(-1, 1, (3, 4, 7)).astype(np.float32)
    shown = iter([*taken[:2].swapaxes(0, 1), *taken[2:, :3].swapaxes(0, 1)])
    held = np.empty((2, 7), np.float32)

    def act(_):
        """Actions in an array that the policy overwrites."""
        action = next(shown)
        held[: len(action)] = action
        return held[: len(action)]

    policy = types.SimpleNamespace(
        name="mine", task="type1_bca", observation="internal", task_kwargs={},
        num_actions=7, reset=lambda view, which: None, act=act,
    )  # fmt: skip
    recorder = submission._Recorder(policy)
    views = [types.SimpleNamespace(num_simulations=count) for count in (2, 1)]
    for view, steps in zip(views, (4, 3), strict=True):
        recorder.reset(view, np.ones(view.num_simulations, bool))
        for _ in range(steps):
            recorder.act({})
            recorder.reset(view, np.arange(view.num_simulations) > 0)  # not all begin
    lengths = 2, 4, 3
    result = types.SimpleNamespace(
        episodes=[types.SimpleNamespace(length=length) for length in lengths],
        settings={"observation": "internal", "task_kwargs": {}},
        policy="mine", task="type1_bca", seeds=(5, 6, 7),
    )  # fmt: skip
    recorder.write(tmp_path / "mine.npz", result)
    player = submission.RecordedActions(tmp_path / "mine.npz")
    wanted = taken.copy()
    for row, length in enumerate(lengths):
        wanted[row, length:] = 0.0
    np.testing.assert_array_equal(player.actions, wanted)
    assert (player.seeds, player.task) == ([5, 6, 7], "type1_bca")
    for view, rows in zip(views, (slice(0, 2), slice(2, 3)), strict=True):
        player.reset(view, np.ones(view.num_simulations, bool))
        for step in (0, 1, 2, 3, 3, 3):
            np.testing.assert_array_equal(player.act({}), wanted[rows, step])
            player.reset(view, np.arange(view.num_simulations) > 0)
