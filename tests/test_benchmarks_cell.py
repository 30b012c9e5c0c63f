"""One cell: trained, judged, written; resumed, refused, reported."""

import dataclasses
import json

import numpy as np
import pytest
import synthetic_env

from cathsim_dmc.agents import evaluation, training
from cathsim_dmc.analysis.heatmap import force_map
from cathsim_dmc.benchmarks import protocol, result, table
from cathsim_dmc.benchmarks.grid import Cell
from cathsim_dmc.tasks.config import MAX_STEPS

CELL = Cell(
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


@pytest.fixture
def folders(tmp_path):
    """Directories of runs and of results."""
    return tmp_path / "runs", tmp_path / "results"


def result_of(folders):
    return folders[1] / f"{CELL.name}.json"


@pytest.fixture
def synthetic(monkeypatch):
    """Trains and judges on a small environment; counts how often."""
    counts = {"train": 0, "judge": 0}

    def train(config, run, resume):
        counts["train"] += 1
        make_env = synthetic_env.make_env
        return training.train(config, run, resume, progress=False, make_env=make_env)

    def judge(policy, task, task_kwargs, episodes, name):
        counts["judge"] += 1
        counts["options"] = task_kwargs
        found = evaluation.evaluate(
            policy, task, episodes, name=name, task_kwargs={},
            make_env=synthetic_env.make_env,
        )  # fmt: skip
        return protocol.Judgement(found)

    monkeypatch.setattr(table, "train", train)
    monkeypatch.setattr(protocol, "judge", judge)
    return counts


def test_a_finished_cell_tells_how_it_came_about(folders, synthetic):
    done = table.work(CELL, *folders)
    written = json.loads(result_of(folders).read_text())
    assert written["cell"]["name"] == CELL.name
    assert written["config"] == json.loads(json.dumps(CELL.config().to_dict()))
    assert done.training["frames"] == 512 and done.training["seconds"] > 0
    assert done.training["curve"]["frames"] == [256, 512]
    assert done.evaluation["summary"]["episodes"] == 3
    assert len(done.evaluation["episodes"]["max_force"]) == 3
    assert {"python", "torch", "mujoco"} <= set(written["versions"])
    assert written["machine"]["cores"] >= 1 and "commit" in written
    assert table.standing(CELL, *folders)[:2] == ("finished", 512)


def test_the_evaluation_is_the_published_one_whatever_was_trained(folders, synthetic):
    options = {"max_steps": 20}
    table.work(_changed(settings={**CELL.settings, "task_kwargs": options}), *folders)
    assert synthetic["options"] == {"max_steps": MAX_STEPS}
    more = {"reward": "path", "goal_radius": 0.1, "friction": 0.1, "rotation": True}
    assert protocol.published_options({**options, **more}) == {
        "friction": 0.1,
        "rotation": True,
        "max_steps": MAX_STEPS,
    }


def test_what_is_done_is_not_done_again(folders, synthetic):
    table.work(CELL, *folders)
    assert table.run([CELL], *folders) == {}
    assert synthetic["train"] == synthetic["judge"] == 1


def test_a_damaged_file_costs_an_evaluation_and_no_training(folders, synthetic):
    table.work(CELL, *folders)
    path = result_of(folders)
    path.write_text(path.read_text()[:100])
    state, frames, remark = table.standing(CELL, *folders)
    assert (state, frames) == ("begun", 512) and "cannot be read" in remark
    table.work(CELL, *folders)
    assert synthetic["train"] == 1 and synthetic["judge"] == 2
    assert table.standing(CELL, *folders)[0] == "finished"


def test_other_settings_are_left_alone(folders, synthetic):
    table.work(CELL, *folders)
    said = []
    for changes in (
        {"settings": {**CELL.settings, "clip": 0.3}},
        {"total_frames": 1024},
        {"evaluation": {"episodes": 4}},
    ):
        other = _changed(**changes)
        state, frames, remark = table.standing(other, *folders)
        assert (state, frames) == ("other settings", 512)
        assert next(iter(changes)) in remark and str(result_of(folders)) in remark
        assert table.run([other], *folders, say=said.append) == {}
    assert synthetic["train"] == 1 and len(said) == 3
    # A label is a matter of the page.
    assert table.standing(_changed(label="other"), *folders)[0] == "finished"


def test_a_cell_that_fails_does_not_stop_the_others(folders, synthetic, monkeypatch):
    work, said = table.work, []

    def fail_once(cell, *directories):
        if cell.seed == 0:
            raise FloatingPointError("loss is not finite")
        return work(cell, *directories)

    wrong, other = _changed(preset="nonsense"), _changed(seed=1)
    assert table.standing(wrong, *folders)[0] == "impossible"
    with monkeypatch.context() as patch:
        patch.setattr(table, "work", fail_once)
        found = table.run([CELL, wrong, other], *folders, say=said.append)
    outcomes = ("failed", "failed", "finished")
    assert found == dict(
        zip((CELL.name, wrong.name, other.name), outcomes, strict=True)
    )
    assert any("loss is not finite" in line for line in said)
    # The next call does what is left.
    assert table.run([CELL, other], *folders) == {CELL.name: "finished"}


def test_an_interrupted_training_ends_the_loop(folders, synthetic, monkeypatch):
    train = table.train

    def interrupted(config, run, resume):
        return dataclasses.replace(train(config, run, resume), interrupted=True)

    with monkeypatch.context() as patch:
        patch.setattr(table, "train", interrupted)
        cells = [CELL, _changed(seed=1)]
        assert table.run(cells, *folders) == {CELL.name: "interrupted"}
    # It was complete in fact, so nothing is trained again.
    assert table.run([CELL], *folders) == {CELL.name: "finished"}
    assert synthetic["train"] == 1


def test_learning_curves_are_thinned_to_200_points():
    rows = [{"frames": float(i), "seconds": i / 2, "success": None} for i in range(999)]
    curve = result.learning_curve(rows)
    assert len(curve["frames"]) == 200
    assert (curve["frames"][0], curve["frames"][-1]) == (0, 998)
    assert set(curve["success"]) == {None} and "distance" not in curve
    assert len(result.learning_curve(rows[:7])["frames"]) == 7
    assert result.learning_curve([]) == {}


def test_the_first_few_episodes_solve_nothing():
    def row(frames, episodes, success):
        return {
            "frames": frames,
            "seconds": frames / 10,
            "episodes": episodes,
            "success": success,
        }

    rows = [row(10, 5, 1.0), row(20, 120, 0.89), row(30, 150, 0.9), row(40, 160, 1.0)]
    assert result.solved(rows) == {"frames": 30, "seconds": 3.0}
    assert result.solved(rows[:2]) is None


def test_force_maps_survive_the_file():
    random = np.random.default_rng(0)
    place = random.uniform(-0.02, 0.02, (50, 3))
    made = force_map(place, random.random(50), np.full(2, -0.021), np.full(2, 0.021))
    read = result.map_from_values(json.loads(json.dumps(result.map_values(made))))
    np.testing.assert_array_equal(read.count, made.count)
    np.testing.assert_allclose(read.mean, made.mean, rtol=1e-5)
    np.testing.assert_allclose(read.x_edges, made.x_edges, atol=1e-9)


def test_a_result_under_another_name_is_refused(folders, synthetic):
    table.work(CELL, *folders)
    path = result_of(folders)
    moved = path.rename(path.with_name("type2_bca-ppo.json"))
    with pytest.raises(result.ResultError, match="type2_bca-ppo.json is damaged"):
        result.read_result(moved)


def _changed(**changes):
    return dataclasses.replace(CELL, **changes)
