"""Training with collectors on a Ray cluster."""

import json
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
import torch
from test_agents_training import run, small_ppo
from torchrl.collectors import Collector

from cathsim_dmc.agents import ConfigError, collectors, make_config, ray_source, train
from cathsim_dmc.agents.collectors import check_collector
from cathsim_dmc.agents.metrics import read_metrics

ray = pytest.importorskip("ray")

SETTINGS = {
    "task": "simple1_bca",
    "num_envs": 8,
    "steps_per_update": 512,
    "minibatch_size": 128,
    "epochs": 2,
    "checkpoint_frames": 512,
    "metrics_frames": 512,
    "normalisation_frames": 64,
    "noise_correlation": 0.9,
    "noise_shared": 0.5,
    "collector": "ray",
    "collectors": 2,
}


@pytest.mark.parametrize(
    ("algorithm", "settings", "message"),
    [
        ("dagger", {}, "dagger.*choose collector='local'"),
        ("ppo", {"num_envs": 16, "collectors": 3}, "num_envs=16.*collectors=3"),
    ],
)
def test_what_no_cluster_can_collect_is_refused_at_once(
    tmp_path, algorithm, settings, message
):
    config = make_config(algorithm, collector="ray", **settings)
    with pytest.raises(ConfigError, match=message):
        train(config, tmp_path / "run", progress=False)
    assert not (tmp_path / "run").exists()


def test_without_ray_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(ConfigError, match=r"pip install 'cathsim-dmc\[ray\]'"):
        check_collector(make_config("ppo", collector="ray"))


class _Mortal:
    """Stands for RayCollector; the first one dies in its third batch."""

    made: list["_Mortal"] = []

    def __init__(self, factories, policy, *, frames_per_batch, **options):
        self.envs = [make() for make in factories]
        share = frames_per_batch // len(factories)
        options = collectors.OPTIONS
        self._collectors = [
            Collector(env, policy, frames_per_batch=share, **options)
            for env in self.envs
        ]
        self.weights = []
        self.made.append(self)

    def update_policy_weights_(self, weights):
        self.weights.append(weights.clone())

    def __iter__(self):
        batches = [iter(one) for one in self._collectors]
        while True:
            if len(self.made) == 1 and len(self.weights) == 3:
                raise ray.exceptions.RayActorError()
            yield torch.stack([next(one) for one in batches])

    def shutdown(self):
        pass


def test_lost_collectors_begin_anew_and_the_training_goes_on(
    tmp_path, monkeypatch, caplog
):
    monkeypatch.setattr(ray_source, "RayCollector", _Mortal)
    monkeypatch.setattr(ray_source, "_start_ray", lambda: None)
    monkeypatch.setattr(ray_source, "_require_room", lambda *needed: None)
    monkeypatch.setattr(_Mortal, "made", [])
    following, seen = ray_source.RaySource.next, []

    def watched(source):
        batch = following(source)
        seen.append(compared(source, batch))
        return batch

    monkeypatch.setattr(ray_source.RaySource, "next", watched)
    config = small_ppo(
        total_frames=2_048, epochs=1, collector="ray", collectors=2, num_envs=16
    )
    result = run(config, tmp_path)
    assert result.frames == 2_048
    rows = read_metrics(tmp_path / "metrics.csv")
    assert [row["frames"] for row in rows] == [512, 1_024, 1_536, 2_048]
    first, second = _Mortal.made
    assert [len(one.envs) for one in (first, second)] == [2, 2]
    assert (len(first.weights), len(second.weights)) == (3, 2)
    assert caplog.text.count("a collector was lost after 1024 frames") == 1
    # Weights and statistics are those of the learner at that time.
    assert [count for _, count, _ in seen] == [256, 768, 1_280, 1_792]
    assert seen[0][0] < 1e-5  # `_Mortal` keeps its first weights
    key = next(key for key in first.weights[0].keys(True, True) if "count" in key)
    counts = [float(weights[key]) for weights in (*first.weights, *second.weights)]
    assert counts == [256, 768, 1_280, 1_280, 1_792]


@torch.no_grad()
def compared(source, batch):
    """How far a batch is from what the learner's policy makes of it, and its shape.

    Returns:
        Largest difference of the means of actions, number of observations in the
        learner's statistics, shape of the batch.
    """
    learner = source._learner
    again = learner.network(batch.clone())
    worst = float((again["loc"] - batch["loc"]).abs().max())
    (statistics,) = [m.module for m in learner.network if hasattr(m.module, "count")]
    return worst, float(statistics.count), list(batch.shape)


def told(lines):
    """What the script says, among what Ray does."""
    return (json.loads(line[5:]) for line in lines if line.startswith("TOLD "))


TESTS = str(Path(__file__).parent)
# A cluster of two nodes with one processor each, and a training on it; tells of the
# collectors that it has, so that they can be killed, and how each batch compares.
SCRIPT = """
import json, sys, logging, os, time
os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
logging.basicConfig(level=logging.WARNING)
import ray
from ray._private import services
from ray.cluster_utils import Cluster
from cathsim_dmc.agents import make_config, ray_source, train

get_node = services.get_node

def patient(*args, **kwargs):
    end = time.monotonic() + 300
    while True:
        try:
            return get_node(*args, **kwargs)
        except RuntimeError:
            if time.monotonic() > end:
                raise
            time.sleep(0.5)

services.get_node = patient

cluster = Cluster(
    initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False}
)
cluster.add_node(num_cpus=1)
ray.init(address=cluster.address, log_to_driver=False)
start = ray_source.RaySource._start

def tell(self):
    start(self)
    def where():
        import os, ray, torch
        context = ray.get_runtime_context()
        return os.getpid(), context.get_node_id(), torch.initial_seed()
    places = [
        ray.get(one.__ray_call__.remote(lambda self, f=where: f()))
        for one in self._collector.remote_collectors
    ]
    print("TOLD", json.dumps(places), flush=True)

ray_source.RaySource._start = tell
sys.path.insert(0, sys.argv[3])
from test_collectors_ray import compared
following = ray_source.RaySource.next

def watched(self):
    batch = following(self)
    print("TOLD", json.dumps({"compared": compared(self, batch)}), flush=True)
    return batch

ray_source.RaySource.next = watched
config = make_config("ppo", **json.loads(sys.argv[2]))
result = train(config, sys.argv[1], progress=False)
print("TOLD", json.dumps({"frames": result.frames, "interrupted": result.interrupted}))
ray.shutdown()
cluster.shutdown()
"""


# Ray gives a node 30 s to come up, which is short beside other work, and kills workers
# when all processes of the machine together take much memory.
PATIENCE = {
    "RAY_memory_monitor_refresh_ms": "0",
    "RAY_raylet_start_wait_time_s": "300",
    "RAY_agent_register_timeout_ms": "300000",
    # A collector that is deleted after Ray has ended would start it again and wait.
    "RAY_ENABLE_AUTO_CONNECT": "0",
}


@pytest.mark.slow
def test_a_killed_collector_does_not_lose_the_run(tmp_path):
    """Two nodes; one collector is killed -9 half way, and the training goes on.

    The log-probabilities of each batch are those that the learner's policy gives.
    """
    settings = json.dumps({**SETTINGS, "total_frames": 3_072})
    with open(tmp_path / "errors.txt", "w") as errors:
        process = subprocess.Popen(
            [sys.executable, "-c", SCRIPT, tmp_path / "run", settings, TESTS],
            stdout=subprocess.PIPE,
            stderr=errors,
            text=True,
            env={**os.environ, **PATIENCE},
        )
    watchdog = threading.Timer(600, process.kill)  # reading its lines has no limit
    watchdog.start()
    try:
        lines = told(iter(process.stdout.readline, ""))
        first = next(lines)
        assert len({node for _, node, _ in first}) == 2, "both on one node"
        assert len({seed for _, _, seed in first}) == 2, "the same noise in both"
        table, end = tmp_path / "run" / "metrics.csv", time.monotonic() + 900
        while not table.exists() or len(read_metrics(table)) < 2:
            assert process.poll() is None, (tmp_path / "errors.txt").read_text()
            assert time.monotonic() < end
            time.sleep(0.05)
        os.kill(first[0][0], signal.SIGKILL)
        *rest, result = lines
        assert process.wait(300) == 0
    finally:
        watchdog.cancel()
        process.kill()
        process.wait()
    (second,) = [line for line in rest if isinstance(line, list)]
    assert not {pid for pid, *_ in first} & {pid for pid, *_ in second}
    batches = [line["compared"] for line in rest if isinstance(line, dict)]
    assert all(worst < 1e-5 for worst, *_ in batches), batches
    counts = [(count, shape) for _, count, shape in batches]
    assert counts == [(64 + 512 * index, [8, 64]) for index in range(6)]
    assert result == {"frames": 3_072, "interrupted": False}
    rows = read_metrics(table)
    assert [row["frames"] for row in rows] == list(range(512, 3_073, 512))
    assert all(row["kl_approx"] < 0.5 for row in rows)
    text = (tmp_path / "errors.txt").read_text()
    assert text.count("a collector was lost after") == 1
