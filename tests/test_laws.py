"""Laws, called as a reader of the formulas would: without an engine or a task."""

import ast
import math
from pathlib import Path

import numpy as np
import pytest

import cathsim_dmc
from cathsim_dmc.entities import device_stack, stack_memory
from cathsim_dmc.laws import (
    blood,
    compliance,
    drive,
    hinges,
    motion,
    sheath,
    sliding,
    springs,
)
from cathsim_dmc.laws.device import Contact, Device
from cathsim_dmc.laws.parameters import Array, shapes, total

PACKAGE = Path(cathsim_dmc.__file__).parent
MOST_PARAMETERS = 8
ALLOCATES = {"empty", "zeros", "ones", "full", "array", "empty_like", "zeros_like"}
RNG = np.random.default_rng(0)


def functions(folder):
    for path in sorted((PACKAGE / folder).glob("*.py")):
        tree = ast.parse(path.read_text())
        for node in ast.walk(tree):
            if isinstance(node, ast.FunctionDef):
                yield f"{folder}/{path.name}:{node.name}", node


def test_a_law_takes_few_parameters_and_allocates_nothing():
    many, allocating = [], []
    for name, node in functions("laws"):
        taken = node.args.args + node.args.kwonlyargs
        if len(taken) > MOST_PARAMETERS:
            many.append(name)
        decorators = {ast.unparse(each) for each in node.decorator_list}
        if not decorators & {"compiled", "inlined"}:
            continue
        for inner in ast.walk(node):
            if isinstance(inner, ast.Attribute) and inner.attr in ALLOCATES:
                allocating.append(name)
    assert not many and not allocating


def test_a_law_knows_no_engine():
    for path in sorted((PACKAGE / "laws").glob("*.py")):
        tree = ast.parse(path.read_text())
        names = {
            alias.name for n in ast.walk(tree) for alias in getattr(n, "names", [])
        }
        assert not names & {"mujoco", "mjcf", "native", "ctypes"}, path.name


def links(count, **changes):
    """Links in a row along x, each free in space, and their generalised forces."""
    cdof = np.zeros((6 * count, 6))
    for link in range(count):
        cdof[6 * link : 6 * link + 3, 3:] = np.eye(3)
        cdof[6 * link + 3 : 6 * link + 6, :3] = np.eye(3)
    fields = {
        "xipos": np.array([[0.01 * n, 0.0, 0.0] for n in range(count)]),
        "xmat": np.tile(np.eye(3).ravel(), (count, 1)),
        "cvel": np.zeros((count, 6)),
        "subtree_com": np.zeros((count, 3)),
        "geom_size": np.tile([8e-4, 5e-3, 0.0], (count, 1)),
        "geoms": np.arange(count),
        "body_dofadr": 6 * np.arange(count, dtype=np.int32),
        "body_dofnum": np.full(count, 6, np.int32),
        "cdof": cdof,
        "qpos": np.zeros(0),
        "qfrc_passive": np.zeros(6 * count),
        "jnt_stiffness": np.zeros(0),
        "qpos_spring": np.zeros(0),
        "hinge_joints": np.zeros(0, np.int64),
        "hinge_qpos": np.zeros(0, np.int64),
        "hinge_dofs": np.zeros(0, np.int64),
    }
    return Device(**fields | changes)


def flowing(count, velocity, **changes):
    found = blood.Blood(
        density=1060.0,
        viscosity=3.5e-3,
        peak=0.0,
        rate=1.0,
        phase=0.0,
        velocity=np.tile(velocity, (count, 1)),
        delay=np.zeros(count),
        friction=np.zeros(count),
        space_velocity=np.zeros((count, 3)),
    )
    return found._replace(**changes)


@pytest.mark.parametrize("speed", [0.01, 0.3, 1.2])
def test_drag_across_a_link_is_that_of_sucker_and_brauer(speed):
    device = links(1)
    blood.drag(flowing(1, [speed, 0.0, 0.0]), 0.0, device)
    reynolds = 1060.0 * speed * 1.6e-3 / 3.5e-3
    coefficient = 1.18 + 6.8 / reynolds**0.89 + 1.96 / math.sqrt(reynolds)
    coefficient -= 4e-4 * reynolds / (1 + 3.64e-7 * reynolds**2)
    force = 0.5 * 1060.0 * 1.6e-3 * 0.01 * coefficient * speed**2
    np.testing.assert_allclose(device.qfrc_passive[0], force, rtol=1e-12)
    assert not device.qfrc_passive[1:].any()


def test_drag_beats_with_the_heart_and_ends_with_the_viscosity():
    beats = [blood.beat(phase) for phase in np.linspace(0.0, 1.0, 1001)]
    assert max(beats) == pytest.approx(1.0, abs=1e-3) and min(beats) < 0.0
    time = 0.128 - 0.05
    given = {"peak": 2.0, "phase": 0.05, "delay": np.array([0.05])}
    one, two = links(1), links(1)
    blood.drag(flowing(1, [0.2, 0.0, 0.0], **given), time + 0.05, one)
    blood.drag(flowing(1, [0.4, 0.0, 0.0]), 0.0, two)
    assert one.qfrc_passive[0] == pytest.approx(two.qfrc_passive[0], rel=1e-3)
    none = links(1)
    blood.drag(flowing(1, [0.2, 0.0, 0.0], viscosity=0.0), 0.0, none)
    assert not none.qfrc_passive.any()


def test_drag_on_a_link_reaches_all_before_it():
    """A base that carries the links bears the sum, and its torque about the pole."""
    device = links(3)
    blood.drag(flowing(3, [0.0, 0.3, 0.0]), 0.0, device)
    alone = links(1)
    blood.drag(flowing(1, [0.0, 0.3, 0.0]), 0.0, alone)
    force = alone.qfrc_passive[1]
    np.testing.assert_allclose(device.qfrc_passive[1::6], [3 * force, 2 * force, force])
    torques = [0.03 * force, 0.03 * force, 0.02 * force]
    np.testing.assert_allclose(device.qfrc_passive[5::6], torques)


@pytest.mark.parametrize("seed", range(3))
def test_drag_on_a_link_that_moves_and_turns_has_any_direction(seed):
    """It is that of the velocity at the link across its axis, and along it."""
    random = np.random.default_rng(seed)
    place, pole, spin, speed, flow, carried = random.normal(size=(6, 3))
    axes, _ = np.linalg.qr(random.normal(size=(3, 3)))
    device = links(
        1,
        xipos=place[None],
        subtree_com=pole[None],
        xmat=axes.reshape(1, 9),
        cvel=np.concatenate([spin, speed])[None],
    )
    given = {"peak": 0.7, "rate": 1.3, "phase": 0.1, "delay": np.array([0.05])}
    given |= {"friction": np.array([0.4]), "space_velocity": carried[None]}
    own = flowing(1, flow, **given)
    blood.drag(own, 0.15, device)
    velocity = 0.7 * blood.beat(1.3 * (0.15 - 0.05) + 0.1) * flow + carried
    velocity -= speed + np.cross(spin, place - pole)
    along = (velocity @ axes[:, 2]) * axes[:, 2]
    across = velocity - along
    force = blood.cross_drag(own, np.linalg.norm(across), 8e-4, 0.01) * across
    force += 0.4 * 0.01 * along
    np.testing.assert_allclose(device.qfrc_passive[:3], force)
    np.testing.assert_allclose(device.qfrc_passive[3:], np.cross(place - pole, force))


def test_springs_are_torques_of_the_isotropic_energy():
    joints = 5
    rest, compliance = RNG.uniform(-0.2, 0.2, joints), RNG.uniform(50, 200, joints)
    angles = RNG.uniform(-0.4, 0.4, 2 * joints)
    bends = hinges.Bends(np.empty(joints, complex), np.empty(joints))

    def energy(at):
        hinges.bent(at, bends)
        return (np.abs(bends.bends - rest) ** 2 / (2 * compliance)).sum()

    device = links(1)._replace(
        qpos=angles,
        qfrc_passive=np.zeros(2 * joints),
        jnt_stiffness=np.repeat(1 / compliance, 2),
        qpos_spring=np.zeros(2 * joints),
        hinge_joints=np.arange(2 * joints),
        hinge_qpos=np.arange(2 * joints),
        hinge_dofs=np.arange(2 * joints),
    )
    free = np.empty((joints, 2))
    scratch = springs.Scratch(np.empty(2 * joints), bends, free)
    springs.shape_torques(springs.Springs(rest, compliance), device, scratch)
    # What the springs of the hinges do by themselves.
    found = device.qfrc_passive - angles * device.jnt_stiffness
    for hinge in range(2 * joints):
        step = 1e-6 * (np.arange(2 * joints) == hinge)
        slope = (energy(angles + step) - energy(angles - step)) / 2e-6
        assert found[hinge] == pytest.approx(-slope, rel=1e-5, abs=1e-9)


def test_steered_commands_are_turned_back_by_the_twist():
    angles = RNG.uniform(-0.5, 0.5, 14)
    bends = hinges.Bends(np.empty(7, complex), np.empty(7))
    turned = np.empty((1, 4))
    hinges.steered(np.array([[1.0, 0, 1, 0]]), angles[None], bends, turned)
    assert abs(bends.twists[-2]) > 1e-3
    assert np.hypot(*turned[0, :2]) == pytest.approx(1.0)
    assert math.atan2(*turned[0, 1::-1]) == pytest.approx(-bends.twists[-2])


def test_a_joint_in_the_sheath_keeps_its_relaxation_time_and_loses_its_shape():
    """Far out, at the mouth, half of its rod beyond in the sheath, and far in."""
    count = 4
    joints = sheath.Joints(
        *(np.arange(8).reshape(4, 2) for _ in range(3)),
        behind=np.full(count, 3e-3),
        ahead=np.full(count, 4e-3),
        distal=np.full(count, 0.7),
    )
    free = sheath.Hinges(*RNG.uniform(1.0, 2.0, (3, count, 2)))
    hinges, out = sheath.Hinges(*np.zeros((3, 2 * count))), np.empty(count)
    places = np.array([0.05, 0.0, -2e-3, -0.05])
    sheath.hold(joints, places, 0.0, free, hinges, out)
    np.testing.assert_allclose(out, [1.0, 0.7, 0.35, 0.0], atol=1e-12)
    kept = np.maximum(out, sheath.LEAST)[:, None]
    for found, one in zip(hinges[:2], free[:2], strict=True):
        np.testing.assert_allclose(found.reshape(-1, 2), one / kept)
    np.testing.assert_allclose(hinges.rest.reshape(-1, 2), free.rest * out[:, None])


def strained():
    """What `motion.warp` finds where space is strained, and the gradient (3, 3)."""
    there = RNG.normal(scale=0.1, size=motion.WARP)
    there[3:12] += np.eye(3).ravel()
    return there, there[3:12].reshape(3, 3)


def test_blood_and_wall_are_carried_by_space():
    there, gradient = strained()
    flow, normal = RNG.normal(size=3), np.array([0.6, 0.0, 0.8])
    found, scale = motion.carried(there, flow)
    assert scale == pytest.approx(np.linalg.det(gradient))
    np.testing.assert_allclose(found, scale * np.linalg.solve(gradient, flow))
    velocity = np.linalg.solve(gradient, there[16:19]) - there[19] * normal
    np.testing.assert_allclose(motion.wall_velocity(there, normal), velocity)


def test_a_plane_of_a_wall_that_moves_is_tangent_to_it_in_space():
    """The clearance at rest, as long as it is in space, and the growth there."""
    there, gradient = strained()
    normal, planes = np.array([0.6, 0.0, 0.8]), np.zeros((1, 4))
    planes[0] = *normal, 0.7
    motion.planes_in_space(there, planes, 1)
    stretch = np.linalg.norm(normal @ gradient)

    def clearance(way):
        value = (0.7 + normal @ gradient @ way) / stretch
        return value + there[12] + there[13:16] @ way

    slope = np.array([clearance(each) - clearance(-each) for each in np.eye(3)]) / 2
    size = np.linalg.norm(slope)
    expected = [*(slope / size), clearance(np.zeros(3)) / size]
    np.testing.assert_allclose(planes[0], expected)


def servo():
    """One servo, whose platform moves by 0.02 m/s at full command."""
    ones = np.ones(1)
    return drive.Servos(
        *(np.zeros(1, int) for _ in range(3)),
        gain=2.0 * ones,
        stiffness=100.0 * ones,
        damping=0.0 * ones,
        limit=0.5 * ones,
        reach=1e-3 * ones,
        rise=ones,
    )


def test_a_servo_holds_its_place_and_slips_at_its_limit():
    ones, way, servos = np.ones(1), np.empty((1, 1)), servo()
    state = drive.State(np.array([[0.01]]), np.zeros((1, 1)), np.array([[0.6]]))
    told = drive.Told(np.array([[0.012]]), np.zeros((1, 1)))

    def follow(command, load):
        drive.follow(servos, state, [[command]] * ones, [[load]] * ones, told, way)
        return told.place[0, 0], told.slipped[0, 0], state.act[0, 0]

    # It pulls with 0.2 N at 0.01 m: nothing slips, and that load is made up for.
    assert follow(0.0, 0.2) == pytest.approx((0.012, 0.0, (100 * 0.012 + 0.2) / 2))
    # In motion at full command it makes up for a tenth of `rise` at most.
    assert follow(1.0, 0.5) == pytest.approx((0.013, 0.0, (100 * 0.012 + 0.3) / 2))
    state.act[0, 0] = 1.0  # 1 N, 0.5 N more than the clamp holds: 5 mm of the spring
    # Of it, 0.7 N had been borne for the load, which falls to 0.5 N.
    assert follow(1.0, 0.5) == pytest.approx((0.009, 0.005, (100 * 0.008 + 0.6) / 2))
    assert way[0, 0] == pytest.approx(0.005)


@pytest.mark.parametrize(("command", "speed"), [(0.6, 0.0), (0.0, 0.6), (-0.2, -0.6)])
def test_a_platform_in_motion_makes_up_for_a_load_slowly(command, speed):
    """Whether it is told to move, or has been."""
    ones, way = np.ones((1, 1)), np.empty((1, 1))
    told = drive.Told(0.0 * ones, 0.0 * ones)
    state = drive.State(0.0 * ones, 2.0 / 100.0 * speed * ones, 0.0 * ones)
    drive.follow(servo(), state, command * ones, 0.9 * ones, told, way)
    assert 2.0 * state.act[0, 0] == pytest.approx(1.1 - 0.6)


def test_a_shared_spring_is_halved_and_a_stiff_wall_stays_rigid():
    solref = np.array([-2000.0, -20.0])
    contact = Contact(np.zeros(3), np.zeros(9), np.zeros(5), solref)
    compliance.share(contact)
    np.testing.assert_array_equal(solref, [-1000.0, -10.0])
    rigid = compliance.Law(np.array([-5e4, -400.0]), np.arange(5.0), 0.0)
    soft = compliance.Law(np.zeros(2), np.array([0.7, 0.95, 3e-3, 0.5, 4]), 8e-3)
    own = compliance.Links(np.array([1, 0]), np.full(2, 25.0), np.array([900.0, 5.0]))
    material = compliance.Material(0.45e6, math.nan, 1.0)
    solref, solimp = np.zeros((2, 2)), np.zeros((2, 5))
    radius = np.full(2, 0.012)
    compliance.write_contacts(radius, material, own, (rigid, soft), solref, solimp)
    stiffness = compliance.stiffness(0.012, material)
    np.testing.assert_array_equal(solref[0], rigid.solref)  # softer than the wall
    expected = compliance.reference(stiffness, 25.0, soft)
    np.testing.assert_allclose(solref[1], expected)
    np.testing.assert_array_equal(solimp, [rigid.solimp, soft.solimp])


def test_an_artery_has_its_thickness_and_support_weighs_by_powers():
    for radius, thickness in ((0.015, 1.5e-3), (0.004, 0.6e-3)):
        own, same = (
            compliance.stiffness(radius, compliance.Material(0.45e6, each, 1.0))
            for each in (math.nan, thickness)
        )
        assert own == pytest.approx(same)
    free, between, held = (
        compliance.stiffness(0.01, compliance.Material(0.45e6, 1e-3, support))
        for support in (0.0, 0.25, 1.0)
    )
    assert between == pytest.approx(free**0.75 * held**0.25)


def test_devices_settle_where_nothing_turns_them():
    stack = device_stack.DeviceStack(("wire_035_glide", "berenstein_5f")).stack
    tables, count = stack.tables, len(stack.spans)
    memory, chain = stack_memory.settling(tables), stack_memory.chain(tables)
    gaps = np.array([0.0, 0.02])
    sliding.coaxial.overlap(gaps, tables, memory.coaxial, chain.overlap)
    np.testing.assert_array_equal(chain.overlap.compliance, stack.overlap(gaps)[0])
    angles = np.zeros((2, count + 2))
    turns = np.empty((2, count))
    sliding.torsion.at_joints(angles, gaps, tables.nodes, turns)
    assert not turns.any()


def test_declared_parameters_have_their_shapes():
    sizes = {"links": 3, "joints": 2}
    assert shapes(springs.Springs, sizes) == {"rest": (2,), "compliance": (2,)}
    assert shapes(blood.Blood, sizes)["velocity"] == (3, 3)
    assert total(blood.Blood, sizes) == 5 + 9 + 3 + 3 + 9
    assert Array("links", 2).shape == ("links", 2)
