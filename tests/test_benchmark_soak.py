"""The soak's policies, its book-keeping, and that it goes on where it stopped."""

import json
import sys

import pytest
import soak


def run(monkeypatch, capsys, out, episodes):
    arguments = ["--out", out, "--episodes", episodes, "--steps", 20, "--threads", 1]
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
