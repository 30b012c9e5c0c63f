"""Training with collectors on a Ray cluster."""

import json
import os
import signal
import subprocess
import sys
import time

import pytest

from cathsim_dmc.agents import ConfigError, make_config, train
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


# A cluster of two nodes with one processor each, and a training on it; tells of the
# collectors that it has, so that they can be killed.
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
    # Ray gives a node 30 s to come up, which is short beside other work.
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
    collector = start(self)
    def where():
        import os, ray, torch
        context = ray.get_runtime_context()
        return os.getpid(), context.get_node_id(), torch.initial_seed()
    places = [
        ray.get(one.__ray_call__.remote(lambda self, f=where: f()))
        for one in collector.remote_collectors
    ]
    print(json.dumps(places), flush=True)
    return collector

ray_source.RaySource._start = tell
config = make_config("ppo", **json.loads(sys.argv[2]))
result = train(config, sys.argv[1], progress=False)
print(json.dumps({"frames": result.frames, "interrupted": result.interrupted}))
ray.shutdown()
cluster.shutdown()
"""


# Compares every batch with what the learner's policy makes of it.
WATCH = """
following = ray_source.RaySource.next

def watched(self):
    batch = following(self)
    again = self._learner.network(batch.clone())
    worst = float((again["loc"] - batch["loc"]).abs().max())
    count = float(self._learner.normaliser.module.count)
    print(json.dumps([worst, count, list(batch.shape)]), flush=True)
    return batch

ray_source.RaySource.next = watched
"""


@pytest.mark.slow
def test_a_killed_collector_does_not_lose_the_run(tmp_path):
    """Two nodes; one collector is killed -9 half way, and the training goes on."""
    settings = json.dumps({**SETTINGS, "total_frames": 3_072})
    with open(tmp_path / "errors.txt", "w") as errors:
        process = subprocess.Popen(
            [sys.executable, "-c", SCRIPT, str(tmp_path / "run"), settings],
            stdout=subprocess.PIPE,
            stderr=errors,
            text=True,
        )
    try:
        lines = iter(process.stdout.readline, "")
        first = json.loads(next(lines))
        assert len({node for _, node, _ in first}) == 2, "both on one node"
        assert len({seed for _, _, seed in first}) == 2, "the same noise in both"
        table, end = tmp_path / "run" / "metrics.csv", time.monotonic() + 900
        while not table.exists() or len(read_metrics(table)) < 2:
            assert process.poll() is None, (tmp_path / "errors.txt").read_text()
            assert time.monotonic() < end
            time.sleep(0.05)
        os.kill(first[0][0], signal.SIGKILL)
        second = json.loads(next(lines))
        result = json.loads(next(lines))
        assert process.wait(300) == 0
    finally:
        process.kill()
        process.wait()
    assert not {pid for pid, *_ in first} & {pid for pid, *_ in second}
    assert result == {"frames": 3_072, "interrupted": False}
    rows = read_metrics(table)
    assert [row["frames"] for row in rows] == list(range(512, 3_073, 512))
    assert all(row["kl_approx"] < 0.5 for row in rows)
    text = (tmp_path / "errors.txt").read_text()
    assert text.count("a collector was lost after") == 1


@pytest.mark.slow
def test_collectors_act_with_the_weights_and_statistics_of_the_learner(tmp_path):
    """The log-probabilities of a batch are those that the learner's policy gives."""
    script = SCRIPT.replace("config = make_config", f"{WATCH}config = make_config")
    settings = json.dumps({**SETTINGS, "total_frames": 1_536})
    done = subprocess.run(
        [sys.executable, "-c", script, str(tmp_path / "run"), settings],
        stdout=subprocess.PIPE,
        text=True,
        timeout=900,
        check=True,
    )
    _, *batches, _ = map(json.loads, done.stdout.splitlines())
    assert [shape for *_, shape in batches] == [[8, 64]] * 3
    counts = [count for _, count, _ in batches]
    assert counts == [64, 64 + 512, 64 + 1024]
    assert all(worst < 1e-5 for worst, *_ in batches), batches
