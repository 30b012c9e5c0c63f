"""The observation that two X-ray planes give, beside what they reconstruct."""

import numpy as np
import pytest

from cathsim_dmc import compiled_cache, suite
from cathsim_dmc.imaging.biplane_loops import carried
from cathsim_dmc.simulation.batch import BatchSimulation
from cathsim_dmc.tasks import biplane_sight
from cathsim_dmc.tasks.route import Route

TASK = "type1_lcca"
OPTIONS = {
    "observation": ["biplane", "route"],
    "fluoroscopy": {"view": [60, 0], "biplane": [-30, 0], "contrast": False},
    "randomisation": {"roll": [1.0, 1.0], "start_insertion": [0.04, 0.04]},
}
STEPS = 6


@pytest.fixture(scope="module")
def both_paths():
    """Observations of a composer environment and of a batch, of the same actions."""
    environment = suite.load("cathsim", TASK, {**OPTIONS, "random": 5})
    batch = BatchSimulation(suite.make_task(TASK, **OPTIONS), 1, seeds=5)
    single, many = [environment.reset().observation], [batch.reset().observation]
    action = np.zeros(21)
    action[:20:2], action[-1] = 0.4, 0.5
    for _ in range(STEPS):
        single.append(environment.step(action).observation)
        many.append(batch.step(action[None]).observation)
    return single, many


def test_both_paths_see_the_same(both_paths):
    for one, of_batch in zip(*both_paths, strict=True):
        for key in (key for key in one if key.startswith("biplane_")):
            np.testing.assert_array_equal(one[key], of_batch[key][0], err_msg=key)


def test_the_planes_show_what_the_route_measures(both_paths):
    for seen in both_paths[0]:
        points = (seen["biplane_points"] - seen["route_points"]).reshape(-1, 3)
        assert np.linalg.norm(points, axis=1).mean() < 13e-3
        device = (seen["biplane_device"] - seen["route_device"]).reshape(-1, 3)
        assert np.linalg.norm(device[-3:], axis=1).max() < 8e-3
        way = np.linalg.norm(seen["route_goal"])
        assert np.linalg.norm(seen["biplane_goal"] - seen["route_goal"]) < 0.35 * way
        np.testing.assert_array_equal(seen["biplane_action"], seen["route_action"])


def test_every_episode_has_errors_of_its_own_which_a_snapshot_keeps():
    errors = {"noise": 0.5, "gaps": 1, "calibration": 2.0}
    seen = {**OPTIONS["fluoroscopy"], "third": "AP", "roadmap_errors": errors}
    observed = ["biplane", "biplane_retry"]
    drawn = {**OPTIONS["randomisation"], "view": [4, 5]}
    options = {"observation": observed, "fluoroscopy": seen, "randomisation": drawn}
    task = suite.make_task(TASK, **options)
    batch = BatchSimulation(task, 2, seeds=5, num_threads=1)
    first = batch.reset().observation["biplane_radii"].copy()
    assert not np.array_equal(first[0], first[1])
    rollout = batch.rollout
    for i, deviation in enumerate(rollout.deviations):
        machine = rollout.case(i).angiograph
        assert rollout._sensors.planes[i] is machine.planes(deviation)
        assert rollout._sensors.thirds[i] is machine.third(deviation)
    action = np.full((2, 21), 0.3)
    batch.step(action)
    kept = batch.snapshot()
    expected = [batch.step(action).observation for _ in range(2)]
    batch.reset()
    batch.restore(kept)
    for one in expected:
        found = batch.step(action).observation
        for key, value in one.items():
            np.testing.assert_array_equal(found[key], value, key)


@pytest.mark.parametrize(
    ("aside", "least", "deviation"), [(4, 0, 1.0), (4, 6, 1 / 3), (1, 6, -0.5)]
)
def test_a_narrow_route_with_errors_has_a_wider_tube(aside, least, deviation):
    along = 1e-3 * np.arange(100)
    points = np.stack([0 * along, 0 * along, along], axis=1)
    route = Route(points, np.full(100, 2e-3), along)
    line = points[50:10:-5] + [1e-3 * aside, 0.0, 0.0]
    seen = biplane_sight._seen(
        line, np.eye(3), route, points[-1], np.full(1, np.nan), 1e-3 * least
    )
    assert seen["deviation"] == pytest.approx(deviation)


def test_one_plane_is_not_enough():
    with pytest.raises(ValueError, match="needs two planes"):
        suite.load("cathsim", TASK, {"observation": "biplane"}).reset()


@pytest.mark.parametrize(("height", "unseen"), [(0.2, "inlet"), (-0.1, "goal 'lcca'")])
def test_planes_that_miss_inlet_or_goal_are_refused(height, unseen):
    options = {"view": (60, 0), "biplane": (-30, 0), "centre": (0, 0, height)}
    with pytest.raises(ValueError, match=f"needs the {unseen} at .* in both planes"):
        suite.load("cathsim", TASK, {"observation": "biplane", "fluoroscopy": options})


def test_planes_that_miss_the_inlet_of_any_anatomy_are_refused():
    """They show inlet and goal of the first arch, not of the second."""
    planes = {"view": (60, 0), "biplane": (-30, 0), "detector_size": 0.3}
    options = {"observation": "biplane", "fluoroscopy": planes, "arches": "test"}
    options |= {"first": 1}
    suite.load("cathsim", "femoral_arch_lcca", {**options, "pool": 1})
    with pytest.raises(ValueError, match="in both planes of 'arch-I-2000002'"):
        suite.load("cathsim", "femoral_arch_lcca", {**options, "pool": 2})


def test_a_frame_is_carried_without_turning_about_the_line():
    angle = np.linspace(2.0, 0.0, 200)
    line = np.stack([np.sin(angle), 0 * angle, 1 - np.cos(angle)], axis=1)
    tip = np.array([np.cos(2.0), 0.0, np.sin(2.0)])
    handle = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
    frame = carried(handle, line, tip)
    np.testing.assert_allclose(frame.T @ frame, np.eye(3), atol=1e-9)
    np.testing.assert_allclose(frame[:, 2], tip, atol=1e-9)
    np.testing.assert_allclose(frame[:, 1], [0.0, 1.0, 0.0], atol=1e-9)


@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_a_process_that_has_compiled_loads_a_task(monkeypatch):
    """It rehearses an episode, and observes before that episode has begun."""
    monkeypatch.setattr(compiled_cache, "has_compiled", lambda: True)
    batch = BatchSimulation(suite.make_task("simple1_bca", **OPTIONS), 1)
    assert np.isfinite(batch.reset().observation["biplane_points"]).all()
