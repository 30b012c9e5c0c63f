"""What the host does around the physics steps on a device, with a device that fakes."""

import importlib.util

import numpy as np
import pytest

from cathsim_dmc import suite
from cathsim_dmc.simulation.warp import stepper as module
from cathsim_dmc.simulation.warp.reduction import Totals
from cathsim_dmc.simulation.warp.simulation import WarpSimulation

needs_warp = pytest.mark.skipif(
    importlib.util.find_spec("mujoco_warp") is None, reason="needs the extra gpu"
)


class Worlds:
    """Takes the place of `worlds.Worlds`; moves all joints by 0.01 m or rad."""

    def __init__(self, device, model, own, laws, substeps):
        laws[0]._walls = ()  # as `bind` does
        self.whole, self.closed, self.written = [], False, []
        self.diverged, self.lost = np.zeros(3), np.zeros(3)

    def write_model(self, own, names):
        self.written.append(set(names))

    def write(self, arrays, whole):
        self.whole.append(whole)

    def step(self):
        pass

    def read(self, arrays, names):
        arrays.qpos += 0.01
        arrays.qpos[self.diverged != 0] = np.nan
        force = np.tile(np.arange(7.0)[:, None], 3) + [0.0, 10.0, 20.0]
        return Totals(force, self.diverged, self.lost, np.zeros((3, 0)))

    def close(self):
        self.closed = True


@pytest.fixture
def simulation(monkeypatch):
    monkeypatch.setattr(module, "Worlds", Worlds)
    made = WarpSimulation(suite.make_task("type1_lcca"), 3, device="cpu")
    made.reset()
    return made


def stepped(simulation, diverged=(0, 0, 0), lost=(0, 0, 0)):
    """Does a control step without its end; returns the positions before it."""
    stepper = simulation.stepper
    stepper.begin(np.zeros_like(stepper.arrays.ctrl))
    if (worlds := stepper._worlds) is not None:
        worlds.diverged, worlds.lost = np.array(diverged), np.array(lost)
    before = stepper.arrays.qpos.copy(), stepper.arrays.time.copy()
    stepper.run()
    return before


@needs_warp
def test_only_worlds_that_diverge_are_restored(simulation):
    stepper = simulation.stepper
    stepped(simulation)
    qpos, time = stepped(simulation, diverged=(0, 1, 0), lost=(1, 0, 0))
    moved = stepper.arrays.qpos - qpos
    np.testing.assert_allclose(moved[[0, 2]], 0.01)
    np.testing.assert_array_equal(moved[1], 0.0)
    np.testing.assert_allclose(stepper.arrays.time - time, [0.04, 0, 0.04])
    assert stepper.warnings.ravel().tolist() == [0, 1, 0]
    assert stepper.lost.tolist() == [1, 0, 0]
    assert stepper._on_device.tolist() == [True, False, True]
    # The device gets the restored state, and that of the next step by itself.
    stepped(simulation), stepped(simulation, lost=(1, 0, 1))
    assert stepper._worlds.whole == [True, False, True, False]
    assert stepper.lost.tolist() == [2, 0, 1]


@needs_warp
def test_what_the_host_changes_goes_to_the_device(simulation):
    stepper = simulation.stepper
    for _ in range(2):
        stepped(simulation)
    states = stepper.states(np.array([2]))
    stepper.set_states(np.array([2]), states)
    stepped(simulation)
    simulation.reset(np.array([1]))
    stepped(simulation)
    stepper._refine(np.array([0]), 2)
    stepped(simulation), stepped(simulation)
    assert stepper._worlds.whole == [True, False, True, True, True, False]
    # A field of the model, once; what effects write in each step, in each.
    each = stepper._each_step
    stepper._expand(["geom_friction"])
    stepper.field(0, "geom_friction")[:] = 1.0
    stepper._worlds.written.clear()
    stepped(simulation), stepped(simulation)
    assert stepper._worlds.written == [{"geom_friction"} | each, each]
    with pytest.raises(KeyError, match="geom_pos"):
        stepper.field(0, "geom_pos")
    # Without the arrays of the device, it all begins anew.
    worlds = stepper._worlds
    stepper.close()
    stepped(simulation)
    assert worlds.closed and stepper._worlds.whole == [True]


@needs_warp
def test_forces_of_a_control_step_are_means_where_they_say_so(simulation):
    stepper = simulation.stepper
    stepped(simulation)
    force, depth = stepper._forces()
    assert force.sum.tolist() == [0, 10, 20] and depth.tolist() == [6, 16, 26]
    np.testing.assert_allclose(force.mean_sum, np.array([4, 14, 24]) / 10)
    np.testing.assert_allclose(force.mean_max, np.array([5, 15, 25]) / 10)
    # A world that is reset has the force of its start, the others keep theirs.
    stepper.still(np.array([1]))
    np.testing.assert_array_equal(stepper._force[:, 1], 0.0)
    assert stepper._forces()[0].sum.tolist() == [0, 0, 20]


@needs_warp
def test_a_state_is_written_and_read_back(simulation):
    stepper = simulation.stepper
    stepped(simulation)
    before = stepper.states()
    random = np.random.RandomState(0)
    for name in ("qpos", "qvel", "act", "ctrl", "userdata", "qfrc_applied"):
        array = getattr(stepper.arrays, name)
        array[:] = random.uniform(-1, 1, array.shape)
    own = stepper.states()
    assert (own != before).any(axis=1).all()
    stepper.set_states(np.array([0, 2]), before[[0, 2]])
    after = stepper.states()
    np.testing.assert_array_equal(after[[0, 2]], before[[0, 2]])
    np.testing.assert_array_equal(after[1], own[1])
    np.testing.assert_array_equal(stepper.states(np.array([1])), own[[1]])
