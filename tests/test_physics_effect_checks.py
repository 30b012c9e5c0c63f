"""Wrong effects of a user are refused by name."""

import collections
import logging
from typing import Any, NamedTuple

import numpy as np
import pytest
from conftest import twin

from cathsim_dmc import suite
from cathsim_dmc.laws.parameters import Array
from cathsim_dmc.physics.effects import Effect
from cathsim_dmc.simulation.batch import BatchSimulation

TASK = "simple1_bca"


class Push(NamedTuple):
    force: Any = Array(3)  # N


class Pushed(Effect):
    """A force on the first link."""

    parameters = Push
    model_fields = ("geom_friction",)
    state = ("steps",)
    force: Any = 0.0
    friction = 0.1

    def bind(self, world):
        self.steps = np.zeros(world.num_simulations)

    def restart(self, index, episode, random_state):
        self.world.parameters.force[index] = self.force
        self.world.field(index, "geom_friction")[:, 0] = self.friction

    def conditions(self, index):
        return {"push.force": float(self.force)}

    @staticmethod
    def law(push, time, links):
        links.xfrc_applied[0, 0] += push.force[0]


def of(name, **own):
    """A variant of the effect with other members."""
    return type(name, (Pushed,), own)()


def make(**own):
    return suite.make_task(TASK, effects=[of("Odd", **own)])


def test_a_right_effect_is_accepted():
    """`bind` need not call that of the base class, which sets nothing."""
    batch = BatchSimulation(make(force=0.01), 2, num_threads=1)
    batch.reset()
    batch.step(np.zeros((2, 21)))
    assert batch.conditions[1].effects["push.force"] == 0.01


@pytest.mark.parametrize(
    ("own", "words"),
    [
        ({"state": "steps"}, r"state of Odd is 'steps'.*tuple of names.*'_speed'"),
        ({"model_fields": "qpos0"}, r"model_fields of Odd is 'qpos0'.*tuple of names"),
        ({"data_fields": (1,)}, r"data_fields of Odd is \(1,\).*tuple of names"),
        ({"data_fields": ("qposs",)}, r"has 'qposs', but mujoco.MjData.*are qpos"),
        (
            {"model_fields": ("geom_fricton",)},
            r"'geom_fricton', but mujoco.MjModel has no array.*similar are geom_frict",
        ),
        ({"model_fields": ("opt",)}, r"'opt', but mujoco.MjModel has no array"),
        (
            {"step_fields": ("geom_solref",)},
            "step_fields of Odd has geom_solref",
        ),
    ],
)
def test_wrong_declarations_are_refused_before_anything_is_built(own, words):
    with pytest.raises(ValueError, match=words):
        make(**own)


@pytest.mark.parametrize("length", [3.0, -3, 0])
def test_an_array_of_no_length_is_refused(length):
    kind = collections.namedtuple("Odd", ["force"], defaults=[Array(length)])
    with pytest.raises(ValueError, match=f"Odd has arrays of .*{length}.*whole"):
        make(parameters=kind)


@pytest.mark.parametrize(
    ("own", "words"),
    [
        ({"force": np.nan}, "parameter force of Odd, at the start of an episode"),
        ({"friction": np.inf}, "geom_friction, written by Odd, at the start of an ep"),
    ],
)
def test_what_is_not_finite_at_the_start_is_refused_in_the_reset(own, words):
    batch = BatchSimulation(make(**own), 2, num_threads=1)
    with pytest.raises(ValueError, match=words):
        batch.reset()


@pytest.mark.parametrize("found", [None, {"a": np.ones(3)}, {1: 0.0}, {"a": np.nan}])
def test_conditions_that_are_no_numbers_are_refused(found):
    environment = suite.environment(make(conditions=lambda self, index: found))
    environment.reset()
    with pytest.raises(ValueError, match="conditions of Odd"):
        _ = environment.task.conditions


class Diluted(Pushed):
    @staticmethod
    def law(push, time, links):
        links.xfrc_applied[0, 0] += push.force[0] / push.force[1]


class Hurled(Pushed):
    @staticmethod
    def law(push, time, links):
        links.xfrc_applied[5, 0] += 1e9
        if time > 0.0:
            links.xfrc_applied[0, 0] += np.nan


class Returning(Pushed):
    @staticmethod
    def law(push, time, links):
        return links.xfrc_applied[:, 0] + push.force[0]


def test_a_law_that_writes_nan_is_an_error():
    """MuJoCo's solver may keep its last solution, and nothing shows."""
    task = suite.make_task(TASK, effects=[Diluted()])
    environment = suite.environment(task)
    environment.reset()
    batch = BatchSimulation(twin(task), 2, num_threads=1)
    batch.reset()
    words = "the law of Diluted writes a number that is not finite"
    with pytest.raises(RuntimeError, match=words):
        environment.step(np.zeros(21))
    with pytest.raises(RuntimeError, match=words):
        batch.step(np.zeros((2, 21)))


def test_a_law_that_writes_nan_where_the_physics_diverges_ends_the_episode(caplog):
    environment = suite.environment(suite.make_task(TASK, effects=[Hurled()]))
    environment.reset()
    with caplog.at_level(logging.ERROR):
        timestep = environment.step(np.zeros(21))
    assert timestep.last() and timestep.discount == 0.0
    assert "the law of Hurled writes a number that is not finite" in caplog.messages


def test_a_law_that_returns_its_force_is_refused():
    task = suite.make_task(TASK, effects=[Returning()])
    with pytest.raises(ValueError, match="Returning.law.*the law returns a value"):
        suite.environment(task)
