"""Control steps that are done again with shorter physics steps."""

import threading

import mujoco
import numpy as np
import pytest
from conftest import twin

from cathsim_dmc import suite
from cathsim_dmc.physics import deep_links, forces
from cathsim_dmc.physics.stepper import Stepper
from cathsim_dmc.simulation.batch import BatchSimulation, _BatchStepper


def _deepest(steps):
    """Deepest contact, m, of a tip that swings from wall to wall."""
    task = suite.make_task("type1_bca", random=0, randomisation=True)
    batch = BatchSimulation(task, 4, num_threads=1, seeds=0)
    batch.reset()
    deepest = 0.0
    for step in range(steps):
        action = np.zeros((4, batch.num_actions))
        action[:, -1] = 1.0
        action[:, :-1] = np.sign(np.sin(step / 20 + np.arange(4)))[:, None]
        batch.step(action)
        deepest = max(deepest, batch.contacts().penetration.max(initial=0.0))
    return deepest


def test_an_impact_in_shorter_steps_is_not_as_deep(monkeypatch):
    deepest = forces.DEEPEST
    assert _deepest(80) < deepest
    monkeypatch.setattr(forces, "DEEPEST", np.inf)
    assert _deepest(80) > deepest


def test_what_goes_deep_in_the_last_physics_step_is_seen():
    batch = BatchSimulation(suite.make_task("type1_lcca"), 1, num_threads=1)
    batch.reset()
    before, calm = np.array([1e-4]), np.zeros(1)

    def depth_at_end():
        way, doubt = batch.stepper._way(calm, before, forces.DEEPEST)
        given = way, np.array([False]), forces.DEEPEST
        return batch.stepper._depth_at_end(before.copy(), *given), doubt

    batch.batch.qpos[:, batch.rollout.index.insertion_qpos] += 0.1
    assert depth_at_end() == (before, False)
    batch.batch.qvel[:, batch.rollout.index.dofs.start] = 1.0
    depth, doubt = depth_at_end()
    assert depth > 1e-3 and doubt


def test_the_way_of_a_link_that_swings_is_that_of_its_end():
    batch = BatchSimulation(suite.make_task("simple1_bca"), 1, num_threads=1)
    batch.reset()
    chain = batch.task.scene.catheter
    batch.batch.qvel[:, batch.rollout.index.dofs.stop - 1] = 20.0
    way, _ = batch.stepper._way(np.zeros(1), np.zeros(1), forces.DEEPEST)
    timestep = batch.task.physics_timestep
    assert way[0] == pytest.approx(20.0 * timestep * chain.link_lengths[-1], rel=0.01)


CHAIN = """
<mujoco>
  <default><geom type="capsule" size="1e-3 0.01" contype="0" conaffinity="1"/></default>
  <worldbody>
    <geom type="box" size="1 1 1" contype="1" conaffinity="0"/>
    <body pos="0.1 0.2 0.3">
      <joint type="slide" axis="0 0 1"/><joint axis="1 1 0"/><geom pos="0 0 0.01"/>
      <body pos="0 0 0.02">
        <joint axis="1 0 0"/><joint axis="0 1 0"/><geom pos="0 0 0.01"/>
        <body pos="0 0 0.02"><geom pos="0 0 0.02"/></body>
      </body>
    </body>
  </worldbody>
</mujoco>"""


@pytest.mark.parametrize(("seed", "fastest"), [(149, 0), (116, 1), (0, 2)])
def test_the_way_of_a_chain_is_that_of_its_fastest_link(seed, fastest):
    """Across the way to the next link, by the velocities that MuJoCo computes."""
    model = mujoco.MjModel.from_xml_string(CHAIN)
    data, random = mujoco.MjData(model), np.random.RandomState(seed)
    data.qpos[:], data.qvel[:] = random.uniform(-1, 1, (2, model.nv))
    data.qvel[0] *= 0.03
    mujoco.mj_forward(model, data)
    speeds = []
    for body, reach in zip((1, 2, 3), (0.02, 0.02, 0.03), strict=True):
        found, kind = np.zeros(6), mujoco.mjtObj.mjOBJ_XBODY
        mujoco.mj_objectVelocity(model, data, kind, body, found, 0)
        turn, velocity = found[:3], found[3:]
        if body < 3:
            ahead = data.xpos[body + 1] - data.xpos[body]
            velocity = velocity - velocity @ ahead / (ahead @ ahead) * ahead
        speeds.append(np.linalg.norm(velocity) + reach * np.linalg.norm(turn))
    assert np.argmax(speeds) == fastest
    links = deep_links.moving(model)
    kept = (getattr(data, name)[None].copy() for name in deep_links.Motion._fields)
    motion, way = deep_links.Motion._make(kept), np.zeros(1)
    calm = np.zeros(1)
    for timestep, hardest, deepest, doubt in (
        (0.004, 1.0, np.inf, False),
        (0.002, -1.0, np.inf, True),
        (0.002, 1.0, 0.0021 * max(speeds), False),
        (0.002, 1.0, 0.0019 * max(speeds), True),
    ):
        limits = hardest, deepest, timestep
        found = deep_links.in_doubt(calm, calm, limits, motion, links, way)
        assert found == doubt
        assert way[0] == pytest.approx(timestep * max(speeds))


@pytest.mark.parametrize(
    ("task", "options", "limit"),
    [
        ("type1_lcca_pair", {"randomisation": True}, {"HARDEST": 1e-2}),
        ("femoral_arch_lcca", {"pool": 2, "arches": "test"}, {"HARDEST": 2e-4}),
        ("type1_lcca_pair", {"randomisation": True}, {"DEEPEST": 1e-6}),
    ],
)
def test_shorter_steps_are_equal_in_both_paths(task, options, limit, monkeypatch):
    monkeypatch.setattr(forces, *limit.popitem())
    refined, every, missed = [], {}, 0
    original = Stepper._refine

    def refine(self, indices, parts):
        rows = original(self, indices, parts)
        assert rows.shape[1] == parts * self.substeps
        refined.extend(indices.tolist())
        found = np.transpose(forces.wall_force(rows)[0])
        every.update(zip(indices, found, strict=True))
        return rows

    monkeypatch.setattr(_BatchStepper, "_refine", refine)
    task = suite.make_task(task, **options)
    environments = [suite.environment(twin(task, seed)) for seed in (5, 6)]
    batch = BatchSimulation(task, 2, num_threads=1, seeds=5)
    batch.reset()
    for environment in environments:
        environment.reset()
    rng = np.random.default_rng(0)
    for _ in range(10):
        every.clear()
        action = rng.uniform(-1, 1, (2, batch.num_actions))
        action[:, -1 if batch.num_actions == 21 else slice(0, 2)] = 1.0
        step = batch.step(action)
        kept, _ = forces.wall_force(batch.stepper.contact_rows)
        for index, found in every.items():
            assert np.transpose(step.wall_force)[index].tolist() == found.tolist()
            peak = step.wall_force.peak_sum[index]
            assert peak >= kept.peak_sum[index]
            missed += peak > kept.peak_sum[index]
        for index, environment in enumerate(environments):
            environment.step(action[index])
            data, own = environment.physics.data.ptr, environment.task
            np.testing.assert_array_equal(batch.batch.qpos[index], data.qpos)
            assert [*own.wall_force] == [each[index] for each in step.wall_force]
            assert own.readings.push_force == step.readings.push_force[index]
            np.testing.assert_array_equal(
                batch.contacts().force[index], own.contacts(environment.physics).force
            )
            stepper = own.rollout._stepper
            rows = batch.stepper.contact_rows[index]
            np.testing.assert_array_equal(rows, stepper.contact_rows[0])
    assert 0 < len(refined) < 20 and missed
    timestep = batch.task.physics_timestep
    for index in range(2):
        assert batch.batch.get_model(index).opt.timestep == timestep


def test_what_diverges_is_done_again_in_both_paths(monkeypatch):
    """A tip that whips: its hinges turn at 1,500 rad/s, one against the next."""
    task = suite.make_task("type1_bca")
    environment = suite.environment(twin(task, 3))
    batch = BatchSimulation(task, 2, num_threads=1, seeds=[3, 4])
    batch.reset()
    environment.reset()
    diverged, original = [], Stepper._warned

    def warned(self):
        found = original(self)
        if found.any():
            diverged.append(found.tolist())
        return found

    monkeypatch.setattr(Stepper, "_warned", warned)
    push = np.zeros((2, batch.num_actions))
    push[:, -1] = 1.0
    for _ in range(20):
        batch.step(push)
        environment.step(push[0])
    hinges = np.r_[batch.rollout.index.dofs][-8:]
    whip = 1.5e3 * np.resize([1.0, -1.0], 8)
    data = environment.physics.data.ptr
    batch.batch.qvel[0, hinges] = data.qvel[hinges] = whip
    for _ in range(5):
        step = batch.step(0.0 * push)
        environment.step(0.0 * push[0])
        assert step.errors == (None, None)
        assert environment.task.error is None
        np.testing.assert_array_equal(batch.batch.qpos[0], data.qpos)
        assert [*environment.task.wall_force] == [each[0] for each in step.wall_force]
    assert diverged == [[True, False], [True]]
    assert batch.stepper.repeated[0] and not batch.stepper.repeated[1]
    # Faster still, it diverges in shorter steps, too.
    batch.batch.qvel[0, hinges] = 1e4 * whip
    assert batch.step(0.0 * push).errors[0] is not None


def test_what_does_not_move_is_no_link():
    text = """<mujoco><worldbody>
      <geom size="0.1" contype="0" conaffinity="1"/>
      <body mocap="true"><geom size="0.1" contype="0" conaffinity="1"/></body>
      <body><joint/><joint axis="1 0 0"/><body>
        <geom size="0.1" contype="0" conaffinity="1"/>
      </body></body>
    </worldbody></mujoco>"""
    model, found = mujoco.MjModel.from_xml_string(text), []
    # In a thread: a search for the joint of the world has no end.
    search = threading.Thread(
        target=lambda: found.append(deep_links.moving(model)), daemon=True
    )
    search.start()
    search.join(timeout=20.0)
    (links,) = found
    assert (links.bodies.tolist(), links.last.tolist()) == ([3], [1])
