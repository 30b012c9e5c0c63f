"""Sensors against known loads; statistics of the published protocol."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cathsim_dmc.validation import force_sensors as forces
from cathsim_dmc.validation import protocol

RNG = np.random.default_rng(5)


@pytest.mark.parametrize("load", [0.01, 0.5])
def test_contact_sensor_reads_the_load_of_a_resting_link(load):
    contacts, load_cell, base, _ = forces.resting_link(load)
    assert contacts == pytest.approx(load, rel=0.01)
    assert load_cell == pytest.approx(contacts, rel=1e-6)
    # What the contacts do not carry, the base does.
    assert contacts + base == pytest.approx(load, rel=1e-3)


@pytest.mark.parametrize("command", [0.1, 1.0])
def test_push_force_is_load_cell_is_contacts_at_a_dead_end(command):
    one = forces.dead_end(command)
    assert one.push > 0.9 * one.motor
    if command == 0.1:  # quiet, all of it arrives
        assert one.push == pytest.approx(one.motor, rel=0.02)
        assert one.ripple < 0.02 * one.push
    assert one.load_cell == pytest.approx(one.push, rel=0.01)
    assert one.contacts == pytest.approx(one.push, rel=0.01)


def test_rim_of_the_sheath_closes_the_balance_of_a_buckled_device():
    one = forces.dead_end(0.5, forces.WIDE_TUBE)
    assert one.load_cell + one.sheath == pytest.approx(one.push, rel=1e-3)


def test_samples_of_the_reference_are_equivalent_to_it():
    samples = RNG.normal(0.4, 0.02, 400)
    result = protocol.compare(samples, margin=0.01)
    assert result["equivalent"] and result["mann_whitney_p"] > 0.01
    assert abs(result["cliffs_delta"]) < 0.15 and abs(result["cohens_d"]) < 0.2
    assert result["shapiro_p"] > 0.001


def test_large_p_value_is_no_equivalence():
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
    white = RNG.normal(size=4000)
    assert protocol.effective_count(white) > 2500
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
        ([0.1, 0.2, 0.3], {"margin": -1.0}, "margin"),
    ],
)
def test_compare_refuses(samples, options, message):
    with pytest.raises(ValueError, match=message):
        protocol.compare(np.array(samples), **options)


def test_load_cell_samples_are_resultants_of_steps_with_contact():
    import recording_samples

    episode = recording_samples.make_episode()
    samples = protocol.load_cell_samples(episode)
    steps = np.unique(episode.contact_step)
    assert samples.shape == steps.shape
    first = episode.contact_force[episode.contact_step == steps[0]].sum(0)
    assert samples[0] == pytest.approx(np.linalg.norm(first))


@pytest.mark.slow
def test_forces_report_passes():
    report = forces.validate_forces()
    assert report.passed, report.failures
