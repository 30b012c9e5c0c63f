"""The page of results, from made-up files of finished cells."""

import importlib.util
import re
import sys
from pathlib import Path

import fabricated_results
import numpy as np
import pytest

SCRIPTS = Path(__file__).parents[1] / "docs/scripts"


@pytest.fixture
def script(monkeypatch):
    """The module docs/scripts/results.py."""
    monkeypatch.syspath_prepend(str(SCRIPTS))
    spec = importlib.util.spec_from_file_location("results", SCRIPTS / "results.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    monkeypatch.delitem(sys.modules, "results_figures", raising=False)
    return module


@pytest.fixture
def page(script, tmp_path):
    """Writes pages of `tmp_path`/results; returns (exit code, text, that in detail)."""

    def write():
        out = tmp_path / "docs/results.md"
        code = script.main(["--results", str(tmp_path / "results"), "--out", str(out)])
        return code, out.read_text(), out.with_name("results_detail.md").read_text()

    return write


def line_of(text, *words):
    """The only line with all words."""
    (line,) = [one for one in text.splitlines() if all(word in one for word in words)]
    return [field.strip() for field in line.strip("| ").split("|")]


def test_ours_stands_beside_the_published(page, tmp_path):
    for seed, rate in enumerate((1.0, 0.9)):
        fabricated_results.write(
            tmp_path / "results", "type1_bca", "PPO-Internal", "ppo", "internal", seed,
            rate,
        )  # fmt: skip
    code, main, text = page()
    assert code == 0
    ours = line_of(text, "| PPO-Internal | 2 | 95 % / 53 % |")
    assert ours[3] == "90 %"  # the worst seed
    # Mean force and mean contact force, as `cathsim eval` calls them.
    assert [float(cell.split(" ±")[0]) for cell in ours[6:8]] == [
        pytest.approx(21.5, abs=1.0),
        pytest.approx(11.5, abs=1.0),
    ]
    theirs = [ours[place].split(" / ")[1] for place in (2, 4, 7, 8)]
    assert theirs == ["53 %", "-70 ± 28", "11 ± 21", "121 ± 95"]
    assert "2 of the 38 cells" in text or re.search(r"\n2 of the \d+ cells", text)
    missing = line_of(text, "- PPO-Internal: type1_lcca (seed 0, 1, 2)")[0]
    assert "type1_bca (seed 2)" in missing
    assert line_of(text, "PPO-Sequential (missing)", "97 %")
    short = ["PPO-Internal", "2", "95 % / 53 %", "– / 7 %", "– / 50 %", "– / 87 %"]
    assert line_of(main, "| PPO-Internal | 2 |")[:6] == short
    assert line_of(main, "| PPO-Internal |", "121")[1:] == ours[5:]
    assert line_of(main, "PPO-Sequential")[1:3] == ["–", "– / 97 %"]
    for name in re.findall(r"\]\((images/\S+)\)", main + text):
        assert (tmp_path / "docs" / name).stat().st_size > 5_000
    assert {path.name for path in (tmp_path / "docs/images").iterdir()} == {
        "results_curves.png",
        "results_forces.png",
        "results_force_maps.png",
    }


@pytest.mark.parametrize(
    "damage",
    [
        lambda text: text[:200],
        lambda text: text.replace('"success": ', '"succes": '),
        lambda text: text.replace('"format": 2', '"format": 99'),
        lambda text: "[]",
    ],
)
def test_a_broken_file_is_named_and_left_out(page, tmp_path, capsys, damage):
    path = fabricated_results.write(
        tmp_path / "results", "type1_bca", "PPO-Internal", "ppo", "internal", 0, 1.0
    )
    path.write_text(damage(path.read_text()))
    code, _, text = page()
    assert code == 1
    assert path.name in capsys.readouterr().err
    assert path.name in text and str(tmp_path) not in text
    assert "0 of the" in text


def test_the_interquartile_mean_drops_a_quarter_on_either_side(script):
    interquartile_mean = script.interquartile_mean
    scores = [[0.0, 0.9], [0.8, 1.0], [0.9, 1.0], [0.1, 0.9]]
    mean, interval = interquartile_mean(scores)
    assert mean == pytest.approx(np.mean([0.8, 0.9, 0.9, 0.9]))
    assert interval[0] < mean < interval[1] <= 1.0
    assert interquartile_mean(scores) == (mean, interval)
    assert interquartile_mean([[0.5], [1.0, 1.0]])[1] is None
    with pytest.raises(ValueError, match="needs a run"):
        interquartile_mean([[1.0], []])
