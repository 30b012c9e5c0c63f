"""Closed forms against other closed forms, and the report of checks."""

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import ellipe, ellipeinc, ellipk, ellipkinc

from cathsim_dmc.validation import force_sensors, pair, rod, theory, vessel, wall
from cathsim_dmc.validation.checks import Check, Report

# Checks whose bounds the physics misses (docs/limits.md).
SHORTFALLS = {
    wall.validate_wall: {
        "S-bend, friction 0.037: push after a stop from 10 mm/s",
        "femoral_type1_lcca_pair, full push: control steps done again",
    },
}


def elastica_by_elliptic_integrals(length, stiffness, end_angle):
    """Force and end (2,), axial and transverse, of a uniform cantilever's elastica.

    With k² = (1 + sin α)/2 and sin φ = 1/(k√2): L√(F/EI) = K(k) - F(φ, k), the
    deflection is L - 2√(EI/F) (E(k) - E(φ, k)) and the axial place √(2 EI sin α / F)
    (Bisshopp and Drucker, Quart. Appl. Math. 3 (1945) 272).
    """
    parameter = (1 + np.sin(end_angle)) / 2
    amplitude = np.arcsin(1 / np.sqrt(2 * parameter))
    number = ellipk(parameter) - ellipkinc(amplitude, parameter)
    force = stiffness * (number / length) ** 2
    scale = np.sqrt(stiffness / force)
    bend = ellipe(parameter) - ellipeinc(amplitude, parameter)
    return force, [scale * np.sqrt(2 * np.sin(end_angle)), length - 2 * scale * bend]


@settings(max_examples=15)
@given(
    angle=st.floats(0.02, 1.4),
    length=st.floats(0.05, 0.5),
    stiffness=st.floats(1e-6, 5e-3),
    split=st.floats(0.1, 0.9),
)
def test_elastica_of_a_uniform_rod_meets_the_elliptic_integrals(
    angle, length, stiffness, split
):
    shape = theory.elastica(
        [split * length, (1 - split) * length], [stiffness] * 2, angle
    )
    force, end = elastica_by_elliptic_integrals(length, stiffness, angle)
    np.testing.assert_allclose(shape.force, force, rtol=1e-6)
    np.testing.assert_allclose(shape.position[-1], end, rtol=1e-6)


def test_checks_keep_their_bounds_and_nan_fails():
    found = [Check.at_most("a", value, 2.0, "%").passed for value in (2, 2.01, np.nan)]
    assert found == [True, False, False]
    assert not Check.at_least("a", np.nan, 2.0, "%").passed
    low, high = Check.deviation("a", 0.9, 1.0, 5), Check.deviation("a", 1.04, 1.0, 5)
    assert low.value == pytest.approx(10) and not low.passed
    assert high.value == pytest.approx(4) and high.passed
    assert not Check.deviation("a", 1.0, np.nan, 5).passed


def test_report_is_one_json_object_without_nan():
    checks = [Check.at_most("a", 1.0, 2.0, "mm"), Check.at_most("b", np.inf, 2.0, "%")]
    report = Report("r", checks, {"array": np.arange(2.0), "nan": float("nan")})
    plain = json.loads(json.dumps(report.as_dict(), allow_nan=False))
    first = {"name": "a", "value": 1.0, "unit": "mm", "bound": "<= 2", "note": ""}
    assert plain["checks"][0] == first | {"passed": True}
    assert plain["checks"][1]["value"] is None
    assert plain["findings"] == {"array": [0.0, 1.0], "nan": None}
    assert not report.passed
    assert report.table().row_count == 2


@pytest.mark.slow
@pytest.mark.parametrize(
    "validate",
    [
        rod.validate_rod,
        pair.validate_pair,
        wall.validate_wall,
        vessel.validate_vessel,
        force_sensors.validate_forces,
    ],
)
def test_the_reports_pass(validate):
    failed = {check.name for check in validate().checks if not check.passed}
    assert failed <= SHORTFALLS.get(validate, set())
