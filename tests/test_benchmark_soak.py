"""The soak's policies, its book-keeping, and that it goes on where it stopped."""

import json
import sys

import numpy as np
import pytest
import soak

from cathsim_dmc import suite


def test_plan_covers_every_task_and_policy_evenly():
    episodes = soak.plan(100)
    assert [episode.number for episode in episodes] == list(range(100))
    keys = [(episode.task, episode.policy) for episode in episodes]
    counts = {key: keys.count(key) for key in keys}
    assert set(counts) == {
        (task, policy) for task in soak.TASKS for policy in soak.POLICIES
    }
    assert set(counts.values()) <= {6, 7}
    # No episode is another one over again; tasks that differ in their goal only are.
    assert len({(e.task, e.policy, e.seed) for e in episodes}) == 100
    scenes = {(suite.TASKS[t].anatomy, suite.TASKS[t].access) for t in soak.TASKS}
    assert len(scenes) == len(soak.TASKS)


@pytest.mark.parametrize("name", ["halton", "push", "bang_bang", "reversals"])
def test_policies_are_repeatable_and_use_the_whole_range(name):
    policy = soak.POLICIES[name]
    actions = policy(400, 21, 1)
    assert actions.shape == (400, 21)
    assert np.abs(actions).max() <= 1
    np.testing.assert_array_equal(actions, policy(400, 21, 1))
    assert (actions != policy(400, 21, 2)).any()
    forward = actions[:, -1]
    if name == "halton":
        assert forward.min() < -0.98 and forward.max() > 0.98
    elif name == "reversals":
        assert set(forward) == {-1.0, 1.0}
    else:
        assert set(forward) == {1.0}


def test_percentile_is_that_of_all_rows_together():
    rows = [
        {"penetration_histogram": {"0": 98, "100": 1}},
        {"penetration_histogram": {"300": 1}},
    ]
    assert soak.percentile(rows, 98) == pytest.approx(1e-6)
    assert soak.percentile(rows, 99) == pytest.approx(101e-6)
    assert soak.percentile(rows, 100) == pytest.approx(301e-6)
    assert soak.percentile([{"penetration_histogram": {}}], 99) == 0


def run(monkeypatch, capsys, out, episodes):
    arguments = ["--out", out, "--episodes", episodes, "--steps", 3, "--threads", 1]
    monkeypatch.setattr(sys, "argv", ["soak", *map(str, arguments), "--json"])
    code = soak.main()
    printed = capsys.readouterr()
    return code, json.loads(printed.out), printed.err


@pytest.mark.slow
def test_it_goes_on_where_it_stopped(monkeypatch, capsys, tmp_path):
    code, first, _ = run(monkeypatch, capsys, tmp_path, 1)
    assert code == 0
    assert first["total"]["episodes"] == 1
    path = tmp_path / "episodes.jsonl"
    before = path.read_text()
    code, second, err = run(monkeypatch, capsys, tmp_path, 2)
    assert code == 0
    assert path.read_text().startswith(before)
    assert second["total"]["episodes"] == 2
    assert err.count("episodes in") == 1, "an episode was run twice"
    assert all(check["passed"] for check in second["checks"])
    assert (tmp_path / "soak.md").read_text().count("|") > 20
    # A line that was cut off is run again.
    path.write_text(path.read_text()[:-20])
    _, third, err = run(monkeypatch, capsys, tmp_path, 2)
    assert err.count("episodes in") == 1
    assert third["total"] == second["total"]


def test_rows_of_another_length_are_refused(tmp_path):
    path = tmp_path / "episodes.jsonl"
    row = {"number": 0, "steps": 3, "tip_step_max": 1e-3}
    path.write_text(json.dumps(row) + "\n")
    with pytest.raises(ValueError, match=r"episodes of 3 steps, not 2000.*--out"):
        soak.read_rows(path, 2000)
    # What an older version wrote lacks a figure, and is run again.
    path.write_text(json.dumps({"number": 0, "steps": 3}) + "\n")
    assert soak.read_rows(path, 3) == []


def test_a_broken_bound_fails_the_report():
    row = {
        "number": 0,
        "task": "type1_bca",
        "policy": "push",
        "seed": 0,
        "steps": 10,
        "warnings": 1,
        "escaped": True,
        "excess_max": 2e-3,
        "excess_step": 3,
        "penetration_max": 1.5e-3,
        "penetration_step": 4,
        "tip_step_max": 4e-3,
        "tip_step_step": 6,
        "force_max": 12.0,
        "force_step": 5,
        "force_sum_max": 13.0,
        "force_sum_mean": 1.0,
        "contacts_max": 10_000,
        "penetration_histogram": {"1500": 10},
    }
    report = soak.report([row])
    assert not any(check["passed"] for check in report["checks"])
    assert report["worst"]["force"]["force_step"] == 5
    assert report["worst"]["tip_step"]["tip_step_step"] == 6
    assert "| 4.00 | 12.00 |" in soak.markdown(report)
