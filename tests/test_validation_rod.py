"""The device of the tasks against elastica, Euler and GJ."""

import numpy as np
import pytest

from cathsim_dmc.entities import devices
from cathsim_dmc.entities.chain import MAX_ROTATION_SPEED
from cathsim_dmc.validation import platforms, rod, sheath, theory
from cathsim_dmc.validation.rig import Rig


def test_rig_has_the_settings_of_the_tasks():
    from cathsim_dmc import suite

    rig = Rig()
    rig.compile()
    task = suite.load("cathsim", "type1_bca", task_kwargs={"random": 0})
    model = task.physics.model.ptr
    for name in ("integrator", "timestep", "cone", "solver", "iterations", "tolerance"):
        assert getattr(rig.model.opt, name) == getattr(model.opt, name), name
    link = model.geom("catheter/link_3").id
    ours = rig.model.geom("catheter/link_3").id
    for name in ("geom_solref", "geom_solimp", "geom_friction", "geom_condim"):
        np.testing.assert_array_equal(
            getattr(rig.model, name)[ours], getattr(model, name)[link]
        )


def test_cantilever_is_the_elastica_up_to_60_degrees_in_any_plane():
    results = rod.cantilevers(end_angles=(2.0, 30.0, 60.0))
    results += rod.cantilevers(end_angles=(45.0,), plane=np.pi / 2)
    assert max(one.deviation for one in results) < rod.CANTILEVER_BOUND / 100
    # The loads are not trivial: the end moves by more than half of the length.
    assert results[2].expected.position[-1, 1] > 0.2


def test_a_displacement_out_of_the_plane_of_the_load_is_an_error(monkeypatch):
    class Aside(Rig):
        """A rig that bends as the elastica does, and by 3 % to the side."""

        def settle(self, force, **_):
            lengths, bending, _ = self.sections
            end = theory.elastica(lengths, bending, np.radians(30.0)).position[-1]
            along, across = end - (lengths.sum(), 0.0)
            aside = 0.03 * np.hypot(along, across)
            self.data.site_xpos[self.head] += across, aside, along

    monkeypatch.setattr(rod, "Rig", Aside)
    (one,) = rod.cantilevers(end_angles=(30.0,), plane=0.0)
    assert one.deviation == pytest.approx(0.03)


def test_the_rise_of_a_lag_is_that_of_each_curve():
    time = np.linspace(0.0, 4.0, 4001)
    mine, expected = (0.3 * (1 - np.exp(-time / rise)) for rise in (0.2, 0.25))
    lag = rod.TwistLag(time, 2 * time, 2 * time - mine, expected)
    assert lag.lags == pytest.approx((0.3, 0.3), rel=1e-4)
    assert lag.rises == pytest.approx((0.2, 0.25), rel=1e-3)


def test_coarse_chain_fails_the_cantilever():
    coarse = devices.Discretisation(shaft_link=0.07)
    (one,) = rod.cantilevers(end_angles=(60.0,), discretisation=coarse)
    assert one.deviation > rod.CANTILEVER_BOUND / 100


@pytest.mark.parametrize("end", ["sliding", "fixed"])
def test_column_buckles_at_eulers_load(end):
    one = rod.buckling(end)
    assert abs(one.critical / one.expected - 1) < rod.BUCKLING_BOUND / 100


def test_short_column_is_weaker_as_the_chain_of_hinges_says():
    one = rod.buckling("sliding", joints=4)
    links = np.pi**2 / 12 / 4**2
    assert one.critical / one.expected - 1 == pytest.approx(-links, abs=0.01)


@pytest.mark.parametrize(
    ("device", "torsion_joints"),
    [("steerable_5f", 1), ("steerable_5f", 25), ("wire_035_amplatz", 4)],
)
def test_twist_is_that_of_gj(device, torsion_joints):
    _, angle = rod.twist_under_torque(device, torsion_joints)
    assert abs(angle / rod.TWIST - 1) < rod.TWIST_BOUND / 100


def test_tip_lags_behind_the_base_as_theory_says():
    one = rod.twist_lag()
    for found, expected in (one.lags, one.rises):
        assert found == pytest.approx(expected, rel=rod.TWIST_BOUND / 100)
    # The speed servo of the base neither overshoots nor hunts.
    speed = np.diff(one.base) / np.diff(one.time)
    assert speed.max() < 1.001 * MAX_ROTATION_SPEED
    assert speed[50:].min() > 0.98 * MAX_ROTATION_SPEED


def test_settle_says_when_it_does_not():
    rig = Rig()
    rig.compile()
    with pytest.raises(RuntimeError, match="still moves"):
        rig.settle((1e-3, 0, 0), longest=0.1)


def test_the_drive_holds_and_is_exact_until_its_clamp_slips():
    """A dashpot of 100 N·s/m gave way by 30 mm a second."""
    driven = rod.Driven()
    assert abs(driven.move(1.0, 0.0, 3.0)) < 1e-5
    driven.move(0.2, 1.0, 3.0)
    assert driven.move(0.4, 1.0, 3.0) == pytest.approx(0.4 * 0.04, rel=0.01)
    driven.move(0.2, 0.0, 4.9)
    before = driven.drives.slipped[0, 0]
    assert abs(driven.move(0.4, 0.0, 4.9)) < 1e-5
    assert driven.drives.slipped[0, 0] == before
    assert driven.move(0.4, 0.0, 5.1) < -1e-3
    assert driven.drives.slipped[0, 0] > before + 1e-3
    # What has slipped follows the next command at once.
    driven.move(0.2, 0.0, 0.0)
    assert driven.move(0.4, 0.5, 0.0) == pytest.approx(0.2 * 0.04, rel=0.05)


def test_platforms_start_stop_and_reverse_smoothly():
    """The base ran at 3.5 times its largest speed, and was pulled back by 0.5 mm."""
    found = list(platforms.checks())
    assert len(found) == 9 and all(one.passed for one in found), found


def test_the_sheath_clamps_a_device_at_its_mouth_and_passes_axial_forces_on():
    """A bore with play doubled the compliance; a bent one takes part of the force."""
    moved, expected = sheath.deflection(0.06)
    assert moved == pytest.approx(expected, rel=sheath.COMPLIANCE_BOUND / 100)
    bore = np.array([[0.0, 0.0, -0.301], [0.0, 0.0, 0.0]])
    moved, expected = sheath.deflection(0.06, bore)
    assert moved > 1.5 * expected
    force = sheath.base_force(0.04)
    assert force == pytest.approx(-sheath.PULL, rel=sheath.FORCE_BOUND / 100)
    turn = np.linspace(0.0, np.pi / 2, 40)
    arc = 0.05 * np.stack([1 - np.cos(turn), 0 * turn, np.sin(turn)], axis=-1)
    straight = 0.3 - 0.05 * np.pi / 2
    line = np.vstack([[[0.0, 0.0, -straight]], arc]) + (0.0, 0.0, straight - 0.3)
    assert abs(sheath.base_force(0.0, line)) < 0.98 * sheath.PULL


@pytest.mark.slow
def test_the_sheath_keeps_its_bounds_at_every_length_and_speed():
    found = list(sheath.checks())
    assert len(found) == 11 and all(one.passed for one in found), found
