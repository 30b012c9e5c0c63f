"""Figures of docs/gpu.md: parity with the CPU, speed and training on a GPU.

    python benchmarks/gpu.py --out gpu.json    (a quarter of an hour on an H100)
    python benchmarks/gpu.py --only parity
    python benchmarks/gpu.py --device warp:cpu --worlds 4 --steps 5   (a check)
    python benchmarks/gpu.py --write docs/gpu.md --out docs/data/gpu.json

Parity replays the same actions in `BatchSimulation` and in MuJoCo Warp. Speed counts
control steps of 40 ms per second of wall time, from actions to observations. Training
counts from where all is compiled to the first checkpoint whose policy succeeds in 95 %
of the episodes, each of at most 200 control steps. Each figure is written as soon as it
is known; what fails is reported and left out, as is what does not begin within the
budget.
"""

import argparse
import csv
import json
import os
import platform
import sys
import tarfile
import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

# isort: off
# torchrl must be imported before dm_control.
import torch
from cathsim_dmc import agents
from cathsim_dmc.simulation.torchrl import BatchedEnv

# isort: on
import numpy as np

from cathsim_dmc import files, suite
from cathsim_dmc.simulation.batch import BatchSimulation
from cathsim_dmc.simulation.warp.simulation import WarpSimulation

PARITY_TASKS: dict[str, dict[str, Any]] = {
    "type1_lcca": {},
    "type1_lcca randomised": {"randomisation": True},
    "femoral_type1_lcca": {},
    "arch_lcca": {"pool": 2},
    "type1_lcca_pair": {},
    "type1_lcca living": {"vessel": "living"},
}
# Task and options by the word after the observation in `SPEED`.
SCENES: dict[str, tuple[str, dict[str, Any]]] = {
    "": ("type1_lcca", {}),
    "pair": ("type1_lcca_pair", {}),
    "living": ("type1_lcca", {"vessel": "living"}),
}
# Observation, worlds and actions, the most important ones first.
SPEED = (
    ("internal", 4096, "random"), ("internal", 4096, "push"),
    ("internal, pair", 4096, "push"), ("internal, living", 4096, "push"),
    ("image", 1024, "random"), ("internal", 16384, "random"),
    ("image", 4096, "random"), ("internal", 1024, "random"),
    ("route", 4096, "random"), ("internal", 1024, "push"),
    ("internal", 16384, "push"), ("image", 4096, "push"), ("route", 4096, "push"),
    ("internal, pair", 4096, "random"), ("internal, living", 4096, "random"),
)  # fmt: skip
ON_THE_CPU = 1024  # simulations of the CPU case, on all cores
# Hundreds of worlds with a few steps each give enough frames for an update.
_UPDATES = {"minibatch_size": 512, "epochs": 10, "checkpoint_frames": 40_960}
_SMALL = {"num_envs": 512, "steps_per_update": 4096, "learning_rate": 2.5e-4}
_LARGE = {"num_envs": 1024, "steps_per_update": 8192, "learning_rate": 3e-4}
TRAINING: dict[str, dict[str, Any]] = {
    "PPO-Internal": {"preset": "tuned", "total_frames": 614_400, **_SMALL, **_UPDATES},
    "PPO-Internal, 1,024 worlds": {
        "preset": "tuned", "total_frames": 737_280, **_LARGE, **_UPDATES
    },
    "PPO-Image": {
        "preset": "tuned_image", "total_frames": 409_600, **_SMALL, **_UPDATES
    },
}  # fmt: skip
EPISODES, LONGEST, ENOUGH = 40, 200, 0.95


class Report:
    """Results, which are written to a file after each measurement."""

    def __init__(self, path: Path | None, budget: float):
        self.found: dict[str, Any] = {}
        self._path, self._budget, self._began = path, budget, time.perf_counter()

    def add(self, part: str, value: Any) -> None:
        """Appends a row (dict) to a part, or sets the part to another value."""
        if isinstance(value, dict):
            self.found.setdefault(part, []).append(value)
        else:
            self.found[part] = value
        seconds = time.perf_counter() - self._began
        print(f"[{seconds:.0f} s] {part}: {json.dumps(value)}", flush=True)
        if self._path is not None:
            files.write_json(self._path, self.found)

    def attempt(
        self, part: str, measure: Callable, *given: Any, seconds: float
    ) -> None:
        """Measures and adds a row, if `seconds` of the budget are left."""
        if not self.has(seconds):
            return
        try:
            self.add(part, measure(*given))
        except Exception as error:  # other measurements may still succeed
            traceback.print_exc()
            words = [str(each) for each in given[:4]]
            self.add("failed", {"part": part, "given": words, "error": repr(error)})

    def has(self, seconds: float) -> bool:
        """Whether so many seconds of the budget are left."""
        return time.perf_counter() - self._began + seconds <= self._budget


def actions(policy: str, steps: int, simulation: BatchSimulation) -> np.ndarray:
    """Actions (steps, N, A): random ones, or a straight push of all devices."""
    shape = steps, simulation.num_simulations, simulation.num_actions
    if policy == "random":
        return np.random.RandomState(0).uniform(-1, 1, shape)
    held = np.zeros(shape)
    coaxial = simulation.task.scene.catheter.coaxial
    held[..., slice(0, None, 2) if coaxial else -1] = 1.0
    return held


def parity(device: str, name: str, steps: int) -> dict[str, Any]:
    """Differences between four worlds of a task and `BatchSimulation`."""
    task, options = name.split()[0], PARITY_TASKS[name]
    one = BatchSimulation(suite.make_task(task, **options), 4, num_threads=4)
    two = WarpSimulation(suite.make_task(task, **options), 4, device=device)
    for simulation in (one, two):
        simulation.seed(0)
        simulation.reset()
    tip, force, count = [], [], []
    for action in actions("push", steps, one):
        here, there = one.step(action), two.step(action)
        apart = here.readings.head - there.readings.head
        tip.append(np.linalg.norm(apart, axis=-1))
        force.append(np.stack([here.wall_force.sum, there.wall_force.sum]))
        count.append([len(s.contacts().present.nonzero()[0]) for s in (one, two)])
    sums = np.array(force).sum(axis=(0, 2))
    return {
        "task": name,
        "steps": steps,
        "tip_mm_median": 1e3 * float(np.median(tip)),
        "tip_mm_largest": 1e3 * float(np.max(tip)),
        "force_ratio": float(sums[1] / sums[0]),
        "contacts": np.array(count).sum(axis=0).tolist(),
        "lost": int(two.stepper.lost.sum()),
    }


def pace(step: Callable[[int], Any], steps: int) -> float:
    """Calls per second, after three warm-up calls."""
    for k in range(3):
        step(k)
    began = time.perf_counter()
    for k in range(steps):
        step(k)
    return steps / (time.perf_counter() - began)


def speed(
    device: str, worlds: int, policy: str, observation: str, steps: int
) -> dict[str, Any]:
    """Control steps per second of the physics alone, and end to end in TorchRL."""
    began = time.perf_counter()
    seen, _, scene = observation.partition(", ")
    task, options = SCENES[scene]
    env = BatchedEnv(task, worlds, observation=seen, task_kwargs=options, device=device)
    state = env.reset()
    built = time.perf_counter() - began
    chosen = actions(policy, 8, env.simulation)
    given = [torch.as_tensor(a, dtype=torch.float32, device=env.device) for a in chosen]
    began = time.perf_counter()
    env.step(state.set("action", given[0]))
    first = time.perf_counter() - began

    stepper, spent = env.simulation.stepper, []

    def whole(k: int) -> None:
        result = env.step(state.set("action", given[k % len(given)]))["next"]
        if device != "cpu":
            spent.append(stepper.profile()["step"])
        if bool(result["done"].any()):
            env.reset(result.set("_reset", result["done"].clone()))

    end_to_end = worlds * pace(whole, steps)
    row = {
        "device": device,
        "worlds": worlds,
        "policy": policy,
        "observation": observation,
        "end_to_end": round(end_to_end),
        "build_and_reset_s": round(built, 1),
        "first_step_s": round(first, 1),
        "repeated": int(env.simulation.stepper.repeated.sum()),
    }
    if device != "cpu":
        row["lost"] = int(stepper.lost.sum())
        row["seconds"] = {k: round(v, 4) for k, v in stepper.profile().items()}
        row["again"] = round(worlds * pace(lambda _: stepper.step_device(), 10))
        # On the CPU, Warp does not wait for the step to end.
        waited = float(np.median(spent))
        row["physics"] = round(worlds / waited) if waited > 1e-3 else row["again"]
        if env.device.type == "cuda":
            free, total = torch.cuda.mem_get_info(env.device)
            row["memory_mb"] = round((total - free) / 2**20)
    env.close()
    return row


def training(name: str, device: str, folder: Path, out: Path | None) -> dict[str, Any]:
    """Trains a policy; frames and seconds until it succeeds. Files go beside `out`."""
    settings = {"task": "type1_lcca", "simulation_device": device, **TRAINING[name]}
    place = "cuda" if device.startswith("cuda") else "cpu"
    cores = os.cpu_count() or 1
    settings |= {"torch_device": place, "torch_threads": cores, "metrics_frames": 1}
    settings |= {"checkpoint_seconds": 1e6, "keep_checkpoints": 100}
    config = agents.make_config("ppo", **settings)
    short = name.lower().replace(", ", "-").replace(" ", "-").replace(",", "")
    run = folder / f"{short}-{time.strftime('%Y%m%d-%H%M%S')}"
    result = agents.train(config, run, progress=False)
    with (run / "metrics.csv").open() as file:
        rows = list(csv.DictReader(file))
    seconds = {int(float(row["frames"])): float(row["seconds"]) for row in rows}
    curve, checkpoint = [], result.checkpoint
    for checkpoint in sorted(
        (run / "checkpoints").iterdir(), key=lambda p: int(p.name)
    ):
        options = {"max_steps": LONGEST}
        found = agents.evaluate(
            str(checkpoint), episodes=EPISODES, task_kwargs=options, num_threads=cores
        )
        success = float(found.values("success").mean())
        frames = int(checkpoint.name)
        curve.append([frames, round(seconds.get(frames, result.seconds), 1), success])
        if success >= ENOUGH:
            break
    reached = [row for row in curve if row[2] >= ENOUGH]
    if out is not None:
        last = run / "checkpoints" / checkpoint.name
        kept = [run / "config.json", run / "metrics.csv", *last.iterdir()]
        with tarfile.open(out.parent / f"{short}.tar.gz", "w:gz") as archive:
            for path in kept:
                archive.add(path, path.relative_to(run.parent))
    return {
        "agent": name,
        "settings": TRAINING[name],
        "frames_per_second": round(result.frames / result.seconds),
        "seconds": round(result.seconds, 1),
        "success": curve,
        "frames_to_95": reached[0][0] if reached else None,
        "seconds_to_95": reached[0][1] if reached else None,
    }


def measure(given: argparse.Namespace, report: Report) -> None:
    """Measures all parts, the most important ones first."""
    device, only = given.device, given.only
    report.add("command", " ".join(["benchmarks/gpu.py", *sys.argv[1:]]))
    report.add("date", time.strftime("%Y-%m-%d"))
    report.add("host", f"{os.cpu_count()} processors, {platform.machine()}")
    if device.startswith("cuda"):
        report.add("gpu", torch.cuda.get_device_name())
    rows = [row for row in SPEED if given.worlds is None or row[1] in given.worlds]
    if given.worlds is not None and not rows:
        rows = [("internal", worlds, "random") for worlds in given.worlds]

    def speeds(chosen: Any, seconds: float) -> None:
        for observation, worlds, policy in chosen if "speed" in only else ():
            case = device, worlds, policy, observation, given.steps
            report.attempt("speed", speed, *case, seconds=seconds)

    def trained(name: str, seconds: float) -> None:
        if "ppo" in only and device.startswith("cuda"):  # trainings need a GPU
            case = name, device, given.runs, given.out
            report.attempt("training", training, *case, seconds=seconds)

    def compared(names: Sequence[str], seconds: float) -> None:
        for task in names if "parity" in only else ():
            case = device.removeprefix("warp:"), task, given.parity_steps
            report.attempt("parity", parity, *case, seconds=seconds)

    names = list(PARITY_TASKS)
    speeds(rows[:2], 0)
    trained("PPO-Internal", 60)
    compared(names[:2], 20)
    # Other models, which are compiled first.
    speeds(rows[2:4], 60)
    compared(names[2:], 60)
    speeds(rows[4:6], 30)
    for observation in ("internal", "image") if "speed" in only else ():
        case = "cpu", ON_THE_CPU, "random", observation, max(given.steps // 2, 1)
        report.attempt("speed", speed, *case, seconds=20)
    trained("PPO-Image", 100)
    trained("PPO-Internal, 1,024 worlds", 90)
    speeds(rows[6:], 30)


def tables(found: Mapping[str, Any]) -> dict[str, str]:
    """The tables of docs/gpu.md by name."""
    parities = [
        "| task | control steps | tip, median | tip, largest | wall force, ratio "
        "| contacts, CPU and GPU |\n|---|---|---|---|---|---|"
    ]
    for row in found.get("parity", ()):
        name, *rest = row["task"].split()
        parities.append(
            f"| {' '.join([f'`{name}`', *rest])} | {row['steps']} | "
            f"{row['tip_mm_median']:.3f} mm | {row['tip_mm_largest']:.2f} mm | "
            f"{row['force_ratio']:.3f} | {row['contacts'][0]}, {row['contacts'][1]} |"
        )
    speeds = [
        "| observation | where | worlds | actions | physics alone | from actions to "
        "observations | GPU memory |\n|---|---|---|---|---|---|---|"
    ]
    for row in found.get("speed", ()):
        on_gpu = row["device"] != "cpu"
        name, *others = row["observation"].split(", ")
        rest = "".join(f", {each}" for each in others)
        memory = row.get("memory_mb", 0) / 1000
        speeds.append(
            f"| `{name}`{rest} | {'GPU' if on_gpu else 'all cores'} | "
            f"{row['worlds']:,} | {row['policy']} | "
            f"{format(row['physics'], ',') if on_gpu else '–'} | "
            f"{row['end_to_end']:,} | {f'{memory:.1f} GB' if on_gpu else '–'} |"
        )
    trainings = [
        "| agent | control steps to 95 % | seconds to 95 % | control steps a second "
        "|\n|---|---|---|---|"
    ]
    for row in found.get("training", ()):
        reached = row["frames_to_95"] is not None
        frames = f"{row['frames_to_95']:,}" if reached else "not reached"
        trainings.append(
            f"| {row['agent']} | {frames} | "
            f"{row['seconds_to_95'] if reached else '–'} | "
            f"{row['frames_per_second']:,} |"
        )
    place = [
        "",
        f"`type1_lcca` (pair: `type1_lcca_pair`) on one {found.get('gpu', 'CPU')}, "
        f"{found['host']}, {found['date']}; control steps per second:",
    ]
    written = {
        "where": place,
        "parity": parities,
        "speed": speeds,
        "training": trainings,
    }
    return {
        name: "\n".join(rows).lstrip() for name, rows in written.items() if rows[1:]
    }


def write(page: Path, found: Mapping[str, Any]) -> None:
    """Writes the tables into a page, each between its two comments."""
    text = page.read_text()
    for name, table in tables(found).items():
        first, last = f"<!-- {name} -->\n", f"\n<!-- /{name} -->"
        before, _, rest = text.partition(first)
        text = before + first + table + last + rest.partition(last)[2]
    files.write_text(page, text)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--worlds", type=int, nargs="+")
    parser.add_argument("--steps", type=int, default=30)
    parser.add_argument("--parity-steps", type=int, default=50)
    parts = ("speed", "parity", "ppo")
    parser.add_argument("--only", nargs="+", choices=parts, default=list(parts))
    parser.add_argument("--budget", type=float, default=900.0, help="seconds")
    parser.add_argument("--runs", type=Path, default=Path("runs/gpu"))
    parser.add_argument("--out", type=Path)
    parser.add_argument("--write", type=Path, help="page to write the file into")
    given = parser.parse_args()
    if given.write is not None:
        write(given.write, json.loads(given.out.read_text()))
        return
    if given.device.startswith("cuda") and not torch.cuda.is_available():
        parser.error(
            f"torch {torch.__version__} finds no GPU: it is a build for the CPU, or "
            "the driver is older than 580, which CUDA 13 asks for"
        )
    measure(given, Report(given.out, given.budget))


if __name__ == "__main__":
    main()
