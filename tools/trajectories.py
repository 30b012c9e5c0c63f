"""Digests of trajectories, to prove that a change of the code changes none of them.

Record before the change and compare after it, on one machine (other processors round
differently):

    python tools/trajectories.py --out before.json
    python tools/trajectories.py --compare before.json
"""

import argparse
import hashlib
import json
import sys
from pathlib import Path

import numpy as np

from cathsim_dmc import files, suite
from cathsim_dmc.simulation.batch import BatchSimulation

STEPS = 60  # control steps of each of two episodes
ALL = {"randomisation": True}
# Name of a case: task and options.
CASES = {
    "type1_bca": ("type1_bca", {}),
    "type1_lcca": ("type1_lcca", {}),
    "type2_lcca": ("type2_lcca", {}),
    "femoral_type1_lcca": ("femoral_type1_lcca", {}),
    "simple1_bca": ("simple1_bca", {}),
    "rotation": ("type1_lcca", {"rotation": True}),
    "randomised": ("type1_lcca", ALL),
    "randomised route": ("type1_lcca", {"observation": ["route", "force"], **ALL}),
    "tracking": ("type2_lcca", {"observation": "tracking"}),
    "image": ("type1_lcca", {"observation": "image"}),
    "sequential randomised": ("type1_lcca", {"observation": "sequential", **ALL}),
    "wire": ("femoral_type1_lcca_wire", {}),
    "pair": ("type1_lcca_pair", {}),
    "pair tracking": ("type1_lcca_pair", {"observation": ["tracking", "force"]}),
    "pair randomised": ("femoral_type1_lcca_pair", ALL),
    "pair memory": (
        "type1_lcca_pair",
        {"observation": ["route_coaxial", "route_retry", "route_turns"]},
    ),
    "pool": ("arch_lcca", {"pool": 3}),
    "pool randomised": ("arch_lcca", {"pool": 3, "observation": "route", **ALL}),
}


def actions(policy: str, count: int) -> np.ndarray:
    """Actions (STEPS, count): a push into the wall, or random ones held 10 steps."""
    random = np.random.RandomState(5).uniform(-1, 1, (STEPS // 10, count))
    held = np.repeat(random, 10, axis=0)
    if policy == "push":
        held[:, :] = 0.0
        held[:, -1] = 1.0
        held[STEPS // 2 :, 0] = 1.0
    return held


def digest(values) -> str:
    """Digest of the types, shapes and bytes of arrays."""
    total = hashlib.sha256()
    for value in values:
        value = np.ascontiguousarray(value)
        total.update(str((value.dtype, value.shape)).encode() + value.tobytes())
    return total.hexdigest()[:16]


def single(name: str, options: dict, policy: str) -> str:
    """Digest of two episodes of the composer environment."""
    seen = []
    environment = suite.load("cathsim", name, {"random": 7, **options})
    for _ in range(2):
        steps = [environment.reset()]
        for action in actions(policy, environment.task.num_actions):
            steps.append(environment.step(action))
            seen += [environment.physics.data.qpos.copy()]
            seen += [*environment.task.wall_force]
            if steps[-1].last():
                break
        for step in steps:
            seen += [value for _, value in sorted(step.observation.items())]
            seen += [np.array(step.reward or 0.0), np.array(step.discount or 0.0)]
    return digest(seen)


def batched(name: str, options: dict, policy: str) -> str:
    """Digest of two episodes of a batch of three simulations."""
    seen = []
    batch = BatchSimulation(suite.make_task(name, **options), 3, num_threads=2, seeds=7)
    for _ in range(2):
        step = batch.reset()
        seen += [np.array(value) for _, value in sorted(step.observation.items())]
        for action in actions(policy, batch.num_actions):
            step = batch.step(np.tile(action, (3, 1)))
            seen += [batch.batch.qpos.copy(), *step.wall_force]
            seen += [step.outcome.reward, step.terminated]
            seen += [np.array(value) for _, value in sorted(step.observation.items())]
    return digest(seen)


def main() -> int:
    """Prints the digests; with --compare the exit status is 1 if one differs."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, help="where to write the digests")
    parser.add_argument("--compare", type=Path, help="digests of before")
    parser.add_argument("--only", nargs="*", default=list(CASES), choices=CASES)
    options = parser.parse_args()
    if options.out:
        files.require_file(options.out)
    before = json.loads(options.compare.read_text()) if options.compare else {}
    found, wrong = {}, 0
    for case in options.only:
        for policy in ("push", "random"):
            for how in (single, batched):
                key = f"{case}, {policy}, {how.__name__}"
                found[key] = how(*CASES[case], policy)
                same = before.get(key, found[key]) == found[key]
                wrong += not same
                print(f"{key:45} {found[key]} {'' if same else 'DIFFERS'}", flush=True)
    if options.out:
        files.write_text(options.out, json.dumps(found, indent=1) + "\n")
    print(f"{len(found)} trajectories, {wrong} differ", file=sys.stderr)
    return int(wrong > 0)


if __name__ == "__main__":
    sys.exit(main())
