"""Observations show one device, whatever length of it is simulated."""

import mujoco
import numpy as np
import pytest
from dm_control import mjcf

from cathsim_dmc import suite
from cathsim_dmc.entities import devices
from cathsim_dmc.entities.catheter import Catheter
from cathsim_dmc.physics.readings import Readings
from cathsim_dmc.tasks.common_chain import TRACKED_PLACES, CommonChain
from cathsim_dmc.tasks.placement import COMMON_LENGTH

LINK = 0.016875  # m, of the shaft
SHORT = COMMON_LENGTH - 6 * LINK
SHAFT_LINK = 0.0175


def chain(length):
    division = devices.Discretisation(working_length=length)
    return Catheter("steerable_5f", division, stroke=0.1)


def posture(catheter, bends, rates):
    """Readings (1, ...) of a chain whose distal hinges are bent and turn, by MuJoCo."""
    physics = mjcf.Physics.from_mjcf_model(catheter.mjcf_model)
    model, data = physics.model.ptr, physics.data.ptr
    data.qpos[-len(bends) :], data.qvel[-len(rates) :] = bends, rates
    data.qpos[0], data.qvel[0] = 0.02, 0.03
    data.xfrc_applied[-5, :3] = 0.1, -0.2, 0.3
    mujoco.mj_forward(model, data)
    mujoco.mj_rnePostConstraint(model, data)
    links = physics.bind(catheter.links).element_id
    head = physics.bind(catheter.head).xpos
    blank = dict.fromkeys(Readings._fields, np.zeros(1))
    return Readings(**blank)._replace(
        joint_positions=data.qpos[None].copy(),
        com_inertia=data.cinert[None, links],
        com_velocity=data.cvel[None, links],
        external_force=data.cfrc_ext[None, links],
        centreline=np.vstack([data.xpos[links], head])[None],
    )


@pytest.fixture(scope="module")
def states():
    """(CommonChain, Readings) of a short and a long chain in one posture."""
    random = np.random.default_rng(0)
    bends, rates = random.uniform(-0.2, 0.2, (2, 30))
    chains = [chain(length) for length in (SHORT, COMMON_LENGTH)]
    return [(CommonChain(c, SHAFT_LINK), posture(c, bends, rates)) for c in chains]


def test_a_short_chain_shows_what_a_long_one_shows(states):
    (short, seen), (long, expected) = states
    assert seen.com_inertia.shape[1] == 20 and short.num_links == long.num_links == 26
    np.testing.assert_array_equal(
        short.joints(seen.joint_positions), long.joints(expected.joint_positions)
    )
    found, wanted = short.links(seen), long.links(expected)
    for one, other in zip(found, wanted, strict=True):
        assert one.shape == other.shape
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-15)
    assert abs(found[2]).max() > 0.01
    # As MuJoCo gives it, without a rounding error.
    np.testing.assert_array_equal(wanted[0], expected.com_inertia)
    offset = expected.centreline[0, 0] - seen.centreline[0, 0]
    np.testing.assert_allclose(
        short.tracked(seen.centreline), long.tracked(expected.centreline), atol=1e-12
    )
    np.testing.assert_allclose(offset, [0, 0, -6 * LINK], atol=1e-12)


def test_a_simulation_shows_the_same_bits_alone_and_beside_others(states):
    (common, state), _ = states
    random = np.random.default_rng(1)
    several = Readings(
        *(np.concatenate([a, *random.normal(size=(4, *a.shape))]) for a in state)
    )
    for one, both in zip(common.links(state), common.links(several), strict=True):
        np.testing.assert_array_equal(one[0], both[0])


def test_tracked_points_are_joints_of_the_steerable_device(states):
    for common, state in states:
        points = common.tracked(state.centreline)[0]
        count = state.centreline.shape[1]
        joints = count - 1 - np.array([13, 11, 9, 7, 6, 4, 2, 0])
        np.testing.assert_array_equal(points[1:], state.centreline[0, joints[1:]])
        np.testing.assert_allclose(points[0], state.centreline[0, joints[0]], atol=1e-9)


def test_tracked_points_lie_straight_behind_a_chain_that_is_shorter():
    device = chain(0.07 + LINK)
    line = np.append(np.cumsum(device.link_lengths[::-1])[::-1], 0.0)
    line = -line[:, None] * [0.6, 0.0, 0.8]
    points = CommonChain(device, SHAFT_LINK).tracked(line)
    expected = -TRACKED_PLACES[:, None] * [0.6, 0.0, 0.8]
    np.testing.assert_allclose(points, expected, atol=1e-9)


def test_a_long_chain_shows_its_distal_part():
    device = chain(0.5)
    common = CommonChain(device, SHAFT_LINK)
    values = np.arange(float(len(device.joints)))
    shown = common.joints(values)
    assert common.num_links == 26 and len(shown) == common.num_joints == 52
    np.testing.assert_array_equal(shown[:2], [0, 1])
    np.testing.assert_array_equal(shown[2:], values[-50:])


OBSERVATION = ["internal", "tracking", "route"]


@pytest.mark.parametrize("suffix", ["", "_pair"])
def test_observations_of_every_length_have_one_shape(suffix):
    tasks = {
        (name, length): suite.make_task(
            name + suffix, working_length=length, observation=OBSERVATION
        )
        for name, length in (
            ("type2_bca", None),
            ("femoral_type3_bca", None),
            ("type2_bca", 0.25),
            ("type2_bca", 0.5),
        )
    }
    lengths = {len(task.scene.catheter.links) for task in tasks.values()}
    assert len(lengths) == 4
    shapes = [
        {key: spec.shape for key, spec in task.observation_specs.items()}
        for task in tasks.values()
    ]
    assert all(one == shapes[0] for one in shapes)


def test_simulations_before_their_first_episode_show_zeros(states):
    common, state = states[0]
    before = Readings(*(np.zeros_like(array) for array in state))
    for shown in common.links(before):
        np.testing.assert_array_equal(shown, 0.0)


def test_x_rays_meet_the_device_behind_its_base(shared_environment):
    environment = shared_environment("type1_lcca")
    environment.reset()
    task = environment.task
    (shadow,) = task.rollout.shadows
    line = task.readings.centreline
    np.testing.assert_array_equal(shadow.points[0, 1:], line)
    way, along = line[0] - shadow.points[0, 0], line[1] - line[0]
    assert np.linalg.norm(way) == pytest.approx(0.3)
    np.testing.assert_allclose(way / 0.3, along / np.linalg.norm(along), atol=1e-9)
