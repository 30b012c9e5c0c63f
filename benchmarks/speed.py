"""All figures of docs/performance.md: speed, and where the time goes.

    python benchmarks/speed.py --json   (with nothing else running)
    python benchmarks/speed.py --short  (real-time factors and overhead alone)

The two sides of a ratio alternate, so that a drift of the machine's speed cancels.
"""

import argparse
import contextlib
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterator

# isort: off
# torchrl must be imported before dm_control.
import torch
from cathsim_dmc.simulation.torchrl import BatchedEnv

# isort: on
import mujoco
import numpy as np

from cathsim_dmc.anatomy.arch import arch
from cathsim_dmc.cli.options import say, show
from cathsim_dmc.imaging.device import Shadow
from cathsim_dmc.simulation.batch import BatchSimulation
from cathsim_dmc.tasks.config import CONTROL_TIMESTEP
from cathsim_dmc.validation.checks import Check, Report
from cathsim_dmc.validation.pace import (
    NEVER,
    RUNS,
    STEPS,
    Pace,
    against_bare_steps,
    load,
    pace,
    speed,
)

DEPTHS = (0.0, 0.1, 0.2, 0.3, np.inf)  # m of insertion, edges of the bins
# Working length, m, and control steps with which the deepest bin is reached.
_LONG, _LONG_STEPS = 0.42, 215
NUM_SIMULATIONS = 16
_RUNS = 12


def everything(say: Callable[[str], None]) -> Report:
    """Report with the checks of `speed`, further checks, and tables."""
    base = speed(say)
    say("by insertion depth")
    long = load(working_length=_LONG)
    depths = {
        policy: by_depth(_median_pace(long, policy, _LONG_STEPS))
        for policy in ("idle", "random", "push", "curl")
    }
    say("batches, images, construction, memory, imports")
    overheads, rates = _overheads()
    checks = [*base.checks, *overheads, *_images(), *_construction(), *_processes()]
    say("where a step goes")
    stages = {policy: account(policy, STEPS) for policy in ("random", "push")}
    findings = {
        **base.findings,
        "by_insertion_depth": depths,
        "batched_steps_per_second": rates,
        "microseconds_in_a_control_step": stages,
    }
    return Report("speed, one core", checks, findings)


def _median_pace(environment, policy: str, steps: int) -> Pace:
    paces = [pace(environment, policy, steps) for _ in range(RUNS)]
    return sorted(paces, key=lambda one: one.factor)[RUNS // 2]


def by_depth(one: Pace) -> dict[str, dict[str, float]]:
    """Real-time factor and mean number of contacts by insertion depth."""
    table = {}
    for low, high in zip(DEPTHS[:-1], DEPTHS[1:], strict=True):
        chosen = (one.insertion >= low) & (one.insertion < high)
        if chosen.any():
            end = "+" if np.isinf(high) else f"–{1e3 * high:.0f}"
            table[f"{1e3 * low:.0f}{end} mm"] = {
                "real_time_factor": chosen.sum()
                * CONTROL_TIMESTEP
                / one.seconds[chosen].sum(),
                "contacts": float(one.contacts[chosen].mean()),
            }
    return table


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
    """CPU time of a control step by stage.

    The stages of `mj_step` come from MuJoCo's own timers, whose shares are applied to
    the time of `mj_step` without timers. The rest of a step, beside `mj_step` and the
    hooks of the task, belongs to composer: schedule, buffers, and observation.

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


@contextlib.contextmanager
def _timed_hooks(task) -> Iterator[dict[str, float]]:
    """Context that measures CPU seconds in the hooks of a task."""
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
    """Context with MuJoCo's timers running; yields a function that reads them."""

    def read(stage: str) -> float:
        return data.timer[int(getattr(mujoco.mjtTimer, f"mjTIMER_{stage}"))].duration

    for timer in data.timer:
        timer.duration, timer.number = 0.0, 0
    mujoco.set_mjcb_time(time.perf_counter)
    try:
        yield read
    finally:
        mujoco.set_mjcb_time(None)


def _batch(threads: int, **options):
    task = load(**options).task
    return BatchSimulation(task, NUM_SIMULATIONS, num_threads=threads, seeds=0)


def thread_scaling(steps: int = 30) -> tuple[list[float], float, dict[str, float]]:
    """Throughput of bare batches on two threads relative to one.

    Returns:
      the ratios; their median, corrected to equal CPU time on one and two cores, as on
      an idle machine; control steps per second.
    """
    batches = {threads: _batch(threads) for threads in (1, 2)}
    shape = (steps, NUM_SIMULATIONS, batches[1].num_actions)
    wall, cpu = [], []
    for run in range(2 * _RUNS + 1):
        actions = np.random.default_rng(run).uniform(-1, 1, shape)
        wall.append({})
        cpu.append({})
        for threads, simulation in batches.items():
            simulation.reset()
            start = time.perf_counter(), time.process_time()
            for action in actions:
                simulation.batch.ctrl[:] = action
                simulation.batch.step(nstep=simulation.task.substeps)
            wall[-1][threads] = time.perf_counter() - start[0]
            cpu[-1][threads] = time.process_time() - start[1]
    total = steps * NUM_SIMULATIONS
    rates = {
        f"{threads} thread{'s' * (threads > 1)}": statistics.median(
            total / run[threads] for run in wall
        )
        for threads in batches
    }
    ratios = [run[1] / run[2] for run in wall[1:]]
    slower = [run[2] / run[1] for run in cpu[1:]]
    undisturbed = statistics.median(np.multiply(ratios, slower))
    return ratios, undisturbed, rates


def torchrl_overhead(steps: int = 30) -> tuple[list[float], float]:
    """Time of TorchRL batched steps divided by `Batch.step`, and steps per second."""
    torch.set_num_threads(1)
    env = BatchedEnv(
        "type1_bca",
        NUM_SIMULATIONS,
        num_threads=1,
        task_kwargs={"goal_radius": NEVER},
    )
    bare = _batch(1)
    ratios, rates = [], []
    for run in range(_RUNS + 1):
        current = env.reset()
        bare.reset()
        bare.batch.state[:] = env.simulation.batch.state
        torch.manual_seed(run)
        ours = theirs = 0.0
        for _ in range(steps):
            action = 2 * torch.rand(*env.action_spec.shape) - 1
            start = time.perf_counter()
            current["action"] = action
            current = env.step(current)["next"]
            middle = time.perf_counter()
            bare.batch.ctrl[:] = action.numpy()
            bare.batch.step(nstep=bare.task.substeps)
            theirs += time.perf_counter() - middle
            ours += middle - start
        ratios.append(ours / theirs)
        rates.append(steps * NUM_SIMULATIONS / ours)
    return ratios[1:], statistics.median(rates[1:])


def frame_rates(frames: int = 100) -> dict[str, float]:
    """Fluoroscopic images per second on one core, of 128 x 128 pixels."""
    environment = load(observation="image")
    environment.reset()
    task = environment.task
    (scope,) = task.rollout.case().angiograph.planes()
    radius = task.scene.catheter.device.outer_radius
    one = [Shadow(task.readings.centreline, radius)]
    many = [Shadow(np.repeat(one[0].points[None], NUM_SIMULATIONS, axis=0), radius)]
    random_state = np.random.RandomState(0)
    ways = {
        "one at a time": (1, lambda: scope.render(one)),
        f"{NUM_SIMULATIONS} at a time": (NUM_SIMULATIONS, lambda: scope.render(many)),
        "with noise": (1, lambda: scope.render(one, random_state)),
    }
    rates = {}
    for name, (count, render) in ways.items():
        runs = []
        for _ in range(_RUNS + 1):
            start = time.process_time()
            for _ in range(frames):
                render()
            runs.append(frames * count / (time.process_time() - start))
        rates[name] = statistics.median(runs[1:])
    return rates


def image_ratio(steps: int = 20) -> list[float]:
    """Rate of a batch with image observations relative to `internal`, same actions."""
    simulations = [_batch(1, observation=o) for o in ("internal", "image")]
    ratios = []
    for run in range(_RUNS + 1):
        seconds = []
        for simulation in simulations:
            simulation.seed(run)
            simulation.reset()
            generator = np.random.default_rng(run)
            shape = (NUM_SIMULATIONS, simulation.num_actions)
            start = time.process_time()
            for _ in range(steps):
                simulation.step(generator.uniform(-1, 1, shape))
            seconds.append(time.process_time() - start)
        ratios.append(seconds[0] / seconds[1])
    return ratios[1:]


def _overheads() -> tuple[list[Check], dict[str, float]]:
    """Checks of the ratios, and control steps per second of batches."""
    torchrl, rate = torchrl_overhead()
    threads, undisturbed, rates = thread_scaling()
    cores = f"; {undisturbed:.2f} x at equal speed of the cores"
    checks = [
        _ratio(Check.at_most, "TorchRL batched step / Batch.step", torchrl, 1.2),
        _ratio(Check.at_least, "two threads / one", threads, 1.85, cores),
    ]
    return checks, {**rates, "TorchRL, 1 thread": rate}


def _images() -> list[Check]:
    return [
        _ratio(Check.at_least, "image / internal, batched", image_ratio(), 0.8),
        *(
            Check.at_least(f"fluoroscopy, {name}", rate, 1500, "frames/s")
            for name, rate in frame_rates().items()
        ),
    ]


def _ratio(check: Callable, name: str, runs: list[float], bar: float, note: str = ""):
    low, middle, high = np.quantile(runs, [0.25, 0.5, 0.75])
    return check(name, float(middle), bar, "x", f"quartiles {low:.2f}–{high:.2f}{note}")


def _construction() -> list[Check]:
    environment = load()
    environment.reset()
    random_state = np.random.RandomState(0)

    def new_anatomy():
        arch.build_arch(arch.sample(random_state, "II"))

    return [
        Check.at_most("construct a task", _timed(lambda: load().close()), 1.0, "s"),
        Check.at_most("reset", 1e3 * _timed(environment.reset, 20), 5.0, "ms"),
        Check.at_most("new parametric anatomy", _timed(new_anatomy), 0.5, "s"),
    ]


def _timed(function: Callable[[], object], runs: int = RUNS) -> float:
    seconds = []
    for _ in range(runs + 1):
        start = time.perf_counter()
        function()
        seconds.append(time.perf_counter() - start)
    return statistics.median(seconds[1:])


def _processes() -> list[Check]:
    package, suite = "import cathsim_dmc", "from cathsim_dmc import suite"
    return [
        Check.at_most("peak memory", peak_memory(), 300, "MB"),
        Check.at_most(package, _import_seconds(package), 0.1, "s"),
        Check.at_most(suite, _import_seconds(suite), 1.5, "s"),
    ]


def _in_fresh_process(code: str, runs: int = RUNS, **environment: str) -> float:
    """Median of the last number that fresh interpreters print."""
    command, own = [sys.executable, "-c", code], {**os.environ, **environment}
    return statistics.median(
        float(subprocess.check_output(command, text=True, env=own).split()[-1])
        for _ in range(runs)
    )


def _import_seconds(statement: str) -> float:
    return _in_fresh_process(
        f"import time; start = time.perf_counter(); {statement}; "
        "print(time.perf_counter() - start)"
    )


def peak_memory() -> float:
    """Peak memory of a process that loads a task and steps it, without OpenGL, MB."""
    # VmHWM is that of the process itself: ru_maxrss would include the memory of the
    # parent at the fork.
    return _in_fresh_process(
        "from cathsim_dmc import suite; "
        "env = suite.load('cathsim', 'type1_bca'); env.reset(); "
        "env.step([0.0] * 21); "
        "print([int(line.split()[1]) / 1024 for line in open('/proc/self/status') "
        "if line.startswith('VmHWM')][0])",
        runs=3,
        MUJOCO_GL="disable",
    )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--short", action="store_true", help="factors, overhead alone")
    parser.add_argument("--json", action="store_true", help="print JSON")
    options = parser.parse_args()
    measure = speed if options.short else everything
    sys.exit(show(measure(say), options.json))
