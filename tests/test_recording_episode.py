import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from recording_samples import make_episode, same

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
    assert same(loaded, episode)
    assert loaded.steps == steps
    assert loaded.contact_counts.sum() == len(loaded.contact_step)


def test_a_record_has_the_radii_of_its_links_or_those_of_a_5f_catheter():
    meta = {**make_episode().meta, "catheter_radius": [1e-3, 1e-3, 1e-3, 0.4e-3]}
    assert make_episode(meta=meta).radii.tolist() == meta["catheter_radius"]
    # Five French are five thirds of a millimetre.
    np.testing.assert_allclose(make_episode().radii, 5e-3 / 6, rtol=0.01)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("reward", np.zeros(5), "reward is .* of shape"),
        ("action", np.zeros(6), "action is .* of shape"),
        ("catheter", np.zeros((7, 5, 2)), "catheter is .* of shape"),
        ("insertion", np.full(7, np.nan), "finite numbers"),
        ("meta", {"success": True, "termination": "won"}, "must be one of"),
        ("meta", {"success": False, "termination": "success"}, "but"),
        ("meta", {"success": True, "termination": "success", "x": np.inf}, "JSON"),
    ],
)
def test_wrong_values_are_named(name, value, message):
    with pytest.raises(ValueError, match=message):
        make_episode(**{name: value})


@pytest.mark.parametrize(
    ("steps", "message"),
    [
        ([0, 6], "lie in"),
        ([-1, 0], "lie in"),
        ([3, 2], "must not decrease"),
        ([0.0, 1.0], "array of integers"),
    ],
)
def test_contacts_must_belong_to_steps_in_order(steps, message):
    zeros = np.zeros((2, 3))
    with pytest.raises(ValueError, match=message):
        make_episode(
            contact_step=np.array(steps), contact_position=zeros, contact_force=zeros
        )


def test_arrays_of_an_episode_are_copies_that_cannot_be_written():
    given = np.zeros(6)
    episode = make_episode(reward=given)
    given[0] = 1.0
    assert not episode.reward.any()
    with pytest.raises(ValueError, match="read-only"):
        episode.qpos[0] = 1.0


def test_every_step_has_a_number_of_contacts():
    places = {"contact_position": np.zeros((3, 3)), "contact_force": np.zeros((3, 3))}
    episode = make_episode(6, contact_step=np.array([1, 1, 3]), **places)
    assert episode.contact_counts.tolist() == [0, 2, 0, 1, 0, 0]


@pytest.mark.parametrize("version", [99, True])
def test_another_format_is_refused(tmp_path, version):
    path = tmp_path / "e.npz"
    make_episode().save(path)
    with np.load(path) as archive:
        arrays = dict(archive)
    header = json.loads(str(arrays["header"]))
    arrays["header"] = np.array(json.dumps({**header, "version": version}))
    np.savez(path, **arrays)
    with pytest.raises(ValueError, match=f"format {version}"):
        Episode.load(path)
