"""Figures of docs/gpu.md: parity with the CPU, and speed on a GPU.

    python benchmarks/gpu.py --out gpu.json          (some six minutes on an H100)
    python benchmarks/gpu.py --device warp:cpu --worlds 4 --steps 5   (a check)

Parity replays the same actions in `BatchSimulation` and in MuJoCo Warp. Speed counts
control steps of 40 ms per second of wall time, from actions to observations.
"""

import argparse
import json
import platform
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

# isort: off
# torchrl goes before dm_control.
import torch
from cathsim_dmc.simulation.torchrl import BatchedEnv

# isort: on
import numpy as np

from cathsim_dmc import files, suite
from cathsim_dmc.simulation.batch import BatchSimulation
from cathsim_dmc.simulation.warp.simulation import WarpSimulation

PARITY_TASKS: dict[str, dict[str, Any]] = {
    "type1_lcca": {},
    "femoral_type1_lcca": {},
    "type1_lcca randomised": {"randomisation": True},
    "arch_lcca": {"pool": 2},
}
OBSERVATIONS = ("internal", "route", "image")


def actions(policy: str, steps: int, shape: tuple[int, int]) -> np.ndarray:
    """Actions (steps, N, A): random ones, or a straight push."""
    if policy == "random":
        return np.random.RandomState(0).uniform(-1, 1, (steps, *shape))
    held = np.zeros((steps, *shape))
    held[..., -1] = 1.0
    return held


def parity(device: str, steps: int) -> list[dict[str, Any]]:
    """Differences of four worlds from `BatchSimulation`, by task."""
    rows = []
    for name, options in PARITY_TASKS.items():
        task = name.split()[0]
        one = BatchSimulation(suite.make_task(task, **options), 4, num_threads=4)
        two = WarpSimulation(suite.make_task(task, **options), 4, device=device)
        for simulation in (one, two):
            simulation.seed(0)
            simulation.reset()
        tip, force, count = [], [], []
        for action in actions("push", steps, (4, one.num_actions)):
            here, there = one.step(action), two.step(action)
            apart = here.readings.head - there.readings.head
            tip.append(np.linalg.norm(apart, axis=-1))
            force.append(np.stack([here.wall_force.sum, there.wall_force.sum]))
            found = [len(s.contacts().present.nonzero()[0]) for s in (one, two)]
            count.append(found)
        sums = np.array(force).sum(axis=(0, 2))
        rows.append(
            {
                "task": name,
                "steps": steps,
                "tip_mm_median": 1e3 * float(np.median(tip)),
                "tip_mm_largest": 1e3 * float(np.max(tip)),
                "force_ratio": float(sums[1] / sums[0]),
                "contacts": np.array(count).sum(axis=0).tolist(),
                "lost": int(two.stepper.lost.sum()),
            }
        )
        print(rows[-1], file=sys.stderr, flush=True)
    return rows


def pace(step: Callable[[int], Any], steps: int) -> float:
    """Calls per second, after three that do not count."""
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
    env = BatchedEnv("type1_lcca", worlds, observation=observation, device=device)
    state = env.reset()
    built = time.perf_counter() - began
    chosen = actions(policy, 8, (worlds, env.simulation.num_actions))
    given = [torch.as_tensor(a, dtype=torch.float32, device=env.device) for a in chosen]
    began = time.perf_counter()
    env.step(state.set("action", given[0]))
    first = time.perf_counter() - began

    def whole(k: int) -> None:
        result = env.step(state.set("action", given[k % len(given)]))["next"]
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
        stepper = env.simulation.stepper
        row["physics"] = round(worlds * pace(lambda _: stepper.step_device(), steps))
        row["lost"] = int(stepper.lost.sum())
        row["seconds"] = {k: round(v, 4) for k, v in stepper.profile().items()}
        if env.device.type == "cuda":
            free, total = torch.cuda.mem_get_info(env.device)
            row["memory_mb"] = round((total - free) / 2**20)
    print(row, file=sys.stderr, flush=True)
    env.close()
    return row


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--worlds", type=int, nargs="+", default=[1024, 4096, 16384])
    parser.add_argument("--steps", type=int, default=40)
    parser.add_argument("--observations", nargs="+", default=list(OBSERVATIONS))
    parser.add_argument("--no-parity", action="store_true")
    parser.add_argument("--out", type=Path)
    given = parser.parse_args()
    found: dict[str, Any] = {"machine": platform.processor() or platform.machine()}
    if given.device.startswith("cuda"):
        found["gpu"] = torch.cuda.get_device_name()
    if not given.no_parity:
        name = given.device.removeprefix("warp:")
        found["parity"] = parity(name, 50)
    rows = found["speed"] = []
    for observation in given.observations:
        for worlds in given.worlds:
            for policy in ("random", "push"):
                own = policy, observation, given.steps
                rows.append(speed(given.device, worlds, *own))
        rows.append(speed("cpu", 256, "random", observation, given.steps))
        if given.out is not None:
            files.write_json(given.out, found)
    print(json.dumps(found, indent=1))


if __name__ == "__main__":
    main()
