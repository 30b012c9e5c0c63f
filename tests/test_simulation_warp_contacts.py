"""Contacts and forces of MuJoCo Warp in small arrays, against MuJoCo."""

import itertools
import types

import mujoco
import numpy as np
import pytest
import warp_arrays
from scipy.spatial.transform import Rotation

from cathsim_dmc.laws import contact
from cathsim_dmc.laws.device import Device as DeviceState
from cathsim_dmc.simulation.warp import contact_kernels as kernels
from cathsim_dmc.simulation.warp import contacts, passive
from cathsim_dmc.simulation.warp.contact_arrays import ROW
from cathsim_dmc.validation.rig import bare, tube


def placed(given):
    """Counts the contacts of all worlds, and writes them."""
    for world in range(warp_arrays.WORLDS):
        kernels.count(world, (), given)
    given.starts[:] = np.cumsum(given.counts) - given.counts
    for thread in range(len(given.found.number)):
        kernels.place(thread, (), given)
    return given


def some_rows(threads):
    """Rows of contacts with different distances, places and directions."""
    rows = np.random.RandomState(1).uniform(-1, 1, (threads, 4, ROW))
    rows[..., 4:7] /= np.linalg.norm(rows[..., 4:7], axis=-1, keepdims=True)
    rows[..., 7] = 0.0
    return rows


def test_contacts_lie_world_by_world_in_the_order_of_carriers_and_links():
    model, _ = warp_arrays.scene()
    links, fields = warp_arrays.links_of(model), warp_arrays.fields_of(model)
    # Threads are numbered (carrier · N + world) · L + link.
    number = np.array([2, 0, 1, 1, 0, 3, 0, 1, 0, 3, 1, 0, 1, 0, 0, 0, 0, 2])
    rows = some_rows(len(number))
    given = placed(warp_arrays.written(links, fields, number, rows))
    out, whose = given.out, itertools.product(range(3), range(3), range(2))
    order = [
        (world, carrier, link, one)
        for world, carrier, link in whose
        for one in range(number.reshape(3, 3, 2)[carrier, world, link])
    ]
    assert given.counts.tolist() == [4, 5, 6] and out.nacon[0] == 15
    assert not given.overflow.any()
    for at, (world, carrier, link, one) in enumerate(order):
        row = rows[(carrier * 3 + world) * 2 + link, one]
        assert out.worldid[at] == world and out.geomcollisionid[at] == one
        assert out.geom[at].tolist() == [links.geoms[link], links.carriers[carrier]]
        assert out.dist[at] == row[0]
        np.testing.assert_array_equal(out.pos[at], row[1:4])
        np.testing.assert_array_equal(out.frame[at, 0], row[4:7])
        frame = out.frame[at]
        np.testing.assert_allclose(frame @ frame.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(frame) == pytest.approx(1)
        assert (out.efc_address[at] == -1).all()
    assert (out.dist[15:] == 9.0).all()


def test_what_a_world_has_no_room_for_leaves_the_others_alone():
    model, _ = warp_arrays.scene()
    links, fields = warp_arrays.links_of(model), warp_arrays.fields_of(model)
    number = np.array([2, 1, 1, 1, 1, 0, 2, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0])
    given = warp_arrays.written(links, fields, number, some_rows(18), room=9)
    given.overflow[0] = 1
    placed(given)
    # OverflowType.NARROWPHASE, beside what else there was too much of.
    assert given.overflow.tolist() == [1 | 1 << 3, 0, 0]
    assert given.counts.tolist() == [3, 2, 1] and given.out.nacon[0] == 6
    assert given.out.worldid.tolist() == [0, 0, 0, 1, 1, 2, 9, 9, 9]
    assert given.out.geomcollisionid.tolist() == [0, 1, 0, 0, 0, 0, 9, 9, 9]


def test_parameters_of_a_contact_are_those_of_mujoco():
    model, worlds = warp_arrays.scene()
    links, number = warp_arrays.links_of(model), np.ones(18, int)
    factors = 1.0, 1.5, 0.0
    given = placed(
        warp_arrays.written(
            links, warp_arrays.fields_of(model, factors), number, some_rows(18)
        )
    )
    out, found = given.out, set()
    for world, factor in enumerate(factors):
        own = mujoco.MjModel.from_xml_string(warp_arrays.SCENE)
        own.geom_friction *= factor
        own.geom_solref *= factor
        data = mujoco.MjData(own)
        data.qpos[:] = worlds[world].qpos
        mujoco.mj_forward(own, data)
        for each in data.contact:
            carrier, link = sorted(each.geom.tolist())
            pair = (out.geom == (link, carrier)).all(axis=1) & (out.worldid == world)
            (at,) = np.flatnonzero(pair)
            found.add((world, link, carrier))
            tangent = kernels._tangent(tuple(each.frame[:3].tolist()))
            np.testing.assert_allclose(tangent, each.frame[3:6], atol=1e-12)
            assert out.dim[at] == each.dim
            for name in ("friction", "solref", "solimp"):
                value, there = getattr(each, name), getattr(out, name)[at]
                np.testing.assert_allclose(there, value, rtol=1e-12, err_msg=name)
    assert len(found) == 3 * 2 * 3


def test_displacements_of_links_are_those_of_mujoco():
    model, worlds = warp_arrays.scene()
    links, moves = warp_arrays.links_of(model), warp_arrays.motion_of(worlds)
    kind, moved = mujoco.mjtObj.mjOBJ_GEOM.value, np.zeros(6)
    for world, data in enumerate(worlds):
        for link, geom in enumerate(links.geoms.tolist()):
            mujoco.mj_objectVelocity(model, data, kind, geom, moved, 0)
            found = kernels._swept(links, moves, world, link, 0.004)
            np.testing.assert_allclose(found[0], 0.004 * moved[3:], atol=1e-12)
            np.testing.assert_allclose(found[1], 0.004 * moved[:3], atol=1e-12)


def test_a_link_is_seen_in_the_frame_of_the_wall_of_its_world():
    model, worlds = warp_arrays.scene()
    given = warp_arrays.scene_of(model, worlds)
    for thread in range(6):
        pair, (world, link) = kernels.pair_of(thread, given), divmod(thread, 2)
        data, geom, walls = worlds[world], int(given.links.geoms[link]), given.walls
        turn = walls.turns[world, 0]
        away = data.geom_xpos[geom] - walls.places[world, 0]
        local = walls.middle[world % 2] + turn.T @ away
        np.testing.assert_allclose(pair.capsule.centre, local, atol=1e-12)
        axis = data.geom_xmat[geom].reshape(3, 3)[:, 2]
        np.testing.assert_allclose(pair.axis, axis, atol=1e-12)
        np.testing.assert_allclose(pair.capsule.axis, turn.T @ axis, atol=1e-12)
        np.testing.assert_array_equal(pair.centre, data.geom_xpos[geom])
        size = given.fields.geom_size[world, geom]
        assert pair.capsule.half_length == size[1]
        assert (pair.world, pair.number) == (world, world % 2)
        assert pair.wall.line[4] == (0.5, 0.6, 0.5)[world]
        # The end cap at the joint of a link belongs to its neighbour.
        assert pair.capsule.caps == ((True, True), (False, True))[link]


def test_a_link_has_its_law_and_its_sweep_in_each_world():
    """Of a lumen; the first link is that of a compliant wall, in single precision."""
    model, worlds = warp_arrays.scene()
    given = warp_arrays.scene_of(model, worlds)
    solimp = np.repeat(given.fields.geom_solimp, 3, axis=0)
    solimp[:, given.links.geoms[0], 0] = np.float32(contact.COMPLIANT)
    solimp[2, given.links.geoms[1], 0] = 0.02
    steps = 0.004 * np.array([1.0, 2.0, 3.0])
    given = given._replace(
        walls=given.walls._replace(is_bore=np.zeros(2, bool)),
        fields=given.fields._replace(geom_solimp=solimp, timestep=steps),
    )
    kind, moved = mujoco.mjtObj.mjOBJ_GEOM.value, np.zeros(6)
    for thread in range(6):
        pair, (world, link) = kernels.pair_of(thread, given), divmod(thread, 2)
        geom, data = int(given.links.geoms[link]), worlds[world]
        impedance = contact.COMPLIANT if link == 0 else solimp[world, geom, 0]
        radius = given.fields.geom_size[world, geom, 0]
        reference = given.fields.geom_solref[world, geom, 0]
        law = contact.contact_law(pair.wall, radius, 0.0, impedance, reference)
        assert tuple(pair.law) == tuple(law) and law.compliant == (link == 0)
        mujoco.mj_objectVelocity(model, data, kind, geom, moved, 0)
        turn = given.walls.turns[world, 0]
        way = (steps[world] * turn.T @ moved.reshape(2, 3).T).T
        own = [tuple(each.tolist()) for each in way]
        sweep = contact.sweep_of(pair.capsule, law, own[1], own[0])
        np.testing.assert_allclose(pair.sweep.travel, sweep.travel, atol=1e-12)
        np.testing.assert_allclose(pair.sweep.turn, sweep.turn, atol=1e-12)
        assert pair.sweep.reach == pytest.approx(sweep.reach)


def test_two_planes_of_a_place_share_its_spring():
    """From the flag of the law to the parameters of the contacts."""
    model, worlds = warp_arrays.scene()
    scene = warp_arrays.scene_of(model, worlds)
    scene.found.number[:] = 0
    pair = kernels.pair_of(2, scene)
    rows = np.array([[1.0, 0, 0, 0.05, 0, 1], [0, 1.0, 0, 0.05, 0, 0]])
    kernels.keep(scene.found, 2, pair, rows, 2)
    given = warp_arrays.written(scene.links, scene.fields, *scene.found)
    out = placed(given).out
    np.testing.assert_allclose(out.solref[0], out.solref[1] / 2)
    np.testing.assert_array_equal(out.worldid[:3], [1, 1, 9])


def test_contacts_of_a_link_with_the_wall_of_its_world():
    """A link in each world, parallel to its bore and pressed into it."""
    model, worlds = warp_arrays.scene()
    given = warp_arrays.scene_of(model, worlds)
    samples, planes, rows = kernels.SCRATCH
    scratch = np.empty(samples), np.empty(planes), np.empty(rows)
    geom = int(given.links.geoms[0])
    for world in range(warp_arrays.WORLDS):
        turn = given.walls.turns[world, 0]
        # Parallel to the bore's axis, and 0.01 m too far to the side.
        radius, reach = given.fields.geom_size[world, geom, 0], (0.5, 0.6, 0.5)[world]
        side = (reach - radius + 0.01) * np.array([0.6, 0.8, 0])
        given.motion.geom_xpos[world, geom] = given.walls.places[world, 0] + turn @ side
        given.motion.geom_xmat[world, geom] = turn
        thread = world * 2
        kernels.find(thread, scratch, given)
        assert given.found.number[thread] >= 1
        for row in given.found.rows[thread, : given.found.number[thread]]:
            assert row[0] == pytest.approx(-0.01, abs=1e-6)
            np.testing.assert_allclose(row[4:7], turn @ [0.6, 0.8, 0], atol=1e-6)
            local = turn.T @ (row[1:4] - given.walls.places[world, 0])
            assert np.hypot(*local[:2]) == pytest.approx(reach + 0.005, abs=1e-6)
    given.motion.geom_xpos[0, geom] = np.nan
    kernels.find(0, scratch, given)
    assert given.found.number[0] == 0


def test_a_world_that_enters_an_anatomy_leaves_the_others_where_they_are():
    def model(radius, place, turn):
        spec = bare(tube(0.04, radius).lumen)
        wall = spec.worldbody.geoms[0]
        wall.conaffinity, wall.quat, wall.pos = 0, turn, place
        link = {"type": mujoco.mjtGeom.mjGEOM_CAPSULE, "size": (1e-3, 1e-2, 0)}
        spec.worldbody.add_body().add_geom(**link, contype=0)
        return spec.compile()

    known = model(4e-3, (0.0, 0.0, 0.02), (1.0, 0.0, 0.0, 0.0))
    other = model(5e-3, (0.01, 0.02, 0.05), (0.8, 0.6, 0.0, 0.0))
    device = types.SimpleNamespace(constant=lambda arrays: arrays)
    walls = contacts.WallContacts(device, known, 3)
    walls._walls = walls._made()
    walls.enter([0, 1], known, mujoco.MjData(known))
    assert walls.is_bound
    walls.enter([1], other, mujoco.MjData(other))
    assert not walls.is_bound  # its wall is not on the device yet
    made, turn = walls._made(), Rotation.from_euler("x", 2 * np.arctan2(0.6, 0.8))
    assert made.of_world[:, 0].tolist() == [0, 1, 0] and len(made.starts) == 2
    wanted = np.tile([0.0, 0.0, 0.02], (3, 1))
    wanted[1] = 0.01, 0.02, 0.05
    np.testing.assert_allclose(made.places[:, 0], wanted)
    np.testing.assert_allclose(made.turns[[0, 2], 0], [np.eye(3)] * 2)
    np.testing.assert_allclose(made.turns[1, 0], turn.as_matrix())


@pytest.mark.parametrize("shared", [True, False])
def test_a_device_of_a_world_has_the_values_of_this_world(shared):
    random = np.random.RandomState(0)
    whole = {
        name: random.rand(warp_arrays.WORLDS, 6, 3) for name in DeviceState._fields
    }
    indices = np.arange(2, 5)
    own = ("geoms", "body_dofadr", "body_dofnum")
    hinges = ("hinge_joints", "hinge_qpos", "hinge_dofs")
    whole |= {name: indices + n for n, name in enumerate((*own, *hinges))}
    fields = ("geom_size", "jnt_stiffness", "qpos_spring")
    if shared:
        whole |= {name: whole[name][:1] for name in fields}
    device = DeviceState(**whole)
    given = passive.Given((), 2, device, np.zeros(warp_arrays.WORLDS), ())
    for world in range(warp_arrays.WORLDS):
        found = passive.device_of(world, given)._asdict()
        for name in ("xipos", "xmat", "cvel", "subtree_com"):
            np.testing.assert_array_equal(found[name], whole[name][world, 2:5])
        for name in ("cdof", "qpos", "qfrc_passive"):
            np.testing.assert_array_equal(found[name], whole[name][world])
        for name in (*own, *hinges):
            np.testing.assert_array_equal(found[name], whole[name])
        for name in fields:
            value = whole[name][0 if shared else world]
            np.testing.assert_array_equal(found[name], value)
