"""The introducer sheath, straight and bent, and joints that follow a line."""

import mujoco
import numpy as np
import pytest

from cathsim_dmc.anatomy import Centreline
from cathsim_dmc.entities import devices
from cathsim_dmc.entities.posture import joints_along
from cathsim_dmc.entities.sheath import CLEARANCE, Sheath, straight
from cathsim_dmc.validation import rig

BEND = 0.04  # m
LENGTH, STROKE = 0.3, 0.15  # m


def bend(straight_length, radius=BEND, angle=np.pi / 2, points=60):
    """Straight along +z from the origin, then an arc towards +x; (n, 3), m."""
    turn = np.linspace(0, angle, points)
    arc = np.stack([radius * (1 - np.cos(turn)), 0 * turn, radius * np.sin(turn)], -1)
    return np.concatenate([[[0, 0, 0]], arc + [0, 0, straight_length]])


class Rig(rig.Rig):
    """A device whose base slides along +z from the origin, in a sheath."""

    def __init__(self, line):
        division = devices.Discretisation(working_length=LENGTH)
        super().__init__("steerable_5f", division, stroke=STROKE, friction=0.0)
        line = line - [0, 0, LENGTH]  # the end of the device lies at the origin
        self.sheath = Sheath(line, self.device.outer_radius, self.lengths.max())
        self.arena.attach(self.sheath)
        self.compile()

    @property
    def nodes(self):
        return np.vstack([self.joints, self.head_position]) + [0, 0, LENGTH]

    def drive(self, command, seconds):
        """Push force (T,) and penetration (T,) of every step."""
        self.data.actuator("catheter/insertion").ctrl[0] = command
        rows = []
        for _ in range(round(seconds / self.model.opt.timestep)):
            self.step()
            depth = max((-one.dist for one in self.data.contact), default=0.0)
            rows.append((self.data.sensor("catheter/push_force").data[2], depth))
        return np.array(rows).T


@pytest.fixture(scope="module")
def straight_rig():
    return Rig(straight(0.23) + [0, 0, 0.23])


def polyline(line):
    return Centreline(line, np.ones(len(line)))


def test_a_straight_sheath_is_one_round_bore(straight_rig):
    """Whichever way a device moves, the bore stops it at the clearance."""
    rig = straight_rig
    assert rig.sheath.bore_radius == rig.catheter.device.outer_radius + CLEARANCE
    mujoco.mj_resetData(rig.model, rig.data)
    sheath = rig.model.body("sheath/bore").id
    for angle in np.linspace(0, 2 * np.pi, 73):
        for distance in (CLEARANCE - 1e-6, CLEARANCE + 1e-6):
            # The bore moves, as the base of the device does not.
            way = distance * np.array([np.cos(angle), np.sin(angle)])
            rig.model.body_pos[sheath, :2] = way
            mujoco.mj_forward(rig.model, rig.data)
            assert (rig.data.ncon > 0) == (distance > CLEARANCE)
    rig.model.body_pos[sheath] = 0.0


def test_the_sheath_holds_a_device_that_is_pushed_aside(straight_rig):
    rig = straight_rig
    mujoco.mj_resetData(rig.model, rig.data)
    body = rig.model.body("catheter/link_6").id
    for share in np.linspace(0, 1, 11):
        rig.data.xfrc_applied[body, :2] = 0.7 * share
        rig.drive(0.0, 0.08)
    _, penetration = rig.drive(0.0, 1.0)
    inside = rig.nodes[:13]
    assert np.abs(inside[:, :2]).max() < CLEARANCE + 0.35e-3
    assert penetration.max() < 0.35e-3


def test_sheath_ends_at_the_inlet_and_reaches_over_the_chain(shared_environment):
    environment = shared_environment("type1_bca")
    task = environment.task
    model = environment.physics.model.ptr
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    body = model.body("sheath/bore").id
    np.testing.assert_allclose(
        data.xpos[body], task.scene.anatomy.inlet.position, atol=1e-9
    )
    axis = data.xmat[body].reshape(3, 3)[:, 2]
    np.testing.assert_allclose(axis, task.scene.anatomy.inlet.direction, atol=1e-9)
    base = data.xpos[model.body("catheter/link_0").id]
    behind = (task.scene.anatomy.inlet.position - base) @ axis
    assert behind == pytest.approx(task.scene.sheath.length, abs=1e-9)


# Bent.


@pytest.fixture(scope="module")
def bent_rig():
    return Rig(bend(0.2))


def beyond(line, length=0.15):
    """The line, gone on straight from its end."""
    direction = (line[-1] - line[-2]) / np.linalg.norm(line[-1] - line[-2])
    return np.concatenate([line, line[-1:] + length * direction])


def test_a_device_laid_along_a_bent_sheath_touches_nothing(bent_rig):
    mujoco.mj_resetData(bent_rig.model, bent_rig.data)
    bent_rig.bend(joints_along(bent_rig.lengths, beyond(bend(0.2))))
    assert bent_rig.data.ncon == 0
    bent_rig.bend(np.zeros((len(bent_rig.lengths) - 1, 2)))
    assert bent_rig.data.ncon > 0


def test_a_device_goes_round_a_bend_without_jam(bent_rig):
    rig = bent_rig
    mujoco.mj_resetData(rig.model, rig.data)
    rig.bend(joints_along(rig.lengths, beyond(bend(0.2))))
    rig.drive(0.0, 1.0)
    push, depth = rig.drive(1.0, 3.5)
    insertion = rig.data.joint("catheter/insertion").qpos[0]
    assert insertion > 0.9 * 0.04 * 3.5
    # Bending and unbending a damped rod takes some force; friction would add much.
    assert push.max() < 0.05 and depth.max() < 0.3e-3
    in_bend = rig.nodes[(rig.nodes[:, 2] > 0.2) & (rig.nodes[:, 0] < 0.035)]
    assert len(in_bend) >= 2
    # On the inner side of the bend the bore is a link's sagitta, 0.9 mm, wider.
    assert polyline(bend(0.2)).project(in_bend).distance.max() < 1.6e-3
    pull, depth = rig.drive(-1.0, 3.0)
    # The reversal is sudden, and swings the free end back.
    assert np.abs(pull).max() < 0.2 and depth.max() < 0.4e-3
    assert rig.data.joint("catheter/insertion").qpos[0] < 0.03
    assert not any(warning.number for warning in rig.data.warning)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        (np.zeros((1, 3)), "has 1 points; give 2 or more"),
        (np.zeros((4, 2)), r"shape \(4, 2\)"),
        ([[0, 0, 0], [0, 0, 0]], "coincide"),
        ([[0, 0, 0], [0, 0, np.nan]], "finite numbers"),
        (bend(0.1, radius=0.004), "turns by .*smooth the line"),
    ],
)
def test_lines_that_no_sheath_follows(line, message):
    with pytest.raises(ValueError, match=message):
        Sheath(np.asarray(line, float), 0.8e-3)
    with pytest.raises(ValueError, match="device_radius is 0.0.*above 0"):
        Sheath(straight(0.1), 0.0)


# Joints along a line.


@pytest.mark.parametrize("turn", [0.0, 1.0, 2.5, 4.0])
def test_nodes_of_the_chain_lie_on_an_arc(bent_rig, turn):
    """Whatever side the arc bends to, nodes lie on it within 0.3 mm."""
    spin = np.array(
        [[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1]]
    )
    line = bend(0.06, angle=4.5, points=200) @ spin.T
    line = beyond(line)
    mujoco.mj_resetData(bent_rig.model, bent_rig.data)
    bent_rig.bend(joints_along(bent_rig.lengths, line))
    nodes = bent_rig.nodes
    assert polyline(line).project(nodes).distance.max() < 0.3e-3
    on_arc = nodes[1:][np.cumsum(bent_rig.lengths) > 0.08][:8]
    centre = spin @ [BEND, 0, 0.06]
    radius = np.linalg.norm(on_arc - centre, axis=-1)
    np.testing.assert_allclose(radius, BEND, atol=0.3e-3)


def test_lines_that_no_chain_follows():
    line = straight(0.1) + [0, 0, 0.1]
    with pytest.raises(ValueError, match="ends before link 2 of 3"):
        joints_along([0.05, 0.04, 0.02], line)
    with pytest.raises(ValueError, match="link 0 points 90.00° away from .z"):
        joints_along([0.01, 0.01], line @ [[1, 0, 0], [0, 0, 1], [0, 1, 0]])
    with pytest.raises(ValueError, match="advance is 0.2 m"):
        joints_along([0.01], line, advance=0.2)
