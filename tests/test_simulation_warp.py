"""MuJoCo Warp on the CPU against `mujoco.batch`, with the same laws and actions."""

import collections
import gc
import importlib.util
import sys
import types
import weakref

import mujoco
import numpy as np
import pytest
import torch

# isort: off
# torchrl goes before dm_control.
from cathsim_dmc import agents
from cathsim_dmc.agents.contact_log import ContactLog
from cathsim_dmc.simulation import environments
from cathsim_dmc.simulation.torchrl import BatchedEnv

# isort: on
from dm_control import mjcf

from cathsim_dmc import suite
from cathsim_dmc.entities.contact import CONTACT_SOLREF
from cathsim_dmc.physics import held
from cathsim_dmc.simulation.batch import BatchSimulation
from cathsim_dmc.simulation.warp import contacts, devices
from cathsim_dmc.simulation.warp.reduction import Totals
from cathsim_dmc.simulation.warp.simulation import WarpSimulation
from cathsim_dmc.simulation.warp.worlds import Worlds

needs_warp = pytest.mark.skipif(
    importlib.util.find_spec("mujoco_warp") is None, reason="needs the extra gpu"
)
STEPS = 24  # control steps; the device is then in contact with the wall


def both(task, count=4, **options):
    one = BatchSimulation(suite.make_task(task, **options), count, num_threads=1)
    two = WarpSimulation(suite.make_task(task, **options), count, device="cpu")
    return one, two


@pytest.mark.slow
@needs_warp
def test_worlds_follow_the_batch():
    one, two = both("type1_lcca", randomisation=True)
    here, there = one.reset(), two.reset()
    for key, value in here.observation.items():
        np.testing.assert_array_equal(there.observation[key], value)
    random = np.random.RandomState(0)
    forces, equal = [], 0
    stiffness = two.stepper._own["jnt_stiffness"].copy()
    for _ in range(STEPS):
        action = random.uniform(-1, 1, (4, one.num_actions))
        action[:, -1] = 1.0
        here, there = one.step(action), two.step(action)
        tips = here.readings.head - there.readings.head
        assert np.linalg.norm(tips, axis=1).max() < 0.5e-3
        found = one.contacts(), two.contacts()
        counts = [each.present.sum(axis=1) for each in found]
        equal += int((counts[0] == counts[1]).sum())
        forces.append((here.wall_force.sum, there.wall_force.sum))
        # The forces are summed up from the rows of constraints, not from the sensors.
        loads = found[1].magnitude.sum(axis=1)
        np.testing.assert_allclose(there.wall_force.sum, loads, rtol=1e-5)
    totals = np.array(forces).sum(axis=(0, 2))
    assert totals[0] > 0.0
    assert totals[1] == pytest.approx(totals[0], rel=0.05)
    # The sheath holds other links than at the beginning, on the device as well.
    stepper = two.stepper
    for name in held.FIELDS:
        there, own = getattr(stepper._worlds.model, name).numpy(), stepper._own[name]
        np.testing.assert_allclose(there, own.reshape(there.shape), rtol=1e-5)
    assert (stepper._own["jnt_stiffness"] != stiffness).any()
    # Where a contact is between two physics steps, single precision decides.
    assert equal >= 0.9 * 4 * STEPS
    assert not two.stepper.lost.any()
    # Some worlds begin anew, the others stay where they are.
    before = two.rollout.readings.head.copy()
    after = two.reset(np.array([1, 3])).readings.head
    np.testing.assert_array_equal(after[[0, 2]], before[[0, 2]])
    assert (after[[1, 3]] != before[[1, 3]]).any()
    # One instant: the same state has the same contacts.
    model, data = two.stepper._mine()
    two.stepper._write(0, data, vars(two.stepper.arrays))
    mujoco.mj_forward(two.stepper._model_of(0), data)
    wall = model.geom("wall").id
    at_wall = [c for c in data.contact if c.geom2 == wall]
    two.stepper.run()
    # Contacts with a rigid wall share no spring.
    used = int(two.stepper.contacts.counts.sum())
    solref = two.stepper._worlds.data.contact.solref.numpy()[:used]
    assert used > 0
    np.testing.assert_allclose(solref, np.tile(CONTACT_SOLREF, (used, 1)), rtol=1e-6)
    assert len(at_wall) == pytest.approx(two.contacts().present[0].sum(), abs=1)


@pytest.mark.slow
@needs_warp
@pytest.mark.parametrize(
    ("task", "options"),
    [
        ("femoral_type1_lcca", {}),
        ("type1_lcca", {"device": "berenstein_5f", "rotation": True}),
        ("arch_lcca", {"pool": 2, "observation": ["route", "force"]}),
        ("type1_lcca", {"vessel": "living", "observation": ["internal", "vessel"]}),
        ("arch_any_pair", {"pool": 2, "vessel": "living"}),
    ],
)
def test_other_scenes_follow_the_batch(task, options):
    """Accesses, shaped devices, living vessels, and an anatomy of each world's own."""
    one, two = both(task, **options)
    one.reset(), two.reset()
    scenes = {id(two.rollout.case(index).scene) for index in range(4)}
    assert len(scenes) == options.get("pool", 1)
    random, forces, equal = np.random.RandomState(0), [], 0
    for step in range(16):
        if step == 4:  # into the next anatomy
            one.reset(np.array([0, 1])), two.reset(np.array([0, 1]))
        action = random.uniform(-1, 1, (4, one.num_actions))
        action[:, [0, 2] if task.endswith("pair") else -1] = 1.0
        here, there = one.step(action), two.step(action)
        tips = here.readings.head - there.readings.head
        assert np.linalg.norm(tips, axis=1).max() < 0.1e-3
        for key, value in here.observation.items():
            np.testing.assert_allclose(there.observation[key], value, atol=0.02)
        counts = [each.contacts().present.sum(axis=1) for each in (one, two)]
        equal += int((counts[0] == counts[1]).sum())
        forces.append((here.wall_force.sum, there.wall_force.sum))
    totals = np.array(forces).sum(axis=(0, 2))
    assert totals[1] == pytest.approx(totals[0], rel=0.01) and totals[0] > 0.0
    assert equal >= 0.9 * 4 * 16


@pytest.mark.slow
@needs_warp
def test_coaxial_devices_follow_the_batch():
    """The outer device overtakes the inner one; then one world begins anew."""
    one, two = both("type1_lcca_pair", randomisation=True)
    one.reset(), two.reset()
    random, forces, leads, off = np.random.RandomState(0), [], set(), []
    errors = collections.defaultdict(list)  # divided by the tolerance
    for step in range(26):
        if step == 23:
            one.reset(np.array([1])), two.reset(np.array([1]))
        action = random.uniform(-1, 1, (4, one.num_actions))
        action[:, [0, 2]] = (-1.0, 1.0) if step < 20 else (1.0, 0.5)
        here, there = one.step(action), two.step(action)
        tips = here.readings.head - there.readings.head
        assert np.linalg.norm(tips, axis=1).max() < 0.05e-3
        coaxial = one.rollout.devices, two.rollout.devices
        leads |= set(coaxial[0].insertion.argmax(axis=1).tolist())
        for name, value in coaxial[0]._asdict().items():
            error = np.abs(getattr(coaxial[1], name) - value)
            errors[name].extend((error / (2e-4 + 2e-3 * np.abs(value))).ravel())
        for key, value in here.observation.items():
            off.append(np.abs(there.observation[key] - value).ravel() > 0.02)
        forces.append((here.wall_force.sum, there.wall_force.sum))
    assert leads == {0, 1}
    # Rounding decides when a tip on the wall slips.
    for name, each in errors.items():
        assert np.quantile(each, 0.95) < 1.0 and max(each) < 5.0, name
    # Speeds differ for a control step where a contact lies between two physics steps.
    assert np.concatenate(off).mean() < 1e-3
    totals = np.array(forces).sum(axis=(0, 2))
    assert totals[1] == pytest.approx(totals[0], rel=0.01) and totals[0] > 0.0
    stepper = two.stepper
    for name in ("body_mass", "geom_friction", "geom_size", "jnt_stiffness"):
        there, own = getattr(stepper._worlds.model, name).numpy(), stepper._own[name]
        np.testing.assert_allclose(there, own.reshape(there.shape), rtol=1e-5)


@needs_warp
@pytest.mark.parametrize(
    ("task", "options", "named"),
    [
        ("type1_lcca", {"solver_tolerance": 1e-8}, "solver_tolerance"),
    ],
)
def test_what_is_not_simulated_is_refused_by_name(task, options, named):
    with pytest.raises(NotImplementedError, match=named):
        WarpSimulation(suite.make_task(task, **options), 1, device="cpu")


@needs_warp
def test_a_device_that_is_not_there_is_refused():
    with pytest.raises(ValueError, match="cuda:7.*cpu"):
        WarpSimulation(suite.make_task("type1_lcca"), 1, device="cuda:7")


def test_without_the_extra_an_error_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "mujoco_warp", None)
    with pytest.raises(ImportError, match=r"\.\[gpu\]"):
        devices.warp_modules()


def test_parameters_of_contacts_are_mixed_as_in_mujoco():
    model = mujoco.MjModel.from_xml_string("""
    <mujoco><worldbody>
      <geom name="a" type="box" size="1 1 1" condim="3" solmix="3" priority="0"/>
      <geom name="b" type="box" size="1 1 1" condim="1" priority="2"/>
      <body pos="0 0 1.05">
        <freejoint/>
        <geom name="c" type="capsule" size="0.1 0.2" contype="0" conaffinity="1"
          condim="4"/>
      </body>
    </worldbody></mujoco>""")
    links = contacts._links(model, np.array([0, 1]))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    dims = {int(c.geom.min()): int(c.dim) for c in data.contact}
    assert dims == {0: links.dims[0, 0], 1: links.dims[0, 1]}
    assert links.mix[0, 0] == 0.25
    assert links.priorities.tolist() == [[0, 1]]


@pytest.mark.parametrize(
    ("options", "names"),
    [({}, ["wall"]), ({"sheath_clearance": 1e-3}, ["wall", "sheath/bore"])],
)
def test_a_bore_without_contact_has_none_on_warp(options, names):
    task = suite.make_task("type1_lcca", **options)
    model = mjcf.Physics.from_mjcf_model(task.root_entity.mjcf_model).model.ptr
    found = [model.geom(geom).name for geom in contacts.carriers_of(model).tolist()]
    assert found == names


@needs_warp
def test_devices_that_turn_take_part_in_a_pool():
    """Anatomies have bases of other lengths, and these the field `dof_length`."""
    task = suite.make_task("arch_lcca", pool=2, rotation=True)
    simulation = WarpSimulation(task, 3, device="cpu")
    simulation.reset()
    stepper = simulation.stepper
    lengths = stepper._own["dof_length"]
    assert (lengths != lengths[0]).any()
    laws = stepper.contacts, stepper._passive
    made = Worlds(stepper._device, stepper._model, stepper._own, laws, 1)
    made.write_model(stepper._own, ["dof_length"])


# What the host changes in every control step, and what else is the state of a world.
EACH, MORE = ["qpos", "act", "ctrl", "qfrc_applied", "time"], ["qvel", "qacc_warmstart"]


@pytest.fixture
def bare_worlds():
    """Four worlds on the CPU, without a scene: arrays of two fields and of a state."""
    import warp

    def zeros(*shape, kind=float):
        return warp.zeros(shape, dtype=kind, device="cpu")

    made = Worlds.__new__(Worlds)
    made._warp, made._fields, made._staged, made.seconds = warp, set(), {}, {}
    made._device = types.SimpleNamespace(name="cpu", is_cuda=False)
    made._colliding = np.array([True, False])
    made.model = types.SimpleNamespace(
        jnt_stiffness=zeros(1, 3),
        geom_pos=zeros(1, 2, kind=warp.vec3),
        geom_priority=zeros(2, kind=int),
        geom_rbound=zeros(1, 2),
        opt=types.SimpleNamespace(disableflags=4, run_rne_postconstraint=None),
    )
    made.data = types.SimpleNamespace(**{name: zeros(4, 2) for name in EACH + MORE})
    return made


@needs_warp
def test_fields_of_worlds_are_written_or_refused(bare_worlds):
    random = np.random.RandomState(0)
    own = {"jnt_stiffness": random.rand(4, 3), "geom_pos": random.rand(4, 2, 3)}
    for name, values in own.items():
        bare_worlds._expand(name, values)
    for factor in (2.0, 3.0):  # the second by the memory of the first
        twice = {name: factor * values for name, values in own.items()}
        bare_worlds.write_model(twice, ["geom_pos"])
        for name, values in (own | {"geom_pos": twice["geom_pos"]}).items():
            found = getattr(bare_worlds.model, name).numpy()
            np.testing.assert_allclose(found, values, rtol=1e-6)
    # Fields that all worlds share may differ where Warp does not read them.
    differ = np.ones((4, 2))
    differ[1, 1] = 2.0
    bare_worlds._expand("geom_priority", differ)
    differ[1, 0] = 2.0
    for name in ("geom_rbound", "none"):
        bare_worlds._expand(name, differ)
        bare_worlds.write_model({name: differ}, [name])
    assert bare_worlds.model.geom_rbound.shape == (1, 2)
    for write in (
        lambda: bare_worlds._expand("geom_priority", differ),
        lambda: bare_worlds.write_model({"geom_priority": differ}, ["geom_priority"]),
    ):
        with pytest.raises(NotImplementedError, match="geom_priority cannot differ"):
            write()


@needs_warp
def test_states_of_worlds_are_copied_to_the_device_and_back(bare_worlds):
    told, random = [], np.random.RandomState(0)
    bare_worlds._passive = types.SimpleNamespace(write=told.append)
    bare_worlds._contacts = types.SimpleNamespace(write=lambda: told.append("contacts"))
    arrays = {name: random.rand(4, 2) for name in EACH + MORE}
    for whole in (False, True):
        bare_worlds.write(types.SimpleNamespace(**arrays), whole)
        for name, values in arrays.items():
            given = values if whole or name in EACH else 0.0 * values
            found = getattr(bare_worlds.data, name).numpy()
            np.testing.assert_allclose(found, given, rtol=1e-6, err_msg=name)
    assert told == [False, True, "contacts"]
    bare_worlds._beside, beside = np.array([0, 3]), random.rand(4, 2)
    totals = Totals(None, None, None, beside)
    bare_worlds._reduction = types.SimpleNamespace(read=lambda: totals)
    back = types.SimpleNamespace(qpos=np.zeros((4, 2)), sensordata=np.ones((4, 5)))
    assert bare_worlds.read(back, ["qpos", "sensordata"]) is totals
    np.testing.assert_allclose(back.qpos, arrays["qpos"], rtol=1e-6)
    np.testing.assert_array_equal(back.sensordata[:, [0, 3]], beside)
    assert (back.sensordata[:, [1, 2, 4]] == 1.0).all()


@needs_warp
def test_only_the_last_physics_step_computes_sensors(bare_worlds):
    seen, option = [], bare_worlds.model.opt

    def step(model, data):
        seen.append((option.disableflags, option.run_rne_postconstraint))

    bare_worlds._mjwarp, bare_worlds._substeps = types.SimpleNamespace(step=step), 3
    bare_worlds._reduction = types.SimpleNamespace(add=lambda *at: seen.append(at))
    bare_worlds._steps()
    without = 4 | mujoco.mjtDisableBit.mjDSBL_SENSOR.value, False
    assert seen == [without, (0, 2), without, (1, 2), (4, True), (2, 2)]
    bare_worlds._mjwarp.step = lambda model, data: 1 / 0
    with pytest.raises(ZeroDivisionError):
        bare_worlds._step(0)
    assert option.disableflags == 4


@pytest.mark.slow
@needs_warp
def test_a_device_gives_its_memory_back():
    """At once: what the collector frees may end the capture of another graph."""
    env = BatchedEnv("type1_lcca", 1, device="warp:cpu")
    stepper = env.simulation.stepper
    kept, closed = env.rand_step(env.reset()), []
    for _ in range(2):
        worlds = weakref.ref(stepper._worlds)
        state = stepper.states()
        gc.collect()  # Warp leaves tracebacks where it compiles, with their frames
        gc.disable()
        try:
            stepper.close()
            closed.append(worlds() is None)
        finally:
            gc.enable()
        after = env.step(kept)
        stepper.set_states(np.arange(1), state)
        torch.testing.assert_close(env.step(kept)["next"], after["next"])
    assert closed == [True, True]
    env.close()
    assert stepper._worlds is None


@pytest.mark.slow
@needs_warp
def test_a_policy_is_evaluated_on_the_device():
    """As `--simulation-device cuda` does, here on the CPU."""
    asked = []

    def make_env(*args, device="cpu", **kwargs):
        asked.append(device)
        device = device.replace("cuda:1", "cpu")
        return environments.make_env(*args, device=device, **kwargs)

    how = {"episodes": 2, "task_kwargs": {"max_steps": 12}, "make_env": make_env}
    log = ContactLog()
    here = agents.evaluate("push", "type1_lcca", **how)
    there = agents.evaluate(
        "push", "type1_lcca", simulation_device="cuda:1", observer=log, **how
    )
    assert asked == ["cpu", "warp:cuda:1"]
    for one, other in zip(here.episodes, there.episodes, strict=True):
        assert (one.length, one.success) == (other.length, other.success)
        assert other.reward == pytest.approx(one.reward, rel=1e-3)
    forces = [each.values("forces.sum.mean") for each in (here, there)]
    np.testing.assert_allclose(forces[1], forces[0], rtol=0.05)
    assert forces[0].min() > 0.0


@pytest.mark.parametrize("device", ["gpu", "warp:cuda", "cuda:-1", None])
def test_another_place_of_an_evaluation_is_refused(device):
    with pytest.raises(ValueError, match=r"--simulation-device.*'cuda:1'"):
        agents.evaluate("push", "type1_lcca", simulation_device=device)


def test_a_cluster_simulates_on_its_cpus():
    with pytest.raises(ValueError, match="--simulation-device"):
        agents.evaluate("push", "type1_lcca", simulation_device="cuda", on_cluster=True)
