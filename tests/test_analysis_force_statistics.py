import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from recording_samples import make_episode
from scipy.stats import binomtest

from cathsim_dmc.analysis.force_statistics import (
    EpisodeStatistics,
    Spread,
    episode_statistics,
    evaluation_statistics,
    force_samples,
    magnitude,
    path_length,
    path_ratio,
    step_forces,
    wilson_interval,
)


def test_magnitude_has_leading_axes():
    force = np.array([[[3.0, 4.0, 0.0]], [[1.0, 2.0, 2.0]]])
    np.testing.assert_allclose(magnitude(force), [[5.0], [3.0]])


@given(seed=st.integers(0, 2**31), steps=st.integers(1, 20), count=st.integers(0, 50))
def test_step_forces_agree_with_a_loop_in_any_order(seed, steps, count):
    rng = np.random.default_rng(seed)
    step = rng.integers(0, steps, count)
    force = rng.normal(size=(count, 3))
    reduced = step_forces(step, force, steps)
    for index in range(steps):
        sizes = [np.linalg.norm(f) for f in force[step == index]]
        assert reduced.contacts[index] == len(sizes)
        assert reduced.total[index] == pytest.approx(sum(sizes))
        assert reduced.largest[index] == pytest.approx(max(sizes, default=0.0))


def test_step_forces_refuse_strangers():
    with pytest.raises(ValueError, match="must lie in"):
        step_forces(np.array([3]), np.zeros((1, 3)), 3)
    with pytest.raises(ValueError, match="shape"):
        step_forces(np.array([0, 1]), np.zeros((1, 3)), 3)


def test_path_length_of_known_lines():
    square = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], float)
    assert path_length(square) == 3.0
    np.testing.assert_allclose(path_length(np.stack([square, 2 * square])), [3.0, 6.0])
    assert path_ratio(square, 1.5) == 2.0
    with pytest.raises(ValueError, match="positive"):
        path_ratio(square, 0.0)


@given(data=st.data(), trials=st.integers(1, 200))
def test_wilson_agrees_with_scipy(data, trials):
    successes = data.draw(st.integers(0, trials))
    ours = wilson_interval(successes, trials)
    theirs = binomtest(successes, trials).proportion_ci(0.95, method="wilson")
    np.testing.assert_allclose(ours, [theirs.low, theirs.high], atol=1e-12)
    assert 0 <= ours[0] <= successes / trials <= ours[1] <= 1


def test_wilson_refuses_nonsense():
    for successes, trials in ((0, 0), (2, 1), (-1, 3)):
        with pytest.raises(ValueError, match="trial"):
            wilson_interval(successes, trials)
    with pytest.raises(ValueError, match="confidence"):
        wilson_interval(1, 2, 1.0)


def episode_with_known_forces():
    """Three steps: forces of 3 and 1 N in step 0, none in 1, 2 N in 2."""
    return make_episode(
        steps=3,
        contact_step=np.array([0, 0, 2]),
        contact_force=np.array([[0, 0, 3.0], [0, -1.0, 0], [2.0, 0, 0]]),
        contact_position=np.zeros((3, 3)),
        push_force=np.array([0.5, -4.0, 1.0]),
        reward=np.array([-1.0, -2.0, 10.0]),
        catheter=np.array([[[0, 0, -1.0], [0, 0, z]] for z in (0, 0.1, 0.3, 0.2)]),
    )


def test_episode_statistics_of_known_forces():
    found = episode_statistics(episode_with_known_forces(), route_length=0.2)
    assert found.f_mean == pytest.approx(2.0)
    assert found.f_max == 3.0
    assert found.step_mean == pytest.approx((4 + 0 + 2) / 3)
    assert found.step_max == 4.0
    assert found.peak_max is None
    assert found.contact_share == pytest.approx(2 / 3)
    assert found.push_max == 4.0
    assert found.reward == 7.0
    assert found.path == pytest.approx(0.4)
    assert found.path_ratio == pytest.approx(2.0)
    assert (found.steps, found.contacts) == (3, 3)


def test_peaks_within_steps_come_from_the_metadata():
    meta = {**make_episode().meta, "wall_force_peak_max": [0.1, 0.7, 0.2]}
    assert episode_statistics(make_episode(meta=meta)).peak_max == 0.7


def test_an_episode_without_contact_or_steps_has_zero_force():
    for steps in (0, 4):
        found = episode_statistics(
            make_episode(steps=steps, counts=np.zeros(steps, int))
        )
        assert found.contacts == 0 and found.f_mean == found.f_max == 0.0
        assert found.step_mean == found.contact_share == 0.0
        assert found.path_ratio is None


def make_statistics(success, f_mean, ratio):
    return EpisodeStatistics(
        steps=10,
        reward=-1.0,
        success=success,
        contacts=5,
        f_mean=f_mean,
        f_max=2 * f_mean,
        step_mean=f_mean,
        step_max=f_mean,
        peak_max=None,
        contact_share=0.5,
        push_max=1.0,
        path=0.1,
        path_ratio=ratio,
    )


def test_evaluation_statistics_weigh_episodes_equally():
    episodes = [
        make_statistics(True, 0.1, 1.2),
        make_statistics(True, 0.2, 1.4),
        make_statistics(False, 0.6, 0.1),
    ]
    found = evaluation_statistics(episodes)
    assert found.f_mean.mean == pytest.approx(0.3)
    assert found.f_mean.sd == pytest.approx(np.std([0.1, 0.2, 0.6], ddof=1))
    assert found.f_max.mean == pytest.approx(0.6)
    assert found.success_rate == pytest.approx(2 / 3)
    assert found.success_interval == wilson_interval(2, 3)
    assert found.path_ratio.mean == pytest.approx(1.3)
    assert found.path_ratio.count == 2
    plain = json.loads(json.dumps(found.as_dict(), allow_nan=False))
    assert plain["f_mean"]["count"] == 3


def test_evaluation_statistics_of_few_episodes():
    one = evaluation_statistics([make_statistics(False, 0.1, 0.5)])
    assert one.f_mean.sd is None and one.path_ratio is None
    assert str(one.f_mean) == "0.1"
    with pytest.raises(ValueError, match="no episodes"):
        evaluation_statistics([])
    with pytest.raises(ValueError, match="no values"):
        Spread.of([])


def test_force_samples_join_all_contacts():
    episodes = [episode_with_known_forces(), make_episode(counts=[0] * 6)]
    np.testing.assert_allclose(force_samples(episodes), [3.0, 1.0, 2.0])
    assert force_samples([]).shape == (0,)
