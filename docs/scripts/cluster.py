"""Measures the costs of a cluster for docs/cluster_costs.md and writes its tables.

python docs/scripts/cluster.py          (with nothing else running)
python docs/scripts/cluster.py --write  (the tables alone, from docs/data)
"""

import argparse
import json
import subprocess
import sys

import figures

sys.path.insert(0, str(figures.ROOT / "benchmarks"))
import cluster_plan  # noqa: E402

PAGE = figures.ROOT / "docs" / "cluster_costs.md"
COMMAND = "benchmarks/cluster_costs.py"


def measure():
    command = [sys.executable, str(figures.ROOT / COMMAND)]
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
    figures.keep("cluster", json.loads(done.stdout), f"python {COMMAND}")


def load(found):
    """Lines on the load of the machine."""
    return [f"The load average was {found['load average']:.0f} on two cores."]


def speed(costs):
    """Table of control steps per second, absolute and relative to one process."""
    rates = costs["control steps per second"]
    alone = rates["one process"]
    rows = [(name, f"{x:,.0f}", f"{x / alone:.0%}") for name, x in rates.items()]
    return figures.grid(("", "control steps/s", "of one process"), rows)


def costs(found):
    """Tables of the costs of a batch, a job and a start."""
    rows = {f"weights ({name}, {one['kB']:,.0f} kB)": one
            for name, one in found["weights, ms"].items()}  # fmt: skip
    size = found["parts, ms"]["bytes a frame"]
    rows[f"parts of a batch ({size:,.0f} bytes a frame)"] = found["parts, ms"]
    counts = [key for key in found["parts, ms"] if key.isdigit()]
    shown = ([n, *(f"{one[key]:.1f}" for key in counts)] for n, one in rows.items())
    lines = figures.grid(["ms, by number of collectors", *counts], shown)
    once = {
        "start of a cluster of two nodes, s": found["start of the cluster, s"],
        "first batch of one collector, s": found["start of collectors, s"]["one node"],
        "first job of a process, s": found["first job, s"],
        "an empty job among many, ms": found["job, ms"],
        "control step, µs of a processor": found["control step, us of a processor"],
        "PPO (`tuned`), µs of a processor by the frame": found["learning, us a frame"],
        "lost process: its batch takes longer by, s": found["loss, s"]["process"],
        "lost node: its batch takes longer by, s": found["loss, s"]["node"],
    }
    shown = ((name, f"{value:.3g}") for name, value in once.items())
    return [*lines, "", *figures.grid(("once", ""), shown)]


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--write", action="store_true", help="tables alone")
    if not parser.parse_args().write:
        measure()
    report = json.loads((figures.DATA / "cluster.json").read_text())
    found = report["findings"]
    trainings, jobs = cluster_plan.tables(found)
    blocks = {"load": load(found), "speed": speed(found), "costs": costs(found)}
    blocks |= {"plan_of_trainings": trainings, "plan_of_jobs": jobs}
    figures.put(PAGE, measured=figures.since(report), **blocks)


if __name__ == "__main__":
    main()
