"""A plan for clusters of 10, 100 and 1,000 nodes, simulated from measured costs.

    python benchmarks/cluster_plan.py
    python benchmarks/cluster_plan.py --nodes 50 --learner-speed 1 --network 1e8

The costs of one node are read from docs/data/cluster.json, which
`benchmarks/cluster_costs.py` measures; Ray is not needed. The options are quantities
that cannot be measured on one machine. The same options give the same table.
"""

import dataclasses
import heapq
import json
from pathlib import Path

import numpy as np
import tyro

DATA = Path(__file__).parents[1] / "docs" / "data" / "cluster.json"
DAY = 86_400.0
BATCHES = 400  # simulated batches of a training


@dataclasses.dataclass(frozen=True)
class Assumptions:
    """What the plan takes for granted.

    Attributes:
        nodes: Numbers of nodes.
        processors: Number of processors of a node, a collector or a job on each.
        simulations: Number of simulations of each collector.
        steps: Control steps of each simulation in a batch.
        network: Bandwidth into the first machine, bytes/s.
        round_trip: Time of a message over the network and back, s.
        learner_speed: Speed of the learner as a multiple of one thread, as on a GPU.
        hours_between_losses: Mean time between two losses of one node, hours.
        job_seconds: Time of one independent job, s.
        jobs: Number of jobs for each processor.
    """

    nodes: tuple[int, ...] = (1, 10, 100, 1000)
    processors: int = 16
    simulations: int = 16
    steps: int = 64
    network: float = 1.25e9
    round_trip: float = 5e-4
    learner_speed: float = 20.0
    hours_between_losses: float = 1_000.0
    job_seconds: float = 60.0
    jobs: int = 10


def line(table):
    """Constant and slope, s, of a fit of milliseconds by the number of processes."""
    counts = {int(key): value for key, value in table.items() if key.isdigit()}
    slope, constant = np.polyfit(list(counts), list(counts.values()), 1)
    return max(constant, 0.0) / 1e3, max(slope, 0.0) / 1e3


def factors(costs, random, count):
    """Random times (count,) relative to their mean, with the spread of a batch."""
    sigma = np.sqrt(np.log1p(costs["spread of a batch's time"] ** 2))
    return random.lognormal(-(sigma**2) / 2, sigma, count)


def training(costs, given, nodes):
    """One row: a synchronous training whose batch grows with the cluster."""
    random = np.random.RandomState(nodes)
    collectors = nodes * given.processors
    frames = collectors * given.simulations * given.steps
    step = 1e-6 * costs["control step, us of a processor"]
    # The slowest of all collectors ends the collection.
    own = given.simulations * given.steps * step
    draws = (factors(costs, random, collectors).max() for _ in range(BATCHES))
    collecting = own * sum(draws) / BATCHES
    sent, received = costs["weights, ms"]["numbers"], costs["parts, ms"]
    constant, each = line(sent)
    # Ray copies an object once to each node, and from node to node.
    copies = 1e3 * sent["kB"] * np.ceil(np.log2(nodes + 1)) / given.network
    weights = constant + each * collectors + given.round_trip + copies
    constant, each = line(received)
    over = frames * received["bytes a frame"] / given.network
    gathering = constant + each * collectors + given.round_trip + over
    learning = 1e-6 * costs["learning, us a frame"] * frames / given.learner_speed
    batch = collecting + weights + gathering + learning
    losses = random.poisson(nodes * DAY / (3600 * given.hours_between_losses))
    # All processes wait for the restarted one and for its part.
    lost = losses * (max(costs["loss, s"].values()) + own)
    rate = frames / batch * (1.0 - min(lost / DAY, 1.0))
    parts = np.array([weights, collecting, gathering, learning]) / batch
    return {
        "nodes": nodes, "processors": collectors, "rate": rate,
        "of linear": rate * step / collectors, "shares": parts.tolist(),
        "losses": int(losses), "lost": lost / DAY,
        "size": frames * received["bytes a frame"],
    }  # fmt: skip


def independent(costs, given, nodes):
    """One row: jobs that do not wait for each other, such as episodes or anatomies."""
    random = np.random.RandomState(nodes)
    places = nodes * given.processors
    count = places * given.jobs
    lengths = given.job_seconds * factors(costs, random, count)
    # A node is lost half-way through its jobs, on average; they are restarted.
    chance = given.job_seconds / (3600 * given.hours_between_losses)
    lost = random.uniform(size=count) < chance
    free, submitted, end = [costs["first job, s"]] * places, 0.0, 0.0
    for length, again in zip(lengths, lost, strict=True):
        # The first machine submits jobs one after the other.
        submitted += costs["job, ms"] / 1e3
        begin = max(heapq.heappop(free), submitted)
        done = begin + length * (1.5 if again else 1.0)
        heapq.heappush(free, done)
        end = max(end, done)
    ideal = lengths.sum() / places
    return {
        "nodes": nodes, "processors": places, "jobs": count, "minutes": end / 60,
        "of linear": ideal / end, "again": int(lost.sum()),
    }  # fmt: skip


def tables(costs, given=None):
    """Both tables as lines of Markdown."""
    given = given or Assumptions()
    head = "| nodes | processors | frames/s | of linear | weights | collection | parts "
    trained = [
        head + "| learning | batch, GB | losses a day | time lost |",
        "|---" * 11 + "|",
    ]
    for row in (training(costs, given, nodes) for nodes in given.nodes):
        shares = " | ".join(f"{share:.1%}" for share in row["shares"])
        trained.append(
            f"| {row['nodes']:,} | {row['processors']:,} | {row['rate']:,.0f} "
            f"| {row['of linear']:.0%} | {shares} | {row['size'] / 1e9:.2f} "
            f"| {row['losses']} | {row['lost']:.1%} |"
        )
    jobs = ["| nodes | processors | jobs | minutes | of linear | begun again |"]
    jobs.append("|---" * 6 + "|")
    for row in (independent(costs, given, nodes) for nodes in given.nodes):
        jobs.append(
            f"| {row['nodes']:,} | {row['processors']:,} | {row['jobs']:,} "
            f"| {row['minutes']:.1f} | {row['of linear']:.0%} | {row['again']} |"
        )
    return trained, jobs


def main(given: tyro.conf.OmitArgPrefixes[Assumptions]) -> None:
    """Print the plan for trainings and that for independent jobs."""
    costs = json.loads(DATA.read_text())["findings"]
    for table in tables(costs, given):
        print("\n".join(table), end="\n\n")


if __name__ == "__main__":
    tyro.cli(main)
