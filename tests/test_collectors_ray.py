"""Training with collectors on a Ray cluster."""

import functools
import os
import signal
import sys
import threading
import time
import types

import pytest
import synthetic_env
import torch
from tensordict import TensorDict
from test_agents_training import run, small_ppo, small_sac

from cathsim_dmc.agents import ConfigError, make_config, train
from cathsim_dmc.agents.collection import check_collector
from cathsim_dmc.agents.episodes import EpisodeTracker
from cathsim_dmc.agents.learners import LEARNERS
from cathsim_dmc.agents.training_log import read_metrics

CLUSTER = {"collector": "ray", "collectors": 2}


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
    with pytest.raises(ConfigError, match=r"ray is not installed.*-e '.\[ray\]'"):
        check_collector(make_config("ppo", collector="ray"), LEARNERS["ppo"].learner)


def test_episodes_whose_process_was_lost_are_left_out():
    env = synthetic_env.make_env("reach", num_envs=3, task_kwargs={"max_steps": 5})
    torch.manual_seed(0)
    whole, tracker = EpisodeTracker(3), EpisodeTracker(3)
    first = env.rollout(3, break_when_any_done=False)
    tracker.add(first)
    # New episodes in all places, as from another collector.
    second = env.rollout(10, break_when_any_done=False)
    outcomes = tracker.add(second)
    assert outcomes == whole.add(second) and len(outcomes) == 6
    assert {one.length for one in outcomes} == {5}


class Actor:
    """A collector in place of a process: its row of a batch, or its loss."""

    def __init__(self, row=None):
        self.row, self.weights, self.asked = row, [], 0
        for name in ("update_policy_weights_", "next"):
            remote = functools.partial(functools.partial, getattr(self, f"_{name}"))
            setattr(self, name, types.SimpleNamespace(remote=remote))

    def _update_policy_weights_(self, weights):
        self.weights.append(float(weights["weight"]))

    def _next(self):
        self.asked += 1
        if self.row is None:
            from ray.exceptions import RayActorError

            raise RayActorError
        return TensorDict({"row": torch.tensor([self.row])}, [1])


def test_a_lost_collector_is_replaced_and_the_parts_keep_their_order(monkeypatch):
    pytest.importorskip("ray")
    from cathsim_dmc.agents import ray_source

    made, added = [], []

    def make_env(task, **options):
        made.append((torch_seeds[-1], options))

    class Collectors:
        remote_collectors = lost, other = [Actor(), Actor(1.0)]
        collector_kwargs = [{"own": n} for n in range(2)]

        def add_collectors(self, factories, count, policy, options, places):
            added.append((options, places))
            factories[0]()
            self.remote_collectors.append(Actor(0.0))

    torch_seeds, threads, killed = [], [], []
    monkeypatch.setattr(torch, "manual_seed", torch_seeds.append)
    monkeypatch.setattr(torch, "set_num_threads", threads.append)
    monkeypatch.setattr(ray_source, "_await_certainty", lambda actor: None)
    monkeypatch.setattr(ray_source.cluster, "room", lambda each: 1)
    ray = types.SimpleNamespace(
        put=lambda held: held, kill=killed.append,
        get=lambda requests: [request() for request in requests],
    )  # fmt: skip
    monkeypatch.setattr(ray_source, "ray", ray)
    policy, source = torch.nn.Linear(1, 1), object.__new__(ray_source.RaySource)
    torch.nn.init.constant_(policy.weight, 4.0)
    config = small_ppo(
        num_envs=4,
        torch_threads=7,
        training_max_steps=5,
        critic_observation="full",
        **CLUSTER,
    )
    vars(source).update(
        _config=config, _learner=types.SimpleNamespace(policy=policy),
        _make_env=make_env, _frames=600, _losses=0, _threads=1, _policy=None,
        _random_frames=lambda frames: 1500 - frames, _collector=Collectors(),
    )  # fmt: skip
    for number in range(2):
        source._factory(number)()
    assert source._batch()["row"].tolist() == [0.0, 1.0]
    assert killed == [Collectors.lost]
    assert Collectors.other.asked == 1 and Collectors.other.weights == [4.0]
    # Random frames are shared; without a processor the new one shares one.
    assert added[0][0] == [{"own": 0, "init_random_frames": 450}]
    assert added[0][1][0]["num_cpus"] == 0
    assert source._batch()["row"].tolist() == [0.0, 1.0]
    assert source._frames == 600 + 2 * config.frames_per_batch
    source._factory(0)()
    seeds, options = zip(*made, strict=True)
    assert len(set(seeds)) == len({one["seed"] for one in options}) == 4
    assert options[1]["seed"] - options[0]["seed"] == 2
    assert {one["num_envs"] for one in options} == {2} and set(threads) == {7}
    assert options[0]["task_kwargs"] == config.training_kwargs
    assert options[0]["observation"] == config.collected_observation


@pytest.fixture(scope="module")
def nodes():
    pytest.importorskip("ray")
    from ray_cluster import two_nodes

    with two_nodes() as found:
        yield found


@pytest.fixture
def batches(monkeypatch):
    """The batches of the cluster, with what each was collected with."""
    from cathsim_dmc.agents import ray_source

    collect, seen = ray_source.RaySource._batch, []

    def batch(source):
        found = collect(source)
        seen.append((found.clone(), *compared(source, found)))
        return found

    monkeypatch.setattr(ray_source.RaySource, "_batch", batch)
    return seen


@torch.no_grad()
def compared(source, batch):
    """How a batch compares with what the learner's policy makes of it now.

    Returns:
        Largest difference of the means of actions, number of observations in the
        learner's statistics, seed and node of each collector.
    """
    import ray

    def where(collector):
        return torch.initial_seed(), ray.get_runtime_context().get_node_id()

    learner = source._learner
    again = learner.network(batch.clone())
    worst = float((again["loc"] - batch["loc"]).abs().max())
    (statistics,) = [m.module for m in learner.network if hasattr(m.module, "count")]
    actors = source._collector.remote_collectors
    places = ray.get([one.__ray_call__.remote(where) for one in actors])
    return worst, float(statistics.count), places


def goes_on(before, after, rows):
    """Whether simulations go on in a batch where they were after that before."""
    last, first = before[rows]["next"], after[rows]
    running = ~last["done"][:, -1, 0]
    same = last["observation_vector"][:, -1] == first["observation_vector"][:, 0]
    return bool(running.any()) and bool(same.all(-1)[running].all())


@pytest.mark.slow
def test_a_killed_node_costs_its_part_of_one_batch(nodes, tmp_path, batches, caplog):
    """Frames, weights, statistics and the episodes of the other node stay."""
    nodes.restore()
    reached, second = tmp_path / "reached", nodes.second

    def pause():
        import ray

        if ray.get_runtime_context().get_node_id() == second and not reached.exists():
            reached.touch()
            time.sleep(600)

    def kill():
        while not reached.exists():
            time.sleep(0.05)
        nodes.kill()

    killer = threading.Thread(target=kill, daemon=True)
    killer.start()
    # In the middle of the third batch of 32 control steps.
    make_env = synthetic_env.calling(pause, at=80)
    config = small_ppo(total_frames=2_560, **CLUSTER)
    result = run(config, tmp_path / "run", make_env=make_env)
    killer.join(60)
    assert result.frames == 2_560
    rows = read_metrics(tmp_path / "run" / "metrics.csv")
    assert [row["frames"] for row in rows] == list(range(512, 2_561, 512))
    assert [one[0].shape for one in batches] == [(16, 32)] * 5
    assert all(worst < 1e-5 for _, worst, *_ in batches)
    assert [count for _, _, count, _ in batches] == [256 + 512 * n for n in range(5)]
    places = [place for *_, place in batches]
    (lost,) = [n for n, (_, node) in enumerate(places[0]) if node == second]
    halves = slice(0, 8), slice(8, 16)
    there, gone = halves[1 - lost], halves[lost]
    for number in range(4):
        pair = batches[number][0], batches[number + 1][0]
        assert goes_on(*pair, there)
        assert goes_on(*pair, gone) == (number != 1)
    assert not batches[2][0][gone]["step_count"][:, 0].any()
    # Another one, with noise of its own, beside the one that has always been there.
    assert places[2][1 - lost] == places[1][1 - lost]
    assert places[2][lost][0] not in [seed for seed, _ in places[1]]
    assert caplog.text.count("was lost after 1024 frames") == 1
    assert "shares processors" in caplog.text
    # On one machine, without the cluster.
    local = config.replace(collector="local", total_frames=3_072)
    assert run(local, tmp_path / "run", resume=True).frames == 3_072


@pytest.mark.slow
def test_a_run_of_one_machine_goes_on_in_a_cluster(nodes, tmp_path, batches, caplog):
    """A process that is killed is replaced; random actions are those that were left."""
    nodes.restore()
    reached = tmp_path / "reached"

    def die():
        if not reached.exists():
            reached.touch()
            os.kill(os.getpid(), signal.SIGKILL)

    config = small_sac(total_frames=256, random_frames=512, steps_per_env=16)
    run(config, tmp_path / "run")
    config = config.replace(total_frames=768, **CLUSTER)
    make_env = synthetic_env.calling(die, at=20)
    result = run(config, tmp_path / "run", resume=True, make_env=make_env)
    assert result.frames == 768 and reached.exists()
    assert caplog.text.count("begins new episodes in its place") == 1
    # Random actions have no mean.
    assert [worst > 1e-3 for _, worst, *_ in batches] == [True, False]


@pytest.mark.slow
def test_errors_say_what_the_cluster_lacks_or_what_happened(nodes, tmp_path):
    nodes.restore()
    config = small_ppo(**CLUSTER)
    with pytest.raises(ConfigError, match=r"4 x 1 processors.*\[1, 1\], room for 2"):
        run(config.replace(collectors=4), tmp_path / "many")
    with pytest.raises(ConfigError, match=r"2 x 2 processors.*room for 0 x 2"):
        run(config.replace(num_threads=2), tmp_path / "wide")
    assert not list(tmp_path.iterdir())

    def fail():
        raise ArithmeticError("a fault of the task")

    def die():
        os.kill(os.getpid(), signal.SIGKILL)

    single = config.replace(normalisation_frames=0, collectors=1)
    with pytest.raises(ArithmeticError, match="a fault of the task"):
        run(single, tmp_path / "fault", make_env=synthetic_env.calling(fail))
    with pytest.raises(RuntimeError, match="lost 3 times in a row.*can be resumed"):
        run(single, tmp_path / "dead", make_env=synthetic_env.calling(die))
