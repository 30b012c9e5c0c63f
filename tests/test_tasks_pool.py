"""Tasks on a list of anatomies, each episode in one of them."""

import json

import numpy as np
import pytest

import cathsim_dmc
from cathsim_dmc import suite
from cathsim_dmc.agents import evaluate, protocols
from cathsim_dmc.anatomy.phantoms import load
from cathsim_dmc.simulation.batch import BatchSimulation

SEEN = ("tracking", "route", "goal", "force")


@pytest.fixture(scope="module")
def options(tmp_path_factory):
    """A small phantom, a folder as of a scan, and a random arch, with other goals."""
    folder = tmp_path_factory.mktemp("scans") / "my_scan"
    load("simple2").save(folder)
    arch = suite.load_arches("train", 1, 1)
    return {"anatomy": ["simple1", folder, *arch], "goal": ["lcca", "bca", "lsa"]}


@pytest.mark.slow
def test_an_episode_is_that_of_its_anatomy_alone_in_both_paths(options):
    both = {**options, "observation": SEEN}
    pooled = suite.load("cathsim", "navigate", both)
    batch = BatchSimulation(suite.make_task("navigate", **both), 3, seeds=1)
    start, length = batch.reset(), pooled.task.config.working_length
    assert length == batch.task.config.working_length is not None
    drawn, action = set(), np.full(21, 0.3)
    rows = [start, *(batch.step(np.tile(action, (3, 1))) for _ in "123")]
    for number in range(3):
        pooled.random_state.set_state(np.random.RandomState(1 + number).get_state())
        steps = [pooled.reset(), *(pooled.step(action) for _ in "123")]
        source = np.random.RandomState(1 + number)
        which = source.randint(3)
        drawn.add(which)
        goal = options["goal"][which]
        assert pooled.task.scene.goal.name == goal
        for row, step in zip(rows, steps, strict=True):
            for key, value in step.observation.items():
                np.testing.assert_array_equal(row.observation[key][number], value)
        alone = {"anatomy": options["anatomy"][which], "goal": goal}
        alone |= {"working_length": length, "observation": SEEN}
        single = suite.load("cathsim", "navigate", alone)
        single.random_state.set_state(source.get_state())
        for step, other in zip(
            steps, [single.reset(), *(single.step(action) for _ in "123")], strict=True
        ):
            assert step.reward == other.reward
            for key, value in other.observation.items():
                np.testing.assert_array_equal(step.observation[key], value)
    assert drawn == {0, 1, 2}


@pytest.mark.slow
def test_conditions_of_an_evaluation_name_the_anatomy(options, tmp_path):
    named = {"anatomy": ["simple1", str(options["anatomy"][1])], "goal": "bca"}
    kwargs = {**named, "max_steps": 2}
    parts = protocols.parts(protocols.get("varied"), "navigate", kwargs, 8, 5)
    drawn = [one for part in parts for one in part.conditions]
    assert {one["anatomy"] for one in drawn} == {"simple1", "my_scan"}
    assert sum(one["anatomy"] == "simple1" for one in drawn) == 4
    seen = []

    def observe(env, running):
        rollout = env.base_env.simulation.rollout
        seen.append([rollout.case(i).scene.anatomy.name for i in range(len(running))])

    result = evaluate(
        "push", "navigate", 4, protocol="varied", task_kwargs=kwargs,
        out_dir=tmp_path, observer=observe,
    )  # fmt: skip
    places = {"simple1": "simple1", "my_scan": load("simple2").name}
    own = [places[one["anatomy"]] for one in result.conditions]
    assert own == [*seen[0], *seen[-1]]  # a batch for each of two devices
    assert json.loads((tmp_path / "evaluation.json").read_text())["distinct"]


def test_a_task_may_have_a_list_of_anatomies(monkeypatch, tmp_path):
    monkeypatch.setattr(suite, "TASKS", dict(suite.TASKS))
    definition = suite.TaskDefinition("Two arches.", ["simple1", "simple2"], "bca")
    suite.TASKS["two"] = definition
    env = suite.environment(suite.make_task("two", random=0, max_steps=3))
    assert env.task.num_anatomies == 2
    names = set()
    for seed in range(6):
        episode = cathsim_dmc.record(env, "push", tmp_path / "one.npz", seed=seed)
        names.add(episode.meta["anatomy"])
    assert names == {"simple1", "simple2"}


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"anatomy": []}, r"a list with one at least"),
        ({"goal": ["bca"]}, r"goal is \['bca'\]; it must be one name, or a list of 2"),
        ({"access": ["ascending"] * 3}, "access is .* a list of 2, as of anatomies"),
        ({"anatomy": ["simple1", "none"]}, "no anatomy at 'none'"),
        ({"anatomy": ["simple1", 3]}, "anatomy is 3"),
        ({"goal": "spleen"}, "goal is 'spleen'"),
    ],
)
def test_wrong_lists_are_refused(wrong, message):
    given = {"anatomy": ["simple1", "simple2"], "goal": "bca", **wrong}
    with pytest.raises(ValueError, match=message):
        suite.make_task("navigate", **given)
