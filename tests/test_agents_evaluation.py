import dataclasses
import json
import types

import numpy as np
import pytest
import synthetic_env
import torch
from dm_control.composer.variation import distributions
from tensordict import TensorDict
from tensordict.nn import TensorDictModule

from cathsim_dmc import __version__, suite
from cathsim_dmc.agents import (
    evaluate,
    evaluation,
    evaluation_files,
    policies,
    protocols,
)
from cathsim_dmc.agents.episodes import EpisodeOutcome, EpisodeTracker
from cathsim_dmc.agents.evaluation import EvaluationResult
from cathsim_dmc.analysis.force_statistics import FIGURES, EpisodeForces, Statistics
from cathsim_dmc.analysis.intervals import success_interval
from cathsim_dmc.cli import agents as commands
from cathsim_dmc.cli import task_options
from cathsim_dmc.cli.options import told_of_replaced
from cathsim_dmc.entities.devices import DEVICES
from cathsim_dmc.physics.effects import Effect
from cathsim_dmc.physics.forces import NAMES
from cathsim_dmc.physics.randomisation import Randomisation
from cathsim_dmc.policies import Policy
from cathsim_dmc.simulation.batch import BatchSimulation

SORTED = sorted(synthetic_env.SIZES)
# Where "position" begins in the concatenated observation.
START = sum(synthetic_env.SIZES[n] for n in SORTED[: SORTED.index("position")])


def expert(observation):
    """Steer straight to the origin."""
    point = observation["observation_vector"][:, START : START + 3]
    action = torch.zeros(len(point), synthetic_env.ACTIONS)
    action[:, :3] = (-10 * point).clamp(-1, 1)
    return action


def push(observation):
    return torch.ones(*observation.batch_size, synthetic_env.ACTIONS)


def play(**kwargs):
    return evaluate(make_env=synthetic_env.make_env, task="reach", **kwargs)


def test_each_seed_is_played_once_and_as_if_alone():
    together = play(policy=expert, episodes=6, seed=50)
    for index, episode in enumerate(together.episodes):
        assert episode.env == index
        (alone,) = play(policy=expert, episodes=1, seed=50 + index).episodes
        assert alone.reward == pytest.approx(episode.reward)
        assert alone.length == episode.length
        env = synthetic_env.ReachEnv(1, seed=50 + index)
        env.reset()
        away = np.linalg.norm(env.point[0])
        assert episode.length >= (away - synthetic_env.GOAL_RADIUS) / 0.1 / 3**0.5
    # Lengths differ, so the quick environments had begun further episodes.
    assert len({episode.length for episode in together.episodes}) > 1
    assert together.successes == 6


def test_only_the_first_episode_of_each_seed_counts():
    """The first of four stands still; the others reach the goal again and again."""

    def three_go(observation):
        action = expert(observation)
        if len(action) > 1:
            action[0] = 0.0
        return action

    class ThreeGo(Policy):
        def reset(self, view, which):
            begun.append(which.copy())

        def act(self, observation):
            return three_go(observation)

    begun, run = [], []
    many = play(
        policy=ThreeGo(), episodes=4, seed=50,
        observer=lambda env, running: run.append(running.copy()),
    ).episodes  # fmt: skip
    assert sum(run).tolist() == [episode.length for episode in many]
    count = sum(begun)
    assert count[0] == 1 and (count[1:] > 1).all()
    assert many[0].length == 40 and not many[0].success
    for number, episode in enumerate(many[1:], 51):
        (alone,) = play(policy=three_go, episodes=1, seed=number).episodes
        assert (episode.length, episode.success) == (alone.length, True)
        assert episode.reward == pytest.approx(alone.reward)
        assert episode.length < 20  # so that another one ends


def test_an_observer_leaves_out_the_step_of_a_physics_error(monkeypatch):
    """The first of two stands still, and its physics fails in the third step."""
    step, run = synthetic_env.ReachEnv._step, []

    def failing(self, tensordict):
        after = step(self, tensordict)
        lost = torch.tensor([[self.count[0] == 3], [False]])
        after["info", "physics_error"] = lost.float()
        after["terminated"] |= lost
        after["done"] |= lost
        return after

    monkeypatch.setattr(synthetic_env.ReachEnv, "_step", failing)
    found = play(
        policy=lambda observation: 0 * push(observation), episodes=2, seed=50,
        observer=lambda env, running: run.append(running.copy()),
    ).episodes  # fmt: skip
    assert [one.length for one in found] == [3, 40] and found[0].physics_error
    assert sum(run).tolist() == [2, 40]


def test_options_of_an_evaluation_replace_those_of_the_training():
    class Trained(Policy):
        task_kwargs, observation = {"max_steps": 5}, "internal"

        def act(self, observation):
            return push(observation)

    for given, length in (None, 5), ({}, 40):
        (episode,) = play(policy=Trained(), episodes=1, task_kwargs=given).episodes
        assert episode.length == length
    for given, played in (None, "internal"), ("image", "image"):
        result = play(policy=Trained(), episodes=1, observation=given)
        assert result.settings["observation"] == played


def test_pieces_of_a_group_are_its_episodes_with_their_numbers(monkeypatch):
    plan = evaluation._Plan.of(expert, "reach", 5, 50, "published", None, None, None)
    (group,) = plan.groups(None, None, synthetic_env.make_env, None)
    pieces = group.pieces(2)
    assert [len(piece.rows) for piece in pieces] == [2, 2, 1]
    found = [one for piece in pieces for one in evaluation._play(piece, None)]
    assert [one.env for one in found] == [0, 1, 2, 3, 4]
    whole = evaluation._play(group, None)
    assert [one.length for one in found] == [one.length for one in whole]
    assert {piece.num_threads for piece in pieces} == {1}
    cluster, threads = evaluation.cluster, []  # its jobs finish in any order
    monkeypatch.setattr(torch, "set_num_threads", threads.append)
    monkeypatch.setattr(
        cluster,
        "over",
        lambda work, jobs, each: [
            (n, work(jobs[n])) for n in reversed(range(len(jobs)))
        ],
    )
    for room in (2, 8):
        monkeypatch.setattr(cluster, "room", lambda each, room=room: room)
        assert evaluation._play_on_cluster([group], None) == whole
    assert set(threads) == {torch.get_num_threads()}
    starts, continued = [], dataclasses.replace(group, start=np.arange(5))
    monkeypatch.setattr(
        evaluation, "_first_episodes", lambda *given: starts.append([*given[-1]]) or ()
    )
    for piece in continued.pieces(2):
        evaluation._play(piece, None)
    assert starts == [[0, 1], [2, 3], [4]]


@pytest.mark.parametrize("protocol", ["published", "varied"])
def test_seeds_count_up_or_are_those_of_the_protocol(protocol):
    def make_env(task, *, seed, **_):
        seeds.append(seed)
        raise InterruptedError

    plan = evaluation._Plan.of("push", "type1_bca", 8, 3, protocol, None, None, None)
    groups = plan.groups(None, None, make_env, None)
    assert sum(len(group.part.seeds) for group in groups) == 8
    for group in groups:
        seeds = []
        with pytest.raises(InterruptedError):
            evaluation._play(group, None)
        (seed,), own = seeds, group.part.seeds
        assert seed == own if protocol == "varied" else seed == own[0] == 3


def test_the_contacts_of_later_episodes_are_left_out():
    """Those of simulations whose first episode has ended."""
    rng = np.random.RandomState(0)
    steps = [
        types.SimpleNamespace(
            present=rng.uniform(size=(3, 4)) < 0.6,
            position=rng.normal(size=(3, 4, 3)), magnitude=rng.uniform(size=(3, 4)),
        )
        for _ in range(2)
    ]  # fmt: skip
    log, shown = evaluation.ContactLog(), iter(steps)
    simulation = types.SimpleNamespace(contacts=lambda: next(shown))
    env = types.SimpleNamespace(base_env=types.SimpleNamespace(simulation=simulation))
    log(env, np.array([True, True, True]))
    log(env, np.array([False, True, False]))
    position, magnitude = log.contacts()
    wanted = [*steps[0].magnitude[steps[0].present]]
    wanted += [*steps[1].magnitude[1][steps[1].present[1]]]
    np.testing.assert_array_equal(magnitude, wanted)
    assert position.shape == (len(wanted), 3)


def test_what_is_told_of_an_episode_is_of_its_own_environment():
    """Two environments, of which the first ends after two steps and the second after
    one; its next episode has not ended.
    """

    def rows(*values):
        return torch.tensor(values)[..., None]

    info = {name: rows([0.1, 0.2], [0.3, 0.4]) for name in NAMES}
    info |= {
        "success": rows([False, True], [False, False]),
        "physics_error": rows([False, False], [True, False]),
        "path_ratio": rows([1.1, 1.2], [1.3, 1.4]),
    }
    ends = rows([False, True], [True, False])
    after = {"reward": rows([1.0, 2.0], [4.0, 8.0]), "done": ends, "terminated": ends}
    steps = {"step_count": rows([0, 1], [0, 0]), "next": {**after, "info": info}}
    second, first = EpisodeTracker(2).add(TensorDict(steps, [2, 2]))
    assert (first.env, first.length, first.reward) == (0, 2, 3.0)
    assert (second.env, second.length, second.reward) == (1, 1, 4.0)
    assert (first.success, first.physics_error) == (True, False)
    assert (second.success, second.physics_error) == (False, True)
    assert [first.path_ratio, second.path_ratio] == pytest.approx([1.2, 1.3])
    assert first.forces.max_force == pytest.approx(0.2)
    assert second.forces.max_force is None  # its only step is that of the error


@pytest.mark.parametrize("failed", [True, False, None])
def test_an_episode_that_the_objective_ended_is_not_one_given_up(failed):
    info = {name: torch.zeros(1, 1, 1) for name in (*NAMES, "path_ratio")}
    info |= dict.fromkeys(("success", "physics_error"), torch.zeros(1, 1, 1).bool())
    if failed is not None:  # not every environment has this figure
        info["failed"] = torch.full((1, 1, 1), failed)
    ends = torch.ones(1, 1, 1).bool()
    after = {"reward": torch.zeros(1, 1, 1), "done": ends, "terminated": ends}
    (episode,) = EpisodeTracker(1).add(
        TensorDict({"next": {**after, "info": info}}, [1, 1])
    )
    assert (episode.failed, episode.given_up) == (bool(failed), not failed)
    settings = {"protocol": None, "task_kwargs": {}}
    result = EvaluationResult("type1_lcca", "random", (0,), (episode,), settings)
    row = result.to_dict()["episodes"][0]
    assert evaluation_files.outcome(row) == episode
    assert evaluation_files.outcome({**row, "failed": False}).given_up
    assert result.summary().get("failed") == (1.0 if failed else None)
    assert result.summary().get("given_up") == (None if failed else 1.0)


def test_force_figures_are_those_of_the_steps():
    (episode,) = play(policy=push, episodes=1, seed=3).episodes
    env = synthetic_env.ReachEnv(1, seed=3)
    current = env.reset()
    forces, reward = [], 0.0
    while True:
        current["action"] = push(current)
        stepped, current = env.step_and_maybe_reset(current)
        forces.append(float(stepped["next", "info", "wall_force_mean_sum"]))
        reward += float(stepped["next", "reward"])
        if stepped["next", "done"]:
            break
    assert episode.length == len(forces) == 40
    assert episode.forces.mean_force == pytest.approx(np.mean(forces))
    assert episode.forces.max_force == pytest.approx(0.5 * max(forces))
    assert episode.forces.peak_force == episode.forces.max_force
    touching = [force for force in forces if force > 0]
    assert 0 < len(touching) < 40
    assert episode.forces.mean_sum.mean_in_contact == pytest.approx(np.mean(touching))
    assert episode.forces.largest_sum == pytest.approx(max(forces))
    assert episode.reward == pytest.approx(reward, rel=1e-5)
    assert (episode.success, episode.terminated) == (False, False)
    assert max(forces) > 0


def test_evaluation_repeats_and_is_json(tmp_path, monkeypatch):
    errors = []
    monkeypatch.setattr(
        evaluation.environments, "record_errors", lambda env, to: errors.append(to)
    )
    first = play(policy="random", episodes=5, out_dir=tmp_path)
    second = play(policy="random", episodes=5)
    assert first == second
    assert errors == [tmp_path / "errors"]
    assert play(policy="random", episodes=5, seed=1) != first
    written = json.loads((tmp_path / "evaluation.json").read_text())
    assert written == json.loads(json.dumps(first.to_dict()))
    assert len(written["episodes"]) == written["summary"]["episodes"] == 5
    assert written["episodes"][1]["seed"] == first.seeds[1]
    assert written["versions"]["cathsim-dmc"] == __version__
    assert EvaluationResult.load(tmp_path).versions == written["versions"]
    forces = written["summary"]["forces"]
    sums = [episode["forces"]["sum"]["mean"] for episode in written["episodes"]]
    assert forces["sum"]["mean"]["mean"] == pytest.approx(np.mean(sums))
    assert forces["sum"]["mean"]["sd"] == pytest.approx(np.std(sums, ddof=1))
    low, high = written["summary"]["success_ci95"]
    assert low <= written["summary"]["success"] <= high


def test_objects_among_the_options_are_written_as_texts(tmp_path):
    own = dataclasses.replace(DEVICES["steerable_5f"], name="own")
    options = {"effects": [Effect()], "device": own, "randomisation": True}

    def make_env(*args, task_kwargs, **kwargs):
        return synthetic_env.make_env(*args, **kwargs)

    given = {"make_env": make_env, "task_kwargs": options, "out_dir": tmp_path}
    result = evaluate("random", "reach", 2, **given)
    assert result.settings["task_kwargs"] == options
    written = json.loads((tmp_path / "evaluation.json").read_text())
    assert "Effect" in written["settings"]["task_kwargs"]["effects"][0]
    assert "name='own'" in written["settings"]["task_kwargs"]["device"]
    assert written["episodes"][1]["conditions"]["device"] == "own"


def test_the_varied_protocol_has_distinct_conditions():
    """Every tenth of each range holds a tenth of the episodes, by seeds alone."""
    varied = protocols.get("varied")
    parts = protocols.parts(varied, "type1_lcca", {}, 100, 1_000_000)
    assert [part.task_kwargs["device"] for part in parts] == list(varied.devices)
    drawn = [one for part in parts for one in part.conditions]
    seeds = [seed for part in parts for seed in part.seeds]
    assert len(set(seeds)) == len(drawn) == 100
    # What an episode begins with may be less than what was drawn.
    assert not {"insertion", "displacement"} & drawn[0].keys()
    assert np.linalg.norm(drawn[0]["displacement_drawn"]) <= 0.01
    names = "friction", "stiffness", "loss", "viscosity", "roll", "insertion_drawn"
    for name in names:
        low, high = getattr(protocols.VARIED_RANGES, name, None) or (0.0, 0.06)
        values = [one[name] for one in drawn]
        counts, _ = np.histogram(values, 10, (low, high))
        assert counts.min() >= 7 and counts.max() <= 13, (name, counts)
    again = np.random.RandomState(seeds[3])
    assert (
        drawn[3]["friction"] == varied.task_kwargs["randomisation"].draw(again).friction
    )
    (pair,) = protocols.parts(varied, "type1_lcca_pair", {}, 3, 0)
    own = {"pool": 5, "first": 20, "arches": "test"}
    for part in protocols.parts(varied, "arch_any", own, 20, 0):
        found = [one["arch"] for one in part.conditions]
        assert sorted(found) == sorted([*range(20, 25)] * 2)
        first = np.random.RandomState(part.seeds[0])
        assert first.randint(5) == found[0] - 20
        drawn = varied.task_kwargs["randomisation"].draw(first)
        assert drawn.friction == part.conditions[0]["friction"]
    assert "device" not in pair.task_kwargs
    with pytest.raises(ValueError, match="protocol is 'hard'; .*published, varied"):
        play(policy="random", protocol="hard")


@pytest.fixture
def own_task(monkeypatch):
    """Registers a task of these options over those of another one; returns its name."""

    def register(base, **options):
        own = {**suite.TASKS[base].options, **options}
        definition = dataclasses.replace(suite.TASKS[base], options=own)
        monkeypatch.setitem(suite.TASKS, "own", definition)
        return "own"

    return register


def test_a_task_is_played_with_its_own_options(own_task):
    varied, published = map(protocols.get, ("varied", "published"))
    task = own_task("type1_bca", device="diagnostic_5f_simmons")
    (part,) = protocols.parts(varied, task, {}, 4, 0)
    assert {one["device"] for one in part.conditions} == {"diagnostic_5f_simmons"}
    task = own_task("arch_bca", pool=2, first=3)
    parts = protocols.parts(varied, task, {}, 8, 0)
    arches = [one["arch"] for part in parts for one in part.conditions]
    assert sorted(arches) == [3] * 4 + [4] * 4
    parts = protocols.parts(varied, "arch_bca", {"numbers": [88, 10]}, 8, 0)
    arches = [one["arch"] for part in parts for one in part.conditions]
    assert sorted(arches) == [10] * 4 + [88] * 4
    task = own_task("type1_bca", randomisation={"friction": (0.1, 0.2)})
    (part,) = protocols.parts(published, task, {}, 4, 0)
    assert all(0.1 <= one["friction"] <= 0.2 for one in part.conditions)
    assert protocols.distinct(task, part.task_kwargs, 4) and len(part.conditions) == 4
    (part,) = protocols.parts(published, task, {"randomisation": False}, 4, 0)
    assert not part.conditions


def test_what_is_given_is_played_or_refused():
    """A device is played in all episodes; two randomisations are one too many."""
    varied = protocols.get("varied")
    for device in varied.devices:
        (part,) = protocols.parts(varied, "type1_bca", {"device": device}, 6, 0)
        assert [one["device"] for one in part.conditions] == [device] * 6
    options = task_options.task_kind()(randomisation={"friction": [0.1, 0.2]})
    message = "the protocol has its own; leave randomisation out"
    with pytest.raises(ValueError, match=message):
        commands.evaluate("push", "type1_bca", protocol="varied", options=options)
    with pytest.raises(ValueError, match=message):
        play(policy="push", protocol="varied", task_kwargs=options.given)


def test_an_evaluation_is_written_at_its_end_and_says_what_it_replaces(
    monkeypatch, tmp_path, capsys
):
    """A baseline that is interrupted leaves no file, which a study would skip."""
    target, meanwhile = tmp_path / "out" / "evaluation.json", KeyboardInterrupt

    def run(policy, **given):
        if policy != "random":
            where = {name: given[name] for name in given if name.endswith("_dir")}
            return play(policy=expert, episodes=2, **where)
        if meanwhile:
            raise meanwhile
        target.parent.mkdir()  # as another process does
        target.write_text("of another process")
        return play(policy=policy, episodes=2)

    player = policies.load_policy(expert)
    player.task = "type1_bca"
    monkeypatch.setattr(commands.agents, "load_policy", lambda *_: player)
    monkeypatch.setattr(commands.agents, "evaluate", run)
    monkeypatch.setattr(evaluation.ContactLog, "draw", lambda *_: None)
    given = {"out": target.parent, "options": task_options.task_kind()()}
    with pytest.raises(KeyboardInterrupt):
        commands.evaluate("mine", **given)
    assert not target.parent.exists()
    meanwhile = None
    commands.evaluate("mine", **given)
    assert f"{target}, which was there before, is replaced" in capsys.readouterr().err
    assert list(json.loads(target.read_text())) == ["policy", "baseline", "seconds"]


def test_the_randomisation_of_a_training_is_no_option_of_the_protocol(monkeypatch):
    """The leaderboard lists no evaluation with options of its own."""
    policy, seen = policies.FunctionPolicy(expert), []
    policy.task, policy.task_kwargs = "type1_bca", {"randomisation": True}

    def play(task, *, observation, num_envs, num_threads, task_kwargs, seed):
        seen.append(task_kwargs["randomisation"])
        return synthetic_env.make_env(task, num_envs=num_envs)

    done = evaluate(policy, episodes=2, protocol="varied", make_env=play)
    assert done.settings["task_kwargs"] == {} and seen == [protocols.VARIED_RANGES] * 2
    done = evaluate(policy, episodes=2, make_env=play)
    assert done.settings["task_kwargs"] == policy.task_kwargs and seen[2:] == [True]
    given = []
    monkeypatch.setattr(commands.agents, "load_policy", lambda *_: policy)
    monkeypatch.setattr(
        commands.agents,
        "evaluate",
        lambda *_, task_kwargs, **__: given.append(task_kwargs) or done,
    )
    options = task_options.task_kind()(device="steerable_4f")
    commands.evaluate("run", protocol="varied", json=True, options=options)
    assert given == [{"device": "steerable_4f"}] * 2


def test_a_policy_of_any_arch_goes_to_a_named_anatomy():
    """Options that chose the training's anatomy do not follow it to another task."""
    policy = policies.FunctionPolicy(expert)
    policy.task = "arch_any"
    policy.task_kwargs = {"pool": 4, "arches": "test", "goal": "lsa", "delay": 2}
    here = policies.task_and_options(policy, None, {"pool": 8})
    assert here == ("arch_any", {**policy.task_kwargs, "pool": 8})
    scan = {"anatomy": "my_scan"}
    there = policies.task_and_options(policy, None, scan)
    assert there == ("navigate", {"delay": 2, **scan})
    untrained = policies.task_and_options(policies.load_policy("expert"), None, scan)
    assert untrained == ("navigate", scan)
    there = policies.task_and_options(policy, "type1_lcca", None)
    assert there == ("type1_lcca", {"delay": 2})


def test_settings_of_the_machine_go_over_those_of_the_policy():
    policy = policies.load_policy("pretrained:navigator_image")
    own = policy.task_kwargs["fluoroscopy"]
    larger = {"fluoroscopy": {"detector_size": 0.9, "third": None}}
    _, options = policies.task_and_options(policy, "type1_lcca", larger)
    assert options["fluoroscopy"] == {**own, **larger["fluoroscopy"]}
    assert larger == {"fluoroscopy": {"detector_size": 0.9, "third": None}}


def test_a_policy_takes_its_devices_to_a_named_anatomy():
    policy = policies.load_policy("pretrained:navigator_pair")
    task, options = policies.task_and_options(policy, None, {"anatomy": "type2"})
    assert (task, options["devices"]) == ("navigate", suite.COAXIAL["pair"][0])
    named = policies.task_and_options(policy, "navigate", {"anatomy": "type2"})
    assert named == (task, options)
    made = suite.make_task(
        task, **options, goal="bca", access="descending", observation=policy.observation
    )
    assert made.scene.catheter.coaxial
    others = ("wire_014_micro", "microcatheter_2f4")
    given = {"anatomy": "type2", "devices": others}
    assert policies.task_and_options(policy, None, given)[1]["devices"] == others


def test_one_condition_has_no_interval_over_its_episodes():
    options = {"task": "type1_bca", "task_kwargs": {"max_steps": 2}, "episodes": 3}
    one = evaluate("push", **options)
    assert not one.distinct and one.summary()["success_ci95"] is None
    rates = one.summary()["safe_success"]
    assert rates == {"0.5 N": 0.0, "1 N": 0.0, "2 N": 0.0}
    many = evaluate("push", protocol="varied", **options)
    assert many.distinct and many.summary()["success_ci95"] is not None
    assert [e["conditions"]["device"] for e in many.to_dict()["episodes"]] == [
        "steerable_5f", "steerable_5f", "steerable_4f",
    ]  # fmt: skip


@pytest.mark.parametrize(
    "task, options, episodes, expected",
    [
        ("type1_bca", {"start_along_route": [0.5, 0.5]}, 5, False),
        ("type1_bca", {"start_along_route": [0.2, 0.5]}, 16, True),
        ("type1_bca", {"start_along_route": [0.2, 0.5]}, 17, False),
        ("arch_any", {"pool": 1}, 5, False),
        ("arch_any", {"pool": 7}, 7, True),
        ("arch_any", {"pool": 7}, 100, False),
        ("type1_bca", {"friction": [0.1, 0.1]}, 5, False),
        ("type1_bca", {"friction": [0.1, 0.2]}, 100, True),
        ("type1_bca", {"friction": distributions.Normal(0.1, 0.01)}, 100, True),
        ("type1_bca", {"delay": [3, 3]}, 5, False),
        ("type1_bca", {"delay": [0, 3]}, 4, True),
        ("type1_bca", {"delay": [0, 3]}, 5, False),
        ("type1_bca", {"start_insertion": [0.0, 0.06]}, 14, False),
        ("type1_bca", {"start_radius": 0.01}, 100, True),
        ("type1_bca", {"tracking_noise": 5e-4, "view": [-5, 5]}, 5, False),
        ("type1_bca", {"gain": [0.9, 1.1], "kerma": [0.5, 2.0]}, 5, False),
        ("type1_bca", {}, 1, False),
    ],
)
def test_episodes_are_distinct_where_all_draws_can_differ(
    task, options, episodes, expected
):
    if options.keys() & {field.name for field in dataclasses.fields(Randomisation)}:
        options = {"randomisation": options}
    assert protocols.distinct(task, options, episodes) == expected


def test_starts_are_counted_where_the_episodes_began():
    """The range of the draw is more than the half of the way that a start may take."""
    drawn = {"randomisation": {"start_insertion": [0.0, 0.2]}, "max_steps": 1}
    found = evaluate("push", "type1_bca", 20, task_kwargs=drawn)
    began = {one.start_insertion for one in found.episodes}
    assert found.num_conditions == len(began) <= 9 < len(found.episodes)
    assert max(began) < 0.04 and not found.distinct
    assert protocols.distinct("type1_bca", drawn, 20)
    # Those of several anatomies are not the same in each.
    both = drawn | {"anatomy": ["simple1", "type2"], "goal": "bca"}
    count = 2 * 41
    assert protocols.distinct("navigate", both, count, 16)
    assert not protocols.distinct("navigate", both, count + 1, 16)
    old = [dataclasses.replace(one, start_insertion=None) for one in found.episodes]
    assert dataclasses.replace(found, episodes=tuple(old)).num_conditions > len(began)


def test_an_evaluation_names_the_device_that_simulates_unless_it_is_the_cpu():
    def make_env(*given, device="cpu", **options):
        return evaluation.environments.make_env(*given, **options)

    how = {"task_kwargs": {"max_steps": 2}, "make_env": make_env}
    here = evaluate("push", "simple1_bca", 1, **how)
    there = evaluate("push", "simple1_bca", 1, simulation_device="cuda:1", **how)
    assert there.settings == {**here.settings, "simulated_on": "cuda:1"}
    added = {"mujoco-warp", "warp-lang", "numba-cuda"}
    assert there.versions.keys() - here.versions.keys() == added


def test_episodes_from_a_snapshot_are_distinct_where_its_states_are():
    drawn = {"friction": [0.05, 0.2], "gain": [0.9, 1.1], "start_radius": 0.0}
    snapshots = []
    for ranges in drawn, {**drawn, "friction": [0.1, 0.1]}:
        task = suite.make_task("simple1_bca", randomisation=ranges, max_steps=40)
        simulation = BatchSimulation(task, 3, num_threads=1, seeds=[1, 2, 3])
        simulation.reset()
        snapshots.append(simulation.snapshot())
    other, alike = snapshots
    assert protocols.distinct_states(other) and not protocols.distinct_states(alike)
    assert not protocols.distinct_states(other[[0, 1, 1]])
    push = np.zeros((3, simulation.num_actions))
    push[:, -1] = [0.0, 0.5, 1.0]
    for _ in range(10):
        simulation.step(push)
    apart = simulation.snapshot()  # by the way of their heads
    assert protocols.distinct_states(apart)
    assert not protocols.distinct_states(apart[:1])
    options = {"randomisation": ranges, "max_steps": 40}
    options = {"task_kwargs": options, "num_threads": 1}
    same = evaluate("push", "simple1_bca", start=apart[:1].repeat(4), **options)
    assert same.num_conditions == 1 and same.summary()["success_ci95"] is None
    found = evaluate("push", "simple1_bca", start=apart, **options)
    assert found.num_conditions == 3 and found.summary()["success_ci95"] is not None


def test_safe_success_counts_the_mean_force_of_every_control_step():
    def episode(success, force):
        told = {"mean_sum": Statistics(0.0, None, force)} if force else {}
        forces = EpisodeForces(peak_sum=Statistics(0.0, None, 0.9), **told)
        return EpisodeOutcome(0, 0.0, 1, True, success, forces, False, 1.0)

    episodes = (episode(True, 0.4), episode(True, 0.6), episode(False, 0.1))
    result = EvaluationResult("reach", "x", (1, 2, 3), episodes, {})
    assert result.safe_success(0.5) == pytest.approx(1 / 3)
    assert result.safe_success(1.0) == pytest.approx(2 / 3)
    exact = EvaluationResult("reach", "x", (1,), (episode(True, 0.5),), {})
    assert exact.safe_success(0.5) == 1.0
    # A file that does not tell the mean is held to the peak, which is never less.
    older = EvaluationResult("reach", "x", (1,), (episode(True, None),), {})
    assert older.safe_success(0.5) == 0 and older.safe_success(1.0) == 1
    assert "mean_sum" not in older.summary()["forces"]
    # Figures are of the episodes that tell them.
    failed = dataclasses.replace(episode(True, None), physics_error=True)
    mixed = (*episodes[:2], failed, failed)
    result = EvaluationResult("reach", "x", (4, 5, 6, 7), mixed, {}, distinct=False)
    (mean, deviation), told = (
        result.mean_sd("forces.mean_sum.maximum"),
        result.to_dict(),
    )
    assert (mean, deviation) == pytest.approx((0.5, 0.1 * 2**0.5))
    assert told["summary"]["forces"]["mean_sum"]["maximum"]["mean"] == mean
    assert told["summary"]["physics_errors"] == 2 and told["seed"] == 4


def test_success_interval_against_a_published_value():
    # Newcombe 1998, table I: 81 of 263 gives 0.2553 to 0.3662.
    assert success_interval(81, 263) == pytest.approx((0.2553, 0.3662), abs=1e-4)


def test_the_table_says_which_force_is_which(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")

    result = play(policy=push, episodes=3)
    commands.print_results([result])
    text = " ".join(capsys.readouterr().out.split())
    for name in FIGURES:
        assert f"{name.replace('_', ' ')}, mN" in text
    mean, deviation = result.mean_sd("forces.sum.mean")
    assert mean > 0.1
    assert f"│ {1e3 * mean:.0f} ± {1e3 * deviation:.0f}" in text
    for wrong in ("forces.sum.maen", "forces", "forces.sum", "lenght", 3, "policy"):
        with pytest.raises(ValueError, match=r"the figure is .*length.*peak_sum.*mean"):
            result.values(wrong)


def test_a_policy_that_does_not_fit_is_told_what_it_was_given():
    class Mute(Policy):
        name = "mute"

        def act(self, observation):
            return None

    def fails(policy, kind, words):
        with pytest.raises(kind, match=words) as caught:
            evaluate(
                policy,
                "simple1_bca",
                2,
                observation="tracking",
                num_threads=1,
                task_kwargs={"max_steps": 2},
            )
        return " ".join(getattr(caught.value, "__notes__", ()))

    for network in (torch.nn.Linear(49, 21), lambda many: many["tracking_goal"]):
        told = fails(network, (TypeError, KeyError), ".")
        assert "{'observation_vector': (2, 49)" in told and "lambda seen" in told
    module = TensorDictModule(torch.nn.Linear(49, 21), ["observation_vector"], ["act"])
    fails(module, TypeError, "answered with a TensorDict; .* as 'action': .*act")

    def infinite(many):
        return torch.tensor([[0.0], [float("inf")]]).expand(2, 21)

    fails(infinite, ValueError, r"infinite returned .* in the rows \[1\]")
    fails(Mute(), ValueError, "mute returned None, no array")
    fails(Mute, TypeError, "policy is the class Mute; give an instance")


def test_a_function_of_one_observation_is_told_what_to_do():
    def one(observation):
        return torch.zeros(21)

    options = {"task_kwargs": {"max_steps": 3}}
    with pytest.raises(ValueError, match=r"one returned shape \(21,\); it must"):
        evaluate(one, "type1_bca", 2, **options)
    with pytest.raises(ValueError, match=r"shape \(1, 21\); it must be \(2, 21\)"):
        evaluate(lambda many: one(many)[None], "type1_bca", 2, **options)

    def each(many):
        return torch.stack([one(single) for single in many])

    assert evaluate(each, "type1_bca", 2, **options).summary()["length"] == 3


def test_an_evaluation_goes_on_from_a_snapshot(tmp_path, cathsim):
    drawn = {"friction": [0.1, 0.1]}  # episodes from seeds are not distinct
    task = suite.make_task("simple1_bca", max_steps=12, randomisation=drawn)
    simulation = BatchSimulation(task, 2, num_threads=1, seeds=5)
    simulation.reset()
    push = np.zeros((2, simulation.num_actions))
    push[:, -1] = 1.0
    for _ in range(4):
        simulation.step(push)
    snapshot = simulation.snapshot()
    path = snapshot.save(tmp_path / "state.npz")
    expected = sum(simulation.step(push).outcome.reward for _ in range(8))
    code, out, err = cathsim(
        *("eval", "push", "--task", "simple1_bca", "--max-steps", "12", "--json"),
        *("--no-baseline", "--threads", "1", "--start", path),
        *("--randomisation", json.dumps(drawn)),
    )
    assert code == 0, err
    played = json.loads(out)["policy"]
    episodes = played["episodes"]
    assert played["settings"]["started"] == snapshot.digest
    assert [one["length"] for one in episodes] == [8, 8]
    # The seeds have not drawn what the snapshot holds.
    assert not any("conditions" in one for one in episodes)
    rewards = [one["reward"] for one in episodes]
    np.testing.assert_allclose(rewards, expected, rtol=1e-6)
    for wrong, text in (
        ({"protocol": "varied"}, "the protocol 'varied' cannot draw them"),
        ({"episodes": 3}, "episodes is 3, but start is of 2 simulations"),
    ):
        with pytest.raises(ValueError, match=text):
            evaluate("push", "simple1_bca", start=snapshot, **wrong)
    with pytest.raises(ValueError, match=r"have ended in its simulations \[0, 1\];"):
        options = {"max_steps": 12, "randomisation": drawn}
        ended = {"start": simulation.snapshot(), "task_kwargs": options}
        evaluate("push", "simple1_bca", **ended, num_threads=1)


@pytest.mark.parametrize(("protocol", "most"), [("published", 94), ("varied", 16)])
def test_seeds_beyond_the_last_are_refused_by_name(protocol, most):
    conditions, first = protocols.get(protocol), 2**32 - 1
    with pytest.raises(ValueError, match=rf"seed is {first}; .* to 42949672{most}"):
        protocols.parts(conditions, "type1_bca", {}, 2, first)


def test_a_protocol_refuses_what_it_draws():
    """And a policy that was trained with another friction is played with the drawn."""
    varied = protocols.get("varied")
    with pytest.raises(ValueError, match="friction: the protocol has its own"):
        varied.beside({"friction": 1.0}, {"friction": 1.0})
    assert varied.beside({"friction": 1.0, "max_steps": 3}, {}) == {"max_steps": 3}


def test_effects_of_a_task_are_no_option_of_its_episodes(monkeypatch):
    definition = suite.TaskDefinition(
        "", "simple1", "bca", options={"effects": [Effect()], "max_steps": 3}
    )
    monkeypatch.setitem(suite.TASKS, "blown", definition)
    (part,) = protocols.parts(protocols.get("published"), "blown", {}, 2, 0)
    assert part.task_kwargs == {"max_steps": 3}
    given = {"effects": []}
    (part,) = protocols.parts(protocols.get("published"), "blown", given, 2, 0)
    assert part.task_kwargs == {"max_steps": 3, "effects": []}


def test_an_earlier_heatmap_does_not_stay_beside_other_results(
    tmp_path, monkeypatch, capsys
):
    old, task = tmp_path / "heatmap.png", types.SimpleNamespace(num_anatomies=2)
    monkeypatch.setattr(suite, "make_task", lambda name, **options: task)
    result = types.SimpleNamespace(task="arch_bca", settings={"task_kwargs": {}})
    old.write_bytes(b"of another evaluation")
    with told_of_replaced([old]):
        evaluation.ContactLog().draw(result, old)
    assert not old.exists()
    assert f"{old}, which was there before, is removed" in capsys.readouterr().err
