import json

import mujoco
import numpy as np
import pytest

from cathsim_dmc import suite
from cathsim_dmc.agents import protocols
from cathsim_dmc.physics.effects import Effect
from cathsim_dmc.physics.randomisation import Randomisation
from cathsim_dmc.recording.episode import Episode
from cathsim_dmc.recording.recorder import EpisodeRecorder
from cathsim_dmc.simulation.batch import BatchSimulation
from cathsim_dmc.simulation.gymnasium import CathSimEnv, CathSimVectorEnv
from cathsim_dmc.tasks.snapshot import Snapshot

RANGES = {
    "friction": [0.02, 0.15], "stiffness": [0.7, 1.3], "loss": [0.5, 2.0],
    "viscosity": [0.5, 2.0], "start_radius": 0.004, "start_insertion": [0.0, 0.06],
    "roll": [-3.0, 3.0], "delay": [0, 3], "view": [-10.0, 10.0], "gain": [0.85, 1.15],
    "kerma": [0.5, 2.0], "goal_shift": [-0.005, 0.005],
}  # fmt: skip
# Drawn, and written into the state by the names of `physics.effects.Draw`.
SAME = (
    "friction", "stiffness", "loss", "viscosity", "roll", "delay", "view", "gain",
    "kerma", "goal_shift",
)  # fmt: skip


def drawn(seed, ranges=RANGES, cases=1):
    random = np.random.RandomState(seed)
    return Randomisation.make(ranges).draw_in(random, cases)


@pytest.fixture(scope="module")
def batch():
    task = suite.make_task("simple1_bca", randomisation=RANGES)
    simulation = BatchSimulation(task, 3, num_threads=1, seeds=5)
    simulation.reset()
    return simulation


def test_what_is_read_is_what_the_seed_draws(batch):
    for index, found in enumerate(batch.conditions):
        _, expected = drawn(5 + index)
        for name in SAME:
            assert getattr(found, name) == getattr(expected, name), name
        assert found.anatomy == "simple1" and found.goal == "bca"
        # The start may be scaled down or reduced where the vessel is narrow.
        assert 0 <= found.insertion <= expected.insertion + 2.5e-3
        size = np.linalg.norm(found.displacement)
        assert size <= 0.00401 and isinstance(found.delay, int)
        assert found.effects == {}


def test_the_displacement_is_the_one_that_was_applied():
    """The joints are linear in the drawn one, so the head misses a large one."""

    def begun(radius, count):
        task = suite.make_task("type2_lcca", randomisation={"start_radius": radius})
        simulation = BatchSimulation(task, count, num_threads=1, seeds=5)
        simulation.reset()
        return simulation

    still, moved = begun(0.0, 1), begun(0.01, 12)
    assert still.conditions[0].displacement == (0.0, 0.0, 0.0)
    frame = np.empty(9)
    mujoco.mju_quat2Mat(frame, moved.task.scene.placement.quaternion)
    frame = frame.reshape(3, 3)
    away = moved.rollout.readings.head - still.rollout.readings.head
    told = np.array([one.displacement for one in moved.conditions])
    np.testing.assert_allclose(told @ frame.T, away, atol=1e-9)
    assert 2e-3 < np.median(np.linalg.norm(told, axis=1)) < 0.01


def test_composer_gymnasium_and_batch_read_the_same(batch):
    options = {"randomisation": RANGES}
    environment = suite.load("cathsim", "simple1_bca", {**options, "random": 6})
    with pytest.raises(RuntimeError, match="no episode has begun"):
        environment.task.rollout.conditions()
    environment.reset()
    assert environment.task.conditions == batch.conditions[1]
    single = CathSimEnv("simple1_bca", **options)
    single.reset(seed=7)
    assert single.conditions == batch.conditions[2]
    many = CathSimVectorEnv(2, "simple1_bca", num_threads=1, **options)
    many.reset(seed=[5, 7])
    assert many.conditions == [batch.conditions[0], batch.conditions[2]]


def test_what_is_not_drawn_is_none():
    environment = suite.load("cathsim", "simple1_bca", {"random": 0})
    environment.reset()
    found = environment.task.conditions
    assert (found.friction, found.roll, found.goal_shift) == (None, None, None)
    assert (found.delay, found.view, found.gain, found.kerma) == (0, (0, 0), 1.0, 1.0)
    assert found.insertion == 0.0 and np.linalg.norm(found.displacement) <= 1e-3


def test_a_restored_episode_has_its_conditions(batch, tmp_path):
    snapshot = Snapshot.load(batch.snapshot().save(tmp_path / "state.npz"))
    task = suite.make_task("simple1_bca", randomisation=RANGES)
    other = BatchSimulation(task, 3, num_threads=1, seeds=50)
    other.reset()
    assert other.conditions != batch.conditions
    other.restore(snapshot[[2, 0]], np.array([0, 2]))
    assert other.conditions[0] == batch.conditions[2]
    assert other.conditions[2] == batch.conditions[0]
    assert other.conditions[1] != batch.conditions[1]


def test_a_snapshot_from_before_there_were_conditions_is_restored(batch):
    snapshot = batch.snapshot()
    arrays = {n: x for n, x in snapshot.arrays.items() if "conditions" not in n}
    assert len(arrays) == len(snapshot.arrays) - 1
    older = Snapshot(snapshot.task, arrays, snapshot.versions)
    task = suite.make_task("simple1_bca", randomisation=RANGES)
    other = BatchSimulation(task, 3, num_threads=1, seeds=50)
    other.restore(older)
    assert other.conditions[0].friction is None and other.conditions[0].delay is None
    assert other.conditions[0].anatomy == "simple1"
    action = np.ones((3, batch.num_actions))
    batch.step(action)
    expected = batch.rollout.readings.head
    np.testing.assert_array_equal(other.step(action).readings.head, expected)


def test_a_living_vessel_tells_its_phases():
    vessel = {
        "flow": {"rate": [50.0, 90.0], "peak": 0.5, "phase": [0.0, 1.0]},
        "wall": {"modulus": [4e5, 6e5]},
        "motion": {"heart": [0.002, 0.004], "breath_phase": [0.0, 1.0]},
    }
    task = suite.make_task("femoral_type1_lcca", vessel=vessel)
    simulation = BatchSimulation(task, 2, num_threads=1, seeds=3)
    simulation.reset()
    one, other = (found.effects for found in simulation.conditions)
    assert one["flow.peak"] == pytest.approx(0.5)
    for found in (one, other):
        assert 50 <= found["flow.rate"] <= 90 and 0 <= found["flow.phase"] <= 1
        assert found["motion.rate"] == pytest.approx(found["flow.rate"])
        assert found["motion.phase"] == pytest.approx(found["flow.phase"])
        assert 4e5 <= found["wall.modulus"] <= 6e5 and "wall.thickness" not in found
        assert found["wall.support"] == 1.0 and found["motion.breath_rate"] == 15.0
        assert 0.002 <= found["motion.heart"] <= 0.004
    assert one["flow.phase"] != other["flow.phase"]
    start = simulation.rollout.vessel
    phases = [found["flow.phase"] for found in (one, other)]
    assert start.heart_phase == pytest.approx(phases)
    breaths = [found["motion.breath_phase"] for found in (one, other)]
    assert start.breath_phase == pytest.approx(breaths)


class Wind(Effect):
    state = ("speed",)

    def bind(self, world):
        super().bind(world)
        self.speed = np.zeros(world.num_simulations)

    def restart(self, index, episode, random_state):
        self.speed[index] = 3.0

    def conditions(self, index):
        return {"wind.speed": float(self.speed[index])}


def test_an_own_effect_tells_what_it_has_drawn():
    environment = suite.load("cathsim", "simple1_bca", {"effects": [Wind()]})
    environment.reset()
    assert environment.task.conditions.effects == {"wind.speed": 3.0}


def test_an_episode_in_a_pool_names_its_anatomy():
    options = {"anatomy": ["simple1", "type1"], "goal": "bca"}
    task = suite.make_task("navigate", **options)
    simulation = BatchSimulation(task, 4, num_threads=1, seeds=0)
    simulation.reset()
    told = [found.anatomy for found in simulation.conditions]
    numbers = [drawn(seed, {}, cases=2)[0] for seed in range(4)]
    assert told == [options["anatomy"][number] for number in numbers]
    assert len({*told}) == 2
    # As an evaluation names it.
    played = protocols.parts(protocols.get("published"), "navigate", options, 4, 0)
    assert [one["anatomy"] for part in played for one in part.conditions] == told


def test_a_recording_carries_them(tmp_path):
    options = {"randomisation": RANGES, "max_steps": 3}
    environment = suite.load("cathsim", "simple1_bca", options)
    recorder = EpisodeRecorder(environment, "simple1_bca", options)
    still = np.zeros(environment.action_spec().shape)
    episode = recorder.record_episode(lambda timestep: still, seed=6)
    read = Episode.load(episode.save(tmp_path / "one.npz")).meta["conditions"]
    assert read == json.loads(json.dumps(environment.task.conditions.as_dict()))
    assert read["friction"] == drawn(6)[1].friction
    assert read["view"] == list(drawn(6)[1].view)
