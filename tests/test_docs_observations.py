"""The table of observations is complete and up to date."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest
from conftest import OBSERVATIONS, twin

from cathsim_dmc import suite
from cathsim_dmc.simulation.batch import BatchSimulation
from cathsim_dmc.tasks import observations
from cathsim_dmc.tasks.observation_kind import Entry, Sizes

SCRIPT = Path(__file__).parents[1] / "docs" / "scripts" / "observations.py"


@pytest.fixture
def script(monkeypatch):
    monkeypatch.syspath_prepend(str(SCRIPT.parent))
    spec = importlib.util.spec_from_file_location("docs_observations", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def environment():
    """With all observations that need no OpenGL."""
    options = {"observation": OBSERVATIONS, "random": 0}
    return suite.load("cathsim", "simple1_bca", options)


def test_the_table_names_what_the_functions_return(environment, monkeypatch):
    """A key that is missing or too many is found."""
    frames = []
    observe = observations.observe
    monkeypatch.setattr(
        observations,
        "observe",
        lambda names, frame: frames.append(frame) or observe(names, frame),
    )
    environment.reset()
    frame = frames[-1]
    for name in OBSERVATIONS:
        returned = observations.OBSERVATIONS[name].observe(frame)
        listed = observations.entry_specs([name], Sizes())
        assert list(returned) == list(listed)


def test_an_own_row_returns_what_it_declares(environment):
    table, entry = observations.OBSERVATIONS, Entry("own", 2, "m", "two numbers")
    for given, words in (
        ({"own": np.zeros((1, 3))}, r"'own' .* declares \(2,\)"),
        ({}, r"'own' .* declares \(2,\)"),
        ({"own": np.zeros((1, 2), dtype=int)}, "of int64, .* declares float"),
        ({"own": [[0.0, 0.0]]}, r"'own' of an observation is \[\[.* an array \(N"),
        ({"own": np.array([[0.0, np.nan]])}, "nan.* must be finite"),
        (np.zeros((1, 2)), "observation 'own' returns is .* a mapping"),
    ):

        def own(frame, given=given):
            return given

        table.row(entry)(own)
        try:
            task = twin(environment.task, observation="own")
            with pytest.raises(ValueError, match=words):
                suite.environment(task).reset()
        finally:
            del table["own"]
    with pytest.raises(ValueError, match="entries goal_position of observation 'own'"):
        table.row(Entry("goal_position", 2, "m", "another"))(own)
    own.__name__ = "goal"
    with pytest.raises(ValueError, match="the name of observation 'goal'"):
        table.row(entry)(own)


@pytest.mark.parametrize(
    ("given", "dtype", "fits"),
    [
        (np.array([[0.0, 1.0]]), np.float64, True),
        (np.array([[-1e-9, 1.0 + 1e-9]]), np.float64, True),
        (np.array([[-1e-3, 1.0]]), np.float64, False),
        (np.array([[0.0, 57.3]]), np.float64, False),
        (np.full((1, 2, 2, 1), 2, np.uint8), np.uint8, False),
    ],
)
def test_an_own_row_starts_in_the_range_that_it_declares(
    environment, given, dtype, fits
):
    table = observations.OBSERVATIONS
    entry = Entry("own", given.shape[1:], "1", "shares", 0.0, 1.0, dtype)

    def own(frame):
        return {"own": given}

    try:
        table.row(entry)(own)
        task = twin(environment.task, observation="own")
        if fits:
            shown = suite.environment(task).reset().observation["own"]
            assert shown.tolist() == given[0].tolist()
        else:
            words = "'own' .* at the start of an episode; .* numbers from 0 to 1"
            with pytest.raises(ValueError, match=words):
                suite.environment(task).reset()
    finally:
        table.pop("own", None)


def test_an_own_row_reads_images_that_the_task_does_not_observe(environment):
    table, seen = observations.OBSERVATIONS, []
    entry = Entry("darkest", 1, "grey level", "least grey level of the image", 0, 255)

    def own(frame):
        seen.append(frame.images["past_0"].copy())
        return {"darkest": seen[-1].min(axis=(1, 2)).astype(float)}

    try:
        table.row(entry)(own)
        task = twin(environment.task, observation="own")
        with pytest.raises(ValueError, match="image 'past_0', which the task does not"):
            suite.environment(task).reset()
        del table["own"]
        with pytest.raises(ValueError, match="images of 'own' is .* it must be of int"):
            table.row(entry, images=("picture",))(own)
        table.row(entry, images=("image", "endoluminal"))(own)
        task = twin(environment.task, observation="own")
        with_image = twin(environment.task, observation=["image", "own"])
        first, image = suite.environment(task).reset(), seen[-1][0]
        other = suite.environment(with_image).reset()
        assert list(first.observation) == ["darkest"]
        np.testing.assert_array_equal(image, other.observation["image"])
        assert first.observation["darkest"] == other.observation["darkest"] < 255
    finally:
        table.pop("own", None)


def test_the_page_is_what_the_specs_say(script):
    assert script.OUTPUT.read_text(encoding="utf-8") == script.page(), (
        "docs/observations.md is out of date; run docs/scripts/observations.py"
    )


def test_values_lie_in_the_ranges_of_the_table(environment):
    random = np.random.default_rng(0)
    timesteps = [environment.reset()]
    timesteps += [environment.step(random.uniform(-1, 1, 21)) for _ in range(20)]
    for name in OBSERVATIONS:
        for entry in observations.OBSERVATIONS[name].entries:
            values = np.stack([t.observation[entry.key] for t in timesteps])
            assert entry.low <= values.min(), entry.key
            assert values.max() <= entry.high, entry.key


def test_a_simulation_that_has_diverged_does_not_keep_others_from_beginning(
    environment,
):
    def own(frame):
        return {"own": given}

    table, given = observations.OBSERVATIONS, np.zeros((2, 1))
    table.row(Entry("own", 1, "m", "a number"))(own)
    try:
        batch = BatchSimulation(twin(environment.task, observation="own"), 2)
        batch.reset()
        given[0] = np.nan
        assert np.isnan(batch.reset(np.array([1])).observation["own"][0])
        with pytest.raises(ValueError, match="'own' of an observation is .*nan"):
            batch.reset(np.array([0]))
    finally:
        del table["own"]
