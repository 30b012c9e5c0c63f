"""Costs and gains of a Ray cluster, on two nodes of this machine.

    python benchmarks/cluster_costs.py           (with nothing else running)

Prints one JSON object, which `docs/scripts/cluster.py` keeps in docs/data and which
`benchmarks/cluster_plan.py` uses to plan larger clusters. Runs that are compared
alternate; control steps and learning are measured in processor time.
"""

import contextlib
import json
import os
import statistics
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import ray
import torch
import tyro
from ray.cluster_utils import Cluster
from tensordict import TensorDict

from cathsim_dmc import cluster
from cathsim_dmc.agents import make_config
from cathsim_dmc.agents.collection import make_collector
from cathsim_dmc.agents.learners import LEARNERS
from cathsim_dmc.agents.networks import NetworkShapes
from cathsim_dmc.cli.options import say
from cathsim_dmc.simulation import environments

TASK = "type1_lcca"
# Number of simulations, and control steps of each in a batch.
ENVS, STEPS = 16, 64
SIZES = (1, 2, 4, 8)  # numbers of processes that costs are fitted to
SETTINGS = {"task": TASK, "num_envs": ENVS, "steps_per_update": ENVS * STEPS}


def main(rounds: int = 8) -> None:
    """Measure everything and print it.

    Args:
        rounds: Number of times that each figure is measured; medians are reported.
    """
    with contextlib.redirect_stdout(sys.stderr):  # Ray reports losses on stdout
        found = measured(rounds)
    print(json.dumps({"checks": [], "findings": found}, indent=1))


def measured(rounds):
    """All measured values by name."""
    began = time.monotonic()
    nodes = Cluster(
        initialize_head=True, head_node_args={"num_cpus": 2, "include_dashboard": False}
    )
    second = nodes.add_node(num_cpus=2)
    ray.init(address=nodes.address, log_to_driver=False, logging_level="warning")
    found = {"start of the cluster, s": time.monotonic() - began}
    found["load average"] = os.getloadavg()[0]
    batch = {}
    for measure in (speeds, learning, weights, parts, jobs):
        say(measure.__name__)
        found |= measure(rounds, batch)
    say("losses")
    found |= losses(nodes, second)
    ray.shutdown()
    nodes.shutdown()
    return found


def source(folder, collector, processes):
    """A collector of batches, and its learner."""
    config = make_config(
        "ppo", "tuned", **SETTINGS, num_threads=1, collector=collector,
        collectors=processes,
    )  # fmt: skip
    env = environments.make_env(TASK, num_envs=ENVS, num_threads=1)
    shapes = NetworkShapes.of(env.observation_spec, env.action_spec)
    learner = LEARNERS["ppo"].learner(config, shapes, Path(folder))
    learner.attach(env)
    return make_collector(config, learner, env, environments.make_env, 0), learner


def speeds(rounds, kept):
    """Control steps per second of one process, one collector and two collectors."""
    kinds = {
        "one process": ("local", 1),
        "one node": ("ray", 1),
        "two nodes": ("ray", 2),
    }
    with tempfile.TemporaryDirectory() as folder:
        sources, starts = {}, {}
        for name, kind in kinds.items():
            began = time.monotonic()
            sources[name], kept["learner"] = source(folder, *kind)
            sources[name] = (sources[name], iter(sources[name]))
            next(sources[name][1])
            starts[name] = time.monotonic() - began
        taken, used = {name: [] for name in kinds}, []
        for _ in range(rounds):
            for name, (_, batches) in sources.items():
                began, before = time.monotonic(), time.process_time()
                kept["batch"] = next(batches)
                taken[name].append(time.monotonic() - began)
                if name == "one process":
                    used.append(time.process_time() - before)
        for one, _ in sources.values():
            one.shutdown()
    medians = {name: statistics.median(values) for name, values in taken.items()}
    alone = np.array(used)
    return {
        "control step, us of a processor": 1e6 * np.median(alone) / (ENVS * STEPS),
        "control steps per second": {n: ENVS * STEPS / s for n, s in medians.items()},
        "start of collectors, s": {n: s for n, s in starts.items() if "node" in n},
        "spread of a batch's time": float(alone.std() / alone.mean()),
    }


def learning(rounds, kept):
    """Processor time of an update per frame, on one thread."""
    torch.set_num_threads(1)
    taken = []
    for _ in range(max(rounds // 2, 2)):
        batch, began = kept["batch"].clone(), time.process_time()
        kept["learner"].update(batch, 0.5)
        taken.append(time.process_time() - began)
    return {"learning, us a frame": 1e6 * statistics.median(taken) / batch.numel()}


class Process:
    """Actor that receives weights and returns its part of a batch."""

    def take(self, weights):
        self.weights = weights

    def keep(self, part):
        self.part = part

    def give(self):
        return self.part


def weights(rounds, kept):
    """Milliseconds to send weights to a number of processes in parallel."""
    kept["actors"] = [
        ray.remote(num_cpus=0)(Process).remote() for _ in range(max(SIZES))
    ]
    small = TensorDict.from_module(kept["learner"].policy).data
    # As many parameters as the networks for images have.
    large = TensorDict({"convolutions": torch.zeros(4_900_000)})
    tables = {}
    for name, values in (("numbers", small), ("images", large)):
        table = {}
        for count in SIZES:
            taken = []
            for _ in range(rounds + 1):
                began = time.monotonic()
                given = ray.put(values)
                ray.get([one.take.remote(given) for one in kept["actors"][:count]])
                taken.append(1e3 * (time.monotonic() - began))
            table[str(count)] = statistics.median(taken[1:])  # the first one connects
        tables[name] = {"kB": values.bytes() / 1e3, **table}
    return {"weights, ms": tables}


def parts(rounds, kept):
    """Milliseconds to receive and concatenate a number of parts of a batch."""
    share, table = kept["batch"][: ENVS // 2].clone(), {}
    ray.get([one.keep.remote(share) for one in kept["actors"]])
    for count in SIZES:
        taken = []
        for _ in range(rounds + 1):
            began = time.monotonic()
            asked = [one.give.remote() for one in kept["actors"][:count]]
            torch.cat(ray.get(asked))
            taken.append(1e3 * (time.monotonic() - began))
        table[str(count)] = statistics.median(taken[1:])
    for one in kept["actors"]:
        ray.kill(one)
    return {"parts, ms": {"bytes a frame": share.bytes() / share.numel(), **table}}


def nothing(job):
    """A job that takes no time."""
    return job


def jobs(rounds, kept):
    """Milliseconds of an empty job among many; seconds of the first in a process."""
    began = time.monotonic()
    dict(cluster.over(nothing, range(1)))
    first, taken = time.monotonic() - began, []
    for _ in range(max(rounds // 2, 2)):
        began = time.monotonic()
        dict(cluster.over(nothing, range(200)))
        taken.append(1e3 * (time.monotonic() - began) / 200)
    return {"job, ms": statistics.median(taken), "first job, s": first}


def losses(nodes, second):
    """Seconds that the loss of a process and of a node add to a batch."""
    found = {}
    with tempfile.TemporaryDirectory() as folder:
        collector, _ = source(folder, "ray", 2)
        batches = iter(collector)
        next(batches)
        usual = _taken(batches)
        actors = collector._collector.remote_collectors
        ray.kill(actors[0])
        found["process"] = _taken(batches) - usual
        where = [ray.get(one.__ray_call__.remote(_node)) for one in actors]
        if second.node_id in where:
            nodes.remove_node(second, allow_graceful=False)
            found["node"] = _taken(batches) - usual
        collector.shutdown()
    return {"loss, s": found}


def _node(actor):
    return ray.get_runtime_context().get_node_id()


def _taken(batches):
    began = time.monotonic()
    next(batches)
    return time.monotonic() - began


if __name__ == "__main__":
    try:
        tyro.cli(main)
    except (ValueError, OSError) as error:
        sys.exit(f"cluster_costs: {error}")
