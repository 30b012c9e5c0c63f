import dataclasses
import json
import math

import numpy as np
import pytest

from cathsim_dmc import suite
from cathsim_dmc.agents import EvaluationResult, comparison, evaluate, protocols
from cathsim_dmc.agents.episodes import EpisodeOutcome
from cathsim_dmc.analysis.force_statistics import EpisodeForces, Statistics
from cathsim_dmc.physics.effects import Effect
from cathsim_dmc.simulation.batch import BatchSimulation


def result(task="type1_bca", policy="mine", episodes=4, first=10, **options):
    """An evaluation in which every second episode succeeds."""
    forces = EpisodeForces(mean_sum=Statistics(0.02, 0.04, 0.3))
    played = tuple(
        EpisodeOutcome(n, 1.0, 50, True, n % 2 == 0, forces, False, 1.1)
        for n in range(episodes)
    )
    settings = {"protocol": "published", "observation": "internal", "frames": None}
    settings["task_kwargs"] = options
    seeds = tuple(range(first, first + episodes))
    return EvaluationResult(task, policy, seeds, played, settings, distinct=False)


def written(folder, one, baseline=None):
    """Writes evaluations as `cathsim eval --out` does."""
    folder.mkdir(parents=True)
    values = {"policy": one.to_dict()}
    if baseline is not None:
        values["baseline"] = baseline.to_dict()
    path = folder / "evaluation.json"
    path.write_text(json.dumps({**values, "seconds": 1.0}))
    return path


@pytest.mark.parametrize("protocol", ["published", "varied"])
def test_an_evaluation_is_read_as_it_was_played(tmp_path, protocol):
    played = evaluate(
        "random", "type1_bca", 3, protocol=protocol, task_kwargs={"max_steps": 3},
        out_dir=tmp_path,
    )  # fmt: skip
    read = EvaluationResult.load(tmp_path)
    assert read == EvaluationResult.load(tmp_path / "evaluation.json")
    plain = json.loads(json.dumps(played.settings))
    assert read == dataclasses.replace(played, settings=plain)
    assert read.summary() == played.summary()
    assert bool(read.conditions) is (protocol == "varied")


@pytest.mark.filterwarnings("ignore:invalid value")
def test_a_figure_that_is_not_finite_is_read(tmp_path):
    one = result()
    odd = dataclasses.replace(one.episodes[0], reward=math.inf)
    one = dataclasses.replace(one, episodes=(odd, *one.episodes[1:]))
    assert EvaluationResult.load(written(tmp_path / "a", one)) == one


def test_the_command_writes_what_is_read(tmp_path, cathsim):
    code, _, err = cathsim(
        *("eval", "push", "--task", "type1_bca", "--episodes", 2, "--threads", 1),
        *("--max-steps", 2, "--out", tmp_path / "one"),
    )
    assert code == 0, err
    read = [EvaluationResult.load(tmp_path / "one", w) for w in ("policy", "baseline")]
    assert [one.policy for one in read] == ["push", "random"]
    assert [len(one.episodes) for one in read] == [2, 2]
    code, out, err = cathsim("table", tmp_path)
    assert code == 0, err
    assert "| type1_bca | push | 0 % | 1 of 2 |" in out and "rules" not in out


@pytest.mark.parametrize(
    "change, message",
    [
        (lambda v: v.clear(), "neither episodes nor a policy"),
        (lambda v: v.update(policy=[]), r"the evaluation is \[\]"),
        (lambda v: v["policy"].update(episodes=[]), "it has no episodes"),
        (lambda v: v["policy"].pop("distinct"), "'distinct'"),
        (lambda v: v["policy"]["episodes"][1].pop("length"), "'length'"),
        (lambda v: v["policy"]["episodes"][1].update(length=0.5), "length is 0.5"),
        (lambda v: v["policy"]["episodes"][1].update(success=1), "success is 1"),
        (lambda v: v["policy"]["episodes"][1].update(conditions={}), "1 of 4 episodes"),
        (lambda v: v["policy"]["episodes"].__setitem__(2, 7), "an episode is 7"),
        (
            lambda v: v["policy"]["episodes"][0]["forces"]["mean_sum"].update(mean=-1),
            "forces.mean_sum.mean is -1",
        ),
    ],
)
def test_what_is_no_evaluation_is_refused(tmp_path, change, message):
    path = written(tmp_path / "a", result())
    values = json.loads(path.read_text())
    change(values)
    path.write_text(json.dumps(values))
    with pytest.raises(ValueError, match=f"is no evaluation; give an .*{message}"):
        EvaluationResult.load(path)


def test_other_files_are_refused(tmp_path):
    for name, text in {"a": "", "b": "[1]", "c": "[" * 10**5, "d": "\x00"}.items():
        (tmp_path / name).write_text(text)
        with pytest.raises(ValueError, match="is no evaluation; give an") as caught:
            EvaluationResult.load(tmp_path / name)
        assert "\n" not in str(caught.value)
    with pytest.raises(FileNotFoundError, match="give an evaluation.json that"):
        EvaluationResult.load(tmp_path / "none")
    path = written(tmp_path / "one", result())
    with pytest.raises(ValueError, match="has no baseline; there is policy"):
        EvaluationResult.load(path, "baseline")
    with pytest.raises(ValueError, match="which is 'best'"):
        EvaluationResult.load(path, "best")


def test_an_evaluation_is_shown_in_a_line():
    assert repr(result(policy="one")) == (
        "<EvaluationResult of 'one' on 'type1_bca', published: 2 of 4 episodes succeed>"
    )


def test_rows_under_other_rules_are_marked(tmp_path):
    same = {"reward": {"path": -1.0}, "observation": ["route"], "max_steps": 2000}
    files = [
        written(tmp_path / "a", result(policy="one")),
        written(tmp_path / "b", result(policy="two", **same)),
        written(tmp_path / "c", result(policy="three", goal_radius=0.004)),
        written(tmp_path / "d", result(policy="four", first=11)),
        written(tmp_path / "e", result(policy="five", episodes=2)),
        written(tmp_path / "f", result("type1_lcca", "six")),
    ]
    found = comparison.Comparison.of(files)
    assert [row.rules for row in found.rows] == [1, 1, 2, 3, 4, 5]
    names = {name for one in found.differences() for name in one}
    assert names == {"task", "episodes", "seeds", "goal_radius"}
    text = repr(found)
    assert text == found._repr_markdown_()
    assert "| one | 50 % | 1 of 4 | 50 % | 50 ± 0 | 20.0 ± 0.0 | – | – | 1 |" in text
    assert "Rows with different rules cannot be compared" in text
    assert "seeds: 11 to 14" in text and "goal_radius: 0.004" in text
    alike = comparison.Comparison.of(files[:2])
    assert "ules" not in "".join(alike.markdown())


def test_an_anatomy_is_told_by_its_lumen_not_by_its_path(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    folders = ["scan", "scan", tmp_path / "scan"]
    for number, (shape, folder) in enumerate(
        zip(("simple1", "simple2", "simple2"), folders, strict=True)
    ):
        scan = suite.load_anatomy(shape)
        dataclasses.replace(scan, name="scan").save(tmp_path / "scan")
        options = {"anatomy": folder, "goal": "bca", "max_steps": 2}
        evaluate("push", "navigate", 1, task_kwargs=options, out_dir=f"study/{number}")
    found = comparison.Comparison.of(["study"])
    assert [row.rules for row in found.rows] == [1, 2, 2]
    one, other = (each["anatomy"] for each in found.differences())
    assert one != other and one.startswith("scan ")
    assert "anatomy: scan " in repr(found)
    one = found.rows[0].result
    settings = {**one.settings, "lumens": ["a 1", "b 2"]}
    pool = comparison.rules_of(dataclasses.replace(one, settings=settings))
    assert pool["anatomy"] == ["a 1", "b 2"]


def test_the_notes_tell_rules_apart_that_differ_late_in_a_long_value(tmp_path):
    friction, stiff, soft = [0.02, 0.02], [1.3, 1.3], [0.7, 0.7]
    wire = "Device(name='own', " + 80 * "-" + " EI={}, source='bench')"
    for name, stiffness, device in (
        ("a", soft, wire.format(1)),
        ("b", stiff, wire.format(1)),
        ("c", stiff, wire.format(2)),
    ):
        drawn = {"friction": friction, "stiffness": stiffness, "start_radius": 0.004}
        one = result(policy=name, randomisation=drawn, device=device)
        written(tmp_path / name, one)
    lines = comparison.Comparison.of([tmp_path]).markdown()
    notes = [line.partition(": ")[2] for line in lines if line.startswith("- rules")]
    assert len(set(notes)) == 3
    assert [f"randomisation.stiffness: {stiff}" in one for one in notes] == [0, 1, 1]
    assert not any("friction" in one for one in notes)
    assert ["EI=2" in one for one in notes] == [False, False, True]


def test_episodes_that_began_at_other_states_have_other_rules():
    simulation = BatchSimulation(suite.make_task("simple1_bca", max_steps=4), 2)
    simulation.reset()
    starts = [None, simulation.snapshot(), simulation.snapshot()]
    simulation.step(np.ones((2, simulation.num_actions)))
    starts.append(simulation.snapshot())
    options = {"episodes": 2, "task_kwargs": {"max_steps": 4}}
    played = [evaluate("push", "simple1_bca", start=one, **options) for one in starts]
    found = [comparison.rules_of(one)["start"] for one in played]
    assert found[0] == "task" and found[1] == found[2]
    assert len(set(found)) == 3


def test_episodes_with_other_effects_have_other_rules():
    class Wind(Effect):
        def __init__(self, force):
            self.force = force

    chosen = [], [Wind(0.1)], [Wind(0.1)], [Wind(0.2)], [Wind(0.2), Effect()]
    rules = [comparison.rules_of(result(effects=each)) for each in chosen]
    assert rules[0] == comparison.rules_of(result()) and rules[1] == rules[2]
    assert rules.index(rules[3]) == 3 and rules.index(rules[4]) == 4
    assert rules.index(rules[1]) == 1


def test_forces_read_at_another_time_have_other_rules():
    older = EpisodeForces(sum=Statistics(0.1, 0.1, 0.2))
    one = result()
    episodes = [dataclasses.replace(e, forces=older) for e in one.episodes]
    other = dataclasses.replace(one, episodes=tuple(episodes))
    assert comparison.rules_of(one) != comparison.rules_of(other)


def test_folders_are_searched_and_equal_baselines_listed_once(tmp_path, cathsim):
    random = result(policy="random")
    written(tmp_path / "x" / "deep", result(policy="a|b"), random)
    path = written(tmp_path / "y", result(policy="other"), random)
    code, out, err = cathsim("table", tmp_path, path, "--json")
    assert code == 0, err
    values = json.loads(out)
    assert [row["policy"] for row in values["rows"]] == ["a|b", "random", "other"]
    assert values["checks"] == [] and values["differences"] == {}
    assert values["rules"]["1"]["max_steps"] == 2000
    _, out, _ = cathsim("table", tmp_path, "--no-baseline")
    assert "random" not in out and r"| a\|b |" in out and "| file |" not in out
    written(tmp_path / "z", result(policy="other", episodes=2))
    _, out, _ = cathsim("table", tmp_path)
    assert f"| {path} | 1 |" in out  # two rows have this task and policy
    (tmp_path / "empty").mkdir()
    for arguments, message in (
        ([tmp_path / "empty"], "no evaluation.json in the folder"),
        ([], "no evaluation is given"),
    ):
        code, _, err = cathsim("table", *arguments)
        assert code == 2 and message in err


@pytest.mark.parametrize(
    "conditions, count",
    [
        ([{"friction": 0.1}, {"friction": 0.2}, {"friction": 0.1}], 2),
        ([{"arch": 3}, {"arch": 4}], 2),
        ([{"kerma": 1.0, "view": [1, 2]}, {"kerma": 2.0, "view": [0, 0]}], 1),
        ([{"displacement_drawn": [1e-3, 0, 0]}, {"displacement_drawn": [0, 0, 0]}], 1),
        ([{"displacement_drawn": [9e-3, 0, 0]}, {"displacement_drawn": [0, 0, 0]}], 2),
        ([{"insertion_drawn": 0.0201}, {"insertion_drawn": 0.0199}], 1),
        ([{"insertion_drawn": 0.02}, {"insertion_drawn": 0.03}], 2),
    ],
)
def test_conditions_are_counted_as_they_are_called_distinct(conditions, count):
    assert protocols.count_distinct(conditions) == count
    played = result(episodes=len(conditions))
    many = dataclasses.replace(played, conditions=tuple(conditions))
    assert many.num_conditions == count
    assert played.num_conditions == 1
    assert dataclasses.replace(played, distinct=True).num_conditions == len(conditions)


def test_the_anatomy_of_a_pool_is_a_condition_of_its_episode():
    """It is drawn by the seed of the episode, as the simulation draws it."""
    options = {"anatomy": ["type1", "type2"], "goal": "bca", "max_steps": 1}
    seen = {}

    def observer(env, running):
        cases = env.base_env.simulation.rollout.case
        seen.update({n: cases(n).scene.anatomy.name for n in range(len(running))})

    played = evaluate("push", "navigate", 6, task_kwargs=options, observer=observer)
    told = [one["anatomy"] for one in played.conditions]
    assert told == [seen[n] for n in range(6)] and len({*told}) == 2
    assert played.num_conditions == 2 and not played.distinct
