"""Contact with a field through MuJoCo's collision table."""

import copy
import subprocess
import sys

import mujoco
import numpy as np
import pytest
from mujoco.batch import Batch

from cathsim_dmc.anatomy.centreline import Centreline, Vessel, VesselTree
from cathsim_dmc.anatomy.field import Field
from cathsim_dmc.anatomy.parts import End
from cathsim_dmc.collision import fields
from cathsim_dmc.compiled import interpreted
from cathsim_dmc.entities.contact import CONTACT_SOLIMP
from cathsim_dmc.laws import contact, motion, moving_contact, places, planes, wall

RADIUS, DEVICE, HALF = 5e-3, 0.8e-3, 3.5e-3


def tree_along(points, radius=RADIUS):
    line = Centreline(points, np.full(len(points), radius))
    return VesselTree({"root": Vessel("root", line)})


@pytest.fixture(scope="module")
def tube():
    """Along z from 0, where it is open, to 60 mm."""
    tree = tree_along(np.linspace((0, 0, 0), (0, 0, 60e-3), 61))
    return Field.of(
        tree, [End("root", np.zeros(3), np.array([0, 0, -1.0]), RADIUS, True)]
    )


def numbers(values):
    return " ".join(repr(float(value)) for value in np.ravel(values))


def carrier(field, name="wall", more=""):
    made = {k: np.ravel(v).tolist() for k, v in fields.carrier(field).items()}
    values = " ".join(f'{key}="{" ".join(map(str, v))}"' for key, v in made.items())
    return f'<geom name="{name}" {values} {more}/>'


def capsule(place, inner="", euler="0 0 0", size=(DEVICE, HALF), more=""):
    return (
        f'<body pos="{numbers(place)}" euler="{euler}"><freejoint/>'
        f'<geom type="capsule" size="{numbers(size)}" mass="1e-3" '
        f'contype="0" conaffinity="1" solref="0.008 1" {more}/>{inner}</body>'
    )


def compiled(body, option='gravity="0 0 0"', visual=""):
    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><option {option} timestep="0.004"/>'
        f"<worldbody>{body}{visual}</worldbody></mujoco>"
    )
    return model, mujoco.MjData(model)


def contacts_of(body):
    model, data = compiled(body)
    mujoco.mj_forward(model, data)
    return data.contact


def test_a_capsule_in_a_straight_tube_overlaps_by_what_it_does(tube):
    overlap, axis = 0.2e-3, RADIUS - DEVICE + 0.2e-3
    angles = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    spokes = np.stack([np.cos(angles), np.sin(angles), 0 * angles], axis=-1)
    body = carrier(tube)
    for number, spoke in enumerate(spokes):
        body += capsule(axis * spoke + (0, 0, 20e-3 + number * 1e-3))
    found = contacts_of(body)
    assert len(found.dist) == 4 * len(spokes)  # two planes at both ends of each
    np.testing.assert_allclose(found.dist, -overlap, atol=0.01e-3)
    place = RADIUS + overlap / 2
    for n, spoke in enumerate(np.repeat(spokes, 4, axis=0)):
        assert found.frame[n, :3] @ spoke > 0.99
        np.testing.assert_allclose(found.pos[n] @ spoke, place, atol=0.02e-3)
    pairs = found.frame[:, :3].reshape(-1, 2, 3).mean(axis=1)
    np.testing.assert_allclose(
        np.vecdot(pairs, np.repeat(spokes, 2, axis=0)), 1, atol=0.01
    )


@pytest.mark.parametrize(
    ("overlap", "planes"), [(0.02e-3, 1), (0.05e-3, 2), (0.2e-3, 2)]
)
def test_a_capsule_in_a_bend_touches_once_inside_and_twice_outside(overlap, planes):
    angle = np.linspace(0, np.pi / 2, 61)
    circle = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=-1)
    field = Field.of(tree_along(30e-3 * circle))
    middle = np.array([np.cos(np.pi / 4), np.sin(np.pi / 4), 0])
    along = "90 45 0"  # the capsule lies along the bend there
    inside, outside = 25e-3 + DEVICE - overlap, 35e-3 - DEVICE + overlap
    for reach, count in ((inside, 1), (outside, 2)):
        law = f'solimp="{numbers(CONTACT_SOLIMP)}"'
        link = capsule(reach * middle, euler=along, more=law)
        found = contacts_of(carrier(field) + link)
        # Outside the ends are deep in both cases.
        assert len(found.dist) == (planes if count == 1 else 2 * count)
        if count == 1:
            np.testing.assert_allclose(found.dist, -overlap, atol=0.01e-3)
        else:
            # Its ends stand further out than its middle.
            more = np.hypot(reach, HALF) - reach
            np.testing.assert_allclose(found.dist, -overlap - more, atol=0.015e-3)


def test_a_capsule_across_an_ostium_touches_its_edge():
    root = tree_along(np.linspace((0, 0, -20e-3), (0, 0, 20e-3), 41)).root
    side = tree_along(np.linspace((0, 0, 0), (20e-3, 0, 0), 21), 3e-3).root
    branch = Vessel("branch", side.centreline, "root", RADIUS)
    field = Field.of(VesselTree({"root": root, "branch": branch}))
    # Along z before the ostium: it rests on the two rims, at z = +-3 mm.
    place = (RADIUS - DEVICE + 0.1e-3, 0, 0)
    found = contacts_of(carrier(field) + capsule(place, size=(DEVICE, 8e-3)))
    assert len(found.dist) == 4
    across = contacts_of(carrier(field) + capsule(place, size=(DEVICE, 2e-3)))
    assert len(across.dist) == 0


def test_behind_the_open_end_nothing_touches(tube):
    outside = (RADIUS - DEVICE + 0.2e-3, 0, -10e-3)
    assert len(contacts_of(carrier(tube) + capsule(outside)).dist) == 0
    # One that reaches in touches the part of the wall that it reaches.
    half_in = contacts_of(carrier(tube) + capsule((*outside[:2], 1e-3)))
    assert len(half_in.dist) and (half_in.pos[:, 2] > 0).all()


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e300])
def test_a_place_that_is_no_number_touches_nothing(tube, value):
    model, data = compiled(carrier(tube) + capsule((0, 0, 30e-3)))
    for index in range(model.nq):
        mujoco.mj_resetData(model, data)
        data.qpos[index] = value
        mujoco.mj_kinematics(model, data)
        mujoco.mj_collision(model, data)
        assert data.ncon == 0


def chain(place):
    """Two links whose joint is at the origin of the second."""
    second = (
        '<body pos="0 0 7e-3"><joint axis="1 0 0" stiffness="1e-4" damping="1e-5"/>'
        f'<geom type="capsule" fromto="0 0 0 0 0 7e-3" size="{DEVICE}" mass="1e-3" '
        'contype="0" conaffinity="1"/></body>'
    )
    return (
        f'<body pos="{numbers(place)}"><freejoint/><geom type="capsule" '
        f'fromto="0 0 0 0 0 7e-3" size="{DEVICE}" mass="1e-3" contype="0" '
        f'conaffinity="1"/>{second}</body>'
    )


def test_an_edge_of_the_wall_is_never_lost_between_two_links():
    """A chain slides over it: at places before, at and behind the joint at 7 mm."""

    def wedge(blocks, points):
        apart = -(blocks[:, None, :] + points)[..., [0, 2]]
        outside = np.linalg.norm(np.maximum(apart, 0.0), axis=-1)
        return outside + np.minimum(apart.max(axis=-1), 0.0)

    corner = Field.sampled(wedge, np.full(3, -0.03), np.full(3, 0.03))
    turned = chain((0, 0, 0)).replace("<body", '<body euler="0 -45 0"', 1)
    model, data = compiled(carrier(corner) + turned)
    along, away = np.array([-1, 0, 1]) / 2**0.5, np.array([-1, 0, -1]) / 2**0.5
    depth = []
    for way in np.arange(1.5e-3, 12.5e-3, 0.05e-3):
        data.qpos[:3] = (DEVICE - 0.1e-3) * away - way * along
        mujoco.mj_forward(model, data)
        depth.append(-data.contact.dist.min(initial=1.0))
    assert 0.0 < min(depth) and np.ptp(depth) < 0.06e-3


def test_a_joint_is_touched_once(tube):
    """The proximal end of a link is left to the link before it."""
    place = (RADIUS - DEVICE + 0.1e-3, 0, 20e-3)
    found = contacts_of(carrier(tube) + chain(place))
    # The free body's own end, the joint and the distal end.
    np.testing.assert_allclose(
        np.sort(found.pos[:, 2])[::2], [20e-3, 27e-3, 34e-3], atol=1e-4
    )


def test_a_bore_is_exact_and_frictionless():
    bore = fields.Bore(np.array([(0, 0, -50e-3), (0, 0, 0)]), 1.2e-3)
    inside = (0.5e-3, 0, -20e-3)
    body = carrier(bore, more='condim="1" priority="1"') + capsule(inside)
    found = contacts_of(body)
    np.testing.assert_allclose(found.dist, -0.1e-3, atol=1e-9)
    assert (found.dim == 1).all()
    past = contacts_of(carrier(bore) + capsule((0.5e-3, 0, 10e-3)))
    assert len(past.dist) == 0


# Impedance that does not change with the depth: the contact is a spring.
IMPEDANCE = 0.95
SPRING = f'priority="1" solimp="{IMPEDANCE} {IMPEDANCE} 1e-3 0.5 2" friction="0 0 0"'


def spring(model, geom, stiffness, relaxation=0.02):
    """`solref` of a contact with a stiffness, N/m, and a relaxation time, s."""
    weight = model.body_invweight0[model.geom_bodyid[geom], 0]
    scaled = stiffness * (1 - IMPEDANCE) * weight
    return -scaled, -relaxation * scaled


@pytest.mark.parametrize("load", [0.02, 0.1, 0.5])
def test_force_over_depth_is_the_stiffness_asked_for(tube, load):
    """Whatever the mass of the link: N/m link by link."""
    stiffness = 2000.0
    for mass in (1e-4, 1e-3):
        body = f"""<body pos="{RADIUS - DEVICE} 0 30e-3">
            <joint type="slide" axis="1 0 0"/><geom name="ball" type="sphere"
            size="{DEVICE}" mass="{mass}" contype="0" conaffinity="1"
            {SPRING}/></body>"""
        model, data = compiled(
            carrier(tube) + body,
            'gravity="0 0 0" integrator="discrete" cone="elliptic"',
        )
        ball = model.geom("ball").id
        model.geom_solref[ball] = spring(model, ball, stiffness)
        data.qfrc_applied[0] = load
        for _ in range(400):
            mujoco.mj_step(model, data)
        assert data.ncon == 1
        assert -data.contact.dist[0] == pytest.approx(load / stiffness, rel=0.01)
        assert abs(data.qvel[0]) < 1e-6


def test_a_light_link_pressed_into_a_hollow_comes_to_rest(tube):
    """The normal turns with the link; one plane would throw it to and fro."""
    body = f"""<body pos="{RADIUS - DEVICE} 0 30e-3"><joint type="slide" axis="1 0 0"/>
        <joint name="side" type="slide" axis="0 1 0"/><geom name="link" type="capsule"
        size="{DEVICE} {HALF}" mass="1e-4" contype="0" conaffinity="1"
        {SPRING}/></body>"""
    model, data = compiled(
        carrier(tube) + body, 'gravity="0 0 0" integrator="discrete" cone="elliptic"'
    )
    link = model.geom("link").id
    model.geom_solref[link] = spring(model, link, 1000.0)
    data.qfrc_applied[0], data.qpos[1] = 0.5, 0.1e-3
    speeds = []
    for _ in range(300):
        mujoco.mj_step(model, data)
        speeds.append(np.abs(data.qvel).max())
    assert max(speeds[-50:]) < 1e-3


def test_a_link_that_hangs_over_a_ledge_touches_its_edge():
    """It lies flat on the wall from its joint on, a few micrometres deeper there."""

    def ledge(blocks, points):
        apart = (blocks[:, None, :] + points)[..., [0, 2]]
        outside = np.linalg.norm(np.maximum(apart, 0.0), axis=-1)
        return outside + np.minimum(apart.max(axis=-1), 0.0)

    field = Field.sampled(ledge, np.full(3, -0.02), np.full(3, 0.02))
    lying = chain((-11e-3, 0, DEVICE - 0.04e-3 + 10e-6))
    lying = lying.replace("<body", '<body euler="0 90.05 0"', 1)
    found = contacts_of(carrier(field) + lying)
    assert found.pos[:, 0].max() == pytest.approx(0.0, abs=1e-3)


def test_an_end_in_a_dead_end_is_held_by_its_bottom_and_by_its_sides():
    width = DEVICE + 0.01e-3

    def pocket(blocks, points):
        places = blocks[:, None, :] + points
        apart = np.stack([np.abs(places[..., 0]) - width, -places[..., 2]], axis=-1)
        outside = np.linalg.norm(np.maximum(apart, 0.0), axis=-1)
        return -(outside + np.minimum(apart.max(axis=-1), 0.0))

    field = Field.sampled(pocket, np.full(3, -0.02), np.full(3, 0.02))
    end = (0, 0, HALF + DEVICE - 0.07e-3)
    found = contacts_of(carrier(field) + capsule(end))
    assert -0.12e-3 < found.dist.min() < -0.05e-3
    assert found.frame[:, 2].min() < -0.9
    assert found.frame[:, 0].min() < -0.5 and found.frame[:, 0].max() > 0.5


def test_an_impact_is_met_a_physics_step_ahead(tube):
    """At 0.4 m/s, 1.6 mm in a step of 4 ms, it came to lie 0.6 mm deep."""
    model, data = compiled(carrier(tube) + capsule((0, 0, 30e-3)))
    data.qpos[0], data.qvel[0] = RADIUS - DEVICE - 1e-3, 0.4
    depth = []
    for _ in range(10):
        mujoco.mj_step(model, data)
        depth.append(-data.contact.dist.min(initial=0.0))
    assert max(depth) < 0.2e-3


@pytest.mark.parametrize("lever", [0.0, 20e-3])
def test_an_end_that_swings_at_the_wall_is_met_a_physics_step_ahead(tube, lever):
    """It turns about its own middle, or about a body that it is an arm of."""
    arm = f'<geom type="capsule" pos="0 0 {lever}" size="{DEVICE} {HALF}" mass="1e-3" '
    arm += 'contype="0" conaffinity="1" solref="0.008 1"/>'
    hub = '<geom size="1e-3" mass="2e-3" contype="0" conaffinity="0"/>'
    body = f'<body><freejoint/>{hub}<body pos="0 0 0">{arm}</body></body>'
    model, data = compiled(carrier(tube) + body)
    data.qpos[:3] = RADIUS - DEVICE - 0.8e-3, 0.0, 20e-3
    data.qvel[4] = 0.4 / (lever + HALF)
    depth = []
    for _ in range(8):
        mujoco.mj_step(model, data)
        depth.append(-data.contact.dist.min(initial=0.0))
    assert max(depth) < 0.4e-3  # more than 1.2 mm if its turn is left out


def test_strain_along_a_tube_changes_nothing_where_a_link_touches_it(tube):
    """The end of a link that leans on the wall, whatever its length is at rest."""
    still, lean = (0.0, 0.0, 0.0), 0.05
    axis = (np.sin(lean), 0.0, np.cos(lean))
    centre = (RADIUS - DEVICE - HALF * axis[0] + 0.03e-3, 0.0, 30e-3)
    capsule = places.Capsule(centre, axis, HALF, (True, True))
    walls = wall.Wall(False, tube.arrays, np.zeros(1))
    law = contact.contact_law(walls, DEVICE, 0.0, CONTACT_SOLIMP[0], 0.008)
    sweep = contact.sweep_of(capsule, law, still, still)
    found = np.zeros((2, planes.MOST, contact.CONTACT))
    samples, rows = np.empty(65), np.empty((planes.PLANES, 4))
    scratch = contact.Scratch(samples, rows)
    # Compilation for one capsule would take 5 s.
    contacts = interpreted(contact.contacts)
    moving_contacts = interpreted(moving_contact.moving_contacts)
    count = contacts(walls, capsule, law, sweep, scratch, found[0])
    values = np.zeros((2, 2, 2, motion.VALUES))
    values[..., 2] = 0.05 * np.array([-0.1, 0.1])  # of the way along z
    lattice = np.concatenate([[-0.1] * 3, [0.2], [2.0] * 3, values.ravel()])
    course = motion.Course(1.0, *[0.0] * 8)
    moved = moving_contact.MovingScratch(
        samples, rows, np.empty((motion.VALUES, 4)), np.empty(motion.WARP)
    )
    assert count == moving_contacts(
        walls, capsule, law, sweep, (lattice, course), moved, found[1]
    )
    assert count > 0 and found[0, 0, 4] == pytest.approx(HALF)
    np.testing.assert_allclose(found[1], found[0], rtol=1e-6, atol=1e-7)


def rolling(field):
    """A small scene that moves: capsules that fall in the tube."""
    bodies = "".join(
        capsule(((n - 2) * 1e-3, 0, 10e-3 + 9e-3 * n), euler=f"{10 * n} 20 0")
        for n in range(5)
    )
    return compiled(carrier(field) + bodies, 'gravity="0 -9.81 1"')


def test_batch_and_composer_step_alike_on_any_number_of_threads(tube):
    model, data = rolling(tube)
    for _ in range(60):
        mujoco.mj_step(model, data)
    assert data.ncon > 2
    for threads in (1, 2, 8):
        batch = Batch(model, 8, threads)
        batch.step(nstep=60)
        assert (np.asarray(batch.qpos) == data.qpos).all()


def test_copies_and_models_of_a_batch_keep_their_fields(tube):
    other = Field.of(tree_along(np.linspace((0, 0, 0), (0, 0, 60e-3), 61), 4e-3))
    model, _ = rolling(tube)
    narrow = copy.copy(model)
    narrow.geom_user[model.geom("wall").id] = fields.register(other)
    alone = []
    for each in (model, narrow):
        data = mujoco.MjData(each)
        for _ in range(30):
            mujoco.mj_step(each, data)
        alone.append(data.qpos.copy())
    assert not np.array_equal(*alone)
    batch = Batch(model, 4, 2)
    batch.set_models([model, narrow, model, narrow])
    batch.step(nstep=30)
    for row, expected in zip(np.asarray(batch.qpos), alone * 2, strict=True):
        assert (row == expected).all()


OTHER = """
import mujoco, numpy as np, sys
{first}
model = mujoco.MjModel.from_xml_string('''<mujoco><worldbody>
  <geom type="box" size="1 1 .1"/><geom type="box" size=".1 1 1" pos="1 0 0"/>
  <body pos=".2 0 .5" euler="20 60 0"><freejoint/>
  <geom type="capsule" size=".05 .3"/><geom type="sphere" size=".1" pos="0 .2 0"/>
  <geom type="box" size=".1 .1 .1" pos="0 -.3 0"/></body></worldbody></mujoco>''')
data = mujoco.MjData(model)
for _ in range(1500): mujoco.mj_step(model, data)
assert data.ncon
print(data.qpos.tobytes().hex(), data.qacc.tobytes().hex())
"""


def test_other_models_are_untouched_bit_for_bit():
    """In a process that has a field, and in one that has none."""
    register = (
        "from cathsim_dmc.collision import fields\n"
        "fields.register(fields.Bore(np.array([(0, 0, 0), (0, 0, 1)]), 0.1))\n"
    )
    answers = [
        subprocess.run(
            [sys.executable, "-c", OTHER.format(first=first)],
            capture_output=True,
            text=True,
            check=True,
        ).stdout
        for first in ("", register)
    ]
    assert answers[0] == answers[1]


def test_a_model_without_its_field_does_not_run(tube):
    model, data = rolling(tube)
    model.geom_user[model.geom("wall").id, 1] += 1
    with pytest.raises(mujoco.FatalError, match="carries a field that is not"):
        mujoco.mj_step(model, data)


def test_a_saved_model_finds_its_field_again(tube, tmp_path):
    model, _ = rolling(tube)
    path = tmp_path / "saved.xml"
    mujoco.mj_saveLastXML(str(path), model)
    again = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(again)
    for _ in range(60):
        mujoco.mj_step(again, data)
    # Elsewhere the carrier is a solid box, which throws the device out.
    again.geom_user[:] = 0
    elsewhere = mujoco.MjData(again)
    mujoco.mj_step(again, elsewhere)
    assert data.contact.dist.min() > -1e-3
    assert elsewhere.contact.dist.min() < -3e-3


def test_a_bore_without_width_is_refused():
    with pytest.raises(ValueError, match="radii 0 m"):
        fields.Bore(np.array([(0, 0, 0), (0, 0, 1)]), 0.0)


@pytest.mark.parametrize(
    ("points", "radii", "words"),
    [
        ([], 1e-3, "points of a bore"),
        ([(0, 0, 0)], 1e-3, "points of a bore is .* two or more"),
        ([(0, 0), (0, 1)], 1e-3, "points of a bore .* shape"),
        ([(0, 0, 0), (0, 0, np.nan)], 1e-3, "points of a bore"),
        ([(0, 0, 0), (0, 0, 1)], [1e-3] * 3, "radii of a bore .* a number, or 2"),
        ([(0, 0, 0), (0, 0, 1)], "x", "radii of a bore"),
        ([(0, 0, 0), (0, 0, 1)], np.inf, "radii of a bore"),
    ],
)
def test_so_is_what_makes_no_bore(points, radii, words):
    with pytest.raises(ValueError, match=words):
        fields.Bore(points, radii)


_TOGETHER = """
import threading
import numpy as np
from cathsim_dmc.collision import fields

barrier, keys = threading.Barrier(8), []

def register(number):
    bore = fields.Bore(np.array([[0, 0, 0], [0, 0, 0.1 + 0.01 * number]]), 2e-3)
    barrier.wait()
    keys.append(fields.register(bore))

threads = [threading.Thread(target=register, args=(n,)) for n in range(8)]
for thread in threads:
    thread.start()
for thread in threads:
    thread.join()
assert len(set(keys)) == 8
for key in keys:  # whose arrays somebody owns
    assert fields.registered(key)[0]
"""


def test_threads_that_register_first_at_once_share_one_table():
    done = subprocess.run(
        [sys.executable, "-c", _TOGETHER], capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stderr


def test_a_wall_moves_if_an_interrupt_ended_the_first_compilation(tube, monkeypatch):
    lattice = np.r_[np.zeros(3), 0.1, 2, 2, 2, np.full(64, 2e-3)]
    collide_by, modules = fields._Table._collide_by, []

    def interrupted(self, module):
        modules.append(module)
        if len(modules) == 1:
            raise KeyboardInterrupt
        collide_by(self, module)

    monkeypatch.setattr(fields._Table, "_collide_by", interrupted)
    with pytest.raises(KeyboardInterrupt):
        fields.register(tube, lattice)
    user = fields.register(tube, lattice)
    assert len(modules) == 2
    np.testing.assert_array_equal(fields.registered(user).lattice, lattice)


def test_equal_walls_that_move_otherwise_have_entries_of_their_own(tube):
    lattices = [np.r_[np.zeros(3), 0.1, 2, 2, 2, np.full(64, v)] for v in (0.0, 1e-3)]
    users = [fields.carrier(tube, lattice)["user"] for lattice in lattices]
    again = fields.carrier(tube, lattices[0].copy())["user"]
    assert len({fields.register(tube), *users}) == 3
    assert again == users[0]
    table = fields._get_table()
    for user, lattice in zip(users, lattices, strict=True):
        key = fields._key([int(part) for part in user[1:]])
        row = table._rows[np.flatnonzero(table._rows[:, 0] == key)[0]]
        held = table._lattices[key]
        assert row[table._motion] == held.ctypes.data
        np.testing.assert_array_equal(held, lattice)
