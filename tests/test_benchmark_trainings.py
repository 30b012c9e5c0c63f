"""The grid of trainings: read, trained, judged, written, continued."""

import dataclasses
import json
from pathlib import Path

import judgement
import pytest
import synthetic_env
import trainings

from cathsim_dmc.agents import evaluation, load_policy, training
from cathsim_dmc.tasks.config import MAX_STEPS

CELL = trainings.Cell(
    label="PPO",
    task="type1_bca",
    algorithm="ppo",
    preset="demo",
    observation="internal",
    seed=0,
    total_frames=512,
    settings={
        "num_envs": 8,
        "steps_per_update": 256,
        "normalisation_frames": 16,
        "metrics_frames": 128,
        "hidden": [8],
    },
    evaluation={"episodes": 3},
)
ROW = """
[[row]]
label = "PPO"
algorithm = "ppo"
preset = "demo"
observation = "internal"
tasks = ["type1_bca", "type1_lcca"]
seeds = [0, 1]
total_frames = 1000
"""


@pytest.fixture
def folders(tmp_path):
    """Directories of runs and of results."""
    return tmp_path / "runs", tmp_path / "results"


def result_of(folders):
    return folders[1] / f"{CELL.name}.json"


def changed(**changes):
    return dataclasses.replace(CELL, **changes)


@pytest.fixture
def grid(tmp_path):
    def write(text):
        path = tmp_path / "grid.toml"
        path.write_text(text)
        return trainings.read_grid(path)

    return write


@pytest.fixture
def synthetic(monkeypatch):
    """Trains and judges on a small environment; keeps the options of evaluations."""
    asked, train = [], training.train

    def small(config, run, resume):
        return train(
            config, run, resume, progress=False, make_env=synthetic_env.make_env
        )

    def judge(policy, task, task_kwargs, episodes, name, num_threads):
        asked.append(task_kwargs)
        found = evaluation.evaluate(
            policy, task, episodes, name=name, task_kwargs={},
            make_env=synthetic_env.make_env,
        )  # fmt: skip
        return found, None

    monkeypatch.setattr(training, "train", small)
    monkeypatch.setattr(judgement, "judge", judge)
    return asked


def test_a_finished_cell_tells_how_it_came_about(folders, synthetic):
    assert trainings.standing(CELL, *folders) == ("waiting", "")
    assert trainings.work(CELL, *folders)
    done = trainings.read_result(result_of(folders))
    assert done.cell["name"] == CELL.name
    assert done.values["config"] == json.loads(json.dumps(CELL.config().to_dict()))
    assert done.training["frames"] == 512 and done.frames_per_second > 0
    assert done.training["curve"]["frames"] == [256, 512]
    assert done.evaluation["summary"]["episodes"] == 3
    assert len(done.evaluation["episodes"]["max_force"]) == 3
    assert trainings.standing(CELL, *folders)[0] == "finished"
    # A label is a matter of the page; other settings are left alone.
    assert trainings.standing(changed(label="other"), *folders)[0] == "finished"
    state, remark = trainings.standing(changed(total_frames=1024), *folders)
    assert state == "other settings" and "total_frames differ; move" in remark
    # The preset has changed since.
    values = {**done.values, "config": {**done.values["config"], "clip": 0.3}}
    result_of(folders).write_text(json.dumps(values))
    state, remark = trainings.standing(CELL, *folders)
    assert state == "other settings" and "clip differ; move" in remark


def test_the_evaluation_is_the_published_one_whatever_was_trained(folders, synthetic):
    options = {"max_steps": 20}
    cell = changed(settings={**CELL.settings, "task_kwargs": options})
    trainings.work(cell, *folders)
    assert synthetic == [{"max_steps": MAX_STEPS}]
    more = {"reward": "path", "goal_radius": 0.1, "friction": 0.1, "rotation": True}
    assert judgement.published_options({**options, **more}) == {
        "friction": 0.1,
        "rotation": True,
        "max_steps": MAX_STEPS,
    }


def test_a_cell_that_fails_does_not_stop_the_others(tmp_path, monkeypatch, capsys):
    (tmp_path / "grid.toml").write_text(ROW)
    did = []

    def work(cell, runs, results):
        did.append(cell.name)
        if cell.seed == 0:
            raise FloatingPointError("loss is not finite")
        return cell.task != "type1_lcca"

    monkeypatch.setattr(trainings, "work", work)
    where = (tmp_path / "grid.toml", tmp_path / "runs", tmp_path / "results")
    # The last one is interrupted.
    assert trainings.main(*where) == 130 and len(did) == 4
    assert "failed, FloatingPointError: loss is not finite" in capsys.readouterr().out
    assert trainings.main(*where, only=["bca"]) == 1 and len(did) == 6
    assert trainings.main(*where, list=True) == 0 and len(did) == 6
    assert trainings.main(tmp_path / "none.toml") == 2
    capsys.readouterr()
    assert trainings.main(*where, only=["bca", "nonsense"]) == 2 and len(did) == 6
    assert "no cell is named like 'nonsense'" in capsys.readouterr().err


def test_every_result_is_of_a_cell_of_the_grid():
    cells = {cell.name: dataclasses.asdict(cell) for cell in trainings.read_grid()}
    for path in (Path(__file__).parents[1] / "results").glob("*.json"):
        cell = json.loads(path.read_text())["cell"]
        assert {"name": path.stem, **cells[path.stem]} == cell


def test_first_seed_of_every_task_comes_first(grid):
    assert [cell.name for cell in grid(ROW)] == [
        "type1_bca-ppo-internal-demo-seed0",
        "type1_lcca-ppo-internal-demo-seed0",
        "type1_bca-ppo-internal-demo-seed1",
        "type1_lcca-ppo-internal-demo-seed1",
    ]
    text = ROW.replace("= 1000", "= { type1_bca = 512, type1_lcca = 1024 }")
    assert [cell.total_frames for cell in grid(text)[:2]] == [512, 1024]
    cell = grid(ROW.replace('"internal"', '["goal", "force"]'))[0]
    assert cell.name == "type1_bca-ppo-goal+force-demo-seed0"


def test_a_cell_makes_the_settings_of_its_training(grid):
    more = (
        "settings = { num_envs = 8, task_kwargs = { friction = 0.1 }, "
        'initial_policy = "runs/{task}-bc" }\n'
    )
    config = grid(ROW + more)[3].config()
    assert (config.algorithm, config.task, config.seed) == ("ppo", "type1_lcca", 1)
    assert (config.total_frames, config.num_envs) == (1000, 8)
    assert config.task_kwargs == {"friction": 0.1}
    assert config.initial_policy == "runs/type1_lcca-bc"
    assert config.clip == 0.2  # of the preset


@pytest.mark.parametrize(
    ("change", "word"),
    [
        (("seeds = [0, 1]", "seeds = [true]"), "seed"),
        (("seeds = [0, 1]", "seed = 1"), "seed"),
        (('label = "PPO"', ""), "label"),
        (('"type1_bca"', '"../escaped"'), "no task"),
        (("[[row]]", '[[row]]\nvariant = "/x"'), "name with /"),
        (('"demo"', '"nonsense"'), "preset"),
        (("= 1000", "= 0"), "total_frames"),
        (("= 1000", "= { type1_bca = 5 }"), "lacks 'type1_lcca'"),
        (("= 1000", "= 1\nevaluation = { episodes = 0 }"), "evaluation=.*episodes"),
        (("= 1000", "= 1\nevaluation = { seed = 0 }"), "evaluation=.*may have task"),
        (("= 1000", '= 1\nevaluation = { task = "none" }'), "of `cathsim list`"),
        (("= 1000", '= 1\nevaluation = { each_arch = "test" }'), "random arches"),
        (("[[row]]", "[row]"), "grid.toml"),
        (("[[row]]", "[[row"), "grid.toml"),
        (("[[row]]", ROW + "[[row]]"), "row 2: .*twice; give a variant"),
    ],
)
def test_a_bad_grid_is_refused_before_any_work(grid, change, word):
    with pytest.raises(ValueError, match=word) as error:
        grid(ROW.replace(*change))
    assert "grid.toml" in str(error.value)


@pytest.mark.parametrize("shares, frames", [([0.0] * 4, 200), ([1, 0.5, 0.02, 0], 400)])
def test_episodes_that_an_expert_drives_do_not_count_as_solved(shares, frames):
    rows = [
        {"frames": 100 * n, "seconds": n, "episodes": 60.0 * n, "success": 1.0}
        for n in range(1, 5)
    ]
    for row, share in zip(rows, shares, strict=True):
        row["expert_share"] = share

    assert trainings.solved(rows) == {"frames": frames, "seconds": frames / 100}


def test_policies_that_ship_fit_the_cells_that_start_from_them():
    starts = [(c, str(c.settings.get("initial_policy"))) for c in trainings.read_grid()]
    starts = [(c, one) for c, one in starts if one.startswith("pretrained:")]
    assert starts
    for cell, name in starts:
        source, own = load_policy(name).config, cell.config()
        assert tuple(own.observation) == tuple(source.observation)
        assert (own.hidden, own.activation) == (source.hidden, source.activation)
