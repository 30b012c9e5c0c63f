"""Arguments that no check of a type refuses, and state that is not there yet."""

import dataclasses
import math

import numpy as np
import pytest
from dm_control import composer

import cathsim_dmc
from cathsim_dmc import bounds, suite
from cathsim_dmc.bridge.serving import ServeOptions
from cathsim_dmc.entities import devices
from cathsim_dmc.entities.arena import AngiographyArena
from cathsim_dmc.entities.catheter import Catheter
from cathsim_dmc.entities.device_stack import DeviceStack
from cathsim_dmc.entities.phantom import Phantom
from cathsim_dmc.entities.robot import Robot
from cathsim_dmc.entities.sheath import Sheath, straight
from cathsim_dmc.physics.effects import Draw, Effect
from cathsim_dmc.physics.forces import Contacts
from cathsim_dmc.play.controls import Controls
from cathsim_dmc.play.session import play
from cathsim_dmc.policies import POLICIES, Policy, make_policy
from cathsim_dmc.policies.coaxial_pursuit import CoaxialPlan, CoaxialSettings
from cathsim_dmc.policies.pursuit import Plan, Settings
from cathsim_dmc.tasks.coaxial_ends import CoaxialEnds
from cathsim_dmc.tasks.config import NavigationConfig
from cathsim_dmc.tasks.navigation import Navigation
from cathsim_dmc.tasks.objectives import Cannulation
from cathsim_dmc.tasks.retry import Pattern, RetrySettings
from cathsim_dmc.tasks.route import Route
from cathsim_dmc.tasks.scene import Scene

TASK = "simple1_bca"


def test_checks_return_what_they_are_given_up_to_their_bounds():
    most, long = bounds.MOST_SEED, "x" * 200
    assert bounds.seeds("seed", 7, 3) == [7, 8, 9]
    assert bounds.seeds("seed", most - 2, 3) == [most - 2, most - 1, most]
    assert bounds.indices("indices", [2, 0, 2], 3).tolist() == [0, 2]
    assert bounds.indices("indices", None, 3).tolist() == [0, 1, 2]
    assert bounds.text("name", long) == long and bounds.pixels("size", (3, 4)) == (3, 4)
    assert bounds.number("x", 2, 1.0, 2.0) == 2.0 == bounds.number("x", 2.0, 2.0)
    assert bounds.actions([-3, 0.5, 2], (3,)).tolist() == [-1.0, 0.5, 1.0]
    for name, check in {
        "seed": lambda: bounds.seeds("seed", most - 1, 3),
        "indices": lambda: bounds.indices("indices", [0, 3], 3),
        "chosen": lambda: bounds.indices("chosen", [0, 0], 3, ascending=True),
        "name": lambda: bounds.text("name", long + "x"),
        "angle": lambda: bounds.array("angle", [True, False]),
    }.items():
        with pytest.raises(ValueError, match=f"^{name} is .*must be"):
            check()


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *(("time_limit", value) for value in (-1, 0, math.nan, "a", True, None, [])),
        *(("max_reset_attempts", value) for value in (0, -1, 1.5, "a", None)),
        ("time_limit", np.ones(2)),
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
    suite._check_settings({"time_limit": math.inf})
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


@pytest.mark.parametrize("name", ["lead", "lumen_friction"])
def test_options_between_devices_are_refused_for_one(name):
    with pytest.raises(ValueError, match=f"{name} is 0.2.*several.*give devices"):
        NavigationConfig(**{name: 0.2})
    with pytest.raises(ValueError, match=f"{name} is 0.2.*give another device"):
        NavigationConfig(devices=["wire_035_glide"], **{name: 0.2})


@pytest.mark.parametrize(
    ("kind", "given", "words"),
    [
        (Settings, {"speed": 2.0}, "speed is 2.0; .*from 0 to 1"),
        (Settings, {"gain": "x"}, "gain is 'x'"),
        (Settings, {"stuck": (30, 30)}, r"stuck\[0\] is 30; .*below stuck\[1\], 30"),
        (Settings, {"stuck": 3}, "stuck is 3"),
        (Settings, {"soft_push": 0.2}, "soft_push is 0.2; .*below hard_push, 0.1"),
        (Settings, {"retry": None}, "retry is None; .*a RetrySettings"),
        (CoaxialSettings, {"lead_gain": math.nan}, "lead_gain is nan"),
        (CoaxialSettings, {"straightening": 0.5}, "straightening is 0.5.*an integer"),
        (RetrySettings, {"thorough": 0}, "thorough is 0; .*at least 1"),
        (RetrySettings, {"slack": -1.0}, "slack is -1.0"),
        (RetrySettings, {"pattern": (1.0,)}, "pattern is .*a Pattern"),
        (Pattern, {"leads": ()}, r"leads is \(\); .*one number or more"),
        (Pattern, {"leads": 0.1}, "leads is 0.1; .*one number or more"),
        (
            Pattern,
            {"lookahead_factors": (1.0, -1.0)},
            "entry of lookahead_factors is -1.0",
        ),
        (Pattern, {"offsets": (math.nan,)}, "entry of offsets is nan"),
    ],
)
def test_settings_of_the_expert_are_checked(kind, given, words):
    with pytest.raises(ValueError, match=words):
        kind(**given)
    assert kind() == dataclasses.replace(kind())


def test_several_goals_of_one_anatomy_tell_what_they_need():
    with pytest.raises(ValueError, match="^goal is .*a list of as many anatomies"):
        suite.make_task("navigate", anatomy="type1", goal=["bca", "lcca"])


@pytest.mark.parametrize("goal", [[1, [2]], [[1, 8, 4], [1]], ["1", 2, 3], "1,2,3", {}])
def test_a_goal_that_is_no_place_is_refused(goal):
    with pytest.raises(ValueError, match="^goal is .*bca.*, a Goal, or a position"):
        suite.make_task("navigate", goal=goal)


def test_own_policies_are_policies_that_act(monkeypatch):
    monkeypatch.setitem(POLICIES, "function", lambda seed: lambda observation: None)
    with pytest.raises(
        ValueError, match=r"POLICIES\['function'\]\(seed\) is .*a Policy"
    ):
        make_policy("function")
    for wrong in (object(), lambda: None):
        monkeypatch.setitem(POLICIES, "wrong", wrong)
        with pytest.raises(ValueError, match=r"POLICIES\['wrong'\] is .* of a seed"):
            make_policy("wrong")
    monkeypatch.setitem(POLICIES, "idler", lambda seed: type("Idler", (Policy,), {})())
    with pytest.raises(NotImplementedError, match=r"Idler lacks act\(observation\)"):
        make_policy("idler").act(None)


@pytest.mark.parametrize("value", [1, "no", None, [True], {"a": 1}])
def test_a_device_is_served_in_lockstep_or_not(value):
    with pytest.raises(ValueError, match="^lockstep is .*True or False"):
        ServeOptions(lockstep=value)


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


def test_the_seed_of_the_last_episode_of_play_is_one():
    with pytest.raises(ValueError, match=f"seed is .*from 0 to {2**32 - 3}"):
        play("no such task", seed=2**32 - 2, episodes=3)


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


@pytest.mark.parametrize("call", ["reset", "step", "restore"])
def test_a_task_is_not_stepped_by_an_environment_that_has_lost_it(call):
    """Composer gives a task to any number of environments; the last one keeps it."""
    task = suite.make_task("simple1_bca", random=0)
    first = suite.environment(task)
    first.reset()
    calls = {
        "reset": first.reset,
        "step": lambda: first.step(np.zeros(task.num_actions)),
        "restore": lambda: first.restore(snapshot),
    }
    snapshot = first.snapshot()
    last = composer.Environment(task, random_state=0)
    last.reset()
    state = last.physics.get_state().copy()
    with pytest.raises(
        ValueError, match=r"simple1_bca.*another environment.*make_task"
    ):
        calls[call]()
    np.testing.assert_array_equal(last.physics.get_state(), state)
    last.step(np.zeros(task.num_actions))


@pytest.mark.parametrize("drawn", [False, True])
@pytest.mark.parametrize("friction", [1.0, 2.0])
def test_the_friction_of_a_device_is_refused_with_its_ratio(friction, drawn):
    rough = dataclasses.replace(devices.get("steerable_5f"), name="r", friction_ratio=3)
    passive = dataclasses.replace(rough, steering_angle=0.0)
    given = {"friction": friction}
    if drawn:
        given = {"randomisation": {"friction": (0.0, friction)}}
    for chosen in ({"device": rough}, {"devices": [passive]}):
        wrong = rf"friction is {friction:g}.*'r'.* 3.*most 2"
        with pytest.raises(ValueError, match=wrong):
            suite.make_task("simple1_bca", **chosen, **given)


def test_options_do_not_change_with_what_they_were_given_as():
    shares, effects = np.array([0.1, 0.2]), [Effect()]
    config = NavigationConfig(start_along_route=shares, effects=effects)
    shares[:], effects[:] = 0.9, []
    assert config.start_along_route == (0.1, 0.2)
    assert len(config.effects) == 1


@pytest.mark.parametrize("ratio", [-1.0, -2.0, 0.6, np.nan, "0.3"])
def test_a_ratio_that_is_not_poissons_is_refused(ratio):
    with pytest.raises(ValueError, match="poisson_ratio is .*0 to 0.5"):
        devices.Section.isotropic(1e-6, ratio)


@pytest.mark.parametrize("pair", [False, True])
def test_what_a_task_shows_is_not_its_state(pair):
    name = "type1_lcca_pair" if pair else "simple1_bca"
    env = suite.load("cathsim", name, {"observation": ["tracking", "goal"]})
    env.reset()
    shown = {**env.task.observation, "readings": env.task.readings.head}
    if pair:
        shown |= env.task.devices._asdict()
    kept = env.snapshot().arrays
    for each in shown.values():
        each += 1.0
    for name, array in env.snapshot().arrays.items():
        np.testing.assert_array_equal(array, kept[name], name)


AXIS, CONFIG = straight(0.2), NavigationConfig()


@pytest.mark.parametrize(
    ("build", "words"),
    [
        (lambda: Sheath(AXIS, "5F"), "device_radius is '5F'.*above 0, at most 0.01 m"),
        (lambda: Sheath(AXIS, 0.8), "device_radius is 0.8.*at most 0.01 m"),
        (
            lambda: Sheath(AXIS, 8e-4, clearance=-1e-3),
            "clearance is -0.001.*at least 0",
        ),
        (lambda: Sheath(AXIS, 8e-4, clearance="x"), "clearance is 'x'.*at least 0"),
        (lambda: Sheath(AXIS, 8e-4, math.nan), "link_length is nan.*at least 0"),
        (lambda: Robot(-1.0), "device_radius is -1.0.*above 0"),
        (lambda: Catheter(timestep=math.nan), "timestep is nan.*above 0"),
        (lambda: Catheter(stroke=250), "stroke is 250.*at most 3 m"),
        (lambda: devices.Discretisation(350), "working_length is 350.*at most 3 m"),
        (lambda: straight(-0.1), "length is -0.1.*above 0"),
        (lambda: Catheter(discretisation=3), "discretisation is 3.*a Discretisation"),
        (lambda: DeviceStack(lead=-0.1), "lead is -0.1.*at least 0"),
        (lambda: DeviceStack(lumen_friction=math.nan), "lumen_friction is nan.*0 to 2"),
        (lambda: DeviceStack(()), "devices is \\(\\).*at least one"),
        (lambda: DeviceStack(3), "devices is 3.*names"),
        (lambda: DeviceStack(devices.BERENSTEIN_5F), "devices is Device.*names"),
        (lambda: DeviceStack("wire_035_glide"), "devices is 'wire_035_glide'.*names"),
        (lambda: AngiographyArena(0.0), "device_density is 0.0.*above 0"),
        (lambda: AngiographyArena(tolerance=-1), "tolerance is -1.*above 0"),
        (lambda: Phantom("type1"), "anatomy is 'type1'.*an Anatomy"),
        (lambda: Scene.build("type1", "lcca", {}), "config is {}.*a NavigationConfig"),
        (lambda: Scene.build("type1", "lcca", CONFIG), "anatomy is 'type1'"),
        (lambda: Navigation("type1", None), "scene is 'type1'.*a Scene"),
        (lambda: Cannulation.to(None, "bca"), "anatomy is None.*an Anatomy"),
        (lambda: suite.make_task(TASK, random=np.random), "RandomState, or an integer"),
    ],
)
def test_wrong_arguments_of_entities_are_refused(build, words):
    with pytest.raises(ValueError, match=words):
        build()


@pytest.mark.parametrize(
    "changes",
    [
        *({"friction": 0.1}, {"physics_timestep": 2e-3}, {"device": "steerable_4f"}),
        {"vessel": "living"},
        {"randomisation": {"goal_shift": [0.0, 0.01]}},
        {},
    ],
)
def test_a_task_has_the_options_of_its_scene(shared_environment, changes):
    task = shared_environment(TASK).task
    config, objective = dataclasses.replace(CONFIG, **changes), task.objective
    if changes:
        refused = f"config has {next(iter(changes))}.*=.*the scene was built"
        with pytest.raises(ValueError, match=refused):
            Navigation(task.scene, objective, config)
        other = dataclasses.replace(task.scene, config=config)
        with pytest.raises(ValueError, match="the scene was built"):
            Navigation(task.scene, objective, others=[(other, objective)])
    with pytest.raises(ValueError, match="config is {}.*a NavigationConfig"):
        Navigation(task.scene, objective, {})
    assert Navigation(task.scene, objective).config is task.scene.config


def test_a_wall_and_its_device_are_in_one_model(shared_environment):
    phantom = Phantom(shared_environment(TASK).task.scene.anatomy, drawn=False)
    device, arena = Catheter(), AngiographyArena()
    arena.attach(phantom)
    with pytest.raises(ValueError, match="'link_0' is not in the model"):
        phantom.add_wall(device.links[0])
    arena.attach(device)
    phantom.add_wall(device.links[0])
    assert arena.mjcf_model.find("geom", "wall") is not None


@pytest.mark.parametrize("name", sorted(POLICIES))
def test_a_policy_without_a_reset_says_so(name):
    with pytest.raises(RuntimeError, match="must be reset before it acts"):
        make_policy(name).act(None)


def test_a_task_without_an_environment_says_so():
    task = suite.make_task("simple1_bca")
    for show in (lambda: task.readings, task.info, task.snapshot):
        with pytest.raises(RuntimeError, match=r"no environment.*suite.environment"):
            show()


def test_objects_with_arrays_are_compared_by_identity():
    one, other = (suite.make_task(TASK).scene for _ in range(2))
    assert one.placement != other.placement and one != other
    assert one in {one} and other not in {one}
    for kind in (Cannulation, Route, Plan, CoaxialPlan, CoaxialEnds, Draw, Contacts):
        assert kind.__eq__ is object.__eq__ and kind.__hash__ is object.__hash__


@pytest.mark.parametrize("options", [{"device": 1}, {"devices": ["wire"]}])
def test_a_device_may_be_an_object(options):
    with pytest.raises(ValueError, match="must be a Device, or one of steerable_5f"):
        suite.make_task(TASK, **options)
    with pytest.raises(ValueError, match=r"\(names or objects of Device\)"):
        suite.make_task(TASK, devices="wire_035_glide")
    glide = devices.DEVICES["wire_035_glide"]
    assert suite.make_task(TASK, devices=[glide]).config.devices == (glide,)


@pytest.mark.parametrize("name", ["readings", "wall_force", "devices", "info"])
def test_what_an_episode_has_is_refused_before_one_has_begun(name):
    environment = suite.load("cathsim", TASK)
    with pytest.raises(RuntimeError, match=r"no episode has begun; call reset\(\)"):
        found = getattr(environment.task, name)
        found()
    environment.reset()
    getattr(environment.task, name)
