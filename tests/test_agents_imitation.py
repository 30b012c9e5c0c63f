"""Cloning, DAgger, demonstrations in SAC's replay, and runs that start from another."""

import copy
import json
import shutil
import types

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from cathsim_dmc import suite
from cathsim_dmc.agents import (
    Checkpoint,
    ConfigError,
    evaluate,
    make_config,
    make_env,
    record_demonstrations,
    train,
)
from cathsim_dmc.agents.dagger import DAgger, _Guided
from cathsim_dmc.agents.demonstrations import EXPERT_ACTION, load_transitions
from cathsim_dmc.agents.imitation import BC
from cathsim_dmc.agents.learners import LEARNERS
from cathsim_dmc.agents.networks import NetworkShapes, network_of
from cathsim_dmc.agents.sac import SAC
from cathsim_dmc.agents.training import take_over
from cathsim_dmc.agents.training_log import read_metrics
from cathsim_dmc.recording.dataset import DatasetError
from cathsim_dmc.tasks.objectives import Cannulation

SHARED = {
    "task": "simple1_bca",
    "observation": "tracking",
    "num_envs": 2,
    "num_threads": 1,
    "hidden": (32,),
    "task_kwargs": {"goal_radius": 0.045},
}
CLOCKS = ("seconds", "frames_per_second")


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    out = tmp_path_factory.mktemp("demos") / "near-v0"
    kwargs = SHARED["task_kwargs"]
    return str(record_demonstrations("simple1_bca", out, 2, task_kwargs=kwargs).path)


@pytest.fixture(scope="module")
def shapes():
    env = make_env("simple1_bca", observation="tracking", num_threads=1)
    return NetworkShapes.of(env.observation_spec, env.action_spec)


def small(algorithm, **changes):
    return make_config(algorithm, **{**SHARED, **changes})


@pytest.fixture(scope="module")
def cloned(dataset, tmp_path_factory):
    out = tmp_path_factory.mktemp("bc")
    config = small(
        "bc", demonstrations=dataset, gradient_steps=600, steps_per_env=8,
        total_frames=64, metrics_frames=16,
    )  # fmt: skip
    train(config, out, progress=False)
    return out


def act(policy, vectors):
    """What a policy would do on average, before the tanh."""
    states = policy[0](TensorDict({"observation_vector": vectors}, [len(vectors)]))
    return network_of(policy)(states["observation_normal"])


def test_a_clone_does_what_the_expert_did(cloned, dataset, shapes):
    rows = read_metrics(cloned / "metrics.csv")
    assert rows[-1]["gradient_steps"] == 600
    assert rows[-1]["loss"] < rows[0]["loss"] / 4
    states = load_transitions(dataset, "tracking", shapes)
    policy = Checkpoint.open(cloned).policy()
    mean, std = act(policy, states["observation_vector"])
    error = mean.tanh() - states[EXPERT_ACTION]
    # A constant action would err by as much as the actions vary.
    assert error.square().mean().sqrt() < states[EXPERT_ACTION].std(0).mean() / 2
    # It explores as far as it errs: PPO that starts from it keeps to the way.
    assert std.max() < 0.5
    assert evaluate(cloned, episodes=1, task_kwargs={"max_steps": 3}).episodes


def test_cloning_needs_a_dataset(tmp_path):
    def make_env(config):
        pytest.fail("the environment is made, which takes long")

    for place in (None, "gone"):
        with pytest.raises(DatasetError, match="cathsim demos"):
            config = small("bc", demonstrations=place)
            train(config, tmp_path, progress=False, make_env=make_env)


def test_a_run_is_resumed_after_its_dataset_has_moved(cloned, dataset, tmp_path):
    run = shutil.copytree(cloned, tmp_path / "run")
    config = Checkpoint.open(run).config.replace(demonstrations="gone")
    with pytest.raises(DatasetError, match="no dataset in gone.*--demonstrations"):
        train(config, run, resume=True, progress=False)
    moved = shutil.copytree(dataset, tmp_path / "moved")
    config = config.replace(demonstrations=str(moved))
    assert train(config, run, resume=True, progress=False).frames == 64


def test_a_clone_that_is_continued_learns_the_same(dataset, shapes, tmp_path):
    config = small(
        "bc", demonstrations=dataset, gradient_steps=40, steps_per_env=1, total_frames=4
    )
    torch.manual_seed(0)
    straight = BC(config, shapes, tmp_path)
    batch = TensorDict({}, [2, 1])
    straight.update(batch, 0.0)
    continued = BC(config, shapes, tmp_path)
    # Copied, as a file does: optimisers share what they are given.
    state = copy.deepcopy((straight.policy_state(), straight.learning_state()))
    continued.load(*state)
    generator = torch.get_rng_state()
    first = straight.update(batch, 0.5)
    torch.set_rng_state(generator)
    assert continued.update(batch, 0.5) == first
    for one, other in zip(
        straight.policy_state().values(), continued.policy_state().values(), strict=True
    ):
        torch.testing.assert_close(one, other, rtol=0, atol=0)


def test_no_loss_is_told_without_a_gradient_step(dataset, shapes, tmp_path):
    config = small(
        "bc", demonstrations=dataset, gradient_steps=1, steps_per_env=1, total_frames=4
    )
    clone, batch = BC(config, shapes, tmp_path), TensorDict({}, [2, 1])
    assert clone.update(batch, 0.0)["loss"] > 0.0
    assert "loss" not in clone.update(batch, 0.5)


def test_a_clone_of_small_weights_errs_less_where_it_has_not_been(
    dataset, shapes, tmp_path
):
    """One number of many tells what to do."""
    like = load_transitions(dataset, "tracking", shapes)["observation_vector"]
    draws = torch.randn(2, 200, shapes.vector, generator=torch.Generator())
    tells = like.std(0).argmax()
    wanted = draws[..., tells, None].tanh().expand(2, 200, shapes.actions)
    names = "observation_vector", EXPERT_ACTION
    states = TensorDict(
        dict(zip(names, (like.mean(0) + like.std(0) * draws, wanted), strict=True)),
        [2, 200],
    )
    errors = {}
    for decay in (0.0, 1.0):
        config = small(
            "bc", demonstrations=dataset, gradient_steps=600, steps_per_env=1,
            total_frames=1, learning_rate=1e-2, weight_decay=decay,
        )  # fmt: skip
        torch.manual_seed(0)
        clone = BC(config, shapes, tmp_path)
        clone.states = states[0]
        clone.update(TensorDict({}, [1, 1]), 0.0)
        mean, action = clone._means(states[1])
        errors[decay] = (mean.tanh() - action).square().mean().item()
    assert errors[1.0] < 0.7 * errors[0.0]


def dagger(**changes):
    settings = {
        "steps_per_env": 8, "gradient_steps": 20, "total_frames": 48,
        "metrics_frames": 16, "checkpoint_frames": 16,
    }  # fmt: skip
    return small("dagger", **{**settings, **changes})


def test_dagger_learns_from_what_the_expert_would_do(tmp_path, monkeypatch):
    batches = []
    update = DAgger.update

    def keep(self, batch, progress):
        batches.append(batch.clone())
        return update(self, batch, progress)

    monkeypatch.setattr(DAgger, "update", keep)
    train(dagger(expert_share=0.0), tmp_path / "a", progress=False)
    first, *later = batches
    torch.testing.assert_close(first["action"], first[EXPERT_ACTION], rtol=0, atol=0)
    for batch in later:  # the learner alone
        assert (batch["action"] != batch[EXPERT_ACTION]).any(-1).all()
    rows = read_metrics(tmp_path / "a" / "metrics.csv")
    assert [row["replay_frames"] for row in rows] == [16, 32, 48]
    assert [row["expert_share"] for row in rows] == [1, 0, 0]
    batches.clear()
    train(dagger(expert_share=0.5), tmp_path / "b", progress=False)
    apart = [(b["action"] != b[EXPERT_ACTION]).any(-1).float().mean() for b in batches]
    assert apart[0] == 0 and 0.2 < apart[1] < 0.8 and apart[1] < apart[2]


def test_the_expert_is_told_the_last_action_of_the_present_episode(
    shapes, tmp_path, monkeypatch
):
    told, begun = [], []

    class Asked:
        def __init__(self, view, lead):
            self.reset = lambda fresh: begun.append(fresh.tolist())

        def act(self, last):
            told.append(last.tolist())
            return np.full(last.shape, 0.5)

    monkeypatch.setattr("cathsim_dmc.agents.dagger.Teacher", Asked)
    view = types.SimpleNamespace(num_simulations=2, num_actions=shapes.actions)
    guided = _Guided(DAgger(dagger(expert_share=1.0), shapes, tmp_path), view)
    for steps in ([0, 0], [1, 0]):  # the second one begins anew
        state = {"observation_vector": torch.zeros(2, shapes.vector)}
        state["step_count"] = torch.tensor(steps)[:, None]
        guided(TensorDict(state, [2]))
    assert begun == [[True, True], [False, True]]
    given = [
        [[value] * shapes.actions for value in pair] for pair in ([0, 0], [0.5, 0])
    ]
    assert told == given


@pytest.mark.parametrize("withdrawn, weight", [(0, 1), (1, 5), (20, 4), (80, 1)])
def test_rare_withdrawals_weigh_as_much_as_the_rest(
    withdrawn, weight, shapes, tmp_path
):
    env = make_env("simple1_bca", observation="tracking", num_threads=1)
    learner = DAgger(dagger(withdrawal_weight=5.0), shapes, tmp_path)
    learner.attach(env)
    target = torch.full((100, shapes.actions), -0.5)
    column = env.base_env.simulation.task.scene.catheter.translations[0]
    target[withdrawn:, column] = 0.5
    weights = learner._weights(target)
    assert weights.shape == (100, 1)
    np.testing.assert_allclose(weights[:withdrawn], weight, rtol=1e-6)
    np.testing.assert_allclose(weights[withdrawn:], 1)


@pytest.mark.slow
def test_dagger_repeats_and_goes_on(tmp_path):
    for name in "ab":
        train(dagger(), tmp_path / name, progress=False)
    one, other = (read_metrics(tmp_path / name / "metrics.csv") for name in "ab")
    for row in (*one, *other):
        for clock in CLOCKS:
            del row[clock]
    assert one == other
    more = dagger(total_frames=64)
    result = train(more, tmp_path / "a", resume=True, progress=False)
    assert result.metrics["replay_frames"] == 64
    assert result.metrics["expert_share"] == pytest.approx(0.5**3)
    # Without the expert, and without its simulations.
    assert evaluate(tmp_path / "a", episodes=1, task_kwargs={"max_steps": 3}).episodes


@pytest.mark.parametrize("algorithm", ["ppo", "sac", "bc", "dagger"])
def test_a_policy_starts_from_that_of_another_run(
    cloned, dataset, shapes, tmp_path, algorithm
):
    own = {"demonstrations": dataset} if algorithm == "bc" else {}
    config = small(algorithm, initial_policy=str(cloned), **own)
    learner = LEARNERS[algorithm].learner(config, shapes, tmp_path)
    vectors = load_transitions(dataset, "tracking", shapes)["observation_vector"]
    source = Checkpoint.open(cloned).policy()
    expected = act(source, vectors)
    fresh, _ = act(learner.policy, vectors)
    assert (fresh.tanh() - expected[0].tanh()).abs().max() > 0.1
    take_over(learner.network, config, shapes)
    for one, other in zip(act(learner.policy, vectors), expected, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-6, atol=1e-6)
    # Other states change nothing but where the weights are learnt anew, too.
    learner.observe(TensorDict({"observation_vector": 3.0 * vectors + 1.0}))
    same = torch.equal(act(learner.policy, vectors)[0], expected[0])
    assert same == (algorithm in ("ppo", "sac"))


def test_the_deviation_to_start_with_can_be_given(cloned, shapes, tmp_path):
    config = small(
        "ppo", total_frames=2, steps_per_update=2, minibatch_size=2, epochs=1,
        learning_rate=1e-12, initial_policy=str(cloned), initial_std=0.3,
    )  # fmt: skip
    train(config, tmp_path, progress=False)
    _, std = act(Checkpoint.open(tmp_path).policy(), torch.zeros(1, shapes.vector))
    np.testing.assert_allclose(std, 0.3, rtol=1e-3)


def test_a_policy_that_does_not_fit_is_refused(cloned, tmp_path):
    config = small("ppo", initial_policy=str(cloned), hidden=(16,))
    with pytest.raises(ConfigError, match=r"hidden: it has \(32,\), given is \(16,\)"):
        train(config, tmp_path, progress=False)
    for name, own, given in (
        ("activation", "'tanh'", "relu"),
        ("observation_clip", "10.0", 5.0),
    ):
        config = small("ppo", initial_policy=str(cloned), **{name: given})
        with pytest.raises(ConfigError, match=f"{name}: it has {own}, given is"):
            train(config, tmp_path, progress=False)
    with pytest.raises(ConfigError, match="initial_std is 0"):
        small("ppo", initial_std=0.0)
    with pytest.raises(ConfigError, match="initial_std .* initial_policy alone"):
        train(small("ppo", initial_std=0.1), tmp_path, progress=False)


def test_demonstrations_of_another_task_are_refused(dataset, shapes, tmp_path):
    shown = {"demonstrations": dataset, "training_reward": {"path": -1.0}}
    BC(small("bc", **shown), shapes, tmp_path)  # which reads no reward
    with pytest.raises(DatasetError, match="the default, not .*path.* record with"):
        SAC(small("sac", **shown), shapes, tmp_path)
    with pytest.raises(DatasetError, match="its task is '.*_bca', not '.*_lcca'"):
        BC(small("bc", task="simple1_lcca", **shown), shapes, tmp_path)
    closer = {"task_kwargs": {"goal_radius": 4e-3}, **shown}
    with pytest.raises(DatasetError, match="its goal_radius is 0.045, not 0.004"):
        BC(small("bc", **closer), shapes, tmp_path)


def _own(anatomy, goal, *, depth=0.01, weight=1.0, farthest_shift=0.0):
    reward = {"success": weight, "distance": -depth}
    return Cannulation.to(anatomy, goal, reward=reward, farthest_shift=farthest_shift)


def test_demonstrations_share_the_options_of_an_own_objective(
    dataset, shapes, tmp_path, monkeypatch
):
    given = {"options": {"weight": 2.0}, "objective": _own}
    own = suite.TaskDefinition("Own.", "simple1", "bca", **given)
    monkeypatch.setitem(suite.TASKS, "own_bca", own)
    copied = shutil.copytree(dataset, tmp_path / "copied")
    (file,) = copied.rglob("metadata.json")
    about = json.loads(file.read_text())
    spec = json.loads(about["env_spec"])
    spec["kwargs"] = {"task": "own_bca", "observation": "tracking"}
    file.write_text(json.dumps({**about, "env_spec": json.dumps(spec)}))

    def read(**options):
        settings = {"demonstrations": str(copied), "task_kwargs": options}
        return BC(small("bc", task="own_bca", **settings), shapes, tmp_path)

    read(depth=0.01, weight=2.0)  # the defaults
    for name, value in (("depth", 0.02), ("weight", 1.0)):
        with pytest.raises(DatasetError, match=f"its {name} is the default, not"):
            read(**{name: value})


def test_half_of_sacs_minibatch_is_shown(dataset, shapes, tmp_path):
    config = small("sac", demonstrations=dataset, random_frames=256)
    learner = SAC(config, shapes, tmp_path)
    shown = load_transitions(dataset, "tracking", shapes)
    own = shown[:4].clone()
    own["action"] = torch.full_like(own["action"], 0.123)
    learner.replay.extend(own.select(*learner.replay_keys))
    sample = learner._sample(10)
    assert (sample["action"] == 0.123).all(-1).tolist() == [False] * 5 + [True] * 5
    torch.manual_seed(0)
    figures = learner._step()
    assert all(torch.isfinite(value).all() for value in figures.values())
