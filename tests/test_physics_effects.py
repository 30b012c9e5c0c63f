"""Effects of one's own, compiled and in arrays, in both paths and on any threads."""

import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from conftest import twin

from cathsim_dmc import suite
from cathsim_dmc.physics.effects import Effect, of_kind
from cathsim_dmc.simulation.batch import BatchSimulation
from cathsim_dmc.tasks.config import NavigationConfig

sys.path.insert(0, str(Path(__file__).parents[1] / "examples"))
from side_wind import SideWind

WIND = np.array([0.02, -0.05, 0.1])  # N/m
STEPS = 12
TASK = "type1_lcca"


class WindInArrays(Effect):
    """The same wind, written once in a control step."""

    data_fields = ("xfrc_applied",)

    def act(self, action, state):
        world = self.world
        lengths = world.chain.link_lengths
        world.arrays.xfrc_applied[:, world.index.links, :3] = lengths[:, None] * WIND
        return action


@pytest.fixture(scope="module")
def windy():
    """Returns a function that makes a task in the wind, of one scene for each name."""
    tasks = {}

    def make(name, effect=SideWind):
        key = (name, effect)
        if key not in tasks:
            effects = [effect(WIND) if effect is SideWind else effect()]
            tasks[key] = suite.make_task(name, effects=effects)
        return twin(tasks[key])

    return make


class Stiffer(Effect):
    """A device of another stiffness, in every second simulation."""

    model_fields = ("jnt_stiffness",)

    def restart(self, index, episode, random_state):
        self.world.field(index, "jnt_stiffness")[:] *= 1.0 + 2.0 * (index % 2)


def actions(count):
    return np.random.default_rng(0).uniform(-1, 1, (STEPS, count))


@pytest.mark.parametrize("clearance", [None, 0.35e-3])
def test_an_effect_makes_the_device_stiffer(clearance):
    """Held in the sheath or in a bore, and again in the next episode."""
    task = suite.make_task("type1_bca", effects=[Stiffer()], sheath_clearance=clearance)
    simulation = BatchSimulation(task, 2, num_threads=1)
    push = np.zeros((2, task.num_actions))
    push[:, -1] = 1.0
    for _ in range(2):
        simulation.seed([0, 0])
        simulation.reset()
        forces = []
        for _ in range(30):
            simulation.step(push)
            forces.append(simulation.contacts().magnitude.sum(axis=1))
        soft, stiff = np.mean(forces, axis=0)
        assert stiff == pytest.approx(3.0 * soft, rel=0.1)


def simulate(task, count, threads=1):
    """Joint positions (STEPS, N, nq) and the forces (N, nbody, 6) at the end."""
    batch = BatchSimulation(task, count, num_threads=threads, seeds=4)
    batch.reset()
    seen = []
    for action in actions(batch.num_actions):
        batch.step(np.tile(action, (count, 1)))
        seen.append(batch.batch.qpos.copy())
    return np.array(seen), batch.batch.xfrc_applied.copy()


def test_the_wind_has_its_size_and_direction(windy):
    task = windy("simple1_bca")
    positions, forces = simulate(task, 1)
    environment = suite.environment(twin(task))
    total = task.scene.catheter.link_lengths.sum()
    np.testing.assert_allclose(forces[0, :, :3].sum(0), WIND * total, rtol=1e-12)
    lengths = task.scene.catheter.link_lengths[:2, None]
    first = environment.task.rollout.index.links.start
    own = forces[0, first : first + 2, :3]
    np.testing.assert_allclose(own, WIND * lengths, rtol=1e-12)
    assert not forces[..., 3:].any()


@pytest.mark.parametrize("name", ["simple1_bca", "simple1_bca_pair"])
def test_an_effect_acts_alike_in_both_paths_and_on_threads(windy, name):
    task = windy(name)
    one, _ = simulate(twin(task), 2, threads=1)
    two, _ = simulate(twin(task), 2, threads=2)
    np.testing.assert_array_equal(one, two)
    environment = suite.environment(twin(task, 5))
    environment.reset()
    for action, expected in zip(actions(task.num_actions), one, strict=True):
        environment.step(action)
        np.testing.assert_array_equal(environment.physics.data.qpos, expected[1])


def test_arrays_once_a_control_step_and_compiled_forces_agree(windy):
    compiled, _ = simulate(windy("simple1_bca"), 2)
    arrays, _ = simulate(windy("simple1_bca", WindInArrays), 2)
    np.testing.assert_array_equal(compiled, arrays)


# What one who builds a scene without this package may have in `userdata` and `solimp`.
_FOREIGN = """
import mujoco, numpy as np, sys
sys.path.insert(0, "examples")
from side_wind import SideWind
from cathsim_dmc import suite

scene = '''
<mujoco>
  <size nuserdata="8"/>
  <worldbody>
    <geom type="plane" size="1 1 1" solimp="0.7 0.95 0.003" solref="-2000 -20"/>
    <body pos="0.1 0 0.09"><freejoint/><geom size="0.1" solimp="0.7 0.95 0.003"/></body>
    <body pos="-.3 0 0.2"><freejoint/><geom type="capsule" size="0.02 0.1"/></body>
  </worldbody>
</mujoco>
'''


def run(values):
    model = mujoco.MjModel.from_xml_string(scene)
    data, seen = mujoco.MjData(model), []
    data.userdata[:] = values
    data.xfrc_applied[1, 0] = 0.1
    for _ in range(300):
        mujoco.mj_step(model, data)
        seen += [data.qpos.copy(), data.xfrc_applied.ravel(), data.userdata.copy()]
    return np.concatenate(seen)


rows = []
numbers = (-2.0, -1000.0, np.nan, 1e30, 1843.0, 2718.0, 2947.0, 2.0)
for value in numbers:
    for place in (1, slice(None)):
        row = np.zeros(8)
        row[place] = value
        rows.append(row)
rows += [np.array([1, 4, 2947, 1e9, -5, 7, 1, first]) for first in numbers]
before = [run(row) for row in rows]
options = {"vessel": "living", "effects": [SideWind((0, 0, 0.1))]}
environment = suite.load("cathsim", "simple1_bca", options)
environment.reset()
suite.load("cathsim", "femoral_type1_lcca_wire", {}).reset()
for row, expected in zip(rows, before, strict=True):
    np.testing.assert_array_equal(run(row), expected)
"""


def ended(script, *arguments, timeout=300):
    """Standard error of a script that must end by itself, without an error."""
    done = subprocess.run(
        [sys.executable, "-c", script, *arguments],
        capture_output=True,
        text=True,
        timeout=timeout,
        cwd=Path(__file__).parents[1],
    )
    assert done.returncode == 0, (done.returncode, done.stderr)
    return done.stderr


@pytest.mark.slow
def test_other_models_are_left_alone_whatever_their_numbers():
    ended(_FOREIGN)


_LOST = """
import ctypes, sys, mujoco, numpy as np
sys.path.insert(0, "examples")
from side_wind import SideWind
from cathsim_dmc import suite

options = {"vessel": "living", "effects": [SideWind((0, 0, 0.1))], "random": 3}
action = np.zeros(21)


def run(environment):
    environment.reset()
    for _ in range(8):
        environment.step(action)
    data = environment.physics.data
    return np.concatenate([data.qpos, data.xfrc_applied.ravel()])


expected = run(suite.load("cathsim", "simple1_bca", options))
environment = suite.load("cathsim", "simple1_bca", options)
for name in ("mjcb_passive", "mjcb_control"):
    change = getattr(mujoco, f"set_{name}")
    change(lambda model, data: None)
    try:
        environment.reset()
    except RuntimeError as error:
        assert f"mujoco.set_{name}(None), then" in str(error), error
    else:
        raise AssertionError(f"{name}: a Python function was not noticed")
    change(None)
    again = suite.load("cathsim", "simple1_bca", options)
    np.testing.assert_array_equal(run(again), expected)
    change(None)
    again = suite.load("cathsim", "simple1_bca", options)
    again.reset()
    change(None)
    again.reset()
    assert getattr(mujoco, f"get_{name}")() is not None
"""


@pytest.mark.slow
def test_callbacks_that_were_removed_are_put_back_or_missed():
    ended(_LOST)


def test_an_error_of_a_law_in_a_reset_is_that_of_the_reset(windy):
    class Astray(SideWind):
        acts_in = "passive"

        @staticmethod
        def law(wind, time, device):
            wind.lengths[int(wind.force_per_length[0])] += 1.0

    wrong, right = (
        suite.environment(twin(windy("simple1_bca"), effects=[Astray((place, 0, 0))]))
        for place in (1e6, 0)
    )
    right.reset()
    with pytest.raises(RuntimeError, match="an index beyond"):
        wrong.reset()
    right.step(np.zeros(21))
    batch = BatchSimulation(
        twin(windy("simple1_bca"), effects=[Astray((1e6, 0, 0))]), 1
    )
    with pytest.raises(RuntimeError, match="an index beyond"):
        batch.reset()
    right.step(np.zeros(21))


@pytest.mark.parametrize("place", [100, 10**8, -(10**8)])
def test_an_index_beyond_the_bodies_is_an_error_and_writes_nothing(windy, place):
    class Astray(SideWind):
        @staticmethod
        def law(wind, time, links):
            links.xfrc_applied[place, 0] = 1.0

    task = twin(windy("simple1_bca"), effects=[Astray(WIND)])
    environment = suite.environment(task)
    environment.reset()
    with pytest.raises(RuntimeError, match=r"law of .*Astray.*an index beyond"):
        environment.step(np.zeros(21))
    batch = BatchSimulation(twin(task), 2, num_threads=2)
    batch.reset()
    with pytest.raises(RuntimeError, match="an index beyond"):
        batch.step(np.zeros((2, 21)))


_CHAIN = """
import ctypes, mujoco, sys
from cathsim_dmc.physics import dispatcher
calls = []
def before(model, data):
    calls.append(data)
kind = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_void_p)
before_c = kind(before)
mujoco.set_mjcb_control(before if "python" in sys.argv else before_c)
dispatcher.stand()
model = mujoco.MjModel.from_xml_string("<mujoco/>")
data = mujoco.MjData(model)
calls.clear()
mujoco.mj_step(model, data)
assert calls == [data._address]
own = mujoco.get_mjcb_control()
mujoco.set_mjcb_control(before_c)  # which removes all that stood there
dispatcher.stand()
calls.clear()
mujoco.mj_step(model, data)
assert calls == [data._address]
assert mujoco.get_mjcb_control() is not before_c
def after(model, data):
    own(model, data)
after_c = kind(after)
mujoco.set_mjcb_control(after_c)  # which calls what stood there
dispatcher.stand()
standing = ctypes.cast(mujoco.get_mjcb_control(), ctypes.c_void_p).value
assert standing == ctypes.cast(after_c, ctypes.c_void_p).value
"""


@pytest.mark.parametrize("kind", ["c", "python"])
def test_what_stood_in_mujoco_before_is_still_called(kind):
    done = subprocess.run(
        [sys.executable, "-c", _CHAIN, kind], capture_output=True, text=True
    )
    if kind == "c":
        assert done.returncode == 0, done.stderr
    else:
        assert "compiled functions cannot call" in done.stderr


class _Vague(NamedTuple):
    """Parameters with another default than an array."""

    force: float = 1.0


def test_what_is_no_effect_is_refused(windy):
    with pytest.raises(ValueError, match=r"effects.*physics\.effects\.Effect"):
        suite.make_task("simple1_bca", effects=[3])
    lost = SideWind(WIND)
    lost.acts_in = "actuators"
    with pytest.raises(ValueError, match="SideWind.acts_in.*passive, control, contact"):
        suite.load("cathsim", "simple1_bca", {"effects": [lost]})
    short = SideWind(WIND)
    short.law = lambda wind: None
    with pytest.raises(ValueError, match="compile SideWind.law, a function of param"):
        suite.load("cathsim", "simple1_bca", {"effects": [short]})
    for kind, words in ((dict, "a NamedTuple"), (_Vague, "a NamedTuple")):
        short.parameters = kind
        with pytest.raises(ValueError, match=words):
            suite.make_task("simple1_bca", effects=[short])
    silent = suite.environment(windy("simple1_bca"))
    silent.reset()
    silent.task.rollout.effects[-2].act = lambda action, state: None
    with pytest.raises(ValueError, match="act of SideWind returns None"):
        silent.step(np.zeros(21))
    with pytest.raises(ValueError, match="build it with the same configuration"):
        suite.environment(twin(windy("simple1_bca"), effects=()))


class Uncompiled(SideWind):
    """A law that asks what numba does not know."""

    @staticmethod
    def law(wind, time, links):
        links.xfrc_applied[0, 0] += wind.no_such_parameter


def test_a_law_that_numba_refuses_is_named_in_one_line():
    with pytest.raises(ValueError, match=r"Uncompiled.*no_such_parameter") as found:
        suite.load("cathsim", "simple1_bca", {"effects": [Uncompiled((0, 0, 1))]})
    text = str(found.value)
    assert text.startswith("numba cannot compile") and "\n" not in text


class Counting(Effect):
    """Counts control steps in an array that it is given."""

    def __init__(self):
        self.count, self.limits = np.zeros(1), np.ones(1)
        self.limits.flags.writeable = False

    def act(self, action, state):
        self.count += 1
        return action


def test_environments_do_not_share_the_arrays_of_an_effect():
    given = Counting()
    config = NavigationConfig(effects=[given])
    chain = suite.make_task("simple1_bca").scene.catheter
    one, other = (of_kind(config.effects_on(chain), Counting) for _ in range(2))
    one.act(None, None)
    assert (one.count, other.count, given.count) == (1, 0, 0)
    assert one.limits is given.limits


class Gain(Effect):
    """Actuation with a wrong gain, which writes into what it gets."""

    def act(self, action, state):
        action *= 3.0
        return action


def test_drives_get_no_more_than_the_largest_action():
    """Else they would catch up with the rest once the command is 0."""
    plain = BatchSimulation(suite.make_task(TASK), 1)
    gained = BatchSimulation(suite.make_task(TASK, effects=[Gain()]), 1)
    plain.reset(), gained.reset()
    push = np.zeros((1, plain.num_actions))
    for push[:, -1] in 6 * [1.0] + 3 * [-1.0]:
        one, other = plain.step(push), gained.step(push)
        assert gained.rollout._action[0, -1] == push[0, -1]
        np.testing.assert_array_equal(other.readings.head, one.readings.head)


@pytest.mark.parametrize(
    "given",
    [None, np.zeros((1, 3)), 0.0, np.full((1, 21), np.nan), np.zeros((1, 21), complex)],
)
def test_an_action_of_another_kind_is_refused(given):
    class Wrong(Effect):
        def act(self, action, state):
            return given

    batch = BatchSimulation(suite.make_task(TASK, effects=[Wrong()]), 1)
    batch.reset()
    with pytest.raises(ValueError, match="act of Wrong returns"):
        batch.step(np.zeros((1, batch.num_actions)))


@pytest.mark.parametrize(
    ("task", "when", "message"),
    [
        ("type1_lcca_pair", "model_fields", "of coaxial devices, a field.*friction"),
        ("type1_lcca", "step_fields", "in act.*restart"),
    ],
)
def test_fields_that_the_device_writes_over_are_refused(task, when, message):
    class Stiff(Effect):
        model_fields = ("jnt_stiffness",)

    setattr(Stiff, when, ("jnt_stiffness",))
    with pytest.raises(ValueError, match=f"Stiff writes jnt_stiffness {message}"):
        BatchSimulation(suite.make_task(task, effects=[Stiff()]), 1)
    if task == "type1_lcca":  # where a bore holds the device, it stays
        BatchSimulation(
            suite.make_task(task, effects=[Stiff()], sheath_clearance=0.35e-3), 1
        )


def test_a_field_that_no_effect_declares_is_refused(shared_environment):
    class Heavier(Effect):
        def restart(self, index, episode, random_state):
            self.world.field(index, "body_mass")[:] *= 2.0

    task = shared_environment("type1_lcca").task
    env = suite.environment(twin(task, effects=[Heavier()]))
    with pytest.raises(ValueError, match="body_mass, .* model_fields; name it there"):
        env.reset()
    env.close()


def test_a_law_with_self_is_refused():
    class Pulled(Effect):
        def law(self, parameters, time, links):
            links.xfrc_applied[0, 0] += 1.0

    with pytest.raises(ValueError, match=r"Pulled.law is a method.*@staticmethod"):
        suite.load("cathsim", "simple1_bca", {"effects": [Pulled()]})
