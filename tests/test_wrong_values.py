"""Arguments that no check of a type refuses, and state that is not there yet."""

import math

import numpy as np
import pytest

import cathsim_dmc
from cathsim_dmc import bounds, suite
from cathsim_dmc.play.controls import Controls
from cathsim_dmc.play.session import play

TASK = "simple1_bca"


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *(("time_limit", value) for value in (-1, 0, math.nan, "a", True, None, [])),
        *(("max_reset_attempts", value) for value in (0, -1, 1.5, "a", None)),
        *(("n_sub_steps", value) for value in (0, "a")),
        *((name, np.ones(2)) for name in ("time_limit", "n_sub_steps")),
        ("time_limit", np.timedelta64(1)),
        ("legacy_step", "no"),
        ("fixed_initial_state", 1),
        ("raise_exception_on_physics_error", None),
        ("delayed_observation_padding", "zero"),
    ],
)
def test_wrong_settings_of_an_environment_are_refused(name, value):
    with pytest.raises(ValueError, match=f"^{name} is .*; it must be"):
        suite.load("cathsim", TASK, environment_kwargs={name: value})


def test_an_environment_may_have_no_time_limit():
    suite._check_settings({"time_limit": math.inf, "n_sub_steps": None})
    suite._check_settings({"time_limit": 0.1, "max_reset_attempts": 3})


@pytest.mark.parametrize(
    "options",
    [
        {"reward": {"distance": 1e308}},
        {"reward": {"distance": -1e16}},
        {"reward": {"success": 1e308}},
    ],
)
def test_numbers_beyond_all_quantities_are_refused(options):
    with pytest.raises(ValueError, match=r"it must be at most 1e\+15 in magnitude"):
        suite.make_task(TASK, **options)


@pytest.mark.parametrize("value", [np.array([0.01, 0.02]), np.timedelta64(1)])
@pytest.mark.parametrize("name", ["lead", "lumen_friction", "friction"])
def test_arrays_and_durations_are_no_numbers(name, value):
    with pytest.raises(ValueError, match=f"{name} is .*; it must be a finite number"):
        suite.make_task(TASK, **{name: value})


def test_so_are_numbers_in_a_row():
    with pytest.raises(ValueError, match=r"place is \[0, 1e\+300\]"):
        bounds.vector("place", [0, 1e300], 2)
    with pytest.raises(ValueError, match=r"range is \(0, 1e\+300\)"):
        bounds.interval("range", (0, 1e300))


@pytest.mark.parametrize(
    "wrong",
    [
        *({"speed": value} for value in (0, -1, math.nan, math.inf, "a")),
        *({"episodes": value} for value in (0, -1, "a", 1.5)),
        *({"seed": value} for value in (-1, "a", 2**32)),
    ],
)
def test_wrong_arguments_of_play_are_refused_before_a_task_is_loaded(wrong):
    (name,) = wrong
    with pytest.raises(ValueError, match=f"^{name} is .*; it must be"):
        play("no such task", **wrong)


def test_before_a_reset_there_is_nothing_to_see():
    env = suite.load("cathsim", TASK, {"random": 0})
    for look in (cathsim_dmc.forces, cathsim_dmc.show, cathsim_dmc.fluoroscopy):
        with pytest.raises(RuntimeError, match="no episode has begun; call reset"):
            look(env)
    env.reset()
    assert len(cathsim_dmc.forces(env)) == 0


@pytest.mark.parametrize(
    ("controls", "shown", "hidden"),
    [
        (Controls(10), ["bend", "straighten", "W/S"], ["rotate"]),
        (Controls(10, True), ["bend", "straighten", "A/D: rotate"], []),
        (Controls(0, True), ["W/S", "A/D: rotate"], ["bend", "straighten"]),
        (Controls(devices=1), ["rotate the device"], ["catheter", "bend"]),
        (Controls(devices=2), ["guidewire", "catheter"], ["bend", "straighten"]),
        (Controls(10, True, watching=True), ["R: again"], ["bend", "W/S", "rotate"]),
    ],
)
def test_help_names_the_keys_that_a_task_has(controls, shown, hidden):
    for word in (*shown, "R: again", "Esc: quit"):
        assert word in controls.help
    for word in hidden:
        assert word not in controls.help
