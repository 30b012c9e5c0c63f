"""Measures what a living vessel costs, breaks and does to policies.

The tables are those of docs/vessel_results.md.

    python docs/scripts/vessel.py cost soak policies [--policy NAME ...] [--episodes 10]

Each part leaves its figures in docs/data/vessel.json, a policy in its own rows; without
a part, page and picture are drawn from there.
"""

import argparse
import itertools
import json
import sys
import time
from pathlib import Path

# torchrl must be imported before dm_control.
from cathsim_dmc.agents.evaluation import evaluate  # isort: skip

import figures
import numpy as np

from cathsim_dmc import suite
from cathsim_dmc.pictures.anatomies import Picture
from cathsim_dmc.simulation.batch import BatchSimulation

PAGE = Path(__file__).parents[1] / "vessel_results.md"
PICTURE = PAGE.parent / "images" / "vessel_policies.png"
DATA = figures.DATA / "vessel.json"
HEART, BREATH = {"phase": (0, 1)}, {"breath_phase": (0, 1)}
CASES = {
    "rigid": "rigid",
    "flow": {"flow": HEART},
    "wall": {"wall": True},
    "motion": {"motion": HEART | BREATH},
    "living": {"flow": HEART, "wall": True, "motion": BREATH},
}
BOTH = ("type1_lcca", "femoral_type1_lcca")
TASKS = {
    "expert": BOTH,
    **{f"pretrained:{name}": (name,) for name in ("type1_bca", "type2_bca")},
    **{f"pretrained:{name}": (name,) for name in ("type1_lcca", "type2_lcca")},
    "pretrained:femoral_type1_lcca": ("femoral_type1_lcca",),
    "pretrained:femoral_type2_lcca": ("femoral_type2_lcca",),
    "pretrained:navigator": BOTH,
    "pretrained:femoral_type1_lcca_living": BOTH,
}
DRAWN = {
    "flow": {"rate": (50, 100), "peak": (0.3, 1.0), "phase": (0, 1)},
    "wall": {"modulus": (0.3e6, 0.6e6), "support": (0.5, 1.0)},
    "motion": {"breathing": (0.5, 1.2), "breath_rate": (10, 25), **BREATH},
}
SOAKED = ("type1_lcca", "type2_bca", "femoral_type1_lcca", "femoral_type2_lcca")
LONGEST = 400  # control steps
SAFE = 1.0  # N


def costs(rounds: int = 3, episodes: int = 3) -> dict:
    """Rates of control steps relative to the rigid vessel's, measured in alternation.

    Rounds repeat the same episodes; the least time of each control step counts.
    """
    batches = {
        case: BatchSimulation(
            suite.make_task("type1_lcca", vessel=vessel, observation="tracking"),
            1,
            num_threads=1,
        )
        for case, vessel in CASES.items()
    }
    kinds = {"random": np.random.RandomState(0).uniform(-1, 1, (12, 21))}
    kinds["push"] = np.tile(np.eye(21)[20], (12, 1))
    seconds = {case: dict.fromkeys(kinds, 0.0) for case in CASES}
    for (kind, held), episode in itertools.product(kinds.items(), range(episodes)):
        least = {case: np.full(120, np.inf) for case in CASES}
        for _ in range(rounds):
            for batch in batches.values():
                batch.seed(episode)
                batch.reset()
            for step, action in enumerate(np.repeat(held, 10, axis=0)):
                for case, batch in batches.items():
                    start = time.process_time()
                    batch.step(action[None])
                    passed = time.process_time() - start
                    least[case][step] = min(least[case][step], passed)
        for case in CASES:
            seconds[case][kind] += float(least[case].sum())
    return {
        case: {kind: seconds["rigid"][kind] / each for kind, each in row.items()}
        for case, row in seconds.items()
    }


def soak(episodes: int = 52, steps: int = LONGEST, together: int = 13) -> dict:
    """Warnings, errors and largest force (N) of long episodes in living vessels."""
    found = {"episodes": 0, "steps": steps, "warnings": 0, "errors": 0, "force": 0.0}
    for number in range(episodes // together):
        task = SOAKED[number % len(SOAKED)]
        batch = BatchSimulation(
            suite.make_task(
                task, vessel=DRAWN, observation="tracking", max_steps=steps
            ),
            together,
            num_threads=1,
            seeds=100 * number,
        )
        batch.reset()
        random = np.random.RandomState(number)
        ended = np.zeros(together, dtype=bool)
        for step in range(steps):
            if step % 10 == 0:
                action = random.uniform(-1, 1, (together, batch.num_actions))
                action[::2, :-1], action[::2, -1] = 0.0, 1.0  # every other pushes
            now = batch.step(action)
            failed = np.array([error is not None for error in now.errors]) & ~ended
            found["errors"] += int(failed.sum())
            force = now.wall_force.peak_max[~ended].max(initial=0.0)
            found["force"] = max(found["force"], float(force))
            ended |= failed
        found["warnings"] += int(np.asarray(batch.batch.warning).sum())
        found["episodes"] += together
    return found


def judged(policy: str, task: str, case: str, episodes: int) -> dict:
    """Row of success, safe success, largest force (N) and steps of a policy."""
    options = {"vessel": CASES[case], "max_steps": LONGEST}
    result = evaluate(policy, task, episodes, task_kwargs=options)
    return {
        "policy": policy,
        "task": task,
        "case": case,
        "episodes": episodes,
        "successes": result.successes,
        "safe": round(result.safe_success(SAFE) * episodes),
        "force": result.mean_sd("forces.largest_sum")[0],
        "steps": result.mean_sd("length")[0],
        "commit": figures.origin("")["commit"],
    }


def table(data: dict) -> list[str]:
    """Table of all policies in all vessels, as lines of Markdown."""
    known = {(row["policy"], row["task"], row["case"]): row for row in data["policies"]}
    rows = []
    for policy, tasks in TASKS.items():
        for task in tasks:
            found = [known.get((policy, task, case)) for case in CASES]
            if any(found):
                rows.append([f"`{policy}`", f"`{task}`", *map(_cell, found)])
    return figures.grid(["policy", "task", *CASES], rows)


def _cell(row: dict | None) -> str:
    if row is None:
        return "–"
    return (
        f"{row['successes']} of {row['episodes']} ({row['safe']}), "
        f"{row['force']:.2f} N, {row['steps']:.0f}"
    )


def draw(data: dict) -> None:
    """Draws a picture of the success of each policy in each vessel."""
    rows = {(policy, task): {} for policy in TASKS for task in TASKS[policy]}
    for row in data["policies"]:
        share = 100 * row["successes"] / row["episodes"]
        rows[row["policy"], row["task"]][row["case"]] = share
    figure = Picture(figsize=(8, 0.36 * len(rows) + 0.9), layout="constrained")
    axes = figure.subplots()
    values = [[row.get(case, np.nan) for case in CASES] for row in rows.values()]
    axes.imshow(values, cmap="RdYlGn", vmin=0, vmax=100, aspect="auto", alpha=0.7)
    for place in np.ndindex(len(rows), len(CASES)):
        share = values[place[0]][place[1]]
        if np.isfinite(share):
            axes.text(*place[::-1], f"{share:.0f} %", ha="center", va="center")
    names = [f"{p.removeprefix('pretrained:')} on {task}" for p, task in rows]
    axes.set_xticks(range(len(CASES)), list(CASES))
    axes.set_yticks(range(len(rows)), names)
    axes.grid(False)
    figure.savefig(PICTURE, dpi=110)


def main():
    """Measures the named parts, then writes page and picture."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("parts", nargs="*", help="cost, soak, policies")
    parser.add_argument("--episodes", type=int, default=10)
    parser.add_argument("--policy", action="append", choices=TASKS)
    parser.add_argument("--case", action="append", choices=CASES)
    given = parser.parse_args()
    if unknown := set(given.parts) - {"cost", "soak", "policies"}:
        parser.error(
            f"no part is called {', '.join(unknown)}; give some of those above"
        )
    if "cost" in given.parts:
        _keep(cost=costs())
    if "soak" in given.parts:
        _keep(soak=soak())
    if "policies" in given.parts:
        for policy in given.policy or TASKS:
            for task in TASKS[policy]:
                for case in given.case or CASES:
                    row = judged(policy, task, case, given.episodes)
                    print(policy, task, case, _cell(row), file=sys.stderr, flush=True)
                    _keep(row)
    data = json.loads(DATA.read_text())
    draw(data)
    blocks: dict[str, str | list[str]] = {"policies": table(data)}
    if "cost" in data:
        rows = [
            (case, f"{row['random']:.2f}", f"{row['push']:.2f}")
            for case, row in data["cost"].items()
        ]
        blocks["cost"] = figures.grid(("", "random", "push"), rows)
    if "soak" in data:
        blocks["soak"] = (
            "{episodes} episodes of {steps} steps: {warnings} warnings of MuJoCo, "
            "{errors} physics errors (escapes among them), largest force {force:.2f} N."
        ).format(**data["soak"])
    figures.put(PAGE, **blocks)


def _keep(row: dict | None = None, **parts: dict) -> None:
    """Writes a row, in place of that of the same policy, task and vessel, or parts."""
    data: dict = json.loads(DATA.read_text())
    data |= parts
    if row is not None:
        others = [
            one
            for one in data["policies"]
            if any(one[key] != row[key] for key in ("policy", "task", "case"))
        ]
        data["policies"] = [*others, row]
    DATA.write_text(json.dumps(data, indent=1) + "\n")


if __name__ == "__main__":
    main()
