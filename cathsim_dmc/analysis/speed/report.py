"""The figures of `cathsim benchmark speed`, each beside its bar.

Real-time factor: simulated seconds per CPU second of this process, one thread. It says
as much about the machine as about the program, so what the checks bound is the
calibrated speed: the real-time factor times the microseconds of one `mj_step` of
dm_control's humanoid, both timed in turns. Every figure is the median of repeated runs
after a warm-up.
"""

import statistics
import subprocess
import sys
import time
from collections.abc import Callable

import numpy as np

from cathsim_dmc.analysis.speed import ratios
from cathsim_dmc.analysis.speed.pace import (
    CURL,
    IDLE,
    PUSH,
    RANDOM,
    Pace,
    account,
    humanoid_step,
    load,
    pace,
)
from cathsim_dmc.validation.checks import Check, Report

RUNS = 5
STEPS = 150  # control steps; a push is then in the branch
# A curved arch, and the straight idealised one that it is held against.
_SCENES = ("type1_bca", "simple1_bca")
# Calibrated speed that each policy must keep on each of them, µs.
_BARS = {PUSH: (150.0, 280.0), RANDOM: (420.0, 850.0), CURL: (220.0, 280.0)}
# Long enough that the deepest bin is reached, m, in so many steps.
_LONG, _LONG_STEPS = 0.42, 215


def speed(say: Callable[[str], None] = lambda text: None) -> Report:
    """All figures of `cathsim benchmark speed` as checks and tables."""
    say("real-time factors")
    checks, calibration = _factors()
    say("by insertion depth")
    long = load(working_length=_LONG)
    depths = {
        drive: _median_pace(long, drive, _LONG_STEPS).by_depth()
        for drive in (IDLE, RANDOM, PUSH, CURL)
    }
    say("overheads")
    overheads, rates = _overheads()
    say("construction, memory, imports")
    checks += overheads + _images() + _construction() + _processes()
    say("where a step goes")
    stages = {drive: account(drive, STEPS) for drive in (RANDOM, PUSH)}
    findings = {
        "calibration": calibration,
        "by_insertion_depth": depths,
        "batched_steps_per_second": rates,
        "microseconds_in_a_control_step": stages,
    }
    return Report("speed, one core", checks, findings)


def _median_pace(environment, drive: str, steps: int) -> Pace:
    paces = [pace(environment, drive, steps) for _ in range(RUNS)]
    return sorted(paces, key=lambda one: one.factor)[RUNS // 2]


def _factors() -> tuple[list[Check], dict[str, dict[str, dict[str, float]]]]:
    """Calibrated speeds, and their two factors by scene and policy.

    The scenes and the humanoid take turns, so that their figures can be compared
    though the machine's speed drifts.
    """
    environments = [load(scene) for scene in _SCENES]
    checks, table = [], {scene: {} for scene in _SCENES}
    for drive, bars in _BARS.items():
        for environment in environments:
            pace(environment, drive, STEPS)
        humanoid, paces = [humanoid_step()], [[] for _ in _SCENES]
        for _ in range(RUNS):
            for environment, runs in zip(environments, paces, strict=True):
                one = pace(environment, drive, STEPS)
                humanoid.append(humanoid_step())
                runs.append((one, one.factor * (humanoid[-2] + humanoid[-1]) / 2))
        step = statistics.median(humanoid)
        for scene, runs, bar in zip(_SCENES, paces, bars, strict=True):
            factor = statistics.median(one.factor for one, _ in runs)
            table[scene][drive] = {
                "real_time_factor": factor,
                "humanoid_step_microseconds": step,
            }
            one, _ = runs[-1]
            note = (
                f"{factor:.1f} x real time, humanoid {step:.1f} µs; "
                f"{one.contacts.mean():.1f} contacts, {one.insertion[-1] * 1e3:.0f} mm"
            )
            product = statistics.median(product for _, product in runs)
            name = f"calibrated speed, {scene}, {drive}"
            checks.append(Check.at_least(name, product, bar, "µs", note))
    return checks, table


def _overheads() -> tuple[list[Check], dict[str, float]]:
    """Ratios, and control steps per second of batches."""
    checks = [
        _ratio(
            Check.at_most,
            f"suite step / mj_step, {drive}",
            ratios.suite_overhead(drive, STEPS),
            1.25,
        )
        for drive in (RANDOM, PUSH)
    ]
    torchrl, rate = ratios.torchrl_overhead()
    threads, undisturbed, rates = ratios.thread_scaling()
    cores = f"; {undisturbed:.2f} x at equal speed of the cores"
    checks += [
        _ratio(Check.at_most, "TorchRL batched step / Batch.step", torchrl, 1.2),
        _ratio(Check.at_least, "two threads / one", threads, 1.85, cores),
    ]
    return checks, {**rates, "TorchRL, 1 thread": rate}


def _images() -> list[Check]:
    batched, single = ratios.batched_image_ratio(), ratios.image_ratio()
    return [
        _ratio(Check.at_least, "image / internal, batched", batched, 0.8),
        _ratio(Check.at_least, "image / internal, suite", single, 0.8),
        *(
            Check.at_least(f"fluoroscopy, {name}", rate, 1500, "frames/s")
            for name, rate in ratios.frame_rates().items()
        ),
    ]


def _ratio(check: Callable, name: str, runs: list[float], bar: float, note: str = ""):
    low, middle, high = np.quantile(runs, [0.25, 0.5, 0.75])
    return check(name, float(middle), bar, "x", f"quartiles {low:.2f}–{high:.2f}{note}")


def _construction() -> list[Check]:
    from cathsim_dmc.anatomy.arch import arch

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


def _in_fresh_process(code: str, runs: int = RUNS) -> float:
    """Median of the number that a fresh interpreter prints."""
    values = []
    for _ in range(runs):
        result = subprocess.run(
            [sys.executable, "-c", code], capture_output=True, text=True, check=True
        )
        values.append(float(result.stdout.split()[-1]))
    return statistics.median(values)


def _import_seconds(statement: str) -> float:
    return _in_fresh_process(
        f"import time; start = time.perf_counter(); {statement}; "
        "print(time.perf_counter() - start)"
    )


def peak_memory() -> float:
    """Peak memory of a process that loads a task and steps it, MB."""
    # The kernel's high-water mark of the address space: ru_maxrss would hold what the
    # parent had when it forked.
    return _in_fresh_process(
        "from cathsim_dmc import suite; "
        "env = suite.load('cathsim', 'type1_bca'); env.reset(); "
        "env.step([0.0] * 21); "
        "print([int(line.split()[1]) / 1024 for line in open('/proc/self/status') "
        "if line.startswith('VmHWM')][0])",
        runs=3,
    )
