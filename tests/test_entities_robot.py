import mujoco
import numpy as np
import pytest
from dm_control import composer, mjcf
from hypothesis import given
from hypothesis import strategies as st

from cathsim_dmc.entities import robot as robot_module
from cathsim_dmc.entities.robot import (
    CYCLE,
    JAW_OPENING,
    JOINTS,
    ROLLER_RADIUS,
    Robot,
    postures,
)

NAMES = list(JOINTS)
COLUMN = {name: i for i, name in enumerate(NAMES)}
RANGES = [joint.range for joint in Robot().joints]  # of slides; wheels have none
SLIDES = [i for i, range_ in enumerate(RANGES) if range_ is not None]
insertions = st.floats(-0.5, 1.5, allow_nan=False)
rotations = st.floats(-50.0, 50.0, allow_nan=False)


def follower_posture(insertion, rotation=0.0, *wire):
    """Posture (..., 16) of a robot with one device, or with a guidewire of its own."""
    four = np.broadcast_arrays(insertion, rotation, *(wire or (insertion, rotation)))
    joints = postures(np.array(four, float).reshape(4, -1))
    return joints.reshape(*four[0].shape, len(JOINTS))


def arena_with_robot(gravity=(0.0, 0.0, -9.81), falling_ball=False):
    arena = composer.Arena()
    root = arena.mjcf_model
    root.option.gravity = gravity
    root.option.integrator = "discrete"
    if falling_ball:  # another moving thing, right through the robot
        body = root.worldbody.add("body", name="ball", pos=(0, 0, 0.1))
        body.add("freejoint", name="ball")
        body.add("geom", name="ball", size=(0.01,), mass=0.01)
    robot = Robot()
    arena.attach(robot)
    return mjcf.Physics.from_mjcf_model(root), robot


def pose(physics, robot, insertion, rotation=0.0):
    """Puts the robot where a device pushed and turned so far needs it."""
    joints = physics.bind(robot.joints)
    joints.qpos = follower_posture(insertion, rotation)
    joints.qvel = 0.0
    physics.forward()


def clamps(insertion):
    """Travel of the platform and opening of the jaws, of the front and rear pair."""
    posture = follower_posture(insertion)
    return [
        (
            posture[..., COLUMN[f"{pair}_platform"]],
            posture[..., COLUMN[f"{pair}_jaw_left"]],
        )
        for pair in ("front", "rear")
    ]


@given(insertions, st.floats(1e-7, 1e-4), rotations)
def test_posture_is_continuous(insertion, step, rotation):
    change = np.abs(
        follower_posture(insertion + step, rotation + step)
        - follower_posture(insertion, rotation)
    )
    # Fastest slide: the return swing, 1 - 1.5 CYCLE / RETURN; jaws are slower.
    fastest = 1.5 * CYCLE / robot_module.RETURN
    wheels = [i for i in range(len(JOINTS)) if i not in SLIDES]
    assert change[SLIDES].max() <= fastest * step + 1e-12
    assert change[wheels].max() <= (1 + fastest) * step / ROLLER_RADIUS + 1e-9


@given(insertions)
def test_device_is_always_held(insertion):
    (_, front), (_, rear) = clamps(insertion)
    assert min(front, rear) == 0.0


@given(insertions, st.floats(-2e-3, 2e-3))
def test_no_slip_while_clamped(insertion, step):
    before = clamps(insertion)
    after = clamps(insertion + step)
    for (travel, opening), (moved, opened) in zip(before, after, strict=True):
        if opening < JAW_OPENING and opened < JAW_OPENING:
            # Also while the jaws are part open the platform goes with the device.
            assert moved - travel == pytest.approx(step, abs=1e-12)


@given(insertions, rotations)
def test_posture_stays_in_range(insertion, rotation):
    posture = follower_posture(insertion, rotation)
    for name, ends, value in zip(JOINTS, RANGES, posture, strict=True):
        assert ends is None or ends[0] <= value <= ends[1], name


def test_rear_clamps_and_guidewire_unit_follow_a_guidewire_of_its_own():
    both = follower_posture(0.1, 1.0)
    own = follower_posture(0.1, 1.0, 0.15, -2.0)
    changed = {name for name, a, b in zip(NAMES, both, own, strict=True) if a != b}
    kept = {name for name in NAMES if name.startswith("front_")}
    # The catheter unit stays half-way between the clamps, and rolls on the catheter.
    assert changed.isdisjoint(kept | {"catheter_ring", "catheter_pinion"})
    assert {"rear_platform", "guidewire_ring", "catheter_platform"} <= changed
    rear = [name for name in NAMES if name.startswith(("rear_", "guidewire_"))]
    alone = follower_posture(0.15, -2.0)
    for name in rear:
        assert own[COLUMN[name]] == alone[COLUMN[name]]
    assert own[COLUMN["guidewire_ring"]] == -2.0


def test_platforms_never_meet():
    posture = follower_posture(np.linspace(0, CYCLE, 4001))
    bodies = [Robot().mjcf_model.find("body", name) for name in JOINTS[:4]]
    half = np.array([body.geom[0].size[2] for body in bodies])  # of the plates
    centre = np.array([body.pos[2] for body in bodies]) + posture[:, :4]
    gaps = (centre - half)[:, :-1] - (centre + half)[:, 1:]
    assert gaps.min() > 0.004
    assert (centre + half).max() < -0.016  # the front end plate
    assert (centre - half).min() > -0.360 + 0.012  # the rear one


def test_joints_and_names():
    physics, robot = arena_with_robot()
    assert [joint.name for joint in robot.joints] == NAMES
    assert [j.full_identifier for j in robot.joints] == [f"robot/{n}" for n in NAMES]
    assert physics.model.nv == physics.model.nq == len(JOINTS) == 16
    assert physics.model.nu == 0 and physics.model.neq == 0
    assert robot.mjcf_model.model == "robot"


def test_ranges_are_written_but_not_enforced():
    physics, robot = arena_with_robot()
    bound = physics.bind(robot.joints)
    assert not np.any(bound.limited)
    wanted = [(0, 0) if ends is None else ends for ends in RANGES]
    np.testing.assert_allclose(bound.range, wanted)


def test_all_geoms_are_for_looks_only():
    physics, robot = arena_with_robot()
    geoms = physics.bind(robot.mjcf_model.find_all("geom"))
    assert not np.any(geoms.contype) and not np.any(geoms.conaffinity)
    kinds = {int(mujoco.mjtGeom.mjGEOM_BOX), int(mujoco.mjtGeom.mjGEOM_CYLINDER)}
    assert set(np.asarray(geoms.type)) <= kinds | {int(mujoco.mjtGeom.mjGEOM_CAPSULE)}
    assert set(np.asarray(geoms.group)) == {2}
    assert np.all(geoms.matid >= 0)
    # The model's mean inertia, which scales the solver's stopping rule, is left
    # alone: a carriage has 0.2 kg.
    mass_matrix_trace = physics.model.stat.meaninertia * physics.model.nv
    assert mass_matrix_trace < 0.02 * 0.2


def test_it_stands_still_and_touches_nothing():
    physics, robot = arena_with_robot(gravity=(3.0, -5.0, -9.81), falling_ball=True)
    pose(physics, robot, 0.0567, 2.0)
    joints = physics.bind(robot.joints)
    start = joints.qpos.copy()
    for _ in range(2000):
        physics.step()
        assert physics.data.ncon == 0 and physics.data.nefc == 0
    assert physics.named.data.qpos["ball"][2] < -10.0  # gravity did act
    np.testing.assert_allclose(joints.qpos, start, rtol=0, atol=1e-9)
    np.testing.assert_allclose(joints.qvel, 0.0, atol=1e-9)
    assert not any(warning.number for warning in physics.data.warning)
