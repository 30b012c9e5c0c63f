"""What the observations show, and when."""

import json
from dataclasses import replace

import numpy as np
import pytest
from conftest import twin

from cathsim_dmc import suite
from cathsim_dmc.anatomy import phantoms
from cathsim_dmc.imaging.fluoroscopy import Fluoroscope
from cathsim_dmc.imaging.options import FluoroscopyOptions
from cathsim_dmc.physics.readings import CoaxialReadings, Readings
from cathsim_dmc.simulation.batch import BatchSimulation
from cathsim_dmc.tasks import observations, route
from cathsim_dmc.tasks.common_chain import CommonChain
from cathsim_dmc.tasks.config import NavigationConfig
from cathsim_dmc.tasks.observation_kind import Entry, ObservationTable, Sizes
from cathsim_dmc.tasks.tracking_noise import TrackingNoise

SIZE = 64


@pytest.fixture(scope="module")
def anatomy():
    return phantoms.load("simple1")


@pytest.fixture(scope="module")
def make():
    """Returns a function that makes an environment that observes: of one scene."""
    task = suite.make_task("simple1_bca")

    def environment(observation, seed=0, fluoroscopy=None):
        images = {"size": SIZE, **(fluoroscopy or {})}
        return suite.environment(
            twin(task, seed, observation=observation, fluoroscopy=images)
        )

    return environment


def push(environment, steps, bend=0.0):
    action = np.zeros(21)
    action[0:20:2], action[-1] = bend, 1.0
    return [environment.step(action) for _ in range(steps)]


@pytest.mark.parametrize("noise", [False, True])
def test_sequential_is_the_last_three_images_oldest_first(make, noise):
    env = make(["image", "sequential"], fluoroscopy={"noise": noise})
    for _ in range(2):  # the second time after an episode
        timesteps = [env.reset(), *push(env, 5)]
        images = [t.observation["image"][..., 0] for t in timesteps]
        stacks = [t.observation["sequential"] for t in timesteps]
        # Nothing of an earlier episode is seen; the first image fills the history.
        for channel in range(3):
            np.testing.assert_array_equal(stacks[0][..., channel], images[0])
        np.testing.assert_array_equal(stacks[1][..., 1], images[0])
        for t in range(2, 6):
            for channel in range(3):
                np.testing.assert_array_equal(
                    stacks[t][..., channel], images[t - 2 + channel]
                )
        assert not np.array_equal(images[0], images[5])


def test_the_image_is_the_fluoroscopes(make, anatomy):
    env = make("image", fluoroscopy={"view": "LAO45", "contrast": 25.0})
    env.reset()
    image = push(env, 10)[-1].observation["image"]
    options = FluoroscopyOptions(view="LAO45", size=SIZE)
    surface = anatomy.surface
    arm = options.carms(surface.vertices)[0]
    scope = Fluoroscope.from_surface(surface, arm, contrast=25.0)
    shadows = env.task.rollout.shadows
    np.testing.assert_array_equal(image, scope.render(shadows)[0])


def test_noise_is_new_in_every_image_and_the_same_for_a_seed(make):
    def images(seed):
        env = make("image", seed, fluoroscopy={"noise": True})
        first = env.reset().observation["image"]
        return [first, *(t.observation["image"] for t in push(env, 2))]

    one, again, other = images(1), images(1), images(2)
    for a, b, c in zip(one, again, other, strict=True):
        np.testing.assert_array_equal(a, b)
        assert (a != c).mean() > 0.2
    far = np.abs(one[0][:4].astype(int) - one[1][:4])  # away from the device
    assert 0 < far.mean() < 10


@pytest.mark.slow
def test_biplane_sees_both_views(make):
    env = make(
        ["image", "sequential", "segmentation", "tracking_2d"],
        fluoroscopy={"view": "AP", "biplane": "LATERAL", "size": (32, 48)},
    )
    seen = env.reset().observation
    assert seen["image"].shape == (32, 48, 2)
    assert seen["sequential"].shape == (32, 48, 6)
    assert seen["segmentation"].shape == (32, 48, 4)
    assert seen["tracking_pixels"].shape == (2 * observations.TRACKED_POINTS * 2,)
    for channel, view in enumerate(("AP", "LATERAL")):
        single = make("image", fluoroscopy={"view": view, "size": (32, 48)})
        np.testing.assert_array_equal(
            seen["image"][..., channel], single.reset().observation["image"][..., 0]
        )


def test_segmentation_is_device_and_vessel(make):
    env = make(["segmentation", "image", "tracking_2d"])
    before = env.reset().observation
    after = push(env, 20)[-1].observation
    assert set(np.unique(after["segmentation"])) == {0, 255}
    device, vessel = np.moveaxis(after["segmentation"] == 255, -1, 0)
    # The vessel stays, the device grows into it and is mostly inside.
    np.testing.assert_array_equal(vessel, before["segmentation"][..., 1] == 255)
    assert device.sum() > (before["segmentation"][..., 0] == 255).sum()
    assert vessel.mean() > 0.05
    # The head, whose pixel coordinates are given, is on the device.
    column, row = after["tracking_pixels"].reshape(-1, 2)[-1]
    r, c = round(row), round(column)
    assert device[r - 1 : r + 2, c - 1 : c + 2].any()
    # Where the device is, the image is darker than that of the vessel alone.
    (shadow,) = env.task.rollout.shadows
    away = replace(shadow, points=shadow.points[0] + [1.0, 0.0, 0.0])
    empty = env.task.rollout.case().angiograph.planes()[0].render([away])
    assert (after["image"][device] < empty[device]).all()
    far = after["image"] == empty
    assert far.mean() > 0.9 and not (device & far[..., 0]).any()


def test_tracking_follows_device_and_goal_in_space_and_on_the_screen(make):
    env = make(["tracking", "tracking_2d", "goal"])
    env.reset()
    seen = push(env, 8, bend=0.3)[-1].observation
    task = env.task
    points = seen["tracking_points"].reshape(-1, 3)
    np.testing.assert_array_equal(points[-1], task.readings.head)
    line = task.readings.centreline
    assert all((point == line).all(-1).any() for point in points)
    carm = task.rollout.case().angiograph.planes()[0].carm
    pixels = seen["tracking_pixels"].reshape(-1, 2)
    np.testing.assert_allclose(pixels, carm.project(points)[0])
    np.testing.assert_allclose(
        seen["tracking_goal_pixels"], carm.project(task.goal_position)[0]
    )
    np.testing.assert_array_equal(seen["goal_position"], task.goal_position)
    np.testing.assert_allclose(
        seen["goal_from_head"], task.goal_position - task.readings.head
    )
    assert np.linalg.norm(seen["goal_from_head"]) == pytest.approx(
        task.info()["distance"]
    )
    assert seen["tracking_insertion"] == task.readings.insertion
    assert seen["tracking_action"][0] == 0.3 and seen["tracking_action"][-1] == 1.0


def test_the_route_ahead_is_that_of_the_centreline_seen_from_the_tip(make):
    env = make("route")
    env.reset()
    observation = push(env, 25, bend=0.3)[-1].observation
    state, line = env.task.readings, env.task.objective.route
    frame = state.head_frame
    np.testing.assert_allclose(frame.T @ frame, np.eye(3), atol=1e-12)
    link = state.head - state.centreline[-2]
    np.testing.assert_allclose(frame[:, 2], link / np.linalg.norm(link), atol=1e-12)
    points = observation["route_points"].reshape(-1, 3) @ frame.T + state.head
    place = line.project(points)
    np.testing.assert_allclose(place.distance, 0, atol=1e-5)
    np.testing.assert_allclose(np.diff(place.arc_length), 5e-3, atol=1e-4)
    np.testing.assert_allclose(observation["route_radii"], place.radius, rtol=1e-2)
    # The head lies in the cross-section of the first of them, or is nowhere nearer.
    nearest = line.project(state.head)
    assert abs(place.arc_length[0] - nearest.arc_length) < 1e-3
    deviation = nearest.distance / nearest.radius - 1
    np.testing.assert_allclose(observation["route_deviation"], deviation, atol=0.03)
    goal = frame @ observation["route_goal"] + state.head
    np.testing.assert_allclose(goal, env.task.objective.goal, atol=1e-12)
    device = observation["route_device"].reshape(-1, 3) @ frame.T + state.head
    shown = CommonChain(env.task.scene.catheter, 0.0175).tracked(state.centreline)
    np.testing.assert_allclose(device, shown[:-1], atol=1e-12)


def test_the_route_goes_straight_on_behind_the_goal():
    objective = suite.make_task("simple1_bca").objective
    line = objective.route
    head, frame = line.points[-1:] - 1e-4, np.eye(3)[None]
    routes = [route.Route.of(objective)]
    chosen = np.zeros(1, int)
    place = route.locate_each(routes, chosen, head)
    ahead = route.look_ahead(routes, chosen, place, head, frame)
    points = ahead.points[0] + line.points[-1] - 1e-4
    way = np.diff(points[2:], axis=0)
    np.testing.assert_allclose(np.linalg.norm(way, axis=-1), 5e-3, atol=1e-9)
    np.testing.assert_allclose(way, np.broadcast_to(way[0], way.shape), atol=1e-9)


def test_a_head_beside_the_route_sees_how_far_it_is_out_of_the_lumen():
    objective = suite.make_task("simple1_bca").objective
    line = objective.route
    middle = len(line.points) // 2
    way = line.points[middle + 1] - line.points[middle - 1]
    aside = np.cross(way, [0.3, 0.5, 0.8])
    aside *= line.radii[middle] / np.linalg.norm(aside)
    heads = line.points[middle] + np.outer([0.0, 1.0, 3.0], aside)
    frames = np.broadcast_to(np.eye(3), (3, 3, 3))
    routes = [route.Route.of(objective)]
    chosen = np.zeros(3, int)
    place = route.locate_each(routes, chosen, heads)
    ahead = route.look_ahead(routes, chosen, place, heads, frames)
    np.testing.assert_allclose(ahead.excess, [-1, 0, 2], atol=0.1)


def test_an_objective_without_a_route_cannot_show_one():
    class Anywhere:
        goal, goal_radius = np.zeros(3), 1.0

    with pytest.raises(ValueError, match="Anywhere has no route"):
        route.Route.of(Anywhere())


def test_options_are_json():
    text = '{"fluoroscopy": {"view": [5, 0], "biplane": "LAO45", "size": 32}}'
    assert NavigationConfig(**json.loads(text)).fluoroscopy.planes == 2


def test_entries_that_networks_cannot_read_are_refused():
    def near(frame):
        return {}

    table = ObservationTable()
    with pytest.raises(ValueError, match="entries action, info .*environments use"):
        table.row(Entry("info", 1, "", ""), Entry("action", 1, "", ""))(near)
    for entry in (
        Entry("near", (), "m", ""),
        Entry("dim", (3,), "", "", dtype=np.uint8),
    ):
        with pytest.raises(ValueError, match=f"entry '{entry.key}'.*must be"):
            entry.spec(Sizes())
    for dtype in (bool, float, np.int64):  # networks and specs know none of them
        with pytest.raises(ValueError, match="dtype of the entry 'dim'.*uint8"):
            Entry("dim", (2, 2, 1), "", "", dtype=dtype)
    spec = {"near": Entry("near", 1, "m", "").spec(Sizes())}
    table.check({"near": np.zeros((2, 1))}, spec, np.arange(2))
    with pytest.raises(ValueError, match="'near' .* is of bool, .* declares float64"):
        table.check({"near": np.zeros((2, 1), bool)}, spec, np.arange(2))


def test_an_image_with_one_bound_has_the_other_of_its_type():
    spec = Entry("dim", (2, 2, 1), "", "", low=1, dtype=np.uint8).spec(Sizes())
    assert (spec.minimum, spec.maximum) == (1, 255)
    assert Entry("near", 1, "m", "", low=0).spec(Sizes()).maximum == np.inf


def test_the_base_bears_what_pushes_and_turns_the_device():
    task = suite.make_task("simple1_bca", rotation=True, observation="force")
    environment = suite.environment(task)
    environment.reset()
    data, base = environment.physics.data.ptr, task.rollout.index.links.start
    axis = task.scene.placement.direction
    for push, turn in ((0.1, 2e-4), (-0.1, -1e-4)):
        data.xfrc_applied[base] = np.append(-push * axis, -turn * axis)
        for _ in range(20):
            observation = environment.step(np.zeros(22)).observation
        np.testing.assert_allclose(observation["push_force"], [push, turn], rtol=1e-3)


def test_the_head_errs_as_the_last_of_the_points_that_are_tracked():
    """Those of simulations that are not seen anew keep their errors."""
    random = np.random.default_rng(0)
    line, ends = random.normal(size=(3, 40, 3)), random.normal(size=(3, 2, 8, 3))
    state, devices = (
        kind(**dict.fromkeys(kind._fields)) for kind in (Readings, CoaxialReadings)
    )
    state = state._replace(centreline=line, head=line[:, -1])
    devices = devices._replace(points=ends)
    noise, states = TrackingNoise(1e-3), [np.random.RandomState(n) for n in range(3)]
    seen, lines = noise.seen(state, devices, states, np.arange(3))
    np.testing.assert_array_equal(seen.head, seen.centreline[:, -1])
    for found, true in ((seen.centreline, line), (lines.points, ends)):
        assert (found - true).std() == pytest.approx(1e-3, rel=0.15)
    after, _ = noise.seen(state, devices, states, np.array([1]))
    changed = (after.centreline != seen.centreline).any(axis=(1, 2))
    assert changed.tolist() == [False, True, False]


def test_biplane_sees_the_vessel_move_whatever_else_is_observed():
    planes = {"view": (60, 0), "biplane": (-30, 0)}
    seen = []
    for names in (["biplane"], ["biplane", "image"]):
        task = suite.make_task(
            "type1_lcca", vessel={"motion": True}, observation=names, fluoroscopy=planes
        )
        batch = BatchSimulation(task, 1, num_threads=1)
        batch.reset()
        for _ in range(4):
            step = batch.step(np.ones((1, batch.num_actions)))
        seen.append(step.observation)
    for key, value in seen[0].items():
        np.testing.assert_array_equal(seen[1][key], value)


def test_camera_matrices_project_the_points_that_are_tracked():
    """Each simulation has its own, with the deviation of its C-arm."""
    names, ranges = ["tracking", "tracking_2d"], {"view": (-9, 9)}
    seen = {"observation": names, "randomisation": ranges}
    machine = {"view": "LAO45", "biplane": "LATERAL", "size": (96, 128)}
    task = suite.make_task("simple1_bca", fluoroscopy=machine, **seen)
    simulation = BatchSimulation(task, 3, num_threads=1)
    observation = simulation.reset().observation
    matrices = simulation.rollout.camera_matrices
    assert matrices.shape == (3, 2, 3, 4) and np.ptp(matrices, axis=0).max() > 1.0
    points = observation["tracking_points"].reshape(3, -1, 3)
    points = np.concatenate([points, np.ones((*points.shape[:2], 1))], axis=-1)
    found = np.einsum("npij,nkj->npki", matrices, points)
    pixels = (found[..., :2] / found[..., 2:]).reshape(3, -1)
    np.testing.assert_allclose(pixels, observation["tracking_pixels"], atol=1e-9)
    bare = BatchSimulation(suite.make_task("simple1_bca"), 2, num_threads=1)
    assert bare.rollout.camera_matrices.shape == (2, 0, 3, 4)
