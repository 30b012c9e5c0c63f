"""Effects of one's own, compiled and in arrays, in both paths and on any threads."""

import subprocess
import sys
from pathlib import Path

import mujoco
import numpy as np
import pytest
from conftest import twin

from cathsim_dmc import suite
from cathsim_dmc.physics import shape_loops
from cathsim_dmc.physics.effects import Effect
from cathsim_dmc.simulation.batch import BatchSimulation

sys.path.insert(0, str(Path(__file__).parents[1] / "examples"))
from side_wind import SideWind

WIND = np.array([0.02, -0.05, 0.1])  # N/m
STEPS = 12


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


def actions(count):
    return np.random.default_rng(0).uniform(-1, 1, (STEPS, count))


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


def test_other_models_are_left_alone(windy):
    spring = """
    <mujoco>
      <size nuserdata="9"/>
      <worldbody><body><freejoint/><geom size="0.1"/></body></worldbody>
    </mujoco>
    """
    windy("simple1_bca")
    shape_loops.install()
    model = mujoco.MjModel.from_xml_string(spring)
    data = mujoco.MjData(model)
    data.xfrc_applied[1], data.userdata[:] = 1.0, -2.0
    mujoco.mj_step(model, data)  # which would not end, were -2 taken for a count
    np.testing.assert_array_equal(data.xfrc_applied[1], 1.0)


_CHAIN = """
import ctypes, mujoco, sys
from cathsim_dmc.physics import callbacks
calls = []
def before(model, data):
    calls.append(data)
kind = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_void_p)
before_c = kind(before)
mujoco.set_mjcb_control(before if "python" in sys.argv else before_c)
callbacks.install(lambda parameters, time, bodies: None)
model = mujoco.MjModel.from_xml_string("<mujoco/>")
data = mujoco.MjData(model)
calls.clear()
mujoco.mj_step(model, data)
assert calls == [data._address]
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


def test_what_is_no_effect_is_refused(windy):
    with pytest.raises(ValueError, match=r"effects.*physics\.effects\.Effect"):
        suite.make_task("simple1_bca", effects=[3])
    idle = SideWind(WIND)
    idle.num_parameters = lambda chain: 0
    with pytest.raises(ValueError, match="SideWind has forces.*would not be called"):
        suite.load("cathsim", "simple1_bca", {"effects": [idle]})
    silent = suite.environment(windy("simple1_bca"))
    silent.reset()
    silent.task.rollout._effects[-2].act = lambda action, state: None
    with pytest.raises(ValueError, match="act of SideWind returns None"):
        silent.step(np.zeros(21))
    with pytest.raises(ValueError, match="build it with the same configuration"):
        suite.environment(twin(windy("simple1_bca"), effects=()))
