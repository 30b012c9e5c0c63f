"""The page of results, from made-up files of finished cells."""

import importlib.util
import re
import sys
from pathlib import Path
from types import SimpleNamespace

import fabricated_results
import pytest

SCRIPTS = Path(__file__).parents[1] / "docs/scripts"


@pytest.fixture
def script(monkeypatch):
    """The module docs/scripts/results.py."""
    monkeypatch.syspath_prepend(str(SCRIPTS))
    spec = importlib.util.spec_from_file_location("results", SCRIPTS / "results.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    for name in ("results_figures", "results_tables"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    return module


@pytest.fixture
def page(script, tmp_path):
    """Writes pages of `tmp_path`/results; returns (exit code, text, that in detail)."""

    def write(*more):
        out = tmp_path / "docs/results.md"
        results = str(tmp_path / "results")
        code = script.main(["--results", results, "--out", str(out), *more])
        return code, out.read_text(), out.with_name("results_detail.md").read_text()

    return write


def line_of(text, *words):
    """The only line with all words."""
    (line,) = [one for one in text.splitlines() if all(word in one for word in words)]
    return [field.strip() for field in line.strip("| ").split("|")]


def test_ours_stands_beside_the_published(page, script, tmp_path):
    for seed, rate in enumerate((1.0, 0.9)):
        fabricated_results.write(
            tmp_path / "results", "type1_bca", "PPO-Internal", "ppo", "internal", seed,
            rate,
        )  # fmt: skip
    code, main, text = page()
    assert code == 0
    ours = line_of(text, "| PPO-Internal † | 2 | 95 % / 53 % |")
    assert ours[3] == "90 %"  # the worst seed
    # Mean force and mean contact force, as `cathsim eval` calls them.
    assert [float(cell.split(" ±")[0]) for cell in ours[6:8]] == [
        pytest.approx(21.5, abs=1.0),
        pytest.approx(11.5, abs=1.0),
    ]
    theirs = [ours[place].split(" / ")[1] for place in (2, 4, 7, 8)]
    assert theirs == ["53 %", "-70 ± 28", "11 ± 21", "121 ± 95"]
    newer = SimpleNamespace(evaluation={"summary": {"forces": {"mean_sum": {}}}})
    assert script.tables.marked("90 %", [newer]) == "90 %"
    # What falls short stands first.
    assert line_of(main, "PPO-Internal † (2)", " of ")[3] == "90 %"
    assert main.index("PPO-Internal † (2)") < main.index("## Success")
    assert "2 of the 38 cells" in text or re.search(r"\n2 of the \d+ cells", text)
    missing = line_of(text, "- PPO-Internal: type1_lcca (seed 0, 1, 2)")[0]
    assert "type1_bca (seed 2)" in missing
    # The grid trains it for another number of frames.
    assert line_of(text, "- PPO-Internal: total_frames") and "Trained with" in text
    assert line_of(text, "PPO-Sequential (missing)", "97 %")
    short = ["PPO-Internal", "2", "95 % † / 53 %", "– / 7 %", "– / 50 %", "– / 87 %"]
    assert line_of(main, "| PPO-Internal | 2 |")[:6] == short
    assert line_of(main, "| PPO-Internal † |", "121")[1:] == ours[5:]
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


def test_the_mean_over_seeds_hides_no_task_that_fails(script):
    scores = [[1.0, 1.0], [0.0, 0.0], [1.0, 1.0], [1.0, 0.6]]
    mean, interval = script.tables.mean_over_seeds(scores)
    assert mean == pytest.approx(0.7)
    assert interval[0] < mean < interval[1] <= 0.75
    assert script.tables.mean_over_seeds(scores) == (mean, interval)
    for few in ([[0.5], [1.0, 1.0]], [[1.0], []], []):
        with pytest.raises(ValueError, match="two runs or more"):
            script.tables.mean_over_seeds(few)


@pytest.mark.slow
def test_means_stand_beside_agents_with_several_seeds_only(page, tmp_path):
    tasks = ("type1_bca", "type1_lcca", "type2_bca", "type2_lcca")
    for task in tasks:
        rate = 0.0 if task == "type1_lcca" else 1.0
        for label, algorithm, seeds in (("PPO", "ppo", 2), ("SAC", "sac", 1)):
            for seed in range(seeds):
                fabricated_results.write(
                    tmp_path / "results", task, f"{label}-Internal", algorithm,
                    "internal", seed, rate,
                )  # fmt: skip
    _, main, _ = page()
    several, one = (
        line_of(main, f"| {label}-Internal | {seeds} |")
        for label, seeds in (("PPO", 2), ("SAC", 1))
    )
    assert several[-1] == "75 % (75–75)" and one[-1] == "–"
    assert line_of(main, "PPO-Sequential")[-1] == "–"


def test_published_agents_are_missing_only_where_the_grid_has_them(
    page, script, tmp_path
):
    grid = (script.HERE / "grid.toml").read_text()
    row = re.search(r'(?s)label = "SAC-Image".*?\n\n', grid)[0]
    less = re.sub("tasks = .*", 'tasks = ["type1_bca", "type2_lcca"]', row)
    (tmp_path / "grid.toml").write_text(grid.replace(row, less))
    fabricated_results.write(
        tmp_path / "results", "type1_lcca", "PPO-Internal", "ppo", "internal", 0, 1.0
    )
    _, _, text = page("--grid", str(tmp_path / "grid.toml"))
    assert line_of(text, "PPO-Sequential (missing)", "97 %")
    for success in ("-196 ± 5", "-68 ± 91"):  # type1_lcca, type2_bca
        assert line_of(text, "SAC-Image (not trained)", success)
    left = text.partition("Published agents that the grid leaves out:")[2]
    assert line_of(left, "- SAC-Image: type1_lcca, type2_bca")
