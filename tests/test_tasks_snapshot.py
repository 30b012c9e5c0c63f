"""Snapshots: an episode goes on bit for bit, elsewhere and later."""

import copy
import dataclasses
import hashlib
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from conftest import slow, twin
from dm_control import mjcf

from cathsim_dmc import suite
from cathsim_dmc.anatomy import Anatomy
from cathsim_dmc.anatomy.centreline import VesselTree
from cathsim_dmc.entities.devices import DEVICES
from cathsim_dmc.physics.effects import Effect, Layout, World
from cathsim_dmc.physics.stepper import Stepper
from cathsim_dmc.simulation.batch import BatchSimulation
from cathsim_dmc.simulation.gymnasium import CathSimEnv, CathSimVectorEnv
from cathsim_dmc.tasks.cases import Case
from cathsim_dmc.tasks.config import NavigationConfig
from cathsim_dmc.tasks.physics_errors import DIVERGED
from cathsim_dmc.tasks.snapshot import (
    Snapshot,
    packed,
    read_arrays,
    restored,
    write_arrays,
)

sys.path.insert(0, str(Path(__file__).parents[1] / "examples"))
from side_wind import SideWind

TESTS = Path(__file__).parent

ONE_DEVICE = ["simple1_bca", "simple1_bca_wire", "type1_lcca", "type2_bca"]
SEEN = ["internal", "tracking", "route", "force", "sequential", "segmentation"]
SEEN += ["tracking_2d", "endoluminal", "biplane"]
SMALL = {"size": 32, "noise": True}
BIPLANE = {"biplane": "LATERAL", "noise": True, "size": (48, 64), "roadmap": 0.4}
MANY = 40
# Of the many: a pair in a vessel with a wall, anatomies that take turns, wind in a
# living vessel, images of two planes with delays.
FEW = (0, 1, 2, 3)
AHEAD = 10
# Of the name of a device of the library, and another one.
SOFT = dataclasses.replace(
    DEVICES["steerable_5f"],
    shaft=dataclasses.replace(DEVICES["steerable_5f"].shaft, bending_stiffness=1e-5),
)


def configuration(number):
    """Name and options of a task, drawn at random; the first ones are of all kinds."""
    rng = np.random.default_rng(1000 + number)
    kind = number if number < len(FEW) else rng.integers(6)
    # "vessel" is given always: what it draws is drawn in every configuration.
    vessel = str(rng.choice(["rigid", "silicone", "living"]))
    options = {"randomisation": bool(rng.integers(2))}
    seen = {"internal", *rng.choice(SEEN, size=3).tolist()}
    if kind == 0:
        name, vessel = "simple1_bca_pair", str(rng.choice(["rigid", "silicone"]))
        seen |= {"drives", "devices"}
    elif kind == 1:
        name = str(rng.choice(["arch_bca", "arch_lcca"]))
        options["pool"] = 2
        seen |= {"route"}
    else:
        name = str(rng.choice(ONE_DEVICE))
        rotation = bool(rng.integers(2))
        if not name.endswith("_wire"):  # whose devices have their own
            options["rotation"] = rotation
    if kind == 2:
        vessel = "living"
        options["effects"] = [SideWind(rng.uniform(-0.05, 0.05, 3))]
    if kind == 3:
        name = str(rng.choice(ONE_DEVICE[2:]))
        seen |= {"biplane", "sequential"}
        options["randomisation"] = {"delay": (1, 4), "tracking_noise": 1e-3}
    if kind == 4:
        options["start_along_route"] = (0.1, 0.8)
    if kind == 5:
        options["physics_timestep"] = 0.002
    if name.startswith(("simple1", "arch")):  # whose inlet is out of sight
        seen.discard("biplane")
    two = "biplane" in seen
    options["fluoroscopy"] = BIPLANE if two else SMALL
    options |= {"endoluminal_size": 16, "vessel": vessel, "observation": sorted(seen)}
    return name, options


def actions(count, steps, seed):
    """Random steering while pushing on, which meets the wall."""
    chosen = np.random.default_rng(seed).uniform(-1, 1, (steps, count))
    chosen[:, -1 if count > 4 else slice(0, None, 2)] = 1.0
    return chosen


def digest(observation, reward):
    total = hashlib.sha256(np.float64(reward or 0.0).tobytes())
    for key, value in observation.items():
        total.update(key.encode() + value.tobytes())
    return total.hexdigest()[:16]


def played(environment, number):
    """Digests of the next control steps, of the next episode's start and steps."""
    count, seen = environment.task.num_actions, []
    for action in actions(count, AHEAD, 2 * number):
        timestep = environment.step(action)
        seen.append(digest(timestep.observation, timestep.reward))
    timestep = environment.reset()
    seen.append(digest(timestep.observation, 0.0))
    for action in actions(count, 2, 2 * number):
        timestep = environment.step(action)
        seen.append(digest(timestep.observation, timestep.reward))
    return seen


def elsewhere(number, path):
    """What an environment of this process plays from a file on."""
    name, options = configuration(number)
    environment = suite.environment(suite.make_task(name, random=7, **options))
    environment.restore(Snapshot.load(path))
    return played(environment, number)


def goes_on(number, path):
    """Plays a configuration, and on from its snapshot in other simulations.

    Returns:
        Digests of what comes after the snapshot, which lies at a path.
    """
    name, options = configuration(number)
    scene = suite.make_task(name, **options)
    environment, count = suite.environment(twin(scene, number)), scene.num_actions
    environment.reset()
    for action in actions(count, number % 13, 2 * number + 1):
        timestep = environment.step(action)
    snapshot = Snapshot.load(environment.snapshot().save(path))
    expected, info = played(environment, number), None

    batch = BatchSimulation(scene, 2, num_threads=2, seeds=50)
    batch.reset()
    for action in actions(count, 3, 99):
        batch.step(np.tile(action, (2, 1)))
    step = batch.restore(snapshot, np.array([1]))
    if number % 13:
        for key, value in timestep.observation.items():
            np.testing.assert_array_equal(step.observation[key][1], value, key)
    assert step.terminated[1] == (number % 13 > 0 and timestep.discount == 0)
    batch.reset(np.array([0]))  # which leaves the restored one alone
    for action, one in zip(actions(count, AHEAD, 2 * number), expected, strict=False):
        step = batch.step(np.tile(action, (2, 1)))
        info = {key: value[1].item() for key, value in step.info().items()}
        mine = {key: value[1] for key, value in step.observation.items()}
        assert digest(mine, step.outcome.reward[1]) == one
    # And back, with the steps that the environment has done since.
    step = batch.restore(snapshot.repeat(2))
    batch.step(np.tile(actions(count, 1, 2 * number), (2, 1)))
    environment.restore(batch.snapshot(np.array([0])))
    for action in actions(count, AHEAD, 2 * number)[1:]:
        environment.step(action)
    assert environment.task.info() == info
    environment.close()
    return expected


def _in_another_process(tmp_path, numbers):
    expected = {n: goes_on(n, tmp_path / f"{n}.npz") for n in numbers}
    code = (
        f"import sys; sys.path.insert(0, {str(TESTS)!r})\n"
        "from test_tasks_snapshot import elsewhere\n"
        f"for n in {tuple(numbers)!r}:\n"
        f"    print(n, *elsewhere(n, {str(tmp_path)!r} + f'/{{n}}.npz'), flush=True)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert not done.returncode, done.stderr
    lines = [line.split() for line in done.stdout.splitlines()]
    assert {int(n): seen for n, *seen in lines} == expected


@pytest.mark.parametrize("number", FEW[1:])
def test_an_episode_goes_on_bit_for_bit(number, tmp_path):
    goes_on(number, tmp_path / "state.npz")


@pytest.mark.slow
def test_an_episode_goes_on_in_another_process(tmp_path):
    _in_another_process(tmp_path, FEW[:1])


@pytest.mark.slow
@pytest.mark.parametrize("first", range(0, MANY, 10))
def test_forty_configurations_go_on_in_another_process(first, tmp_path):
    _in_another_process(tmp_path, range(first, first + 10))


# Everything that changes is declared.

# Attributes that follow from those that are kept: Rollout._derive, Effect.enter, the
# beginning of a control step. Fields and parameters lie in MuJoCo.
DERIVED = {
    "Rollout": {"objectives", "resting_goal", "resting", "_open"},
    "ImageSensors": {"planes", "thirds"},
    "BiplaneSight": {"_machines"},
    "Moving": {"_motions", "_surfaces", "_alike", "inlets"},
    "Flow": {"_circulations", "_alike"},
    "Wall": {"_fields", "_places"},
    # Scratch, and views of the model.
    "SingleDevice": {"_steering", "_held", "_sheathed", "_hinged"},
    "SlidingDevices": {"_fields", "_live", "_held", "_sheathed", "_hinged"},
}
_CONSTANT = (World, Layout, Stepper, Case, NavigationConfig, mjcf.Element)


def content(value, engine, seen=None):
    """What an attribute holds, without what lies in MuJoCo's arrays, as text."""
    seen = set() if seen is None else seen
    if isinstance(value, np.ndarray):
        if any(np.may_share_memory(value, array) for array in engine):
            return "MuJoCo's"
        return hashlib.sha256(np.ascontiguousarray(value).tobytes()).hexdigest()
    if isinstance(value, np.random.RandomState):
        return content(value.get_state(legacy=False)["state"]["key"], engine)
    if value is None or isinstance(value, str | int | float | bool):
        return repr(value)
    if id(value) in seen or isinstance(value, _CONSTANT):
        return ""
    seen.add(id(value))
    if isinstance(value, dict):
        return [(repr(k), content(one, engine, seen)) for k, one in value.items()]
    if isinstance(value, list | tuple):
        return [content(one, engine, seen) for one in value]
    if type(value).__module__.startswith(("cathsim_dmc", __name__)):
        own = vars(value) if hasattr(value, "__dict__") else {}
        return [(k, content(one, engine, seen)) for k, one in own.items()]
    return ""


def undeclared(simulation):
    """Attributes that change in an episode, and are neither declared nor derived."""
    arrays = [getattr(simulation.batch, n) for n in simulation.task.data_fields]
    engine = [*arrays, simulation.batch.userdata, simulation.batch.state]
    engine.append(simulation.batch.ctrl)
    holders = simulation.rollout.holders()
    for effect in simulation.rollout.effects:  # what they share is put back in place
        engine += [getattr(effect, name) for name in effect.state]

    def contents():
        return {
            (type(holder).__name__, name): content(value, engine)
            for holder in holders.values()
            for name, value in vars(holder).items()
            if not any(value is one for one in holders.values())
            and name not in (*holder.state, "effects", "world")
        }

    before, found = contents(), set()
    for episode in range(2):
        simulation.reset()
        for action in actions(simulation.num_actions, 8, episode):
            simulation.step(np.tile(action, (simulation.num_simulations, 1)))
        after = contents()
        found |= {key for key in after if after[key] != before.get(key)}
        before = after
    return {key for key in found if key[1] not in DERIVED.get(key[0], ())}


class Counter(Effect):
    """Counts the control steps, which it forgets to declare."""

    def bind(self, world):
        super().bind(world)
        self.count = np.zeros(world.num_simulations)

    def act(self, action, state):
        self.count += 1
        return action


@pytest.mark.parametrize("number", FEW)
def test_whatever_changes_in_an_episode_is_declared(number):
    name, options = configuration(number)
    simulation = BatchSimulation(suite.make_task(name, **options), 2, num_threads=1)
    assert undeclared(simulation) == set()


def test_an_effect_that_does_not_declare_its_state_is_found():
    task = suite.make_task("simple1_bca", effects=[Counter()])
    assert undeclared(BatchSimulation(task, 2, num_threads=1)) == {("Counter", "count")}


# Other faces, and what is refused.


@pytest.fixture(scope="module")
def task():
    """Returns a function that gives a task on one scene, with a seed."""
    made = suite.make_task("simple1_bca")
    return lambda seed=0, **changes: twin(made, seed, **changes)


def test_gymnasium_goes_on_too():
    environments = [CathSimEnv("simple1_bca") for _ in range(2)]
    environments[0].reset(seed=5)
    observation, *_ = environments[0].step(np.ones(21))
    again, info = environments[1].restore(environments[0].snapshot())
    assert info["distance"] > 0
    for key, value in observation.items():
        np.testing.assert_array_equal(again[key], value)
    many = CathSimVectorEnv(2, "simple1_bca", num_threads=1)
    seen, infos = many.restore(environments[0].snapshot().repeat(2))
    assert infos["distance"].tolist() == [info["distance"]] * 2
    one, other = (each.step(np.ones(21)) for each in environments)
    _, reward, *_ = many.step(np.ones((2, 21)))
    assert one[1:] == other[1:] and reward.tolist() == [one[1]] * 2
    np.testing.assert_array_equal(many.snapshot().arrays["rollout.steps"], [2, 2])


def test_torchrl_goes_on_within_transforms():
    from cathsim_dmc.simulation.environments import VECTOR, make_env

    env = make_env("simple1_bca", num_envs=2, num_threads=1, seed=3)
    state = env.rand_action(env.reset())
    seen = env.step(state)["next", VECTOR]
    snapshot = env.base_env.snapshot()
    env.step(state)
    assert (env.reset(snapshot=snapshot)[VECTOR] == seen).all()
    restored = env.base_env.restore(snapshot)
    assert restored.batch_size == env.batch_size


def test_a_snapshot_that_does_not_fit_is_refused_in_a_line(task):
    environment = suite.environment(task())
    with pytest.raises(RuntimeError, match="reset"):
        environment.snapshot()
    environment.reset()
    snapshot = environment.snapshot()
    batch = BatchSimulation(task(), 2, num_threads=1)
    with pytest.raises(RuntimeError, match="have no episode"):
        batch.snapshot()
    with pytest.raises(ValueError, match=r"of 1 simulations, 2 are.*repeat"):
        batch.restore(snapshot)
    with pytest.raises(ValueError, match="choose the one to repeat"):
        snapshot.repeat(2).repeat(2)
    other = suite.environment(task(randomisation={"tracking_noise": 1e-3}))
    with pytest.raises(ValueError, match="other options: it lacks tracking"):
        other.restore(snapshot)
    other.reset()
    with pytest.raises(ValueError, match="other options: it has tracking"):
        environment.restore(other.snapshot())
    pair = suite.environment(suite.make_task("simple1_bca_pair"))
    with pytest.raises(ValueError, match="of another task: its devices") as error:
        pair.restore(snapshot)
    assert "\n" not in str(error.value)
    far = dict(snapshot.arrays)
    far["rollout._random_states.rest"] = np.array([[1e6, 0, 0]])
    with pytest.raises(ValueError, match="random states"):
        environment.restore(dataclasses.replace(snapshot, arrays=far))
    with pytest.raises(ValueError, match="no simulation of 1 is chosen"):
        snapshot[[]]


@pytest.mark.parametrize(
    "change",
    [{"goal": ["bca", "lsa"]}, *slow({"numbers": [11, 10], "goal": ["bca", "bca"]})],
)
def test_anatomies_in_another_order_or_with_other_goals_are_another_task(change):
    chosen = {"numbers": [10, 11], "goal": ["bca", *change["goal"][:1]]}
    first, second = (
        BatchSimulation(suite.make_task("arch_any", **options), 1, num_threads=1)
        for options in (chosen, {**chosen, **change})
    )
    first.reset()
    second.reset()
    snapshot = first.snapshot()
    with pytest.raises(ValueError, match="another task: its cases .*is"):
        second.restore(snapshot)
    for number in (-1, 2):  # of 0 and 1
        odd = {**snapshot.arrays, "rollout._case_of": np.array([number])}
        with pytest.raises(ValueError, match=rf"is of the anatomies \[{number}\]"):
            first.restore(dataclasses.replace(snapshot, arrays=odd))


@pytest.mark.parametrize(
    ("options", "key"),
    [
        ({"device": SOFT}, "devices"),
        ({"working_length": 0.205}, "links"),
        ({"sheath_clearance": 3.5e-4}, "sheath_clearance"),
        ({"physics_timestep": 0.002}, "timestep"),
    ],
)
def test_another_device_or_sheath_is_another_task(options, key):
    chosen = {"working_length": 0.2}
    batches = [
        BatchSimulation(suite.make_task("simple1_bca", **each), 1, num_threads=1)
        for each in (chosen, {**chosen, **options})
    ]
    for batch in batches:
        batch.reset()
    for mine, other in (batches, batches[::-1]):
        with pytest.raises(ValueError, match=f"another task: its {key} .*is"):
            mine.restore(other.snapshot())


def test_coaxial_devices_with_another_lead_are_another_task():
    mine, others = (
        suite.load("cathsim", "simple1_bca_pair", {"lead": lead})
        for lead in (0.02, 0.05)
    )
    mine.reset()
    others.reset()
    with pytest.raises(ValueError, match="another task: its lead is 0.02"):
        others.restore(mine.snapshot())


def test_blood_that_flows_is_no_blood_at_rest():
    batches = [
        BatchSimulation(suite.make_task("simple1_bca", vessel=each), 1, num_threads=1)
        for each in ("silicone", {"wall": True, "flow": True})
    ]
    for batch in batches:
        batch.reset()
    words = "other options: it .*same .* vessel", "split of the flow is None, here"
    for mine, other, said in zip(batches, batches[::-1], words, strict=True):
        with pytest.raises(ValueError, match=said):
            mine.restore(other.snapshot())


def test_simulations_are_kept_and_restored_in_ascending_order(task):
    batch = BatchSimulation(task(), 3, num_threads=1)
    batch.reset()
    snapshot = batch.snapshot(np.array([0, 2]))
    for wrong in ([2, 0], [0, 0]):
        with pytest.raises(ValueError, match=r"indices is \[\d, 0\].*ascending"):
            batch.restore(snapshot, wrong)
        with pytest.raises(ValueError, match="ascending"):
            batch.snapshot(wrong)
    batch.restore(snapshot, [0, 2])


def test_a_refused_snapshot_leaves_the_episode_as_it_is(task):
    one, other = (suite.environment(task(3)) for _ in range(2))
    for environment in (one, other):
        environment.reset()
        environment.step(np.ones(21))
    snapshot = one.snapshot()
    arrays = dict(snapshot.arrays)
    arrays["stepper.state"] = arrays["stepper.state"].copy()
    arrays["stepper.state"][0, -1] = np.inf
    with pytest.raises(ValueError, match="diverged"):
        one.restore(dataclasses.replace(snapshot, arrays=arrays))
    for _ in range(2):
        timesteps = one.step(np.ones(21)), other.step(np.ones(21))
    assert timesteps[0].reward == timesteps[1].reward


def test_a_step_that_diverges_does_so_again_from_its_snapshot(task):
    """As MuJoCo resets a simulation, it counts its warnings from one again."""
    single, batch = suite.environment(task()), BatchSimulation(task(), 1)
    for simulation, data in ((single, single.physics.data), (batch, batch.batch)):
        simulation.reset()
        data.qvel[...] = 2e4
        snapshot = simulation.snapshot()
        for _ in range(2):
            simulation.restore(snapshot)
            if simulation is single:
                simulation.step(np.zeros(21))
                assert simulation.task.error == DIVERGED
            else:
                assert simulation.step(np.zeros((1, 21))).errors == (DIVERGED,)


def test_a_stepper_without_snapshots_is_refused_by_name(task):
    batch = BatchSimulation(task(), 2, num_threads=1)
    batch.reset()
    batch.stepper.has_snapshots = False
    with pytest.raises(NotImplementedError, match=r"Stepper has no snapshots; simul"):
        batch.snapshot()


def test_a_damaged_file_is_refused(task, tmp_path, monkeypatch):
    environment = suite.environment(task())
    environment.reset()
    path = environment.snapshot().save(tmp_path / "state.npz")
    data = path.read_bytes()
    for place in np.linspace(0, len(data) - 1, 40).astype(int):
        changed = bytearray(data)
        changed[place] ^= 0xFF
        (tmp_path / "bad.npz").write_bytes(changed)
        try:
            loaded = Snapshot.load(tmp_path / "bad.npz")
        except ValueError as error:
            assert "bad.npz is no file of a snapshot" in str(error)
            assert "\n" not in str(error)
        else:  # a byte of the archive that says nothing of its content
            assert loaded.task == environment.snapshot().task
    np.savez(tmp_path / "bad.npz", meta=np.array([{}], object))
    with pytest.raises(ValueError, match="no file of a snapshot"):
        Snapshot.load(tmp_path / "bad.npz")
    meta, arrays = read_arrays(path, "snapshot")
    with pytest.raises(ValueError, match="a snapshot of format 1, not a recording of"):
        read_arrays(path, "recording")
    none = {name: array[:0] for name, array in arrays.items()}
    for bad, words in (
        ({**arrays, "more": np.zeros(2)}, "holds no snapshot: .* different numbers of"),
        (none, "holds no snapshot: .* different numbers of"),
        ({**arrays, "more": np.zeros(1, complex)}, "other than numbers and texts"),
    ):
        write_arrays(path, "snapshot", meta, bad)
        with pytest.raises(ValueError, match=words):
            Snapshot.load(path)
    older = dataclasses.replace(environment.snapshot(), versions={"mujoco": "1"})
    assert Snapshot.load(older.save(path)).versions == older.versions
    monkeypatch.setattr("cathsim_dmc.tasks.snapshot._FORMAT", 2)
    with pytest.raises(ValueError, match="it is a snapshot of format 1, not a .* 2"):
        Snapshot.load(path)
    with pytest.raises(FileNotFoundError):
        Snapshot.load(tmp_path / "none.npz")
    with pytest.raises(ValueError, match=r"must end in \.npz"):
        environment.snapshot().save(tmp_path / "state.txt")


def test_an_interrupted_step_can_be_put_back(task, monkeypatch):
    batch = BatchSimulation(task(), 2, num_threads=1)
    batch.reset()
    action = np.ones((2, 21))
    batch.step(action)
    snapshot, expected = batch.snapshot(), copy.copy(batch.step(action).distance)
    with monkeypatch.context() as patch:
        patch.setattr(batch.stepper, "run", lambda: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            batch.step(action)
    with pytest.raises(RuntimeError, match="no episode to keep"):
        batch.snapshot()
    batch.restore(snapshot)
    np.testing.assert_array_equal(batch.step(action).distance, expected)


def test_an_anatomy_of_the_same_name_is_another_one(monkeypatch):
    def environment(shrunk):
        made = suite.make_task("simple1_bca")
        if shrunk:
            made.scene.anatomy.__dict__["digest"] = "0" * 8
        return suite.environment(made)

    one, other = environment(False), environment(True)
    one.reset()
    one.restore(one.snapshot())
    other.reset()
    with pytest.raises(ValueError, match="of another task: its anatomies"):
        other.restore(one.snapshot())


def test_the_digest_of_an_anatomy_is_that_of_its_lumen():
    tree = suite.load_anatomy("simple1").tree
    (name, vessel), *_ = tree.vessels.items()
    line = dataclasses.replace(vessel.centreline, radii=0.99 * vessel.centreline.radii)
    wide = dataclasses.replace(vessel, centreline=line)
    narrow = VesselTree({**tree.vessels, name: wide})
    same = [Anatomy.from_tree(each).digest for each in (tree, tree, narrow)]
    assert same[0] == same[1] != same[2]


def test_paths_of_any_number_of_points_fit():
    def snapshot(points, axes):
        arrays = {"paths*": np.zeros((1, points, axes))}
        return Snapshot({}, {"stepper.state": np.zeros((1, 2)), **arrays})

    snapshot(2, 3).require(snapshot(4, 3))
    with pytest.raises(ValueError, match=r"of another model: paths\* .*\(-1, 2\)"):
        snapshot(2, 2).require(snapshot(4, 3))


def test_a_state_of_any_kind_comes_back_to_its_simulations():
    def values(seed):
        made = np.random.RandomState(seed)
        made.normal()  # another number of the pair is kept
        sources = [np.random.RandomState(5), made]
        lines = [made.normal(size=(2, 3)), made.normal(size=(4, 3))]
        return {
            "array": made.normal(size=(2, 3)), "lines": lines, "sources": sources,
            "texts": ("", "a", None)[seed : seed + 2], "none": None,
        }  # fmt: skip

    rows, first, second = np.arange(2), values(0), values(1)
    wanted, arrays = values(1), packed("state", second, rows)
    kept = first["array"].copy(), first["array"]
    found = restored("state", first, arrays, rows)
    np.testing.assert_array_equal(*kept)
    np.testing.assert_array_equal(found["array"], wanted["array"])
    for mine, other in zip(found["lines"], wanted["lines"], strict=True):
        np.testing.assert_array_equal(mine, other)
    assert found["texts"] == ("a", None) and found["none"] is None
    for mine, other in zip(first["sources"], wanted["sources"], strict=True):
        assert mine.normal() == other.normal()


@pytest.mark.parametrize("value", [[1.0], 1.0, np.zeros(3), np.array([None])])
def test_a_state_that_cannot_be_kept_is_refused(value):
    class Odd(Effect):
        state = ("numbers",)
        numbers = value

    task = suite.make_task("simple1_bca", effects=[Odd()])
    with pytest.raises(ValueError, match="'numbers' of Odd is .*each of the 1 simul"):
        suite.environment(task)


def test_a_state_that_an_effect_does_not_have_is_refused():
    class Odd(Effect):
        state = ("numbers",)

    task = suite.make_task("simple1_bca", effects=[Odd()])
    with pytest.raises(ValueError, match="'numbers' of Odd is missing; it must be an"):
        suite.environment(task)


def test_a_state_that_becomes_another_kind_is_refused():
    class Odd(Counter):
        state = ("count",)

        def act(self, action, state):
            self.count = 1.0
            return action

    environment = suite.environment(suite.make_task("simple1_bca", effects=[Odd()]))
    environment.reset()
    environment.snapshot()
    environment.step(np.zeros(21))
    with pytest.raises(ValueError, match="'count' of Odd is 1.0; it must be an"):
        environment.snapshot()


def test_effects_that_differ_are_named(task):
    environment = suite.environment(task())
    other = suite.environment(suite.make_task("simple1_bca", effects=[Counter()]))
    environment.reset()
    other.reset()
    said = r"its effects from number \d on is \[\['Counter'\], .*, here it is \[\['Sing"
    with pytest.raises(ValueError, match=said):
        environment.restore(other.snapshot())


def test_a_file_of_another_kind_is_told_from_a_damaged_one(tmp_path):
    np.savez(tmp_path / "other.npz", a=np.zeros(3))
    with pytest.raises(ValueError, match="no checksum, so it is a file of another"):
        Snapshot.load(tmp_path / "other.npz")
