import dataclasses
import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from recording_samples import make_episode

from cathsim_dmc.recording.episode import Episode


@settings(max_examples=20)
@given(
    steps=st.integers(0, 12),
    links=st.integers(1, 5),
    actions=st.integers(1, 22),
    seed=st.integers(0, 2**31),
)
def test_save_and_load_return_the_same_bits(
    tmp_path_factory, steps, links, actions, seed
):
    path = tmp_path_factory.mktemp("episode") / "e.npz"
    episode = make_episode(steps, links, actions, seed)
    assert episode.save(path) == path
    loaded = Episode.load(path)
    assert loaded.equals(episode)
    assert loaded.steps == steps
    assert loaded.contact_counts.sum() == len(loaded.contact_step)


def test_equals_notices_one_changed_value():
    episode = make_episode()
    reward = episode.reward.copy()
    reward[3] = np.nextafter(reward[3], np.inf)
    assert not episode.equals(dataclasses.replace(episode, reward=reward))


def test_arrays_are_read_only_copies():
    reward = np.zeros(6)
    episode = make_episode(reward=reward)
    reward[0] = 5
    assert episode.reward[0] == 0
    with pytest.raises(ValueError, match="read-only"):
        episode.reward[0] = 1


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("reward", np.zeros(5), "reward must have shape"),
        ("action", np.zeros(6), "action must have shape"),
        ("catheter", np.zeros((7, 5, 2)), "catheter must have shape"),
        ("body_quat", np.ones((7, 3, 4)), "unit quaternions"),
        ("time", np.zeros(7), "increase strictly"),
        ("insertion", np.full(7, np.nan), "not finite in row 0"),
        ("wall_force_sum", np.full(6, -1.0), "must not be negative"),
    ],
)
def test_wrong_values_are_named(name, value, message):
    with pytest.raises(ValueError, match=message):
        make_episode(**{name: value})


@pytest.mark.parametrize(
    ("steps", "message"),
    [
        ([0, 6], "must lie in"),
        ([-1, 0], "must lie in"),
        ([3, 2], "must not decrease"),
        ([0.0, 1.0], "must hold integers"),
    ],
)
def test_contacts_must_belong_to_steps_in_order(steps, message):
    zeros = np.zeros((2, 3))
    with pytest.raises(ValueError, match=message):
        make_episode(
            contact_step=np.array(steps), contact_position=zeros, contact_force=zeros
        )


@pytest.mark.parametrize(
    ("meta", "message"),
    [
        ({"success": True, "termination": "won"}, "must be one of"),
        ({"success": False, "termination": "success"}, "but"),
        ({"success": False, "termination": "truncated", "x": float("nan")}, "JSON"),
    ],
)
def test_wrong_metadata_is_refused(meta, message):
    with pytest.raises(ValueError, match=message):
        make_episode(meta=meta)


def test_numpy_values_in_metadata_become_plain():
    meta = {"success": np.True_, "termination": "success", "goal": np.arange(3)}
    assert make_episode(meta=meta).meta["goal"] == [0, 1, 2]


def test_a_later_format_is_refused(tmp_path):
    path = tmp_path / "e.npz"
    make_episode().save(path)
    with np.load(path) as archive:
        arrays = dict(archive)
    header = json.loads(str(arrays["header"]))
    arrays["header"] = np.array(json.dumps({**header, "version": 99}))
    np.savez(path, **arrays)
    with pytest.raises(ValueError, match="format 99"):
        Episode.load(path)
