"""What a chain is made of where devices lie in each other, as a pure function."""

import dataclasses
import itertools

import numpy as np
import pytest
from scipy.integrate import quad

from cathsim_dmc.entities import devices, stack_memory
from cathsim_dmc.entities.arena import BLOOD_DENSITY
from cathsim_dmc.entities.catheter import Catheter
from cathsim_dmc.entities.coaxial import Stack, weight_density
from cathsim_dmc.entities.torsion import rods_of
from cathsim_dmc.laws import coaxial, coaxial_forces, sliding, torsion
from cathsim_dmc.laws.coaxial import Posture
from cathsim_dmc.laws.coaxial_forces import Lumen
from cathsim_dmc.laws.torsion import STICKING

PAIR = ("wire_035_glide", "diagnostic_5f_simmons")
LENGTHS = np.concatenate([np.full(12, 0.0166), np.full(20, 0.007)])


def stack(names=PAIR, lengths=LENGTHS):
    return Stack([devices.get(name) for name in names], lengths)


@pytest.fixture(scope="module")
def pair():
    return stack()


def bending(device, place):
    """EI of a device at a distance from its end, 0 beyond it."""
    if place < 0:
        return 0.0
    section = device.tip if place < device.tip_length else device.shaft
    return section.bending_stiffness


def curvature(device, place):
    for arc in reversed(device.tip_shape):
        if 0 <= place < arc.length:
            return np.copysign(1 / arc.radius, arc.angle)
        place -= arc.length
    return 0.0


def integral(function, low, high, breaks):
    inside = sorted(b for b in breaks if low < b < high)
    ends = [low, *inside, high]
    return sum(quad(function, a, b)[0] for a, b in itertools.pairwise(ends))


@pytest.mark.parametrize(
    "gaps", [(0.0, 0.0), (0.0, 0.0234), (0.0, 0.11), (0.041, 0.0), (0.5, 0.0)]
)
def test_integrals_are_those_of_the_devices(pair, gaps):
    """Against numerical integration of EI(s) and κ(s), joint by joint."""
    overlap = pair.overlap(gaps)
    breaks = []
    for device, gap in zip(pair.devices, gaps, strict=True):
        arcs = np.cumsum([arc.length for arc in reversed(device.tip_shape)])
        breaks += [gap, gap + device.tip_length, *(gap + arcs)]

    def parts(s):
        stiff = [bending(d, s - g) for d, g in zip(pair.devices, gaps, strict=True)]
        bent = [curvature(d, s - g) for d, g in zip(pair.devices, gaps, strict=True)]
        return np.array(stiff), np.array(bent)

    for joint in range(0, len(pair.spans), 3):
        far, place, near = pair.nodes[joint : joint + 3]
        breaks = [*breaks, place]

        def weight(s, far=far, place=place, near=near):
            return (
                (s - near) / (place - near) if s < place else (far - s) / (far - place)
            )

        compliance = integral(
            lambda s: weight(s) / parts(s)[0].sum(), near, far, breaks
        )
        assert overlap.compliance[joint] == pytest.approx(compliance, rel=1e-8)
        for k in range(2):

            def bend(s, k=k):
                stiff, bent = parts(s)
                return weight(s) * stiff[k] * bent[k] / stiff.sum()

            rest = integral(bend, near, far, breaks)
            assert overlap.rest[k, joint] == pytest.approx(rest, abs=1e-9)

        def both(s):
            stiff, bent = parts(s)
            return weight(s) * np.prod(stiff) * np.prod(bent) / stiff.sum()

        coupling = integral(both, near, far, breaks)
        assert overlap.coupling[0, joint] == pytest.approx(coupling, abs=1e-12)


def test_one_device_is_the_catheter():
    """A stack of one is as stiff and as heavy as `Catheter`, and its end lies there."""
    for name in ("diagnostic_5f_simmons", "wire_035_glide", "steerable_4f"):
        catheter = Catheter(name)
        device, lengths = catheter.device, catheter.link_lengths
        alone = stack([name], lengths)
        overlap = alone.overlap([0.0])
        theirs = np.array([bend.stiffness[0] for bend in catheter.bends[::2]])
        border = len(lengths) - device.tip_links - 1
        uniform = np.abs(np.arange(len(theirs)) - border) > 1
        mine = 1 / overlap.compliance
        np.testing.assert_allclose(mine[uniform], theirs[uniform], rtol=1e-9)
        assert overlap.compliance.sum() == pytest.approx((1 / theirs).sum(), rel=1e-9)
        # Small bends move the end by their angle times their distance from it.
        moved, place = 0.0, 0.0
        for arc in reversed(device.tip_shape):
            moved += arc.angle * (place + arc.length / 2)
            place += arc.length
        assert (overlap.rest[0] * alone.nodes[1:-1]).sum() == pytest.approx(moved)
        links = alone.links(overlap, 0.037)
        np.testing.assert_allclose(
            links.mass, [geom.mass for geom in catheter.link_geoms], rtol=1e-12
        )
        assert (links.radius == device.outer_radius).all()


def test_nothing_jumps_as_one_device_slides_through_the_other(pair):
    """A tenth of the step has a tenth of the effect, wherever the ends lie."""
    rng = np.random.default_rng(0)
    found = []
    leads = rng.uniform(0.0, 0.2, 200)
    for lead, front in zip(leads, rng.integers(2, size=200), strict=True):
        turns = np.tile(rng.uniform(-3, 3, (2, 1)), len(pair.spans))
        gaps = lead * (np.arange(2) == front)
        for each in (gaps, gaps + 1e-7 * (gaps > 0)):
            overlap = pair.overlap(each)
            shape = rest_angles(overlap, turns)
            found.append((overlap.compliance, shape, *pair.links(overlap, 0.04)))
    for each in zip(*found, strict=True):
        before, after = np.array(each[::2]), np.array(each[1::2])
        # 0.1 µm of 7 mm: at most some 1e-4 of the whole range of a joint.
        assert np.abs(after - before).max() < 1e-3 * np.abs(before).max()


def test_restoring_torque_is_the_derivative_of_the_energy(pair):
    rng = np.random.default_rng(1)
    overlap = pair.overlap([0.0, 0.013])
    joints = len(pair.spans)
    bends = rng.normal(size=joints) + 1j * rng.normal(size=joints)
    turns = rng.uniform(-3, 3, (2, joints))

    def energy(turns):
        """½ ∫ Σ EI_k |κ - κ_k|² at the best κ for the bends, up to a constant."""
        rest = (overlap.rest * np.exp(1j * turns)).sum(axis=0)
        joint = np.abs(bends - rest) ** 2 / (2 * overlap.compliance)
        return joint - overlap.coupling[0] * np.cos(turns[0] - turns[1])

    torque, rate = restoring(pair, overlap, bends, turns)
    for k in range(2):
        step = np.zeros_like(turns)
        step[k] = 1e-5
        slope = (energy(turns + step) - energy(turns - step)) / 2e-5
        np.testing.assert_allclose(torque[k], -slope, atol=1e-9)
        change = (
            restoring(pair, overlap, bends, turns + step)[0][k]
            - restoring(pair, overlap, bends, turns - step)[0][k]
        ) / 2e-5
        np.testing.assert_allclose(rate[k], -change, atol=1e-9)


def test_links_have_the_outermost_devices_outside(pair):
    wire, catheter = pair.devices
    links = pair.links(pair.overlap([0.0, 0.0245]), 0.06)
    beyond = pair.nodes[:-1] <= 0.0245 + 1e-12
    assert beyond.sum() == 3 and pair.nodes[-5] == pytest.approx(0.028)
    assert (links.radius[beyond] == wire.outer_radius).all()
    np.testing.assert_allclose(links.friction[beyond], 0.02)
    np.testing.assert_allclose(links.friction[0], 0.06)
    # The fourth link from the end is half covered.
    half = (wire.outer_radius + catheter.outer_radius) / 2
    assert links.radius[-4] == pytest.approx(half)
    # A catheter that leads is alone outside, and hides the wire.
    links = pair.links(pair.overlap([0.0245, 0.0]), 0.06)
    np.testing.assert_allclose(links.radius, catheter.outer_radius)
    total = wire.linear_density * (LENGTHS.sum() - 0.0245)
    total += catheter.linear_density * LENGTHS.sum()
    # The blood that the catheter displaces, and that in its lumen beside the wire.
    section = catheter.outer_radius**2 + catheter.inner_radius**2
    blood = section * LENGTHS.sum() - wire.outer_radius**2 * (LENGTHS.sum() - 0.0245)
    total += BLOOD_DENSITY * np.pi * blood
    assert links.mass.sum() == pytest.approx(total)


@pytest.mark.parametrize("gaps", [(0.0, 0.0245), (0.0245, 0.0)])
def test_links_weigh_in_blood_what_those_devices_do_that_are_there(pair, gaps):
    weights = np.array([weight_density(device) for device in pair.devices])
    whole = pair.links(pair.overlap([0.0, 0.0]), 0.06)
    assert not whole.buoyancy.any()
    gravity = weights.sum() * LENGTHS / whole.mass  # as buoyancy reduces it for all
    overlap = pair.overlap(gaps)
    links = pair.links(overlap, 0.06)
    np.testing.assert_allclose(
        gravity * links.mass * (1 - links.buoyancy), weights @ overlap.present * LENGTHS
    )


def pressed(stack, overlap, bends, turns):
    """Pressure of devices without axial forces of the joints."""
    tables, axial, devices = stack.tables, np.zeros(turns.shape), len(turns)
    lumen = Lumen(np.zeros(devices), np.ones(devices - 1), 0.04, 1.0)
    posture, scratch = Posture(np.zeros(0), bends, turns), stack_memory.scratch(tables)
    force, drag = np.empty((devices - 1, turns.shape[1])), np.empty(devices - 1)
    coaxial_forces.pressure(
        tables, overlap, posture, axial, lumen, scratch, force, drag
    )
    return force


def rest_angles(overlap, turns):
    """Rest angles (J,) complex of the joints, rad."""
    shape = np.empty(turns.shape[1], complex)
    coaxial.rest_angles(overlap.rest, turns, shape)
    return shape


def restoring(stack, overlap, bends, turns):
    """Torque (K, J) of the shapes on each device, and its rate."""
    posture, scratch = Posture(np.zeros(0), bends, turns), stack_memory.scratch
    torque, rate = np.empty((2, *turns.shape))
    coaxial_forces.restoring(overlap, posture, scratch(stack.tables), torque, rate)
    return torque, rate


def at_joints(angles, gaps, nodes):
    """Rotations (K, J) of devices at the joints, rad."""
    turns = np.empty((len(gaps), len(nodes) - 2))
    torsion.at_joints(angles, gaps, nodes, turns)
    return turns


def energy(stack, gaps, bends, angles):
    """Of a pair at given bends and rotations of the nodes of its rods, N·m."""
    nodes, devices = stack.nodes, stack.devices
    overlap, turns = stack.overlap(gaps), at_joints(angles, gaps, nodes)
    found = np.abs(bends - rest_angles(overlap, turns)) ** 2
    found = (found / (2 * overlap.compliance)).sum()
    found -= (overlap.coupling[0] * np.cos(turns[0] - turns[1])).sum()
    # What the shapes store in each other, apart from the angle between them.
    last, first = stack.link_lengths[-1], stack.link_lengths[0]
    breaks = [last, nodes[0] - first]
    for device, gap in zip(devices, gaps, strict=True):
        arcs = np.cumsum([arc.length for arc in reversed(device.tip_shape)])
        breaks += [gap, gap + device.tip_length, *(gap + arcs)]

    def own(s):
        stiff = [bending(d, s - g) for d, g in zip(devices, gaps, strict=True)]
        bent = [curvature(d, s - g) for d, g in zip(devices, gaps, strict=True)]
        stiff, bent = np.array(stiff), np.array(bent)
        stored = (stiff * bent**2).sum() - ((stiff * bent) ** 2).sum() / stiff.sum()
        return min(s / last, (nodes[0] - s) / first, 1.0) * stored / 2

    return found + integral(own, 0.0, nodes[0], breaks)


@pytest.mark.parametrize("gaps", [(0.0, 0.031), (0.0237, 0.0), (0.06, 0.0), (0.2, 0.0)])
def test_axial_forces_are_the_derivative_of_the_energy(pair, gaps):
    rng = np.random.default_rng(7)
    gaps, joints = np.array(gaps), len(pair.spans)
    follower = int(gaps.argmax())
    bends = rng.normal(scale=0.1, size=joints) * np.exp(0.8j)
    angles = np.cumsum(rng.normal(scale=0.2, size=(2, joints + 2)), axis=-1)
    overlap, turns = pair.overlap(gaps), at_joints(angles, gaps, pair.nodes)
    slopes = (at_joints(angles, gaps + 1e-8, pair.nodes) - turns) / 1e-8
    slopes *= restoring(pair, overlap, bends, turns)[0]
    posture, scratch = Posture(gaps, bends, turns), stack_memory.scratch(pair.tables)
    force = np.empty(turns.shape)
    coaxial_forces.axial(pair.tables, overlap, posture, slopes, scratch, force)
    force = force.sum(axis=-1)
    step = 2e-5 * (np.arange(2) == follower)
    ends = [energy(pair, gaps + side * step, bends, angles) for side in (1, -1)]
    assert force[follower] == pytest.approx(-(ends[0] - ends[1]) / 4e-5, rel=1e-3)
    assert force[1 - follower] == -force[follower]


def test_devices_press_on_each_other_where_they_bend_against_each_other(pair):
    still = np.zeros((2, len(pair.spans)))
    free = pair.overlap([0.0, 0.0])
    shape = free.rest.sum(axis=0).astype(complex)
    assert pressed(pair, free, shape, still).max() > 0.1
    # A straight tube on a straight wire does not press at all.
    straight = [dataclasses.replace(d, tip_shape=()) for d in pair.devices]
    alike = Stack(straight, LENGTHS)
    free = alike.overlap([0.0, 0.0])
    assert pressed(alike, free, 0 * shape, still).max() == 0.0
    # Nor do devices of which one has been withdrawn altogether.
    apart = pair.overlap([1.0, 0.0])
    bent = apart.rest.sum(axis=0).astype(complex)
    assert pressed(pair, apart, bent, still).max() == 0.0


def plain(pair):
    """The pair without shapes and softer tips, on equal links."""
    own = [dataclasses.replace(d, tip_shape=(), tip=d.shaft) for d in pair.devices]
    return Stack(own, np.full(20, 7e-3))


def test_a_wire_rubs_in_a_bend_as_a_rope_on_a_capstan(pair):
    """In an arc a wire bears EI κ²/2 beside what pushes it past all friction."""
    alike, angle, end, coefficient = plain(pair), 0.05, 0.3, 0.2
    overlap, joints = alike.overlap([0.0, 0.0]), len(alike.spans)
    posture = Posture(
        np.zeros(2), np.full(joints, angle * np.exp(0.4j)), np.zeros((2, joints))
    )
    lumen = Lumen(np.array([end, 0.0]), np.ones(1), coefficient, 1.0)
    force, drag = np.empty((1, joints)), np.empty(1)
    coaxial_forces.pressure(
        alike.tables, overlap, posture, np.zeros((2, joints)), lumen,
        stack_memory.scratch(alike.tables), force, drag,
    )  # fmt: skip
    stiffness = alike.devices[0].shaft.bending_stiffness
    borne = end + stiffness * (angle / 7e-3) ** 2 / 2
    grown = (1 + coefficient * angle) ** np.arange(joints + 1.0)
    np.testing.assert_allclose(force[0, ::-1], borne * grown[:-1] * angle)
    np.testing.assert_allclose(drag, borne * (grown[-1] - 1))


def test_the_wall_rubs_on_the_joints_as_on_the_links_around_them():
    """Those at the base bear half of the first link; the sheath bears the rest."""
    rng = np.random.default_rng(3)
    outermost, force = rng.uniform(size=(2, 6)), rng.uniform(size=6)
    arms, torque = np.array([0.4e-3, 0.8e-3]), np.empty((2, 5))
    coaxial_forces.wall_friction(arms, outermost, force, 0.3, torque)
    borne = outermost * force
    borne[:, 0] /= 2
    np.testing.assert_allclose(torque.sum(axis=1), 0.3 * arms * borne.sum(axis=1))


def test_the_lumen_holds_back_a_wire_that_turns_by_the_radius_of_the_wire(pair):
    """Turned on and on in an arc, it twists until its base bears all friction."""
    alike, coefficient = plain(pair), 0.2
    tables, rods = alike.tables, rods_of(alike.devices, alike.nodes)
    devices = sliding.Devices(
        tables, rods, alike.arms, alike.sections, coefficient, 0.04, torque=1.0
    )
    count = len(alike.spans)
    loads = sliding.Loads(
        np.array([0.5, 0.0]), np.zeros(count + 1), 0.0, 0.0, stiffness=1.0, loss=1.0
    )
    hinges = np.zeros((count, 2))
    hinges[np.arange(count), 1 - np.arange(count) % 2] = 0.05  # about y
    state = sliding.State(
        np.zeros(2), hinges.ravel(), np.zeros((2, count + 2)), np.zeros(1),
        np.zeros(1), np.zeros(2), np.zeros((2, count)),
    )  # fmt: skip
    memory, chain = stack_memory.settling(tables), stack_memory.chain(tables)
    for _ in range(40):
        sliding.settle(devices, loads, state, memory, chain)
    borne = rods.stiffness[0, 0] * (state.angles[0, 0] - state.angles[0, 1])
    held = coefficient * alike.devices[0].outer_radius * memory.pressure.sum()
    assert borne == pytest.approx(held, rel=1e-3) and held > 0.0
    assert state.angles[0, -1] > 1.0 and not state.angles[1].any()


def test_devices_that_do_not_fit_are_refused():
    with pytest.raises(ValueError, match=r"wire_035_glide.*0.889 mm.*0.533 mm"):
        stack(["wire_035_glide", "microcatheter_021"])
    with pytest.raises(ValueError, match="is solid"):
        stack(["wire_014_micro", "wire_035_glide"])
    with pytest.raises(ValueError, match="no device"):
        stack([])
    assert stack(["wire_014_micro", "microcatheter_021", "berenstein_5f"]).devices


# Twist.


@pytest.fixture
def rod():
    return rods_of([devices.get("berenstein_5f")], stack(("berenstein_5f",)).nodes)


def wound(rod, angles, base, duration, friction=0.0, brake=0.0):
    """Rotations after one more of the base, with friction or a brake at the end."""
    loads = np.zeros((3, 1, len(LENGTHS)))
    loads[2, 0, -1] = friction
    loads[0, 0, -1] = -brake
    scratch, new = stack_memory.rod_scratch(len(LENGTHS)), np.empty_like(angles)
    torsion.turned(angles, np.array([base]), rod, duration, loads, scratch, new)
    return new


def test_a_load_at_the_end_winds_the_device_by_its_compliance(rod):
    """After the relaxation time of the material, as `validate rod` demands."""
    stiffness = 1 / (1 / rod.stiffness[0]).sum()
    device = devices.get("berenstein_5f")
    expected = device.tip_length / device.tip.torsional_stiffness
    expected += (LENGTHS.sum() - device.tip_length) / device.shaft.torsional_stiffness
    assert stiffness == pytest.approx(1 / expected, rel=1e-12)
    rod, step = rod._replace(times=np.array([0.4])), 0.004
    angles, lag = np.zeros((1, len(LENGTHS) + 1)), []
    for _ in range(1500):
        angles = wound(rod, angles, 3.14 * step, step, brake=0.35 * stiffness)
        lag.append(angles[0, 0] - angles[0, -1])
    assert lag[-1] == pytest.approx(0.35, rel=1e-3)
    reached = step * (1 + np.argmax(np.array(lag) >= (1 - np.exp(-1)) * lag[-1]))
    assert reached == pytest.approx(0.4, abs=2 * step)


@pytest.mark.parametrize("gaps", [(0.0, 0.0237), (0.05, 0.0)])
def test_nodes_bear_the_loads_of_the_joints(pair, gaps):
    """They do the same work at any rotation of the nodes, the bases held."""
    rng = np.random.default_rng(5)
    joints, gaps = len(pair.spans), np.array(gaps)
    angles, loads = rng.normal(size=(2, joints + 2)), rng.normal(size=(3, 2, joints))
    angles[:, 0] = 0.0
    borne = np.empty((3, 2, joints + 1))
    torsion.at_nodes(loads, gaps, pair.nodes, borne)
    work = (loads * at_joints(angles, gaps, pair.nodes)).sum(axis=(1, 2))
    np.testing.assert_allclose((borne * angles[:, 1:]).sum(axis=(1, 2)), work)


def test_friction_winds_the_device_up_until_it_gives(rod):
    """The end stays, but for a creep, until its twist bears the friction."""
    friction = 0.5 / (1 / rod.stiffness[0]).sum()  # half a radian of twist
    angles = np.zeros((1, len(LENGTHS) + 1))
    base, tip = [], []
    for _ in range(200):
        angles = wound(rod, angles, 0.02, 0.04, friction)
        base.append(angles[0, 0])
        tip.append(angles[0, -1])
    stuck = np.array(base) < 0.2
    assert np.max(np.array(tip)[stuck]) <= STICKING * 0.04 * stuck.sum()
    assert base[-1] - tip[-1] == pytest.approx(0.5, rel=0.02)
    # Released, it keeps what friction holds.
    for _ in range(200):
        angles = wound(rod, angles, 0.0, 0.04, friction)
    assert 0.3 < base[-1] - angles[0, -1] < 0.5
