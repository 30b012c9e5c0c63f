"""Long load: many control steps with random resets; memory, speed, warnings, NaN.

    python benchmarks/long_load.py --steps 1000000 --out runs/long-load.json

Control steps are counted for each simulation: a step of 16 simulations counts 16. At
the end the same steps are timed here and in a fresh process, in alternation.
Exit code 1: a bound was broken.

Bounds: memory grows by less than 20 MB after the warm-up; the speed at the end is at
least 95 % of that of the fresh process; no MuJoCo warning, no NaN, no physics error.
"""

import argparse
import dataclasses
import gc
import json
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

from cathsim_dmc import files, suite
from cathsim_dmc.cli.options import say
from cathsim_dmc.simulation.batch import BatchSimulation
from cathsim_dmc.validation.checks import Check

GROWTH = 20e6  # bytes
SPEED = 0.95
WARM_UP = 0.1  # of all steps
RESET = 0.002  # probability of a reset of a simulation in each control step
HOLD = 10  # control steps between two draws of the actions


class Load:
    """A batch under random actions with random resets."""

    def __init__(self, given: argparse.Namespace):
        kwargs = {"randomisation": True, "max_steps": 10**9}
        self.batch = BatchSimulation(
            suite.make_task(given.task, **kwargs),
            given.simulations,
            num_threads=given.threads,
            seeds=given.seed,
        )
        self.batch.reset()
        self.random = np.random.default_rng(given.seed)
        self.action = np.zeros((given.simulations, self.batch.num_actions))
        self.resets = self.errors = self.not_finite = self.count = 0

    def run(self, calls: int) -> float:
        """Makes `calls` steps of the batch; returns control steps per second."""
        start, size = time.perf_counter(), len(self.action)
        for _ in range(calls):
            if self.count % HOLD == 0:
                self.action = self.random.uniform(-1, 1, self.action.shape)
            step = self.batch.step(self.action)
            self.count += 1
            self.errors += int(step.physics_error.sum())
            for value in step.observation.values():
                if value.dtype.kind == "f" and not np.isfinite(value).all():
                    self.not_finite += 1
            ended = step.terminated | step.truncated
            anew = np.flatnonzero(ended | (self.random.random(size) < RESET))
            if len(anew):
                self.resets += len(anew)
                self.batch.reset(anew)
        return calls * size / (time.perf_counter() - start)

    def time(self, number: int, calls: int) -> float:
        """Control steps per second of a run that is the same in every process."""
        self.batch.seed(number)
        self.batch.reset()
        self.random, self.count = np.random.default_rng(number), 0
        return self.run(calls)

    @property
    def warnings(self) -> int:
        """Number of MuJoCo warnings, by its own counters."""
        return int(np.sum(self.batch.batch.warning))


def memory() -> int:
    """Resident memory of this process, bytes."""
    gc.collect()
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith("VmRSS:"):
            return 1024 * int(line.split()[1])
    raise RuntimeError("needs Linux: /proc/self/status tells the memory")


def serve(load: Load, calls: int) -> None:
    """Times a run for each line on standard input."""
    load.run(calls)
    print("ready", flush=True)
    for line in sys.stdin:
        print(load.time(int(line), calls), flush=True)


def in_turns(
    load: Load, arguments: argparse.Namespace, calls: int
) -> list[list[float]]:
    """Speeds in this and in a fresh process, measured in alternation."""
    command = [sys.executable, __file__, "--serve", str(calls)]
    for name in ("task", "simulations", "threads", "seed"):
        command += [f"--{name}", str(getattr(arguments, name))]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as fresh:
        stdin, stdout = fresh.stdin, fresh.stdout
        assert stdin and stdout
        stdout.readline()
        speeds: list[list[float]] = [[], []]
        for number in range(arguments.rounds):
            speeds[0].append(load.time(number, calls))
            stdin.write(f"{number}\n")
            stdin.flush()
            speeds[1].append(float(stdout.readline()))
        stdin.close()
    return speeds


def measure(arguments: argparse.Namespace) -> dict:
    load = Load(arguments)
    calls = max(1, arguments.steps // arguments.simulations)
    warm = max(1, int(WARM_UP * calls))
    load.run(warm)
    held, series = memory(), []
    stretch = max(1, (calls - warm) // 20)
    while load.count < calls:
        speed = load.run(min(stretch, calls - load.count))
        steps, growth = load.count * arguments.simulations, memory() - held
        series.append((steps, growth, speed))
        say(f"{steps:,} steps, {growth / 1e6:+.1f} MB, {speed:.0f}/s")
    here, fresh = in_turns(load, arguments, max(1, min(stretch, 400)))
    ratio = float(np.median(np.divide(here, fresh)))
    checks = [
        Check.at_most("memory growth after warm-up", growth / 1e6, GROWTH / 1e6, "MB"),
        Check.at_least("speed over that of a fresh process", ratio, SPEED),
        Check.at_most("MuJoCo warnings", load.warnings, 0),
        Check.at_most("observations with NaN", load.not_finite, 0),
        Check.at_most("physics errors", load.errors, 0),
    ]
    return {
        "checks": [dataclasses.asdict(check) for check in checks],
        "passed": all(check.passed for check in checks),
        "task": arguments.task,
        "steps": calls * arguments.simulations,
        "resets": load.resets,
        "series": series,
        "speeds": {"here": here, "fresh": fresh},
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--task", default="type1_lcca")
    parser.add_argument("--steps", type=int, default=1_000_000)
    parser.add_argument("--simulations", type=int, default=16)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path)
    parser.add_argument("--serve", type=int, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.serve:
        serve(Load(arguments), arguments.serve)
        return 0
    if arguments.steps < (least := 2 * arguments.simulations):
        parser.error(
            f"--steps is {arguments.steps}; it must be {least} or more, two for each "
            "simulation: one warms up"
        )
    try:
        if arguments.out is not None:
            files.require_file(arguments.out)
    except OSError as error:
        parser.error(f"--out: {error}")
    report = measure(arguments)
    text = json.dumps(report, indent=2) + "\n"
    print(text, end="")
    if arguments.out is not None:
        files.write_text(arguments.out, text)
    return 0 if report["passed"] else 1


if __name__ == "__main__":
    sys.exit(main())
