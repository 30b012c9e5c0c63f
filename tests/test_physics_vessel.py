"""Vessels that live: flow, wall and motion, in both paths, on any threads."""

import dataclasses
import types

import mujoco
import numpy as np
import pytest
from conftest import twin

from cathsim_dmc import suite
from cathsim_dmc.anatomy import phantoms
from cathsim_dmc.anatomy.centreline import Centreline, Vessel, VesselTree
from cathsim_dmc.anatomy.circulation import Circulation
from cathsim_dmc.laws.blood import beat
from cathsim_dmc.laws.compliance import Material, stiffness
from cathsim_dmc.laws.contact import COMPLIANT
from cathsim_dmc.physics.blood import BLOOD_VISCOSITY
from cathsim_dmc.physics.flow import Flow, FlowOptions
from cathsim_dmc.physics.vessel import VesselOptions
from cathsim_dmc.physics.wall import STIFFENING, Wall, WallOptions
from cathsim_dmc.simulation.batch import BatchSimulation
from cathsim_dmc.validation import vessel

STEPS = 8
DRAWN = {
    "flow": {"rate": (60, 90), "peak": (0.4, 1.0), "phase": (0, 1)},
    "wall": {"modulus": (0.3e6, 0.6e6), "support": (0.5, 1.0)},
    "motion": {"breathing": (0.5, 1.0), "breath_phase": (0, 1)},
}


@pytest.fixture(scope="module")
def living():
    """A task whose heart is drawn for each episode."""
    return suite.make_task(
        "simple1_bca", vessel=DRAWN, observation=["tracking", "vessel"]
    )


def run(task, count, threads):
    """Joint positions (STEPS, N, nq) and the observed velocity (STEPS, N, 3)."""
    batch = BatchSimulation(task, count, num_threads=threads, seeds=3)
    batch.reset()
    action = np.full((count, batch.num_actions), 0.3)
    steps = [(batch.step(action), batch.batch.qpos.copy()) for _ in range(STEPS)]
    velocities = [step.observation["blood_velocity"] for step, _ in steps]
    return np.array([qpos for _, qpos in steps]), np.array(velocities)


def line(start, end, wide, narrow):
    """A straight centreline that narrows, from a place to another."""
    share = np.linspace(0.0, 1.0, 41)[:, None]
    radii = wide + share[:, 0] * (narrow - wide)
    return Centreline(start + share * np.subtract(end, start), radii)


@pytest.mark.parametrize("against", [False, True])
def test_blood_comes_to_a_place_by_the_way_from_the_heart(against):
    """Vessels at right angles; the aorta's points run with the blood or against it."""
    aorta = line([0, 0, 0], [0, 0, 0.2], 12e-3, 9e-3)
    if against:
        aorta = Centreline(aorta.points[::-1], aorta.radii[::-1])
    arm = line([0, 0, 0.08], [0.1, 0, 0.08], 5e-3, 4e-3)
    thin = line([0.04, 0, 0.08], [0.04, 0.06, 0.08], 3e-3, 2e-3)
    tiny = line([0.04, 0.03, 0.08], [0.04, 0.03, 0.12], 2e-3, 1e-3)
    vessels = (
        Vessel("aorta", aorta), Vessel("arm", arm, "aorta", 11e-3),
        Vessel("thin", thin, "arm", 5e-3), Vessel("tiny", tiny, "thin", 3e-3),
    )  # fmt: skip
    blood = Circulation.of(VesselTree({one.name: one for one in vessels}))
    np.testing.assert_allclose(blood.ways, np.abs(blood.ends).sum(axis=-1), atol=1e-9)
    assert blood.radius == pytest.approx(12e-3)
    # By Murray's law the ends divide the blood as the cubes of 9, 4, 2 and 1 mm do.
    cubes, (x, y, z) = 9**3 + 4**3 + 2**3 + 1, blood.ends[:, 0].T
    wanted = np.select(
        [blood.vessel == 3, blood.vessel == 2, blood.vessel == 1, z < 0.079],
        [1, 2**3 + (y < 0.029), 4**3 + (2**3 + 1) * (x < 0.039), cubes], 9**3,
    )  # fmt: skip
    sign = np.where((blood.vessel == 0) & against, -1.0, 1.0)
    # Place of the next mouth along each vessel, on the axis on which it runs.
    mouths, axes = [0.08, 0.04, 0.03, np.inf], np.take([2, 0, 1, 2], blood.vessel)
    middles = np.take_along_axis(blood.ends.mean(axis=1), axes[:, None], 1)[:, 0]
    clear = np.abs(middles - np.take(mouths, blood.vessel)) > 3.1e-3
    found = (sign * blood.shares.mean(axis=1))[clear]
    np.testing.assert_allclose(found, wanted[clear] / cubes, rtol=1e-9)


def test_flow_is_alike_in_both_paths_and_on_any_threads(living):
    one, velocity = run(twin(living), 8, 1)
    for threads in (2, 8):
        np.testing.assert_array_equal(one, run(twin(living), 8, threads)[0])
    environment = suite.environment(twin(living, 5))
    environment.reset()
    for k in range(STEPS):
        observed = environment.step(np.full(21, 0.3)).observation
        np.testing.assert_array_equal(environment.physics.data.qpos, one[k, 2])
        np.testing.assert_array_equal(observed["blood_velocity"], velocity[k, 2])
    assert np.ptp(np.linalg.norm(velocity, axis=-1)) > 0.1
    assert environment.task.info()["indentation"] >= 0.0


def test_contacts_that_share_a_spring_are_told_apart_by_no_bit_of_their_distance():
    task = suite.make_task("type1_lcca", vessel={"wall": True})
    environment = suite.environment(task)
    environment.reset()
    action = np.zeros(21)
    action[[0, -1]] = 1.0
    halved, odd = [], []
    for _ in range(80):
        environment.step(action)
        model, data = (getattr(environment.physics, of).ptr for of in ("model", "data"))
        mujoco.mj_forward(model, data)
        for contact in data.contact:
            if contact.solimp[0] == COMPLIANT:
                stiff = model.geom_solref[contact.geom1, 0]
                assert contact.solref[0] in (stiff, stiff / 2)
                halved.append(contact.solref[0] != stiff)
                odd.append(np.float64(contact.dist).view(np.int64) % 2 == 1)
    assert 10 < sum(halved) < len(halved) - 10
    agree = np.mean(np.array(halved) == odd)
    assert 0.2 < agree < 0.8, agree


def test_blood_drags_along_a_pair_by_the_radii_of_its_links_now():
    """The wire of one simulation advances, and the catheter of the other."""
    task = suite.make_task("simple1_lcca_pair", vessel={"flow": True})
    batch = BatchSimulation(task, 2, seeds=0)
    batch.reset()
    action = np.array([[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]])
    for _ in range(20):
        batch.step(action)
    flow = batch.rollout.effects[0]
    geoms = flow.world.index.geoms
    radii = batch.batch.expand("geom_size")[:, geoms, 0].copy()
    batch.step(action)
    inside = flow.radius > 0.0
    assert (inside & (radii[0] < radii[1])).sum() > 2
    gap = np.maximum(flow.radius[inside] / radii[inside], 1.2)
    expected = 2 * np.pi * BLOOD_VISCOSITY / np.log(gap)
    np.testing.assert_allclose(flow.world.parameters.friction[inside], expected)


@pytest.mark.parametrize("access", ["ascending", "descending"])
def test_blood_comes_from_the_heart_delayed_by_the_way(access):
    anatomy = phantoms.load("type1", access=access)
    circulation, root = anatomy.circulation, anatomy.tree.root.centreline
    course = circulation.courses["aorta"]
    assert not course.reverse and course.begin == 0.0
    of_root = circulation.vessel == 0
    np.testing.assert_allclose(circulation.shares[of_root][0], 1.0)
    np.testing.assert_allclose(circulation.shares[of_root][-1], 0.761, atol=1e-12)
    np.testing.assert_allclose(circulation.ways[of_root][-1, 1], root.length)
    lcca = list(anatomy.tree.vessels).index("lcca")
    np.testing.assert_allclose(
        circulation.ways[circulation.vessel == lcca][0, 0], anatomy.tree.origin("lcca")
    )


def test_blood_at_links_and_head_is_that_of_their_places_in_the_aorta():
    """Plug-like profile of the inflow, late by the way from the heart (SI units)."""
    options = {"rate": 75.0, "peak": 0.5, "phase": 0.2, "wave_speed": 5.0}
    task = suite.make_task("simple1_bca", vessel={"flow": options})
    circulation = task.scene.anatomy.circulation
    aorta = task.scene.anatomy.tree.root.centreline
    batch = BatchSimulation(task, 1, seeds=0)
    batch.reset()
    action = np.zeros((1, 21))
    action[:, -1] = 1.0
    for _ in range(20):
        nodes = batch.rollout.readings.centreline[0].copy()
        batch.step(action)

    def expected(points):
        """Velocity (P, 3) at the peak of the beat, and its delay (P,)."""
        place = aorta.project(points)
        share = circulation.courses["aorta"].share(place.arc_length)
        mean = 0.5 * share * (13.8e-3 / place.radius) ** 2
        speed = mean * 11 / 9 * (1 - (place.distance / place.radius) ** 9)
        along = aorta.at(place.arc_length).tangent
        return speed[:, None] * along, place.arc_length / 5.0

    flow = batch.rollout.effects[0]
    blood, inside = flow.world.parameters, flow.radius[0] > 0.0
    velocity, delay = expected(0.5 * (nodes[1:] + nodes[:-1])[inside])
    assert inside.sum() > 8
    found = blood.peak[0] * blood.velocity[0, inside]
    np.testing.assert_allclose(found, velocity, atol=1e-9)
    np.testing.assert_allclose(blood.delay[0, inside], delay, atol=1e-9)
    (velocity,), (delay,) = expected(batch.rollout.readings.head)
    beats = beat(1.25 * (20 * 0.04 - delay) + 0.2)
    shown = batch.rollout.vessel.blood_velocity[0]
    np.testing.assert_allclose(shown, beats * velocity, rtol=1e-6, atol=1e-9)


def test_volume_and_profile_are_those_prescribed():
    for name in vessel.ANATOMIES:
        assert vessel.volume_defect(phantoms.load(name)) < vessel.VOLUME_BOUND
    lost = dataclasses.replace(phantoms.load("simple1"))
    blood = lost.circulation
    for more in ({"aorta": 0.01}, {"bca": 0.01, "lcca": -0.01}, {"lsa": np.nan}):
        courses = {
            name: one._replace(outlet=one.outlet + more.get(name, 0.0))
            for name, one in blood.courses.items()
        }
        vars(lost)["circulation"] = dataclasses.replace(blood, courses=courses)
        assert not vessel.volume_defect(lost) < vessel.VOLUME_BOUND, more
    deviation, flow = vessel.profile()
    assert deviation < vessel.PROFILE_BOUND
    assert flow == pytest.approx(1.0, abs=1e-8)


def test_outlets_share_by_murray_where_that_is_asked_for():
    anatomy = phantoms.load("type1")
    courses = Circulation.of(anatomy.tree, murray=True).courses
    radii = {end.vessel: end.radius for end in anatomy.ends if not end.open}
    cubes = {name: radius**3 for name, radius in radii.items()}
    for name, cube in cubes.items():
        share = cube / sum(cubes.values())
        assert courses[name].outlet == pytest.approx(share, rel=1e-6)
    measured, murray = anatomy.circulation, anatomy.murray_circulation
    assert measured.courses["lcca"].outlet == 0.069 != murray.courses["lcca"].outlet
    for split, blood in (("measured", measured), ("murray", murray)):
        flow = Flow(FlowOptions(split=split))
        flow._circulations = {}
        flow.enter(0, anatomy)
        assert flow._circulations[0] is blood


@pytest.mark.parametrize("force", vessel.FORCES)
def test_a_free_link_reaches_the_terminal_velocity_of_its_drag(force):
    mine, expected = vessel.terminal_velocity(force)
    assert mine == pytest.approx(expected, rel=vessel.FLOW_BOUND / 100)


def test_a_cantilever_in_a_cross_flow_bends_like_the_elastica():
    mine, expected = vessel.cantilever(0.1)
    assert mine == pytest.approx(expected, rel=vessel.FLOW_BOUND / 100)


def test_what_is_drawn_and_shown_of_the_heart(living):
    batch = BatchSimulation(twin(living), 6, seeds=0)
    batch.reset()
    blood = batch.rollout.effects[0].world.parameters
    inflow, rate, phase = (each.copy() for each in blood[2:5])
    assert np.ptp(rate) > 0.1 and np.ptp(phase) > 0.3 and np.ptp(inflow) > 0
    step = batch.step(np.zeros((6, 21)))
    shown = step.info()["heart_phase"]
    np.testing.assert_allclose(shown, (phase + 0.04 * rate) % 1.0, atol=1e-12)
    observed = step.observation["heart_phase"] @ [1j, 1.0]
    np.testing.assert_allclose(observed, np.exp(2j * np.pi * shown))
    assert set(step.info()) == set(living.info_types)


@pytest.mark.parametrize("kind", ["sphere", "capsule"])
def test_force_rises_with_the_depth_as_the_formula_says(kind):
    places = 2 if kind == "capsule" else 1
    for radius, modulus in zip(vessel.RADII, vessel.MODULI, strict=True):
        expected = places * stiffness(radius, Material(modulus, 1.5e-3, 1.0))
        loads = expected * np.array([2e-4, 6e-4])
        slope = np.ptp(loads) / np.ptp(vessel.indentation(kind, radius, modulus, loads))
        assert slope == pytest.approx(expected, rel=vessel.SLOPE_BOUND / 100)


def test_stiffness_lies_between_the_limits_of_a_silicone_tube():
    # Derived: an ovalising line load of 1.5e-2 N/mm per mm at 4.4 mm, over R √(R/t).
    free, held = (stiffness(4.4e-3, Material(0.52e6, 1.5e-3, s)) for s in (0.0, 1.0))
    assert free == pytest.approx(1.5e4 * 4.4e-3 * np.sqrt(4.4 / 1.5), rel=0.05)
    assert held > free
    # An aorta yields by about 0.6 mm under 0.1 N.
    aorta = stiffness(0.014, Material(0.45e6, 1.4e-3, 1.0))
    assert 0.1 / aorta == pytest.approx(0.6e-3, rel=0.05)


def pushed(vessel):
    """Joint positions, indentations and contacts of a push against the arch's wall."""
    task = suite.make_task("simple1_bca", vessel=vessel)
    batch = BatchSimulation(task, 1, seeds=0)
    batch.reset()
    action = np.zeros((1, 21))
    action[:, -1] = action[:, 0] = 1.0
    qpos, found, count = [], [], 0
    for _ in range(50):
        batch.step(action)
        qpos.append(batch.batch.qpos.copy())
        found.append(float(batch.contacts().penetration.max()))
        count += batch.contacts().present.sum()
    return np.array(qpos), np.array(found), count


@pytest.fixture(scope="module")
def rigid():
    """What `pushed` finds in a rigid vessel."""
    return pushed("rigid")


def test_a_wall_of_a_thousand_times_the_modulus_is_the_rigid_one(rigid):
    hard = pushed({"wall": {"modulus": 0.45e9}})
    np.testing.assert_array_equal(rigid[0], hard[0])
    soft, indented, _ = pushed({"wall": {"modulus": 0.1e6}})
    assert indented.max() > 1.5 * rigid[1].max()
    assert not np.array_equal(rigid[0], soft)


def test_a_link_outside_the_lumen_keeps_the_wall_that_it_indents(monkeypatch):
    """Its radius is 0 there, which stands for a link that has met no vessel."""
    monkeypatch.setattr(Wall, "_write", lambda wall, rows: None)
    blood = types.SimpleNamespace(radius=np.array([[0.0, 5e-3], [3e-3, 0.0]]))
    wall = Wall(WallOptions(), blood)
    wall._radius = np.array([[4e-3, 4e-3], [0.0, 0.0]])
    wall.act(np.zeros(0), None)
    assert wall._radius.tolist() == [[4e-3, 5e-3], [3e-3, 0.0]]


def test_the_check_of_a_stiffened_wall_sees_one_that_is_not():
    assert vessel.stiffened(1.0) > 1e-4


@pytest.mark.parametrize(
    "part", [{"wall": True}, {"motion": {"heart": 0, "breathing": 0}}]
)
def test_a_device_touches_a_living_wall_at_as_many_places_as_a_rigid_one(rigid, part):
    assert pushed(part)[2] < 1.25 * rigid[2]


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ("liquid", "rigid, silicone, living"),
        (3, "living, or a mapping with some of flow, wall, motion"),
        ({"wall": {"modulus": 1.0}}, "vessel wall: modulus is 1.0.*10000 to 1e.09 Pa"),
        ({"wall": {"thickness": (0.0, 1.0)}}, "vessel wall: thickness.*0.005 m"),
        ({"wall": {"support": None}}, "vessel wall: support is None"),
        ({"flow": {"rate": "fast"}}, "rate is 'fast'.*a finite number from 30"),
        ({"flow": {"rate": 500}}, "vessel flow: rate is 500.*30 to 200 1/min"),
        ({"flow": {"peak": (0.5, 9)}}, "vessel flow: peak.*0 to 2 m/s"),
        ({"flow": {"wave_speed": float("nan")}}, "wave_speed.*2 to 20 m/s"),
        ({"flow": {"pulse": 1}}, "rate, peak, phase, wave_speed, split"),
        ({"flow": {"split": "even"}}, "split is 'even'.*measured, murray"),
        ({"flow": "fast"}, "True, False, or a mapping with some of rate"),
        ({"flows": True}, "some of flow"),
        ({"motion": {"heart": 0.1}}, "vessel motion: heart is 0.1.*0 to 0.012 m"),
        ({"motion": {"breath_rate": 0}}, "vessel motion: breath_rate.*4 to 60 1/min"),
        (
            {"flow": True, "motion": {"rate": 70}},
            "rate is 70, and the flow has a heart.*give rate of the flow alone",
        ),
    ],
)
def test_what_no_vessel_does_is_refused(given, words):
    with pytest.raises(ValueError, match=words):
        VesselOptions.make(given)
    if isinstance(given, dict) and "flows" not in given:
        with pytest.raises(ValueError, match=words):
            VesselOptions(**given)


def test_options_of_a_vessel_are_those_of_a_mapping():
    given = {"flow": True, "wall": {"support": 0.5}, "motion": False}
    assert VesselOptions(**given) == VesselOptions.make(given)
    assert VesselOptions(**given).wall.support == 0.5
    silicone = VesselOptions.make("silicone")
    assert silicone == VesselOptions(wall={"modulus": 0.52e6, "thickness": 1.5e-3})
    assert silicone.deepest == STIFFENING and VesselOptions().deepest is None


def test_what_cannot_flow_or_be_observed_is_refused():
    whole = phantoms.load("simple1")
    heart = [end for end in whole.ends if end.vessel == "aorta" and end.open]
    others = [end for end in whole.ends if end not in heart]
    for ends in ((), heart, others):
        with pytest.raises(ValueError, match=f"has {len(ends)} free.*leave flow out"):
            VesselOptions.make("living").check(dataclasses.replace(whole, ends=ends))
    with pytest.raises(ValueError, match="'vessel' needs a living vessel"):
        suite.make_task("simple1_bca", observation="vessel")


def test_a_flow_without_inflow_is_the_limit_of_a_small_one():
    """A peak of 0 in the law stands for a steady flow, of 1 m³/s here."""

    def pushed(peak):
        task = suite.make_task(
            "simple1_bca",
            random=0,
            vessel={"flow": {"peak": peak}},
            observation="vessel",
        )
        env = suite.environment(task)
        env.reset()
        for _ in range(8):
            step = env.step(np.eye(task.num_actions)[-1])
        assert task.error is None
        return task.readings.centreline, step.observation["blood_velocity"]

    still, slow = pushed(0.0), pushed(1e-12)
    np.testing.assert_allclose(still[0], slow[0], atol=1e-9)
    np.testing.assert_array_equal(still[1], 0.0)


def test_a_surface_of_no_simulation_or_before_an_episode_is_refused():
    batch = BatchSimulation(suite.make_task("simple1_bca", vessel="living"), 2)
    with pytest.raises(RuntimeError, match="no episode has begun; call reset"):
        batch.rollout.moving.surface(0)
    batch.reset()
    assert np.isfinite(batch.rollout.moving.surface(1).vertices).all()
    for index in (2, -1, None, 0.0):
        with pytest.raises(ValueError, match="^index is .*an integer from 0 to 1"):
            batch.rollout.moving.surface(index)


def test_a_snapshot_of_another_split_of_the_flow_is_refused():
    split, made = {"flow": {"split": "murray"}}, []
    for chosen in ({"flow": True}, split):
        made.append(BatchSimulation(suite.make_task("simple1_bca", vessel=chosen), 1))
        made[-1].reset()
    one, other = made
    for mine, its in ((one, other), (other, one)):
        with pytest.raises(ValueError, match="its split of the flow is 'm"):
            mine.restore(its.snapshot())
    one.restore(one.snapshot())


def test_a_wrong_name_of_a_vessel_tells_that_a_mapping_is_allowed():
    with pytest.raises(ValueError, match="silicone, living, or a mapping with some of"):
        suite.make_task("simple1_bca", vessel="flow=1")
