"""The batched path against as many composer environments, bit for bit."""

import numpy as np
import pytest
from conftest import twin

from cathsim_dmc import suite
from cathsim_dmc.anatomy import phantoms
from cathsim_dmc.anatomy.parts import Goal
from cathsim_dmc.simulation.batch import BatchSimulation

SIMULATIONS = 2
STEPS = 60
SEED = 10
NUMBERS = ("internal", "tracking", "route", "goal", "force")
PICTURES = ("image", "sequential", "segmentation", "tracking_2d", "endoluminal")
SMALL = {"size": 16}
NOISY_BIPLANE = {"biplane": "LATERAL", "noise": True, "size": (48, 64), "roadmap": 0.4}


@pytest.fixture(scope="module")
def anatomy():
    return phantoms.load("simple1")


class Pair:
    """A batch and the composer environments with the same seeds."""

    def __init__(self, task, **options):
        """Each environment and the batch compile a model of their own."""
        if not isinstance(task, str):
            task, options = "navigate", {"anatomy": task, "goal": "bca", **options}
        task = suite.make_task(task, **options)
        self.environments = [
            suite.environment(twin(task, SEED + i)) for i in range(SIMULATIONS)
        ]
        self.batch = BatchSimulation(task, SIMULATIONS, seeds=SEED, num_threads=2)

    def reset(self):
        self.timesteps = [each.reset() for each in self.environments]
        self.compare_observations(self.batch.reset().observation)

    def reset_some(self, indices):
        observation = self.batch.reset(np.array(indices)).observation
        for i in indices:
            self.timesteps[i] = self.environments[i].reset()
        self.compare_observations(observation)

    def step(self, action):
        step = self.batch.step(action)
        self.timesteps = [
            each.step(row) for each, row in zip(self.environments, action, strict=True)
        ]
        self.compare_observations(step.observation)
        for i, timestep in enumerate(self.timesteps):
            task = self.environments[i].task
            assert step.outcome.reward[i] == timestep.reward
            assert (step.terminated[i] or step.truncated[i]) == timestep.last()
            assert step.terminated[i] == (timestep.discount == 0)
            for name in task.wall_force._fields:
                batched = getattr(step.wall_force, name)[i]
                assert batched == getattr(task.wall_force, name)
            assert step.readings.push_force[i] == task.readings.push_force
            mine, theirs = task.info(), step.info()
            assert list(mine) == list(theirs)
            assert mine == {name: value[i].item() for name, value in theirs.items()}
        return step

    def compare_observations(self, observation):
        for i, timestep in enumerate(self.timesteps):
            assert list(observation) == list(timestep.observation)
            for key, value in observation.items():
                other = timestep.observation[key]
                assert value[i].dtype == other.dtype
                np.testing.assert_array_equal(value[i], other, err_msg=f"{key} of {i}")


def actions(steps, seed=0, count=21):
    """Random steering while pushing on, which meets the wall."""
    random = np.random.default_rng(seed)
    rows = random.uniform(-1, 1, (steps, SIMULATIONS, count))
    rows[..., -1 if count > 4 else slice(0, None, 2)] = 1.0
    return rows


@pytest.mark.slow
def test_episodes_are_equal_bit_for_bit(anatomy):
    pair = Pair(anatomy, observation=[*NUMBERS, *PICTURES], max_steps=STEPS)
    touched = False
    for episode in range(2):
        pair.reset()
        for action in actions(STEPS, episode):
            step = pair.step(action)
            touched |= bool((step.wall_force.sum > 0).any())
        assert step.truncated.all()
    assert touched


def test_partial_resets_are_equal(anatomy):
    pair = Pair(
        anatomy, observation=["internal", "sequential"], fluoroscopy=NOISY_BIPLANE
    )
    pair.reset()
    for index, action in enumerate(actions(24)):
        pair.step(action)
        if index % 6 == 5:
            pair.reset_some([index // 6 % SIMULATIONS])


@pytest.mark.parametrize("diverged", [False, True])
def test_a_reset_leaves_the_figures_of_other_simulations(anatomy, diverged):
    reward = {"distance": -1.0, "smoothness": -1.0, "force": -1.0}
    options = {"anatomy": anatomy, "goal": "bca", "reward": reward}
    batch = BatchSimulation(suite.make_task("navigate", **options), 2, num_threads=1)
    batch.reset()
    first, second = actions(2)
    batch.step(first)
    if diverged:
        batch.batch.qvel[1] = np.nan
    before = batch.step(second)
    after = batch.reset(np.array([0]))
    assert (after.errors[1] is not None) == diverged
    assert diverged or before.info()["reward_smoothness"][1] < 0
    for name, value in before.info().items():
        assert after.info()[name][1] == value[1], name
    assert after.outcome.reward[1] == before.outcome.reward[1]
    assert after.terminated.tolist() == [False, diverged]


def test_randomised_episodes_are_equal():
    # The wall of the phantom is met at once.
    pair = Pair(
        "navigate",
        anatomy="type1",
        goal="bca",
        observation=[*NUMBERS, *PICTURES],
        fluoroscopy=NOISY_BIPLANE,
        endoluminal_size=SMALL["size"],
        randomisation=True,
        reward={"path": -1.0, "success": 10.0, "force": -0.1, "smoothness": -0.01},
    )
    seen, touched = [], False
    for episode in range(2):
        pair.reset()
        seen.append(pair.batch.rollout.resting_goal.copy())
        for index, action in enumerate(actions(20, episode)):
            touched |= bool((pair.step(action).wall_force.sum > 0).any())
            if index == 15:
                pair.reset_some([1, 0])
    assert touched
    # It is randomised indeed: no two goals of an episode and none of two are alike.
    assert len(np.unique(np.concatenate(seen), axis=0)) == 2 * SIMULATIONS


@pytest.mark.parametrize(
    "name, options",
    [
        ("simple1_bca_pair", {"randomisation": True}),
        ("type1_lcca_wire", {"randomisation": True}),
        ("type1_lcca", {"device": "berenstein_5f", "rotation": True}),
        pytest.param("arch_bca_pair", {"pool": 2}, marks=pytest.mark.slow),
    ],
)
def test_shaped_devices_are_equal(name, options):
    observation = ["internal", "tracking", "force"]
    if name.endswith("_pair"):
        observation += ["route_coaxial", "route_retry", "route_turns"]
    pair = Pair(name, observation=observation, **options)
    pair.reset()
    for index, action in enumerate(actions(24, count=pair.batch.num_actions)):
        pair.step(action)
        if index % 12 == 6:
            pair.reset_some([1])


def test_what_a_caller_writes_into_a_step_changes_no_episode(anatomy):
    pair = Pair(anatomy, observation="force")
    pair.reset()
    for action in actions(12):
        step = pair.step(action)
        for array in (*step.readings, *step.wall_force, *step.observation.values()):
            array *= 1e3
        for environment in pair.environments:
            task = environment.task
            for array in (task.goal_position, task.readings.head):
                array += 1.0
    alone = BatchSimulation(twin(pair.batch.task), SIMULATIONS, seeds=SEED)
    alone.reset()
    for action in actions(12):
        kept = alone.step(action)
    for name, mine in zip(kept.readings._fields, kept.readings, strict=True):
        theirs = getattr(pair.batch.rollout.readings, name)
        np.testing.assert_array_equal(mine, theirs, err_msg=name)
    np.testing.assert_array_equal(kept.distance, step.distance)


@pytest.mark.parametrize("name", ["diagnostic_5f_simmons", "berenstein_5f"])
def test_a_shaped_device_that_is_left_alone_comes_to_rest(name):
    batch = BatchSimulation(suite.make_task("type2_lcca", device=name), 1)
    batch.reset()
    heads, action = [], np.ones((1, 1))
    for count in range(200):
        action[:] = count < 50
        step = batch.step(action)
        heads.append(step.readings.head[0])
        assert step.errors == (None,)
    assert np.ptp(heads[-25:], axis=0).max() < 0.1e-3


def test_success_ends_both(anatomy):
    # A goal in the aorta ahead of the tip, which a straight push reaches.
    aorta = anatomy.tree.vessel("aorta").centreline
    start = suite.make_task("navigate", anatomy=anatomy, goal="bca").scene.placement
    ahead = aorta.project(start.start + 0.02 * start.direction).arc_length
    goal = Goal("ahead", "aorta", aorta.at(ahead).position, float(ahead))
    pair = Pair(anatomy, goal=goal, observation="tracking")
    pair.reset()
    push = np.zeros((SIMULATIONS, 21))
    push[:, -1] = 1.0
    for _ in range(40):
        step = pair.step(push)
        if step.terminated.any():
            break
    ended = step.terminated
    assert ended.any()
    np.testing.assert_array_equal(step.outcome.reward[ended], 10.0)
    pair.reset_some(np.flatnonzero(ended))


@pytest.mark.slow
@pytest.mark.parametrize("noise", [False, True])
def test_one_policy_on_images_runs_alike(anatomy, noise):
    """A policy that looks at the image steers both paths along the same way."""

    def steer(image):
        rows = image.astype(np.float64).mean(axis=(-1, -2)) - image.mean()
        action = np.ones((*image.shape[:-3], 21))
        action[..., :20] = np.clip(rows[..., 20:40] / 8, -1, 1)
        return action

    pair = Pair(anatomy, observation="image", fluoroscopy={"noise": noise, "size": 64})
    pair.reset()
    observation = {"image": np.stack([t.observation["image"] for t in pair.timesteps])}
    for _ in range(20):
        observation = pair.step(steer(observation["image"])).observation
    heads = [each.task.readings.head for each in pair.environments]
    np.testing.assert_array_equal(pair.batch.rollout.readings.head, heads)
