"""Sensors against known loads."""

import pytest

from cathsim_dmc.validation import force_sensors as forces


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
