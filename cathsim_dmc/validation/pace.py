"""Speed of the simulator on one core, and its checks.

Real-time factor: simulated seconds per CPU second of this process, one thread. It
depends on the machine, so the checks bound the calibrated speed: the real-time factor
times the microseconds of one `mj_step` of dm_control's humanoid, timed in alternation.
Every value is the median of repeated runs after a warm-up. `speed.py` measures more:
threads, images, stages, memory; it is a script of the source tree, in benchmarks.
"""

import copy
import dataclasses
import functools
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import mujoco
import numpy as np
from dm_control import composer

from cathsim_dmc import suite
from cathsim_dmc.policies import in_environment, make_policy
from cathsim_dmc.tasks.config import CONTROL_TIMESTEP
from cathsim_dmc.validation.checks import Check, Report

RUNS = 5
STEPS = 150  # control steps, after which a push is in the branch
RATIOS = 24  # runs for the overhead ratio
# A curved arch, and the straight idealised one for comparison.
SCENES = ("type1_bca", "simple1_bca")
# Least calibrated speed of each policy on each of them, µs.
BARS = {"push": (150.0, 280.0), "random": (420.0, 850.0), "curl": (220.0, 280.0)}
MOST_OVERHEAD = 1.25  # time of a suite step divided by that of its mj_step calls
NEVER = 1e-6  # m, goal radius that no policy reaches
_WARM_STEPS = 1000  # of the humanoid, 5 s, after which it lies on the floor
_TIMED_STEPS = 2000  # of the humanoid


@dataclasses.dataclass(frozen=True, eq=False)
class Pace:
    """Speed of one episode.

    Attributes:
        insertion: (T,), m, after each control step.
        seconds: (T,), CPU seconds of each control step.
        contacts: (T,), contacts with the wall at the end of each control step.
    """

    insertion: np.ndarray
    seconds: np.ndarray
    contacts: np.ndarray

    @property
    def factor(self) -> float:
        """Real-time factor of the whole episode."""
        return len(self.seconds) * CONTROL_TIMESTEP / self.seconds.sum()


def speed(say: Callable[[str], None] = lambda text: None) -> Report:
    """Report of the calibrated speeds and of the overhead of a suite step."""
    say("real-time factors")
    checks, calibration = calibrated_speeds()
    say("overhead")
    for policy in ("random", "push"):
        runs = suite_overhead(policy)
        low, middle, high = np.quantile(runs, [0.25, 0.5, 0.75])
        name = f"suite step / mj_step, {policy}"
        note = f"quartiles {low:.2f}–{high:.2f}"
        checks.append(Check.at_most(name, float(middle), MOST_OVERHEAD, "x", note))
    return Report("speed, one core", checks, {"calibration": calibration})


def calibrated_speeds() -> tuple[list[Check], dict[str, dict[str, dict[str, float]]]]:
    """Checks of the calibrated speeds, and their two factors by scene and policy.

    Runs of the scenes and the humanoid alternate, which cancels a drift of the
    machine's speed.
    """
    environments = [load(scene) for scene in SCENES]
    checks, table = [], {scene: {} for scene in SCENES}
    for policy, bars in BARS.items():
        for environment in environments:
            pace(environment, policy, STEPS)
        humanoid, paces = [humanoid_step()], [[] for _ in SCENES]
        for _ in range(RUNS):
            for environment, runs in zip(environments, paces, strict=True):
                one = pace(environment, policy, STEPS)
                humanoid.append(humanoid_step())
                runs.append((one, one.factor * (humanoid[-2] + humanoid[-1]) / 2))
        step = statistics.median(humanoid)
        for scene, runs, bar in zip(SCENES, paces, bars, strict=True):
            factor = statistics.median(one.factor for one, _ in runs)
            table[scene][policy] = {
                "real_time_factor": factor,
                "humanoid_step_microseconds": step,
            }
            one, _ = runs[-1]
            note = (
                f"{factor:.1f} x real time, humanoid {step:.1f} µs; "
                f"{one.contacts.mean():.1f} contacts, {one.insertion[-1] * 1e3:.0f} mm"
            )
            product = statistics.median(product for _, product in runs)
            name = f"calibrated speed, {scene}, {policy}"
            checks.append(Check.at_least(name, product, bar, "µs", note))
    return checks, table


def load(task: str = "type1_bca", **options) -> composer.Environment:
    """Loads a suite environment whose episodes never end in success."""
    options.setdefault("goal_radius", NEVER)
    return suite.load(suite.DOMAIN, task, task_kwargs={"random": 0, **options})


def pace(
    environment: composer.Environment, policy: str, steps: int, seed: int = 0
) -> Pace:
    """Play an episode of a suite environment and time every control step.

    Args:
        policy: Name of a policy in `cathsim_dmc.policies.POLICIES`.
    """
    act = in_environment(make_policy(policy, seed), environment)
    seconds, insertion, contacts = [], [], []
    timestep = environment.reset()
    while len(seconds) < steps and not timestep.last():
        action, start = act(timestep), time.process_time()
        timestep = environment.step(action)
        seconds.append(time.process_time() - start)
        insertion.append(float(environment.task.readings.insertion))
        contacts.append(float(environment.task.contacts(environment.physics).found))
    return Pace(np.array(insertion), np.array(seconds), np.array(contacts))


def suite_overhead(policy: str) -> list[float]:
    """Overheads (RATIOS,): CPU time of suite steps divided by that of `mj_step`."""
    environment = load()
    pairs = [
        against_bare_steps(environment, policy, STEPS, run) for run in range(RATIOS + 1)
    ]
    return [ours / bare for ours, bare in pairs[1:]]


class Begun(NamedTuple):
    """State before the physics steps of a control step.

    Attributes:
        state: (nstate,), including the control, see `Stepper.before`.
        fields: Fields of the model that are written at every control step, by name.
    """

    state: np.ndarray
    fields: Mapping[str, np.ndarray]

    @classmethod
    def last(cls, environment: composer.Environment) -> "Begun":
        """The one of the last control step of a suite environment."""
        task = environment.task
        names = {name for effect in task.effects for name in effect.step_fields}
        fields = {name: task.stepper.field(0, name).copy() for name in names}
        return cls(task.stepper.before[0], fields)


def against_bare_steps(
    environment: composer.Environment, policy: str, steps: int, seed: int
) -> tuple[float, float]:
    """CPU seconds of an episode, and of the bare `mj_step` calls of its control steps.

    The two alternate by episodes: alternating by steps, each would find the CPU caches
    filled by the other. Repeated control steps count in the episode only.
    """
    timestep, seconds = environment.reset(), 0.0
    # None of these policies uses the observation.
    act = in_environment(make_policy(policy, seed), environment)
    actions, begun = [act(timestep) for _ in range(steps)], []
    for action in actions:
        start = time.process_time()
        environment.step(action)
        seconds += time.process_time() - start
        begun.append(Begun.last(environment))
    return seconds, bare_steps(environment, begun)[0]


def bare_steps(
    environment: composer.Environment, begun: Sequence[Begun]
) -> tuple[float, np.ndarray]:
    """Repeats the physics steps of control steps, without the task.

    Args:
        environment: Suite environment of the control steps.
        begun: State before each of them.

    Returns:
        CPU seconds of the `mj_step` calls, and states (T, nstate) after each control
        step.
    """
    model = copy.copy(environment.physics.model.ptr)
    data, kind = mujoco.MjData(model), mujoco.mjtState.mjSTATE_INTEGRATION.value
    seconds, after = 0.0, np.array([each.state for each in begun])
    for one, state in zip(begun, after, strict=True):
        for name, values in one.fields.items():
            getattr(model, name)[:] = values
        mujoco.mj_setState(model, data, one.state, kind)
        start = time.process_time()
        for _ in range(environment.task.substeps):
            mujoco.mj_step(model, data)
        seconds += time.process_time() - start
        mujoco.mj_getState(model, data, state, kind)
    return seconds, after


def humanoid_step() -> float:
    """CPU time of one `mj_step` of dm_control's humanoid, µs, a measure of the machine.

    The humanoid of `stand` falls without controls from its standing pose; the first
    steps warm it up and are not timed.
    """
    model, start = _humanoid()
    data = mujoco.MjData(model)
    mujoco.mj_copyData(data, model, start)
    mujoco.mj_step(model, data, nstep=_WARM_STEPS)
    begin = time.process_time()
    mujoco.mj_step(model, data, nstep=_TIMED_STEPS)
    return 1e6 * (time.process_time() - begin) / _TIMED_STEPS


@functools.cache
def _humanoid() -> tuple[mujoco.MjModel, mujoco.MjData]:
    from dm_control import suite as control_suite

    environment = control_suite.load("humanoid", "stand", task_kwargs={"random": 0})
    environment.reset()
    return environment.physics.model.ptr, environment.physics.data.ptr
