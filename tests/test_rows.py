"""Rows of large arrays, shared out among the cores."""

import os
import threading
import time

import numpy as np
import pytest

from cathsim_dmc import rows, suite
from cathsim_dmc.simulation.batch import BatchSimulation


@pytest.fixture(autouse=True)
def cores(monkeypatch):
    monkeypatch.setattr(os, "cpu_count", lambda: 4)


@pytest.mark.parametrize("count", [0, 1, 511, 512, 4099])
def test_each_row_has_its_turn_once(count):
    turns = np.zeros(count, int)
    names = set()

    def act(part):
        turns[part] += 1
        names.add(threading.get_ident())

    rows.each(count, act)
    assert (turns == 1).all()
    alone = names == {threading.get_ident()}
    assert alone == (count < 512)


def test_a_forked_process_has_threads_of_its_own(monkeypatch):
    """Those of its parent are gone, and to wait for them takes for ever."""
    used = []
    for process in (1, 2):
        monkeypatch.setattr(os, "getpid", lambda process=process: process)
        names, together = set(), threading.Barrier(4)

        def act(_, names=names, together=together):
            together.wait(10.0)
            names.add(threading.get_ident())

        rows.each(2048, act)
        used.append(names)
    assert len(used[0] | used[1]) == 8


@pytest.mark.parametrize(("count", "kinds"), [(40, 20), (4099, 20), (4099, 1)])
def test_groups_are_shared_out_when_they_are_many(count, kinds):
    """Each of them is of few, or one of all."""
    items = [object() for _ in range(kinds)]
    chosen = [items[row % kinds] for row in range(count)]
    turns, names = np.zeros(count, int), set()

    def act(item, own):
        assert all(chosen[row] is item for row in own)
        turns[own] += 1
        names.add(threading.get_ident())
        time.sleep(1e-3)

    rows.of_each(rows.alike(chosen), act)
    assert (turns == 1).all()
    assert (len(names) > 1) == (count > 40)


def test_an_error_in_a_part_is_raised():
    with pytest.raises(ZeroDivisionError):
        rows.each(2048, lambda part: 1 // (part.start - 512))


@pytest.mark.parametrize("count", [8, 2048])
def test_copies_are_of_the_kind_asked_for(count):
    source = np.random.RandomState(0).uniform(size=(2, 3, count)).T[:, ::2]
    found = rows.copied(source, np.float32)
    np.testing.assert_array_equal(found, source.astype(np.float32))
    assert found.dtype == np.float32 and found.flags.c_contiguous
    same = rows.copied(source)
    np.testing.assert_array_equal(same, source)
    assert not np.shares_memory(same, source)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "observation"),
    [("type1_lcca", ["internal", "image"]), ("type1_lcca_pair", ["internal"])],
)
def test_many_simulations_are_those_of_few(name, observation):
    def play(count):
        task = suite.make_task(name, observation=observation)
        batch = BatchSimulation(task, count, num_threads=2, seeds=0)
        batch.reset()
        actions = np.random.RandomState(1).uniform(-1, 1, (600, batch.num_actions))
        return batch.step(actions[:count])

    few, many = play(3), play(600)
    for name, values in few.observation.items():
        np.testing.assert_array_equal(many.observation[name][:3], values)
    np.testing.assert_array_equal(many.outcome.reward[:3], few.outcome.reward)
