"""The compiled chain is the device it stands for: masses, stiffness, shape, motors."""

import dataclasses
import math

import mujoco
import numpy as np
import pytest
from dm_control import mjcf
from scipy.linalg import eigh

from cathsim_dmc.entities import devices
from cathsim_dmc.entities.arena import BLOOD_DENSITY, AngiographyArena
from cathsim_dmc.entities.armature import FREE_END, LARGEST, hinge_armatures
from cathsim_dmc.entities.catheter import Catheter
from cathsim_dmc.entities.chain import (
    CARRIAGE_MASS,
    MAX_PUSH_FORCE,
    MAX_PUSH_SPEED,
    ROTOR_INERTIA,
    TIMESTEP,
    TORSION_ARMATURE,
)
from cathsim_dmc.entities.coaxial import carried_mass
from cathsim_dmc.entities.device_stack import DeviceStack
from cathsim_dmc.laws import coaxial

STEERABLE = ("steerable_5f", "steerable_4f")
LENGTH = 0.3


def compiled(device="steerable_5f", **options):
    """Catheter and physics of a device alone in the arena, as in a task."""
    device = devices.get(device)
    discretisation = devices.Discretisation(
        working_length=options.pop("working_length", LENGTH),
        torsion_joints=options.pop("torsion_joints", 0),
        shaft_link=options.pop("shaft_link", 0.0175),
    )
    area = math.pi * device.outer_radius**2
    arena = AngiographyArena(device_density=device.linear_density / area)
    catheter = Catheter(device, discretisation, **options)
    arena.attach(catheter)
    return catheter, mjcf.Physics.from_mjcf_model(arena.mjcf_model)


@pytest.fixture(scope="module")
def published():
    return compiled()


@pytest.mark.parametrize("name", devices.DEVICES)
def test_masses_and_inertias_are_the_physical_ones(name):
    """composer's own arena raises masses below 1e-5 kg and inertias below 1e-11."""
    catheter, physics = compiled(name)
    device, model = catheter.device, physics.model.ptr
    bodies = physics.bind(catheter.links).element_id
    # The device, the blood that it displaces and the blood in its lumen.
    areas = np.pi * (device.outer_radius**2 + device.inner_radius**2)
    moved = device.linear_density + BLOOD_DENSITY * areas
    masses = moved * catheter.link_lengths
    np.testing.assert_allclose(model.body_mass[bodies], masses, rtol=1e-9)
    assert model.body_mass[bodies].sum() == pytest.approx(moved * LENGTH, rel=1e-9)
    moments = [
        coaxial._inertia(mass, device.outer_radius, length)
        for mass, length in zip(masses, catheter.link_lengths, strict=True)
    ]
    expected = [(across, across, along) for across, along in moments]
    compiled_moments = np.sort(model.body_inertia[bodies], axis=-1)[:, ::-1]
    np.testing.assert_allclose(compiled_moments, expected, rtol=1e-6)
    if name == "microcatheter_021":  # or floors would not have acted
        assert masses.min() < 1e-5 and compiled_moments.min() < 1e-11


@pytest.mark.parametrize("name", devices.DEVICES)
def test_joint_stiffness_is_that_of_the_rod(name):
    catheter, physics = compiled(name)
    device, lengths = catheter.device, catheter.link_lengths
    bends = physics.bind(catheter.bends)
    stiffness = np.asarray(bends.stiffness).reshape(-1, 2)
    assert stiffness.shape == (len(lengths) - 1, 2)
    np.testing.assert_array_equal(stiffness[:, 0], stiffness[:, 1])
    first_tip = len(lengths) - device.tip_links
    in_tip = np.arange(len(lengths)) >= first_tip
    assert lengths[in_tip].sum() == pytest.approx(device.tip_length)
    # A joint bends half a link on each side.
    bending = np.where(
        in_tip, device.tip.bending_stiffness, device.shaft.bending_stiffness
    )
    half = lengths / 2 / bending
    np.testing.assert_allclose(stiffness[:, 0], 1 / (half[1:] + half[:-1]), rtol=1e-9)
    np.testing.assert_allclose(
        np.asarray(bends.damping).reshape(-1, 2),
        max(device.relaxation_time - TIMESTEP, 0) * stiffness,
        rtol=1e-9,
    )
    assert 1e-8 < min(bends.armature) <= max(bends.armature) <= LARGEST


@pytest.mark.parametrize("shaft_link", [0.007, 0.0175, 0.03])
def test_compliance_does_not_depend_on_the_links(shaft_link):
    """The sum of l/EI over the joints is that of the rod less its outer half links."""
    catheter, physics = compiled(shaft_link=shaft_link)
    device, lengths = catheter.device, catheter.link_lengths
    stiffness = np.asarray(physics.bind(catheter.bends).stiffness)[::2]
    shaft = LENGTH - device.tip_length - lengths[0] / 2
    tip = device.tip_length - lengths[-1] / 2
    expected = (
        shaft / device.shaft.bending_stiffness + tip / device.tip.bending_stiffness
    )
    assert (1 / stiffness).sum() == pytest.approx(expected, rel=1e-9)
    assert lengths.max() <= max(shaft_link, 0.007) + 1e-12
    assert lengths.sum() == pytest.approx(LENGTH, rel=1e-12)


def test_capsules_have_the_device_s_radius_and_the_links_length(published):
    catheter, physics = published
    model = physics.model.ptr
    for index, length in enumerate(catheter.link_lengths):
        geom = model.geom(f"catheter/link_{index}")
        assert geom.type[0] == mujoco.mjtGeom.mjGEOM_CAPSULE
        assert geom.size[0] == pytest.approx(catheter.device.outer_radius)
        assert geom.size[1] == pytest.approx(length / 2)
        np.testing.assert_allclose(geom.pos, [0, 0, length / 2], atol=1e-12)
        assert geom.condim[0] == 3
        assert geom.margin[0] == 0 and geom.gap[0] == 0


def test_a_curled_device_has_no_contact(published):
    catheter, physics = published
    with physics.reset_context():
        # Rolled up to a ring that overlaps itself.
        joints = physics.bind(catheter.bends[1::2])
        joints.qpos = np.full(len(catheter.bends) // 2, 0.8)
    assert physics.data.ncon == 0
    physics.reset()


def test_straight_device_ends_at_its_origin(published):
    catheter, physics = published
    physics.reset()
    np.testing.assert_allclose(physics.bind(catheter.head).xpos, 0, atol=1e-12)
    bodies = physics.bind(catheter.links).element_id
    starts = physics.data.ptr.xpos[bodies]
    np.testing.assert_allclose(starts[:, :2], 0, atol=1e-12)
    np.testing.assert_allclose(
        -starts[:, 2], np.cumsum(catheter.link_lengths[::-1])[::-1], rtol=1e-12
    )


# Motors.


def test_actuators_are_in_the_order_of_the_action(published):
    catheter, physics = published
    np.testing.assert_allclose(catheter.link_lengths[-10:], 0.007)  # as published
    tip = [f"tip_{axis}_{joint}" for joint in range(10) for axis in "xy"]
    assert catheter.action_names == (*tip, "insertion")
    model = physics.model.ptr
    assert model.nu == 21
    compiled_names = [model.actuator(index).name for index in range(model.nu)]
    assert compiled_names == [f"catheter/{name}" for name in [*tip, "insertion"]]
    # Motor i of the tip turns the proximal joint of link i of the tip.
    first = len(catheter.link_lengths) - 10
    for index, motor in enumerate(catheter.tip_motors):
        joint = f"catheter/bend_{'xy'[index % 2]}_{first + index // 2}"
        actuator = model.actuator(f"catheter/{motor.name}")
        assert model.joint(int(actuator.trnid[0])).name == joint
    np.testing.assert_array_equal(model.actuator_ctrlrange, [[-1, 1]] * 21)
    assert model.actuator_ctrllimited.all()


def test_rotation_adds_one_action():
    catheter, physics = compiled(rotation=True, torsion_joints=4)
    assert catheter.action_names[20:] == ("insertion", "rotation")
    passive, _ = compiled("wire_035_amplatz", rotation=True)
    assert passive.action_names == ("insertion", "rotation")
    model = physics.model.ptr
    assert model.nu == 22
    joint = model.joint("catheter/rotation")
    assert model.dof_armature[joint.dofadr[0]] == ROTOR_INERTIA
    np.testing.assert_allclose(joint.axis, [0, 0, 1])


@pytest.mark.parametrize("name", STEERABLE)
def test_a_motor_bends_its_free_joint_by_the_steering_angle(name):
    catheter, physics = compiled(name)
    physics.model.opt.gravity[:] = 0
    physics.bind(catheter.tip_motors[-1]).ctrl = 1.0
    for _ in range(1500):
        physics.step()
    angles = np.asarray(physics.bind(catheter.bends).qpos)
    assert angles[-1] == pytest.approx(catheter.device.steering_angle, rel=1e-3)
    assert np.abs(angles[:-1]).max() < 1e-4


def test_carriage_moves_at_the_speed_asked_for(published):
    catheter, physics = published
    physics.reset()
    model = physics.model.ptr
    joint = model.joint("catheter/insertion")
    assert model.dof_armature[joint.dofadr[0]] == CARRIAGE_MASS
    assert joint.type[0] == mujoco.mjtJoint.mjJNT_SLIDE
    np.testing.assert_allclose(joint.range, [0, catheter.stroke])
    limits = model.actuator("catheter/insertion").forcerange
    np.testing.assert_allclose(limits, [-MAX_PUSH_FORCE, MAX_PUSH_FORCE])
    physics.bind(catheter.actuators[20]).ctrl = 1.0
    for _ in range(250):
        physics.step()
    speed = physics.bind(catheter.insertion).qvel
    assert float(np.squeeze(speed)) == pytest.approx(MAX_PUSH_SPEED, rel=0.01)
    physics.reset()


# Torsion and rest shape.


@pytest.mark.parametrize("count", [0, 1, 4, 9])
def test_torsion_hinges_add_up_to_the_rod(count):
    catheter, physics = compiled(rotation=True, torsion_joints=count)
    model, device = physics.model.ptr, catheter.device
    twists = [
        model.joint(index)
        for index in range(model.njnt)
        if "/twist_" in model.joint(index).name
    ]
    assert len(twists) == count
    if count == 0:
        return
    compliance = sum(1 / twist.stiffness[0] for twist in twists)
    first_half = catheter.link_lengths[0] / 2
    expected = (
        LENGTH - device.tip_length - first_half
    ) / device.shaft.torsional_stiffness + (
        device.tip_length / device.tip.torsional_stiffness
    )
    assert compliance == pytest.approx(expected, rel=1e-9)
    for twist in twists:
        np.testing.assert_allclose(twist.axis, [0, 0, 1])
        assert model.dof_armature[twist.dofadr[0]] == TORSION_ARMATURE


@pytest.mark.parametrize("name", ["diagnostic_5f_j", "diagnostic_5f_simmons"])
def test_rest_shape_turns_by_the_arcs(name):
    catheter, physics = compiled(name)
    addresses = physics.bind(catheter.bends).qposadr
    rest = physics.model.ptr.qpos_spring[addresses]
    np.testing.assert_array_equal(rest[::2], 0)
    turning = sum(arc.angle for arc in catheter.device.tip_shape)
    outer = catheter.link_lengths[-1] / 2  # the last half link has no joint
    lost = catheter.device.rest_angle(outer, 0.0)
    assert rest[1::2].sum() == pytest.approx(turning - lost, rel=1e-9)


def test_a_shape_has_links_that_follow_it():
    """Straight links of a few of a pigtail would bend it by millimetres elsewhere."""
    wire = devices.get("wire_035_glide")
    arc = devices.Arc(6e-3, math.radians(300))
    pigtail = dataclasses.replace(
        wire, name="pigtail", tip_length=0.04, tip_links=6, tip_shape=(arc,)
    )
    catheter = Catheter(pigtail)
    rest = np.cumsum([0.0, *(hinge.springref for hinge in catheter.bends[1::2])])
    ways = catheter.link_lengths[:, None] * np.stack([np.sin(rest), np.cos(rest)], -1)
    end = ways.sum(0) - (0.0, catheter.link_lengths.sum() - arc.length)
    exact = arc.radius * np.array([1 - math.cos(arc.angle), math.sin(arc.angle)])
    np.testing.assert_allclose(end, exact, atol=0.5e-3)
    for links, angle in ((1, 109), (3, 130), (5, 68)):
        coarse = dataclasses.replace(pigtail, tip_links=links)
        wrong = f"'pigtail' bends by {angle}°.*up to 60°; give more tip_links than "
        for chain in (Catheter, lambda one: DeviceStack((one,))):
            with pytest.raises(ValueError, match=f"{wrong}{links},"):
                chain(coarse)


@pytest.mark.parametrize(
    ("name", "value"), [("stroke", 0.0), ("friction", 2.5), ("torsion_joints", 100)]
)
def test_impossible_figures_are_refused(name, value):
    with pytest.raises(ValueError, match=f"{name} is {value}"):
        compiled(rotation=True, **{name: value})


def test_an_unknown_device_lists_the_known():
    with pytest.raises(
        ValueError, match=r"device is 'amplatz'.*steerable_5f.*lunderquist"
    ):
        devices.get("amplatz")


def test_isotropic_section_has_the_shear_modulus_of_its_material():
    section = devices.Section.isotropic(3.0, 0.5)
    # GJ = E / 2(1+ν) · 2I
    assert section.torsional_stiffness == pytest.approx(2.0)


@pytest.mark.parametrize("name", ["steerable_5f", "wire_035_glide"])
def test_axial_stiffness_is_that_of_a_solid_rod_that_bends_alike(name):
    """EI = E π r⁴ / 4 and EA = E π r²."""
    device = devices.get(name)
    square = np.pi * device.outer_radius**2
    modulus = 4 * device.shaft.bending_stiffness / (square * device.outer_radius**2)
    assert device.axial_stiffness == pytest.approx(modulus * square)


@pytest.mark.parametrize("name", devices.DEVICES)
def test_the_armature_slows_the_first_mode_of_a_free_end_as_it_says(name):
    """Of a chain of hinges that is held at 120 mm, moved by masses in blood."""
    device = devices.get(name)
    lengths = devices.Discretisation().link_lengths(device)
    nodes = np.append(np.cumsum(lengths[::-1])[::-1], 0.0)  # from the end, m
    middles = (nodes[:-1] + nodes[1:]) / 2
    tip, shaft = device.tip.bending_stiffness, device.shaft.bending_stiffness
    bent = np.minimum(middles, device.tip_length) / tip
    bent += np.maximum(middles - device.tip_length, 0.0) / shaft
    compliance, hinges = -np.diff(bent), nodes[1:-1]
    free = hinges < FREE_END
    arms = np.maximum(hinges[free] - middles[:, None], 0.0)
    masses = (device.linear_density + carried_mass([device])) * lengths
    inertia = arms.T @ (masses[:, None] * arms)
    square = eigh(np.diag(1 / compliance[free]), inertia, eigvals_only=True)[0]
    expected = np.minimum(LARGEST, 0.21 / (square * compliance))
    np.testing.assert_allclose(hinge_armatures(device, lengths), expected, rtol=0.03)
