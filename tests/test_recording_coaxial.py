"""Coaxial devices in a record."""

import numpy as np
import pytest

from cathsim_dmc import suite
from cathsim_dmc.recording.recorder import EpisodeRecorder
from cathsim_dmc.recording.records import CoaxialRecord

STEPS = 12


@pytest.fixture(scope="module")
def recorded():
    """The catheter is pushed over the wire, turned, and takes the lead."""
    env = suite.load("cathsim", "simple1_lcca_pair", {"random": 3})
    seen = []

    def policy(timestep):
        seen.append(env.task.devices)
        return np.array([-1.0, 0.0, 1.0, 0.5])

    episode = EpisodeRecorder(env).record_episode(policy, seed=3, max_steps=STEPS)
    seen.append(env.task.devices)
    yield episode, seen
    env.close()


def test_the_record_has_both_devices(recorded):
    episode, seen = recorded
    coaxial = CoaxialRecord.of(episode)
    assert coaxial.names == ("guidewire", "catheter")
    # A wire of 0.035 inches in a catheter of 5 French, thirds of a millimetre.
    wide = np.array([0.035 * 25.4e-3, 5e-3 / 3]) / 2
    np.testing.assert_allclose(coaxial.radii, wide, rtol=0.02)
    assert coaxial.insertion.shape == (STEPS + 1, 2)
    for name in ("insertion", "rotation", "tip_rotation"):
        expected = [getattr(state, name) for state in seen]
        np.testing.assert_array_equal(getattr(coaxial, name), expected)
    assert coaxial.rotation[-1, 1] == pytest.approx(STEPS * 0.5 * 3.14 * 0.04)
    # What the task says of the ends: on the straight chain of the same physics step.
    ends = coaxial.ends(episode.catheter)
    for state, readings in zip(ends[1:], seen[1:], strict=True):
        np.testing.assert_allclose(state, readings.points[:, -1], atol=1e-5)


def test_a_link_looks_like_what_is_outermost_in_its_middle():
    line, turns = np.zeros((2, 5, 3)), np.zeros((2, 2))
    line[..., 2] = np.arange(5) * 10e-3
    ends = np.array([[0.1, 0.086], [0.1, 0.084]])  # 14 and 16 mm of wire stand out
    record = CoaxialRecord(("wire", "catheter"), np.ones(2), ends, turns, turns)
    assert record.outermost(line).tolist() == [[1, 1, 1, 0], [1, 1, 0, 0]]


def test_the_device_that_leads_has_no_gap_whichever_it_is():
    """Ends lie on the chain, which is as long as the leading device."""
    turns, line = np.zeros((3, 2)), np.zeros((3, 5, 3))
    line[..., 2] = np.arange(5) * 10e-3
    ends = np.array([[0.10, 0.09], [0.10, 0.10], [0.10, 0.115]])
    record = CoaxialRecord(("wire", "catheter"), np.ones(2), ends, turns, turns)
    np.testing.assert_allclose(record.gaps, [[0, 0.01], [0, 0], [0.015, 0]])
    height = record.ends(line)[..., 2]
    np.testing.assert_allclose(height, 0.04 - record.gaps)
