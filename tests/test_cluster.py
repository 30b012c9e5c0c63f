"""Independent jobs on a Ray cluster: the same numbers as on one machine."""

import dataclasses
import functools
import itertools
import json
import os
import signal
import sys
import threading
import time
import types
from pathlib import Path

import cluster_plan
import numpy as np
import pytest
import robust
import torch
import trainings
from tensordict import TensorDict

from cathsim_dmc import cluster
from cathsim_dmc.agents import evaluate, evaluation, load_policy, protocols
from cathsim_dmc.agents.policies import FunctionPolicy
from cathsim_dmc.recording import image_set
from cathsim_dmc.recording.image_set import ImageSetOptions
from cathsim_dmc.simulation import environments
from cathsim_dmc.tasks.config import EVALUATION_SEED

TASK = "type1_lcca"
VARIED = {"task": TASK, "protocol": "varied", "task_kwargs": {"max_steps": 12}}


def test_a_job_has_a_processor():
    with pytest.raises(ValueError, match="processors of a job is 0; it must be"):
        next(cluster.over(abs, [1], 0))


def test_without_ray_the_extra_is_named(monkeypatch, cathsim, tmp_path):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(ModuleNotFoundError, match=r"^ray is not installed.*\[ray\]"):
        list(cluster.over(abs, [1]))
    for command in (
        ("eval", "random", "--task", TASK, "--ray", "--out", tmp_path / "eval"),
        ("dataset", tmp_path / "set", "--ray"),
    ):
        code, _, error = cathsim(*command)
        assert code == 2 and "-e '.[ray]'" in error
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("rows", [1, 3])
def test_rows_of_a_network_do_not_depend_on_how_many_are_played(rows):
    torch.manual_seed(0)
    network = torch.nn.Sequential(torch.nn.Linear(900, 256), torch.nn.Linear(256, 21))
    policy = FunctionPolicy(lambda seen: network(seen[environments.VECTOR]), "network")
    seen = torch.randn(30, 900)
    whole = policy.act(observation(seen))
    for first in range(0, 30, rows):
        own = policy.among(first, 30).act(observation(seen[first : first + rows]))
        np.testing.assert_array_equal(own, whole[first : first + rows])


def observation(rows):
    return TensorDict({environments.VECTOR: rows}, [len(rows)])


@pytest.mark.parametrize(
    "name",
    [
        "random",
        pytest.param("expert", marks=pytest.mark.slow),
        pytest.param("pretrained:type1_lcca", marks=pytest.mark.slow),
    ],
)
def test_episodes_played_apart_are_those_played_together(name):
    player, logs = load_policy(name, 7), [evaluation.ContactLog() for _ in range(2)]
    parts = protocols.parts(
        protocols.get("varied"), TASK, {"max_steps": 12}, 7, EVALUATION_SEED
    )
    make_env = functools.partial(
        environments.make_env, TASK, observation=player.observation or "internal"
    )
    apart = []
    together = []
    for part in parts:
        whole = evaluation._Group(
            part, range(len(part.seeds)), player, True, make_env, None, 1, 1, None
        )
        together += evaluation._play(whole, logs[0])
        pieces = [(piece, evaluation.ContactLog()) for piece in whole.pieces(2)]
        apart += itertools.chain(*(evaluation._play(*each) for each in pieces))
        logs[1].join([log for _, log in pieces])
    assert apart == together and len(apart) == 7
    for one, other in zip(*(log.contacts() for log in logs), strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.slow
def test_a_policy_draws_the_same_for_each_device():
    """What was played before leaves the numbers of an evaluation alone."""
    player = load_policy("random")
    first, again = (evaluate(player, episodes=2, **VARIED) for _ in range(2))
    assert first.episodes == again.episodes


def test_the_plan_follows_from_the_measured_costs():
    report = json.loads(cluster_plan.DATA.read_text())
    page = (cluster_plan.DATA.parents[1] / "cluster_costs.md").read_text()
    for table in cluster_plan.tables(report["findings"]):
        assert "\n".join(table) in page, "run docs/scripts/cluster.py --write"
    usual = cluster_plan.Assumptions()
    rates = [
        cluster_plan.training(report["findings"], given, 100)["rate"]
        for given in (
            usual,
            dataclasses.replace(usual, network=1e7),
            dataclasses.replace(usual, learner_speed=1.0),
            dataclasses.replace(usual, hours_between_losses=1.0),
        )
    ]
    assert max(rates[1:]) < 0.99 * rates[0]
    jobs = cluster_plan.independent(report["findings"], usual, 10)
    often = dataclasses.replace(usual, hours_between_losses=1.0)
    worse = cluster_plan.independent(report["findings"], often, 10)
    assert jobs["jobs"] == 1_600 and 0.5 < jobs["of linear"] <= 1.0
    assert worse["again"] > 10 and worse["minutes"] >= jobs["minutes"]


@pytest.fixture
def fake_ray(monkeypatch, tmp_path):
    """Takes the place of Ray: jobs run here, in another folder, the last one first."""

    class RayError(Exception):
        pass

    class RayTaskError(RayError):
        def __init__(self, cause):
            super().__init__(cause)
            self.cause = cause

    class Ray(types.ModuleType):
        cancelled, options = [], {}

        def nodes(self):
            given = (True, {"CPU": 2.0}), (False, {"CPU": 9.0}), (True, {"CPU": 3.0})
            machines = *given, (True, {})
            return [{"Alive": alive, "Resources": own} for alive, own in machines]

        def remote(self, **options):
            self.options.update(options)
            return lambda work: types.SimpleNamespace(
                remote=lambda *given: functools.partial(work, *given)
            )

        def wait(self, left):
            return left[-1:], left[:-1]

        def get(self, job):
            os.chdir(tmp_path)
            try:
                return job()
            except RayError:
                raise
            except Exception as error:
                raise RayTaskError(error) from error

        def cancel(self, job, force):
            self.cancelled.append(job)

    ray = Ray("ray")
    ray.exceptions = types.SimpleNamespace(RayError=RayError, RayTaskError=RayTaskError)
    monkeypatch.setitem(sys.modules, "ray", ray)
    monkeypatch.setitem(sys.modules, "ray.exceptions", ray.exceptions)
    monkeypatch.setattr(cluster, "connect", lambda: None)
    monkeypatch.chdir(tmp_path)
    return ray


def test_the_room_of_a_cluster_is_that_of_its_live_machines(fake_ray):
    assert cluster.processors() == [3, 2, 0]
    assert [cluster.room(each) for each in (1, 2, 3, 4)] == [5, 2, 1, 0]
    cluster.require_room(2, 2)
    with pytest.raises(ValueError, match=r"3 x 2 .* \[3, 2, 0\], room for 2 x 2"):
        cluster.require_room(3, 2)
    with pytest.raises(ValueError, match="1 x 4 processors do not fit"):
        next(cluster.over(abs, [1], 4))


def test_each_job_of_a_cluster_has_its_result_and_those_left_are_cancelled(fake_ray):
    def work(number):
        if number == 11:
            raise ArithmeticError("a fault of the task")
        if number == 12:
            raise fake_ray.exceptions.RayError("a machine\nis gone")
        return number, os.getcwd()

    Path("here").mkdir()
    os.chdir("here")
    said, here = [], os.getcwd()
    jobs = cluster.over(work, range(10, 14), say=said.append, keep_going=True)
    found = dict(jobs)
    assert found[0] == (10, here) and found[3] == (13, here)
    assert isinstance(found[1], ArithmeticError) and found[1].__cause__
    assert str(found[2]) == "job 3 was lost 4 times, the last: a machine is gone"
    assert said == [f"{count} of 4 jobs are done" for count in (1, 2, 3, 4)]
    assert fake_ray.options == {"num_cpus": 1, "max_retries": 3}
    assert not fake_ray.cancelled
    with pytest.raises(ArithmeticError, match="a fault"):
        list(cluster.over(work, [10, 11, 13], 2))
    assert len(fake_ray.cancelled) == 1 and fake_ray.options["num_cpus"] == 2


@pytest.fixture(scope="module")
def nodes():
    pytest.importorskip("ray")
    from ray_cluster import two_nodes

    with two_nodes() as found:
        yield found


def kill_when(nodes, path):
    """Kills the second node as soon as a file is there."""

    def wait():
        while not path.exists():
            time.sleep(0.05)
        nodes.kill()

    killer = threading.Thread(target=wait, daemon=True)
    killer.start()
    return killer


def pause_there(node, path):
    """Makes the file and waits to be killed, once, on one node."""
    import ray

    if ray.get_runtime_context().get_node_id() == node and not path.exists():
        path.touch()
        time.sleep(600)


@pytest.mark.slow
def test_jobs_of_a_killed_node_run_again(nodes, tmp_path):
    nodes.restore()
    reached, second = tmp_path / "reached", nodes.second

    def work(number):
        pause_there(second, reached)
        time.sleep(0.2)
        return number**2

    killer = kill_when(nodes, reached)
    said = []
    found = dict(cluster.over(work, range(8), say=said.append))
    killer.join(60)
    assert found == {number: number**2 for number in range(8)}
    assert said[-1] == "8 of 8 jobs are done" and len(said) == 8
    with pytest.raises(
        ValueError, match=r"1 x 2 processors.*\[1(, 1)?\], room for 0 x 2"
    ):
        next(cluster.over(work, [1], 2))


@pytest.mark.slow
def test_errors_of_jobs_are_those_of_the_work(nodes):
    def work(number):
        if number == 1:
            raise ArithmeticError("a fault of the task")
        if number == 2:
            os.kill(os.getpid(), signal.SIGKILL)
        return number

    with pytest.raises(ArithmeticError, match="a fault of the task"):
        list(cluster.over(work, [1, 1]))
    found = dict(cluster.over(work, range(3), keep_going=True))
    assert found[0] == 0 and isinstance(found[1], ArithmeticError)
    assert isinstance(found[2], RuntimeError) and "was lost 4 times" in str(found[2])


def test_nothing_is_sent_to_ray(monkeypatch):
    """The own option of Ray is off where this package starts a cluster."""
    ray = pytest.importorskip("ray")
    given = {}
    monkeypatch.setattr(ray, "is_initialized", lambda: False)
    monkeypatch.setattr(ray, "init", lambda **options: given.update(options))
    before = dict(os.environ)
    cluster.connect()
    assert given["include_dashboard"] is False and dict(os.environ) == before


@pytest.mark.slow
def test_an_evaluation_survives_a_node_bit_for_bit(nodes, tmp_path):
    nodes.restore()
    reached, second, here = tmp_path / "reached", nodes.second, os.getpid()
    network = torch.nn.Linear(900, 21)

    def policy(seen):
        if os.getpid() != here:
            pause_there(second, reached)
        vector = seen[environments.VECTOR]
        filled = torch.nn.functional.pad(vector, (0, 900 - vector.shape[-1]))
        return network(filled).tanh()

    logs = [evaluation.ContactLog() for _ in range(2)]
    alone = evaluate(policy, episodes=5, observer=logs[0], **VARIED)
    killer = kill_when(nodes, reached)
    options = {"observer": logs[1], "on_cluster": True, **VARIED}
    found = evaluate(policy, episodes=5, **options)
    killer.join(60)
    assert reached.exists() and found.to_dict() == alone.to_dict()
    for one, other in zip(*(log.contacts() for log in logs), strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.slow
def test_the_command_evaluates_on_a_cluster(nodes, tmp_path, cathsim):
    nodes.restore()
    common = ("eval", "pretrained:type1_lcca", "--episodes", 4, "--max-steps", 40)
    files = []
    for name, more in (("alone", ()), ("cluster", ("--ray",))):
        code, _, _ = cathsim(*common, "--out", tmp_path / name, *more)
        assert code == 0
        found = json.loads((tmp_path / name / "evaluation.json").read_text())
        found.pop("seconds")
        files.append((found, (tmp_path / name / "heatmap.png").read_bytes()))
    assert files[0] == files[1]


@pytest.mark.slow
def test_a_data_set_survives_a_node_byte_for_byte(nodes, tmp_path, monkeypatch):
    nodes.restore()
    small = {"sequences": 1, "frames": 2, "views": 1, "size": 64}
    options = ImageSetOptions(**small, anatomies=(1, 1, 0))
    image_set.write(tmp_path / "alone", options, processes=1)
    reached, second, lines = tmp_path / "reached", nodes.second, []

    def simulated(shard):
        pause_there(second, reached)
        from cathsim_dmc.recording import image_set

        return image_set._simulated(shard)

    monkeypatch.setattr(image_set, "_simulated", simulated)
    killer = kill_when(nodes, reached)
    done = image_set.write(
        tmp_path / "cluster", options, say=lines.append, on_cluster=True
    )
    killer.join(60)
    assert reached.exists() and done["new"] == 4 and len(lines) == 2
    files = [contents(tmp_path / name) for name in ("alone", "cluster")]
    assert files[0] == files[1] and len(files[0]) == 2 + 3 + 2


def contents(folder):
    """Bytes of all files by their path in a folder."""
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file()
    }


@pytest.mark.slow
def test_the_cells_of_the_varied_protocol_are_those_of_one_machine(nodes, tmp_path):
    nodes.restore()
    lines = []
    for name, ray in (("alone", False), ("cluster", True)):
        out = tmp_path / f"{name}.jsonl"
        cells = robust.Selection(only=("anatomies",), anatomy=("simple1",), max_steps=5)
        robust.main("random", out, cells, ray=ray)
        robust.main("random", out, cells, ray=ray)  # nothing is left
        lines.append([json.loads(line) for line in out.read_text().splitlines()])
        for line in lines[-1]:
            line.pop("seconds")
    assert lines[0] == lines[1] and len(lines[0]) >= 2


GRID = """
[[row]]
label = "PPO"
algorithm = "ppo"
preset = "demo"
observation = "internal"
tasks = ["simple1_bca"]
seeds = [0]
total_frames = 512
evaluation = { episodes = 1 }
settings = { num_envs = 8, steps_per_update = 256, hidden = [8] }
"""
# Begins when that above is trained.
AFTER = GRID.replace("{ num", '{ initial_policy = "runs/NAME", num').replace(
    '"internal"', '"internal"\nvariant = "after"'
)


@pytest.mark.slow
def test_trainings_on_a_cluster_are_those_of_one_machine(
    nodes, tmp_path, monkeypatch, capsys
):
    nodes.restore()
    (tmp_path / "grid.toml").write_text(GRID)
    (first,) = trainings.read_grid(tmp_path / "grid.toml")
    # On the cluster, one that starts from it, and is the first in the grid.
    texts = {"alone": GRID, "cluster": AFTER.replace("NAME", first.name) + GRID}
    results = []
    for name, text in texts.items():
        (tmp_path / name).mkdir()
        monkeypatch.chdir(tmp_path / name)
        Path("grid.toml").write_text(text)
        where = Path("grid.toml"), Path("runs"), Path("results")
        assert trainings.main(*where, ray=name == "cluster") == 0, capsys.readouterr()
        found = json.loads(Path(f"results/{first.name}.json").read_text())
        results.append(timeless(found))
    assert results[0] == results[1]
    assert len(list(Path("results").iterdir())) == 2
    # A folder that another machine does not see.
    mark = tmp_path / "nowhere"
    with pytest.raises(FileNotFoundError, match="all machines share"):
        trainings._work_apart((first, mark, mark, mark, 1, 1))


def timeless(result):
    """A result without what a clock says."""
    del result["finished"]
    for values in result["training"], result["training"]["curve"], result["evaluation"]:
        del values["seconds"]
    if result["training"]["solved"]:
        del result["training"]["solved"]["seconds"]
    return result
