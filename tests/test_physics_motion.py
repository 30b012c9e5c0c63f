"""A moving vessel: where its wall is, what it carries, what is judged in it."""

import mujoco
import numpy as np
import pytest

from cathsim_dmc import suite
from cathsim_dmc.anatomy import phantoms
from cathsim_dmc.anatomy.motion import Motion, _along_aorta
from cathsim_dmc.anatomy.scan import topology
from cathsim_dmc.collision import fields
from cathsim_dmc.laws import blood, heart
from cathsim_dmc.physics.vessel import VesselOptions
from cathsim_dmc.simulation.batch import BatchSimulation
from cathsim_dmc.validation import motion, rig


@pytest.fixture(scope="module")
def tube():
    """A straight tube along z."""
    return rig.tube(0.2, motion.RADIUS)


@pytest.fixture(scope="module")
def arch():
    """The smallest phantom."""
    return phantoms.load("simple1")


def test_branches_move_with_their_ostia_in_the_aorta_as_published():
    """In inspiration down, to the front, and to the middle: of the LSA to the right."""
    forked = phantoms.load("type2")
    names, blood = list(forked.tree.vessels), forked.circulation
    moved = np.hstack(_along_aorta(blood, forked.tree))
    for name, size, side in (("bca", 12.0e-3, 1.0), ("lsa", 11.1e-3, -1.0)):
        both = [names.index(each) for each in (name, f"{name}_fork2")]
        (way,) = np.unique(moved[np.isin(blood.vessel, both)], axis=0)
        fading = np.exp(-0.5 * (blood.courses[name].begin / 50e-3) ** 2)
        assert np.linalg.norm(way[:3]) == pytest.approx(fading)
        assert np.linalg.norm(way[3:]) == pytest.approx(size)
        unit = [0.33 * side, -0.47, -0.82]
        np.testing.assert_allclose(way[3:] / size, unit, atol=0.01)


def test_the_heart_moves_the_root_and_breathing_the_aorta_as_far_as_published(arch):
    """By 50 mm the heart's motion has faded as one deviation of a Gaussian does."""
    blood = arch.circulation
    root = blood.vessel == 0
    way, line = blood.ways[root].mean(axis=1), arch.tree.root.centreline
    heart, breath = (each[root] for each in _along_aorta(blood, arch.tree))
    size = np.linalg.norm(heart, axis=1)
    np.testing.assert_allclose(size, np.exp(-0.5 * (way / 50e-3) ** 2), rtol=1e-6)
    np.testing.assert_allclose(heart[0] / size[0], [0.3, -0.3, -0.9], atol=0.01)
    # Half-way up to the BCA, and at the end.
    begin = blood.courses["bca"].begin
    far = np.linalg.norm(breath, axis=1)
    places = np.interp([0.0, begin / 4, begin / 2, line.length], way, far)
    np.testing.assert_allclose(places[:3], 8.9e-3, rtol=0.02)
    assert places[3] == pytest.approx(4.9e-3, rel=0.05)
    for place, side in ((0, 1.0), (-1, -1.0)):  # the descending aorta to the right
        unit = breath[place] / far[place]
        np.testing.assert_allclose(unit, [0.33 * side, -0.47, -0.82], atol=0.02)


def test_the_radius_follows_the_pulse_which_travels(tube):
    deviation, delays, expected = motion.diameters(tube)
    assert 1e3 * deviation < motion.WALL_BOUND
    np.testing.assert_allclose(delays, expected, atol=1e-4)


def test_the_wall_is_where_heart_and_breathing_put_it(arch):
    assert 1e3 * motion.wall_place(arch) < motion.WALL_BOUND


def test_a_wall_that_a_probe_does_not_find_fails(arch, monkeypatch):
    there = motion.clearances

    def clearances(anatomy, course, times, points):
        points[0, 0] = anatomy.tree.root.centreline.at(0.05).position
        return there(anatomy, course, times, points)

    monkeypatch.setattr(motion, "clearances", clearances)
    assert not 1e3 * motion.wall_place(arch) < motion.WALL_BOUND


def test_a_wall_carries_what_rests_on_it(tube):
    assert motion.slip(tube) < motion.SLIP_BOUND


def test_motion_in_the_walls_frame_is_that_under_its_inertia(tube):
    assert motion.frame(tube) < motion.FRAME_BOUND


def test_blood_in_a_moving_vessel_keeps_its_volume_and_moves_along(tube):
    for time in motion.FLOW_TIMES:
        flow = motion.section_flow(tube, time)
        assert flow == pytest.approx(1.0, rel=motion.FLOW_BOUND / 100)


def test_blood_at_rest_and_blood_that_flows_are_carried_by_the_vessel():
    def speeds(**vessel):
        task = suite.make_task("simple1_bca", vessel={"motion": True, **vessel})
        batch = BatchSimulation(task, 1, seeds=0)
        batch.reset()
        steps = [batch.step(np.zeros((1, 21))) for _ in range(40)]
        return np.concatenate([step.info()["blood_speed"] for step in steps])

    rest = speeds()
    assert rest[0] < 1e-3 and 3e-3 < rest.max() < 0.1
    np.testing.assert_allclose(speeds(flow={"peak": 1e-9}), rest, atol=1e-7)


def test_places_in_space_are_found_and_the_sheath_rests(arch):
    course = motion.parameters(5.5e-3, 1.0, 0.02)
    points = np.concatenate([v.centreline.points for v in arch.tree.vessels.values()])
    there, growth = arch.motion.to_space(course, 2.2, points)
    np.testing.assert_allclose(
        arch.motion.to_rest(course, 2.2, there), points, atol=1e-6
    )
    moved = np.linalg.norm(there - points, axis=1)
    assert moved.max() > 8e-3 and growth.max() > 1e-4
    inlet = np.linalg.norm(points - arch.inlet.position, axis=1).argmin()
    assert moved[inlet] == 0.0 == growth[inlet]
    low, step, shape = np.split(arch.motion.lattice[:7], [3, 4])
    assert (low + step * (shape - 1) >= arch.lumen.box[1]).all()


def test_the_surface_grows_with_the_pulse(arch):
    """By the growth of the radius times the area, to first order."""
    course, rest = motion.parameters(0.0, 0.0, 0.02), arch.surface
    _, growth = arch.motion.to_space(course, 2.2, rest.vertices)
    swept = growth[rest.faces].mean(axis=1) @ topology.areas(rest.vertices, rest.faces)
    grown = arch.motion.surface(course, 2.2, rest)
    assert grown.volume - rest.volume == pytest.approx(swept, rel=0.05) and swept > 0.0


def test_motions_that_fold_space_are_refused(arch):
    options = VesselOptions.make({"motion": {"breathing": (0.5, 2.0), "heart": 0.012}})
    with pytest.raises(ValueError, match="breathing 2 fold 'simple1'.*smaller"):
        options.check(arch)
    # The gradient of breathing is diag(1, 1, 0); the heart moves against it.
    low, step, shape = np.zeros(3), 6e-3, (4, 4, 4)
    breath = step * np.argwhere(np.ones(shape)) * (1, 1, 0)
    values = np.hstack([-breath, breath, np.zeros((64, 2))])
    linear = Motion(np.concatenate([low, [step], shape, values.ravel()]))
    linear.check("linear", 0.3, 0.59)
    with pytest.raises(ValueError, match="heart 300 mm and breathing 0.61 fold 'lin"):
        linear.check("linear", 0.3, 0.61)


def test_goal_and_head_are_judged_in_the_vessel_at_rest():
    task = suite.make_task("simple1_bca", vessel={"motion": True})
    batch = BatchSimulation(task, 1, seeds=0)
    batch.reset()
    np.testing.assert_allclose(batch.rollout.goal, batch.rollout.resting_goal)
    for _ in range(50):  # to the end of inspiration
        step = batch.step(np.zeros((1, 21)))
    rollout = batch.rollout
    assert np.linalg.norm(rollout.goal - rollout.resting_goal, axis=-1)[0] > 5e-3
    resting = np.linalg.norm(rollout.resting.head - rollout.resting_goal, axis=-1)
    np.testing.assert_allclose(step.distance, resting)
    np.testing.assert_allclose(step.info()["breath_phase"], 0.5, atol=1e-9)
    # What is in the sheath has not moved, so it has not left the vessel either.
    moved = rollout.readings.centreline[0] - rollout.resting.centreline[0]
    inlet = task.scene.anatomy.inlet
    nodes = rollout.readings.centreline[0] - inlet.position
    sheathed = nodes @ inlet.direction < 0.0
    assert sheathed[0] and not moved[sheathed].any()


def test_a_wall_that_moves_past_the_sheath_does_not_touch_what_is_in_it(tube):
    moving = motion.rigid_motion(tube, np.array([1.0, 0.0, 0.0]))
    spec = motion.stirred(tube.lumen, moving.lattice)
    beside = motion.RADIUS + 6e-3  # of which the wall moves 5.5 mm
    line = np.array([[beside, 0.0, -0.05], [beside, 0.0, 0.0]])
    bore = fields.carrier(fields.Bore(line, 2e-3))
    box, ball = mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_SPHERE
    spec.worldbody.add_geom(
        type=box, pos=bore["pos"], size=bore["size"], userdata=bore["user"]
    )
    body = spec.worldbody.add_body(pos=(beside, 0.0, -1e-3))
    body.add_freejoint()
    body.add_geom(type=ball, size=(5e-4, 0, 0))
    model, found = spec.compile(), []
    for sheath in (-1, 1):
        course = motion.parameters(5.5e-3, 0.0, 0.0)
        data = motion.begin(model, course, sheath)
        data.time = 1.35
        mujoco.mj_fwdPosition(model, data)
        found.append(data.ncon)
    assert found == [1, 0]


def test_fluoroscopy_shows_the_vessel_where_it_is():
    task = suite.make_task(
        "simple1_bca", vessel={"motion": True}, observation="segmentation"
    )
    environment = suite.environment(task)
    environment.reset()
    for _ in range(50):  # to the end of inspiration
        step = environment.step(np.zeros(21))
    vessel_now = step.observation["segmentation"][..., 1] > 0
    plane = task.rollout.case().angiograph.planes()[0]
    there = plane.around(task.rollout.moving.surface(0))
    # As links and contacts, it is where it was as the last physics step began.
    physics = environment.physics
    (time,) = task.rollout.moving.times
    assert time == pytest.approx(physics.data.time - physics.model.opt.timestep)
    np.testing.assert_array_equal(vessel_now, there.vessel_mask)
    assert (vessel_now != plane.vessel_mask).mean() > 0.02


def test_numbers_that_are_none_reach_no_place_of_an_array(shared_environment):
    """Where they did, a physics step ended the process."""
    assert np.isnan(heart.pulse(np.nan)[0]) and np.isnan(blood.beat(np.nan))
    env = shared_environment("simple1_bca", vessel="living")
    for place in range(2, 11):  # the parameters of the motion, from the last on
        env.reset()
        env.physics.data.userdata[-place] = np.nan
        try:
            assert np.isfinite(env.step(np.zeros(21)).reward)
        except ValueError as error:  # of the objective: its reward is no number
            assert "finite" in str(error) or "nan" in str(error)
