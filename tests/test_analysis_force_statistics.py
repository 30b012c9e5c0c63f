import dataclasses
import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from recording_samples import make_episode

from cathsim_dmc import suite
from cathsim_dmc.analysis.force_statistics import (
    FIGURES,
    QUANTITIES,
    EpisodeForces,
    ForceTracker,
    Statistics,
    millinewtons,
    recorded_forces,
)
from cathsim_dmc.entities.devices import DEVICES
from cathsim_dmc.tasks.objectives import Cannulation
from cathsim_dmc.tasks.step import info_types


def known_episode(**meta):
    """Four steps: two contacts of 3 and 1 N, none, one of 2 N, none."""
    return make_episode(
        steps=4,
        contact_step=np.array([0, 0, 2]),
        contact_force=np.array([[0, 0, 3.0], [0, -1.0, 0], [2.0, 0, 0]]),
        contact_position=np.zeros((3, 3)),
        wall_force_sum=np.array([4.0, 0.0, 2.0, 0.0]),
        wall_force_max=np.array([3.0, 0.0, 2.0, 0.0]),
        meta={**make_episode().meta, **meta},
    )


def test_statistics_of_known_forces():
    peaks = {
        "wall_force_peak_sum": [4.0, 1.5, 5.0, 0.0],
        "wall_force_peak_max": [3.5, 1.0, 2.0, 0.0],
    }
    means = {
        "wall_force_mean_sum": [4.0, 0.5, 1.5, 0.0],
        "wall_force_mean_max": [3.0, 0.5, 1.0, 0.0],
    }
    ends = EpisodeForces(
        sum=Statistics(mean=1.5, mean_in_contact=3.0, maximum=4.0),
        max=Statistics(mean=1.25, mean_in_contact=2.5, maximum=3.0),
        peak_sum=Statistics(mean=2.625, mean_in_contact=3.5, maximum=5.0),
        peak_max=Statistics(mean=1.625, mean_in_contact=6.5 / 3, maximum=3.5),
    )
    found = recorded_forces(known_episode(**peaks, **means))
    assert found == dataclasses.replace(
        ends,
        mean_sum=Statistics(mean=1.5, mean_in_contact=2.0, maximum=4.0),
        mean_max=Statistics(mean=1.125, mean_in_contact=1.5, maximum=3.0),
    )
    assert found.max_force == 3.0 and found.mean_contact_force == 1.5
    # A recording without means is read by what it tells.
    older = recorded_forces(known_episode(**peaks))
    assert older == ends and older.max_force == 3.0
    assert older.mean_contact_force == 2.5 and older.largest_sum == 5.0


def test_without_contact_forces_are_zero_and_in_contact_unknown():
    found = recorded_forces(
        make_episode(
            steps=3,
            counts=np.zeros(3, int),
            wall_force_sum=np.zeros(3),
            wall_force_max=np.zeros(3),
        )
    )
    assert found.sum == Statistics(mean=0.0, mean_in_contact=None, maximum=0.0)
    empty = recorded_forces(make_episode(steps=0, counts=np.zeros(0, int)))
    assert empty == EpisodeForces()


@given(seed=st.integers(0, 2**31), steps=st.integers(1, 30), count=st.integers(1, 4))
def test_episodes_that_end_at_different_steps_keep_apart(seed, steps, count):
    rng = np.random.default_rng(seed)
    values = rng.exponential(size=(len(QUANTITIES), steps, count))
    values *= rng.random(values.shape) < 0.6
    ends = rng.random((steps, count)) < 0.2
    ends[-1] = True
    tracker = ForceTracker(count)
    begun = np.zeros(count, int)
    for step in range(steps):
        tracker.add(values[:, step], np.zeros(count, bool))
        for simulation in np.flatnonzero(ends[step]):
            found = dataclasses.astuple(tracker.finish(simulation))
            part = values[:, begun[simulation] : step + 1, simulation]
            for (mean, touching, largest), row in zip(found, part, strict=True):
                assert mean == pytest.approx(row.mean())
                assert largest == row.max()
                if row.any():
                    assert touching == pytest.approx(row[row > 0].mean())
                else:
                    assert touching is None
            begun[simulation] = step + 1


def test_the_step_of_a_physics_error_has_no_part_in_the_forces():
    tracker = ForceTracker(2)
    for force, failed in ([2.0, 1.0], [False, False]), ([1e6, 3.0], [True, False]):
        tracker.add([np.array(force)] * len(QUANTITIES), np.array(failed))
    first, second = tracker.finish(0), tracker.finish(1)
    assert (first.max_force, first.mean_force) == (2.0, 2.0)
    assert (second.max_force, second.mean_force) == (3.0, 2.0)
    tracker.add([np.array([1e6, 0.0])] * len(QUANTITIES), np.array([True, False]))
    assert tracker.finish(0) == EpisodeForces()


def test_forces_are_told_in_three_digits():
    given = (None,), (0.0,), (9.876e-3,), (0.09876,), (0.9876,), (5e-3, 0.1234)
    told = ["–", "0.00", "9.88", "98.8", "988", "5 ± 123"]
    assert [millinewtons(*one) for one in given] == told


def test_every_name_in_the_page_of_forces_exists():
    text = Path(__file__).parents[1].joinpath("docs/forces.md").read_text()
    statistics = {field.name for field in dataclasses.fields(Statistics)}
    known = {
        *info_types(()),
        *QUANTITIES,
        *statistics,
        *FIGURES,
        *Cannulation.TERMS,
        "force",
        *suite.TASKS,
        *DEVICES,
    }
    known |= {f"{one}.{other}" for one in QUANTITIES for other in statistics}
    words = re.findall(r"`([a-z_0-9.]+)`", text)
    files = (r"[a-z_/]+\.(json|py)", r"summary\.forces", r"cathsim_dmc\.[a-z_.]+")
    unknown = {word for word in words if not any(re.fullmatch(f, word) for f in files)}
    assert len(words) > 20
    assert unknown - known == set()
    # The table of named figures says what they are.
    forces = EpisodeForces(*(Statistics(i, i + 0.1, i + 0.2) for i in range(6)))
    rows = re.findall(r"^\| `(\w+)` \| `(\w+)\.(\w+)` \|", text, re.M)
    assert [name for name, *_ in rows] == list(FIGURES)
    for name, quantity, statistic in rows:
        figure = getattr(forces, name)
        assert figure == getattr(getattr(forces, quantity), statistic)
