"""Statistics of the published comparison of forces, and its figure."""

import json

import numpy as np
import pytest
import recording_samples
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from cathsim_dmc import style
from cathsim_dmc.validation import force_sensors, protocol

RNG = np.random.default_rng(5)


def test_samples_of_the_reference_are_equivalent_to_it():
    result = protocol.compare(RNG.normal(0.4, 0.02, 400), margin=0.01)
    assert result["equivalent"] and result["mann_whitney_p"] > 0.01
    assert abs(result["cliffs_delta"]) < 0.15 and abs(result["cohens_d"]) < 0.2
    assert result["shapiro_p"] > 0.001 and result["levene_p"] > 0.001
    apart = protocol.compare(RNG.normal(0.45, 0.02, 400), margin=0.04)
    assert not apart["equivalent"] and apart["mann_whitney_p"] < 1e-6


def test_deviation_and_effect_size_are_those_of_a_sample():
    found = protocol.compare(np.array([0.2, 0.3, 0.4, 0.5]), 0.4, 0.02)
    assert found["sd"] == pytest.approx(0.1 * (5 / 3) ** 0.5)
    pooled = ((0.01 * 5 / 3 + 0.02**2) / 2) ** 0.5
    assert found["cohens_d"] == pytest.approx((0.35 - 0.4) / pooled)


def test_the_drawn_density_is_one_in_all_and_ends_at_zero():
    samples = np.abs(RNG.normal(0.0, 0.1, 300))
    drawn = protocol.figure(samples, protocol.compare(samples))
    force, density = drawn.axes[0].lines[0].get_data()
    assert force[0] == 0.0
    assert np.trapezoid(density, force) == pytest.approx(1.0, abs=0.02)


def test_a_large_p_value_is_no_equivalence():
    # Four wild samples: no test finds a difference, nor shows equality.
    result = protocol.compare(np.array([0.1, 0.7, 0.3, 0.5]), margin=0.02)
    assert result["mann_whitney_p"] > 0.5
    assert not result["equivalent"]


@settings(max_examples=25)
@given(st.lists(st.floats(0, 1), min_size=3, max_size=12))
def test_cliffs_delta_is_its_definition(samples):
    reference = protocol.reference_sample(0.4, 0.02, len(samples))
    signs = np.sign(np.subtract.outer(samples, reference))
    delta = protocol.compare(np.array(samples))["cliffs_delta"]
    assert delta == pytest.approx(signs.mean(), abs=1e-12)


def test_effective_count_of_white_and_of_correlated_noise():
    white = RNG.normal(size=4_000)
    assert protocol.effective_count(white) > 2_500
    # A first-order process of correlation ρ: n (1 - ρ)/(1 + ρ).
    slow, rho = np.zeros(20_000), 0.9
    for index, kick in enumerate(RNG.normal(size=len(slow) - 1)):
        slow[index + 1] = rho * slow[index] + kick
    expected = len(slow) * (1 - rho) / (1 + rho)
    assert protocol.effective_count(slow) == pytest.approx(expected, rel=0.35)


@pytest.mark.parametrize(
    ("samples", "options", "message"),
    [
        ([0.1, 0.2], {}, "too few"),
        ([0.1, 0.2, np.nan, 0.3], {}, "NaN"),
        ([0.1, 0.2, 0.3], {"reference_sd": 0.0}, "reference_sd"),
        ([0.1, 0.2, 0.3], {"reference_mean": np.nan}, "reference_mean"),
        ([0.1, 0.2, 0.3], {"margin": -1.0}, "margin"),
    ],
)
def test_compare_refuses(samples, options, message):
    with pytest.raises(ValueError, match=message):
        protocol.compare(np.array(samples), **options)


def test_an_episode_gives_the_resultants_of_its_steps_with_contact():
    episode = recording_samples.make_episode()
    report = force_sensors.compare_forces(episode, mean=0.1, sd=0.05)
    samples, steps = report.data["samples"], np.unique(episode.contact_step)
    assert samples.shape == steps.shape
    first = episode.contact_force[episode.contact_step == steps[0]].sum(0)
    assert samples[0] == pytest.approx(np.linalg.norm(first))
    found = report.findings["protocol"]
    assert (found["count"], found["reference_mean"]) == (len(samples), 0.1)
    assert found["task"] == episode.task
    other = force_sensors.compare_forces(episode, mean=0.1, sd=0.05, margin=0.03)
    found = other.findings["protocol"]
    assert (found["margin"], found["reference_sd"]) == (0.03, 0.05)
    json.dumps(report.as_dict())


def test_the_figure_has_both_densities_and_cumulative_shares(tmp_path):
    samples = np.abs(RNG.normal(0.1, 0.03, 200))
    drawn = protocol.figure(samples, protocol.compare(samples))
    density, cumulative = drawn.axes
    for line, mean in zip(density.lines, (samples.mean(), 0.4), strict=True):
        x, y = line.get_data()
        assert np.trapezoid(y, x) == pytest.approx(1.0, abs=0.02)
        assert np.trapezoid(x * y, x) == pytest.approx(mean, abs=0.01)
    for line in cumulative.lines:
        share = line.get_ydata()
        assert share[0] < 1e-3 and share[-1] > 0.999 and (np.diff(share) >= 0).all()
    style.save(drawn, tmp_path / "forces.png")
    assert np.asarray(Image.open(tmp_path / "forces.png").convert("L")).std() > 5


def test_options_of_forces_are_refused_elsewhere_and_bad_episodes_at_once(
    tmp_path, cathsim
):
    code, _, error = cathsim("validate", "rod", "--mean", "0.3")
    assert code == 2 and "validate forces" in error
    (tmp_path / "broken.npz").write_bytes(b"none")
    code, _, error = cathsim("validate", "forces", "--episode", tmp_path / "broken.npz")
    assert code == 2 and "broken.npz" in error
