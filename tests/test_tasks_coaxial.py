"""Coaxial devices in a task: how they move, what is written, both paths alike."""

import numpy as np
import pytest

from cathsim_dmc import suite
from cathsim_dmc.entities import stack_memory
from cathsim_dmc.entities.arena import BLOOD_DENSITY
from cathsim_dmc.laws import sliding as laws
from cathsim_dmc.physics import sliding
from cathsim_dmc.physics.blood import StillBlood
from cathsim_dmc.physics.effects import userdata_size
from cathsim_dmc.tasks.config import CONTROL_TIMESTEP, NavigationConfig

TASK = "simple1_lcca_pair"
STEP = 0.04 * CONTROL_TIMESTEP  # m, of a device at full speed in a control step


@pytest.fixture(scope="module")
def environment():
    env = suite.load("cathsim", TASK, {"random": 3, "observation": ["internal"]})
    yield env
    env.close()


def run(environment, action, steps):
    for _ in range(steps):
        timestep = environment.step(np.array(action, dtype=float))
    return timestep.observation


def test_actions_are_translation_and_rotation_of_each(environment):
    names = environment.action_spec().name.split("\t")
    wire = ["guidewire/insertion", "guidewire/rotation"]
    assert names == [*wire, "catheter/insertion", "catheter/rotation"]
    alone = suite.make_task("simple1_lcca_wire")
    assert list(alone.scene.catheter.action_names) == wire


def test_the_wire_starts_ahead(environment):
    seen = environment.reset().observation
    insertion = seen["device_insertion"]
    assert insertion[0] == environment.task.readings.insertion
    assert insertion[0] - insertion[1] == pytest.approx(0.03)
    assert (seen["device_rotation"] == 0).all()
    points = seen["device_points"].reshape(2, 8, 3)
    np.testing.assert_allclose(points[0, -1], environment.task.readings.head)
    # The catheter's end lies 30 mm of nearly straight wire behind.
    gap = np.linalg.norm(points[0, -1] - points[1, -1])
    assert 0.025 < gap <= 0.0301


def test_each_device_moves_by_its_own_action(environment):
    before = environment.reset().observation["device_insertion"]
    seen = run(environment, [0.0, 0.0, 0.5, 0.0], 10)
    moved = seen["device_insertion"] - before
    assert moved[1] == pytest.approx(5 * STEP)
    # Held, but for the give of the drive under load.
    assert abs(moved[0]) < 0.2e-3
    seen = run(environment, [0.5, 0.0, 0.0, 0.0], 10)
    moved = seen["device_insertion"] - before
    assert moved == pytest.approx([5 * STEP, 5 * STEP], rel=0.1)


def test_the_catheter_overtakes_the_wire_and_takes_the_lead(environment):
    environment.reset()
    seen = run(environment, [0.0, 0.0, 1.0, 0.0], 30)
    wire, catheter = seen["device_insertion"]
    assert catheter > wire + 0.01
    assert environment.task.readings.insertion == catheter
    # Now the wire is withdrawn until it has left the patient, and no farther.
    seen = run(environment, [-1.0, 0.0, 0.0, 0.0], 80)
    depth = environment.task.scene.placement.start_depth
    assert seen["device_insertion"][0] == pytest.approx(-depth)
    # The links are the catheter's alone wherever it has left the sheath.
    model = environment.physics.model.ptr
    links = [i for i in range(model.nbody) if "link_" in model.body(i).name]
    catheter = environment.task.scene.catheter.device
    blood = catheter.outer_radius**2 + catheter.inner_radius**2
    expected = catheter.linear_density + BLOOD_DENSITY * np.pi * blood
    expected = expected * environment.task.scene.catheter.link_lengths
    np.testing.assert_allclose(model.body_mass[links][-8:], expected[-8:])


def test_neither_can_leave_its_base(environment):
    environment.reset()
    seen = run(environment, [-1.0, 0.0, -1.0, 0.0], 100)
    # One of them always keeps the end of the chain at its start.
    assert seen["device_insertion"].max() == pytest.approx(0.0, abs=2e-4)
    depth = environment.task.scene.placement.start_depth
    assert seen["device_insertion"].min() >= -depth


def test_a_device_that_starts_outside_the_patient_stays_there():
    given = {"lead": 0.1, "observation": "drives", "random": 0}
    environment = suite.load("cathsim", "type1_lcca_pair", given)
    before = environment.reset().observation["device_insertion"]
    for push, way in ((0.0, 0.0), (-1.0, 0.0), (1.0, 2 * STEP)):
        seen = run(environment, [0.0, 0.0, push, 0.0], 2)["device_insertion"]
        assert seen[1] - before[1] == pytest.approx(way, abs=1e-4)


def test_rotation_turns_the_shape_of_the_end(environment):
    """Where the wire lies free, its springs follow the rotation of its end."""
    environment.reset()
    model = environment.physics.model.ptr
    count = len(environment.task.scene.catheter.links)
    ends = [
        model.joint(f"catheter/bend_{axis}_{count - 2}").qposadr[0] for axis in "xy"
    ]

    def direction():
        x, y = model.qpos_spring[ends]
        return y - 1j * x

    first = direction()
    assert first.real > 0.05 and abs(first.imag) < 1e-3
    seen = run(environment, [0.0, 0.5, 0.0, 0.0], 25)
    assert seen["device_rotation"][0] == pytest.approx(0.5 * 3.14)
    run(environment, [0.0, 0.0, 0.0, 0.0], 50)
    seen = environment.task.rollout.devices
    turned = np.angle(direction() / first)
    assert turned == pytest.approx(seen.tip_rotation[0, 0], abs=0.05)
    assert 1.0 < turned < 1.7
    assert seen.rotation[0, 1] == 0.0


@pytest.mark.parametrize("stiffness, loss", [(2.0, 1.0), (1.0, 3.0)])
def test_factors_scale_the_torsion_of_the_devices(environment, stiffness, loss):
    """In a smooth bend, twist does not depend on stiffness; loss is that of devices."""
    entity = environment.task.scene.catheter
    devices, tables = sliding.devices_at(entity), entity.stack.tables
    rods, links = devices.rods, len(tables.lengths)
    hinges = np.random.default_rng(0).uniform(-0.2, 0.2, 2 * links - 2)
    turned, lumen = np.array([0.0, 0.1]), np.zeros((2, 1))

    def angles(times, stiffness, loss):
        state = laws.State(
            gaps=entity.start_gaps,
            hinges=hinges,
            angles=np.zeros((2, links + 1)),
            ways=lumen[0],
            drag=lumen[1],
            slipped=np.zeros(2),
            axial=np.zeros((2, links - 1)),
        )
        loads = laws.Loads(turned, np.zeros(links), 0.0, 0.0, stiffness, loss)
        given = devices._replace(rods=rods._replace(times=times))
        memory, chain = stack_memory.settling(tables), stack_memory.chain(tables)
        laws.settle(given, loads, state, memory, chain)
        return state.angles

    expected = angles(loss * rods.times, 1.0, 1.0)
    assert np.abs(expected[:, -1]).min() > 1e-3
    np.testing.assert_allclose(angles(rods.times, stiffness, loss), expected, 1e-9)


@pytest.mark.parametrize("catheter", [1.0, 0.0], ids=["apart", "coinciding ends"])
def test_the_load_is_what_touches_the_leading_device(environment, catheter):
    """It bears the wall's force on its links where it has left the others."""
    environment.reset()
    run(environment, [1.0, 0.0, 1.0, 0.0], 100)
    if catheter == 0.0:
        run(environment, [0.0, 0.0, 1.0, 0.0], 30)
    run(environment, [0.5, 0.0, 0.5, 0.0], 10)
    run(environment, [0.0, 0.0, 0.0, 0.0], 40)
    task = environment.task
    seen, state = task.rollout.devices, task.readings
    gap = np.ptp(seen.insertion)
    assert (gap > 0.02) == (catheter > 0)
    nodes = task.scene.catheter.stack.nodes
    link = min(int((nodes[1:] > gap).sum()) + 1, len(nodes) - 2)
    along = state.centreline[link + 1] - state.centreline[link]
    borne = -state.external_force[link:, 3:].sum(0) @ along / np.linalg.norm(along)
    assert borne > 0.005
    assert seen.leading_load[0] == pytest.approx(borne, rel=0.02, abs=2e-3)
    assert seen.push.sum() == pytest.approx(float(state.push_force), abs=1e-9)


def test_a_clamp_slips_that_pushes_a_wire_into_a_bend(monkeypatch):
    """The wire stays behind its command; the drive of the catheter bears as much."""
    options = {
        "devices": ("wire_035_glide", "diagnostic_5f_simmons"),
        "observation": "tracking",
        "random": 0,
    }
    environment = suite.load("cathsim", TASK, options)
    environment.reset()
    run(environment, [0.0, 0.0, 1.0, 0.0], 60)  # the wire's end is behind the bend
    # In motion all devices are behind their commands with the chain.
    run(environment, np.zeros(4), 5)
    before = environment.task.rollout.devices.insertion[0, 0]
    monkeypatch.setattr(sliding, "MAX_PUSH_FORCE", 0.02)
    run(environment, [0.1, 0.0, 0.0, 0.0], 160)
    seen = environment.task.rollout.devices
    (slipped,) = environment.task.rollout.slipped[:, 0]
    moved = seen.insertion[0, 0] - before
    assert slipped > 1e-3
    assert moved == pytest.approx(160 * 0.1 * STEP - slipped, abs=1e-4)
    assert seen.push[0, 0] == pytest.approx(0.02, rel=0.02)
    applied = environment.physics.data.ptr.qfrc_applied
    assert applied.max() == pytest.approx(seen.push[0, 0])
    # The friction in the lumen stays when the devices stop.
    rubbing = seen.lumen_friction[0]
    run(environment, [0.0, 0.0, 0.0, 0.0], 1)
    assert 0.0 < environment.task.rollout.devices.lumen_friction[0]
    assert rubbing > 0.0
    environment.close()


def test_a_step_of_a_single_device_does_no_pair_work(shared_environment, monkeypatch):
    environment = shared_environment("type1_bca")
    assert environment.task.rollout.devices is None
    chain = environment.task.scene.catheter
    own = userdata_size([StillBlood()], chain)
    assert environment.physics.model.ptr.nuserdata == own
    monkeypatch.setattr(sliding, "sliding", None)
    environment.reset()
    environment.step(np.zeros(21))


@pytest.mark.parametrize(
    "options, message",
    [
        ({"devices": "berenstein_5f"}, "from the innermost outwards"),
        ({"devices": []}, "from the innermost outwards"),
        ({"devices": ["berenstein_5f"], "device": "steerable_4f"}, "leave one of"),
        ({"devices": ["berenstein_5f"], "rotation": True}, "rotation is True"),
    ],
)
def test_options_that_cannot_be_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        NavigationConfig(**options)


def test_a_steerable_device_in_a_stack_is_refused():
    with pytest.raises(ValueError, match="motors in its tip"):
        suite.make_task("simple1_bca_wire", devices=["steerable_5f"])
