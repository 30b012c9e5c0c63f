"""One cell: trained, judged, written; resumed, refused, reported."""

import dataclasses
import json
import subprocess
import sys

import numpy as np
import pytest
import synthetic_env

from cathsim_dmc.agents import ConfigError, evaluation, training
from cathsim_dmc.analysis.heatmap import force_map
from cathsim_dmc.benchmarks import Folders, cell, protocol, result, runner
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
    return Folders(tmp_path / "runs", tmp_path / "results")


@pytest.fixture
def synthetic(monkeypatch):
    """Trains and judges on a small environment; counts how often."""
    counts = {"train": 0, "judge": 0}

    def train(config, run, resume):
        counts["train"] += 1
        make_env = synthetic_env.make_env
        return training.train(config, run, resume, progress=False, make_env=make_env)

    def judge(policy, task, *, observation, task_kwargs, episodes, name, num_threads):
        counts["judge"] += 1
        counts["options"] = task_kwargs
        found = evaluation.evaluate(
            policy, task, episodes, name=name, task_kwargs={},
            make_env=synthetic_env.make_env,
        )  # fmt: skip
        return protocol.Judgement(found, None)

    monkeypatch.setattr(cell, "train", train)
    monkeypatch.setattr(protocol, "judge", judge)
    return counts


def test_a_finished_cell_tells_how_it_came_about(folders, synthetic):
    done = cell.work(CELL, folders)
    written = json.loads(folders.result(CELL).read_text())
    assert written["cell"]["name"] == CELL.name
    assert written["config"] == json.loads(json.dumps(CELL.config().to_dict()))
    assert done.training["frames"] == 512 and done.training["seconds"] > 0
    assert done.training["curve"]["frames"] == [256, 512]
    assert done.evaluation["summary"]["episodes"] == 3
    assert len(done.evaluation["episodes"]["max_force"]) == 3
    assert {"python", "torch", "mujoco"} <= set(written["versions"])
    assert written["machine"]["cores"] >= 1 and "commit" in written
    assert len(done.training["sessions"]) == 1
    assert runner.standing(CELL, folders).state == "finished"


def test_the_evaluation_is_the_published_one_whatever_was_trained(folders, synthetic):
    options = {"max_steps": 20}
    cell.work(_changed(settings={**CELL.settings, "task_kwargs": options}), folders)
    assert synthetic["options"] == {"max_steps": MAX_STEPS}
    more = {"reward": "path", "goal_radius": 0.1, "friction": 0.1, "rotation": True}
    assert protocol.published_options({**options, **more}) == {
        "friction": 0.1,
        "rotation": True,
        "max_steps": MAX_STEPS,
    }


def test_what_is_done_is_not_done_again(folders, synthetic):
    cell.work(CELL, folders)
    cell.work(CELL, folders)
    assert synthetic["train"] == synthetic["judge"] == 1


def test_a_damaged_file_costs_an_evaluation_and_no_training(folders, synthetic):
    cell.work(CELL, folders)
    path = folders.result(CELL)
    path.write_text(path.read_text()[:100])
    assert "cannot be read" in runner.standing(CELL, folders).remark
    cell.work(CELL, folders)
    assert synthetic["train"] == 1 and synthetic["judge"] == 2
    assert runner.standing(CELL, folders).state == "finished"


def test_other_settings_are_left_alone_unless_asked_for(folders, synthetic):
    cell.work(CELL, folders)
    other = _changed(settings={**CELL.settings, "clip": 0.3})
    assert other.name == CELL.name
    before = runner.standing(other, folders)
    assert before.state == "other settings" and "clip: 0.2, now 0.3" in before.remark
    with pytest.raises(ConfigError, match="clip.*--anew"):
        cell.work(other, folders)
    cell.work(other, folders, anew=True)
    assert runner.standing(other, folders).state == "finished"
    assert folders.run(CELL).with_name(f"{CELL.name}.old1").is_dir()
    assert synthetic["train"] == 2


def test_more_frames_are_other_settings(folders, synthetic):
    cell.work(CELL, folders)
    longer = _changed(total_frames=1024)
    assert "total_frames" in runner.standing(longer, folders).remark


def test_a_failure_is_noted_until_it_is_mended(folders, synthetic, monkeypatch):
    def fail(*arguments, **options):
        raise FloatingPointError("loss is not finite")

    with monkeypatch.context() as patch:
        patch.setattr(cell, "train", fail)
        with pytest.raises(FloatingPointError):
            cell.work(CELL, folders)
    now = runner.standing(CELL, folders)
    assert now.state == "failed" and "loss is not finite" in now.remark
    cell.work(CELL, folders)
    assert folders.failure(CELL) is None


def test_a_cell_belongs_to_one_process(folders):
    folders.runs.mkdir()
    lock = folders.runs / f".{CELL.name}.lock"
    hold = "import fcntl, sys, time; f = open(sys.argv[1], 'ab'); "
    hold += "fcntl.flock(f, fcntl.LOCK_EX); print('held', flush=True); time.sleep(120)"
    command = [sys.executable, "-c", hold, str(lock)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as holder:
        try:
            assert holder.stdout.readline() == "held\n"
            assert cell.is_busy(folders, CELL)
            assert runner.standing(CELL, folders).state == "running"
            with pytest.raises(cell.BusyError, match=CELL.name):
                cell.work(CELL, folders)
        finally:
            holder.kill()
    assert not cell.is_busy(folders, CELL)


def test_estimates_come_from_the_cells_most_alike():
    def standing(frames, seconds, state="begun", **changes):
        return runner.Standing(_changed(**changes), state, frames, seconds)

    waiting = standing(0, 0.0, "waiting", task="type2_bca", total_frames=1000)
    slow = standing(1000, 100.0, task="type2_bca", seed=1)
    fast = standing(1000, 10.0, task="type1_lcca", seed=1)
    other = standing(1000, 1.0, algorithm="sac")
    evaluation_alone = 120.0
    both = runner.estimate(waiting, [waiting, slow, fast, other])
    assert both == pytest.approx(100 + evaluation_alone)
    assert runner.estimate(waiting, [waiting, fast]) == pytest.approx(
        10 + evaluation_alone
    )
    assert runner.estimate(waiting, [waiting, other]) is None


def test_what_is_left_is_told_with_the_speeds_of_all_cells():
    def standing(state, frames=0, seconds=0.0, **changes):
        return runner.Standing(_changed(**changes), state, frames, seconds)

    waiting = standing("waiting", total_frames=1000)
    trained = standing("begun", 1000, 100.0, seed=1, total_frames=2000)
    foreign = standing("other settings", 500, 5.0, seed=2)
    wrong = standing("impossible", preset="nonsense")
    # The speed is that of a cell that was not asked for; 100 s and the evaluation.
    text = runner.left_over([waiting], [waiting, trained])
    assert text == "0 of 1 cells finished, 1 left: about 0:03:40"
    unknown = runner.left_over([waiting], [waiting])
    assert unknown.endswith("1 left: about 0:00:00 and 1 of unknown length")
    # What is not run takes no time and is not left.
    text = runner.left_over([foreign, wrong], [foreign, wrong])
    assert text == (
        "0 of 2 cells finished; 1 with other settings, left as they are; 1 impossible"
    )


def test_an_unknown_preset_is_impossible_and_stops_nothing(folders):
    wrong = _changed(preset="nonsense")
    said = []
    assert runner.standing(wrong, folders).state == "impossible"
    assert runner.run([], folders, say=said.append) == {}


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
    cell.work(CELL, folders)
    path = folders.result(CELL)
    moved = path.rename(path.with_name("type2_bca-ppo.json"))
    with pytest.raises(result.ResultError, match="another cell"):
        result.read_result(moved)


def _changed(**changes):
    return dataclasses.replace(CELL, **changes)
