"""Speed of the environment under a policy, by insertion depth and by stage."""

import contextlib
import dataclasses
import functools
import itertools
import time
from collections.abc import Callable, Iterator

import mujoco
import numpy as np

from cathsim_dmc import suite
from cathsim_dmc.policies import in_environment, make_policy
from cathsim_dmc.simulation.episodes import ComposerSimulation, play
from cathsim_dmc.tasks.config import CONTROL_TIMESTEP

DEPTHS = (0.0, 0.1, 0.2, 0.3, np.inf)  # m of insertion, edges of the bins
_WARM_STEPS = 1000  # of the humanoid, 5 s: it has come to lie on the floor
NEVER = 1e-6  # m, goal radius that no policy meets


# Policies of `cathsim_dmc.policies` under which the speed is measured.
IDLE, RANDOM, PUSH, CURL = "idle", "random", "push", "curl"


@dataclasses.dataclass(frozen=True)
class Pace:
    """Speed of one episode.

    Attributes:
      insertion: (T,), m, after each control step.
      seconds: (T,), CPU seconds of each control step.
      contacts: (T,), with the wall at its end.
    """

    insertion: np.ndarray
    seconds: np.ndarray
    contacts: np.ndarray

    @property
    def factor(self) -> float:
        """Real-time factor of the whole episode."""
        return len(self.seconds) * CONTROL_TIMESTEP / self.seconds.sum()

    def by_depth(self) -> dict[str, dict[str, float]]:
        """Real-time factor and mean number of contacts by insertion depth."""
        table = {}
        for low, high in zip(DEPTHS[:-1], DEPTHS[1:], strict=True):
            chosen = (self.insertion >= low) & (self.insertion < high)
            if chosen.any():
                end = "+" if np.isinf(high) else f"–{1e3 * high:.0f}"
                table[f"{1e3 * low:.0f}{end} mm"] = {
                    "real_time_factor": chosen.sum()
                    * CONTROL_TIMESTEP
                    / self.seconds[chosen].sum(),
                    "steps_per_second": chosen.sum() / self.seconds[chosen].sum(),
                    "contacts": float(self.contacts[chosen].mean()),
                }
        return table


def humanoid_step(steps: int = 2000) -> float:
    """CPU time of one `mj_step` of dm_control's humanoid, µs: the speed of the machine.

    A real-time factor times this is a figure that another machine, or the same one at
    another hour, can be held to. The humanoid of `stand` falls without controls from
    its standing pose; the first steps warm it up and are not timed.

    Args:
      steps: number of timed physics steps.
    """
    model, start = _humanoid()
    data = mujoco.MjData(model)
    mujoco.mj_copyData(data, model, start)
    mujoco.mj_step(model, data, nstep=_WARM_STEPS)
    begin = time.process_time()
    mujoco.mj_step(model, data, nstep=steps)
    return 1e6 * (time.process_time() - begin) / steps


@functools.cache
def _humanoid() -> tuple[mujoco.MjModel, mujoco.MjData]:
    from dm_control import suite as control_suite

    environment = control_suite.load("humanoid", "stand", task_kwargs={"random": 0})
    environment.reset()
    return environment.physics.model.ptr, environment.physics.data.ptr


def load(task: str = "type1_bca", **options):
    """A suite environment whose episodes never end in success."""
    options.setdefault("goal_radius", NEVER)
    return suite.load(suite.DOMAIN, task, task_kwargs={"random": 0, **options})


def pace(environment, policy: str, steps: int, seed: int = 0) -> Pace:
    """Runs an episode of a suite environment and times every control step."""
    act = in_environment(make_policy(policy, seed), environment)
    timed, insertion, contacts = _Timed(environment), [], []
    for _ in itertools.islice(play(timed, act), 1, steps + 1):
        insertion.append(float(environment.task.readings.insertion))
        contacts.append(float(environment.task.contacts(environment.physics).found))
    return Pace(np.array(insertion), np.array(timed.seconds), np.array(contacts))


class _Timed(ComposerSimulation):
    """A composer environment with the CPU seconds of each control step."""

    def __init__(self, environment):
        super().__init__(environment)
        self.seconds: list[float] = []

    def step(self, action: np.ndarray):
        start = time.process_time()
        answer = super().step(action)
        self.seconds.append(time.process_time() - start)
        return answer


# MuJoCo's timers of the stages of `mj_step`.
_STAGES = {
    "kinematics and inertia": ("POS_KINEMATICS", "POS_INERTIA"),
    "broad phase": ("COL_BROAD",),
    "narrow phase": ("COL_NARROW",),
    "constraints": ("POS_MAKE", "POS_PROJECT", "CONSTRAINT"),
}
_HOOKS = {
    "before_step": "action and follower",
    "after_step": "forces, reward, errors of physics",
}


def account(policy: str, steps: int = 150, runs: int = 7) -> dict[str, float]:
    """Where a control step goes.

    The stages of `mj_step` come from MuJoCo's own timers, whose shares are applied to
    the time it takes without them. What is left of a step beside `mj_step` and the
    hooks of the task is composer's: its schedule, its buffers, and the observation.

    Returns:
      CPU time of each stage in a control step, µs; they add up to the whole.
    """
    environment = load()
    task = environment.task
    bare, added, hooks = [], [], []
    for run in range(runs + 1):
        ours, theirs = against_bare_steps(environment, policy, steps, run)
        bare.append(theirs)
        added.append(ours - theirs)
        with _timed_hooks(task) as seconds:
            pace(environment, policy, steps, run)
        hooks.append([seconds[name] for name in _HOOKS])
    with _mujoco_timers(environment.physics.data.ptr) as timers:
        pace(environment, policy, steps)
        stages = {
            name: sum(timers(stage) for stage in parts)
            for name, parts in _STAGES.items()
        }
        total = timers("STEP")
    physics = np.median(bare[1:])
    table = {name: physics * part / total for name, part in stages.items()}
    table["other physics"] = physics - sum(table.values())
    table.update(zip(_HOOKS.values(), np.median(hooks[1:], axis=0), strict=True))
    table["composer and observation"] = (
        physics + np.median(added[1:]) - sum(table.values())
    )
    return {name: 1e6 * float(value) / steps for name, value in table.items()}


def against_bare_steps(
    environment, policy: str, steps: int, seed: int
) -> tuple[float, float]:
    """CPU seconds of an episode, and of bare `mj_step` calls with the same controls."""
    substeps = environment.task.substeps
    timestep = environment.reset()
    # None of these policies looks at the observation.
    act = in_environment(make_policy(policy, seed), environment)
    actions = [act(timestep) for _ in range(steps)]
    model, data = environment.physics.model.ptr, environment.physics.data.ptr
    bare = mujoco.MjData(model)
    mujoco.mj_copyData(bare, model, data)
    start = time.process_time()
    for action in actions:
        environment.step(action)
    middle = time.process_time()
    for action in actions:
        bare.ctrl[:] = action
        for _ in range(substeps):
            mujoco.mj_step(model, bare)
    return middle - start, time.process_time() - middle


@contextlib.contextmanager
def _timed_hooks(task) -> Iterator[dict[str, float]]:
    """CPU seconds in the hooks of a task, while the context is open."""
    seconds = dict.fromkeys(_HOOKS, 0.0)

    def timed(name: str) -> Callable:
        hook = getattr(task, name)

        def call(*arguments):
            start = time.process_time()
            hook(*arguments)
            seconds[name] += time.process_time() - start

        return call

    for name in _HOOKS:
        setattr(task, name, timed(name))
    try:
        yield seconds
    finally:
        for name in _HOOKS:
            delattr(task, name)


@contextlib.contextmanager
def _mujoco_timers(data: mujoco.MjData) -> Iterator[Callable[[str], float]]:
    """MuJoCo's timers, read by name, running while the context is open."""

    def read(stage: str) -> float:
        return data.timer[int(getattr(mujoco.mjtTimer, f"mjTIMER_{stage}"))].duration

    for timer in data.timer:
        timer.duration, timer.number = 0.0, 0
    mujoco.set_mjcb_time(time.perf_counter)
    try:
        yield read
    finally:
        mujoco.set_mjcb_time(None)
