"""One face for every policy: by name, trained or a function, batched or composer."""

import numpy as np
import pytest
import synthetic_env
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torchrl.envs import CatTensors, TransformedEnv

from cathsim_dmc import policies, suite
from cathsim_dmc.agents import evaluate, load_policy
from cathsim_dmc.agents.training import train
from cathsim_dmc.pictures import record
from cathsim_dmc.policies import POLICIES, Policy, View, in_environment, make_policy
from cathsim_dmc.recording.recorder import EpisodeRecorder
from cathsim_dmc.simulation import environments
from cathsim_dmc.simulation.torchrl import BatchedEnv

TASK = "simple1_bca"
SHORT = {"max_steps": 12}
QUICK = ("push",)


def assert_same_in_composer(outcome, name, task, seed, options):
    """An episode of an evaluation is that of a composer environment, bit for bit."""
    env = suite.load("cathsim", task, options)
    act = in_environment(make_policy(name, seed), env)
    episode = EpisodeRecorder(env).record_episode(act, seed)
    assert outcome.length == episode.steps
    assert outcome.reward == sum(episode.reward.astype(np.float32).astype(float))
    largest = np.float32(episode.wall_force_max).max()
    assert outcome.forces.max.maximum == largest
    largest = np.float32(episode.meta["wall_force_mean_max"]).max()
    assert outcome.forces.max_force == largest


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=() if name in QUICK else pytest.mark.slow)
        for name in POLICIES
    ],
)
def test_a_named_policy_plays_the_same_in_composer(name):
    batched = evaluate(name, TASK, 2, 7, task_kwargs=SHORT, num_threads=1)
    assert batched.policy == name
    for seed, episode in enumerate(batched.episodes, 7):
        assert_same_in_composer(episode, name, TASK, seed, SHORT)
    assert batched.episodes[0].reward != batched.episodes[1].reward


def test_a_policy_begins_anew_after_a_restored_snapshot():
    """Another episode in between leaves nothing in its memory."""
    env = suite.load("cathsim", TASK, {"random": 0})
    env.reset()
    for _ in range(20):
        env.step(np.eye(21)[-1])
    snapshot, found = env.snapshot(), []
    for _ in range(2):
        act = in_environment(make_policy("expert"), env)
        for _ in range(2):
            timestep, actions = env.restore(snapshot), []
            for _ in range(8):
                actions.append(act(timestep))
                timestep = env.step(actions[-1])
            found.append(actions)
            for _ in range(3):
                timestep = env.step(act(timestep))
    assert all(np.array_equal(found[0], other) for other in found[1:])


class Backwards(Policy):
    """Pulls, and counts how often it was told of a new episode."""

    name = "backwards"
    observation = "tracking"

    def __init__(self, seed=0):
        self.begun = []

    def reset(self, view, which):
        self.begun.append(which.copy())
        self.shape = view.num_simulations, view.num_actions
        self.motors = len(view.task.scene.catheter.tip_motors)
        assert view.rollout.readings.head.shape == (self.shape[0], 3)
        assert view.rollout.wall_force.sum.shape == self.shape[:1]

    def act(self, observation):
        action = np.zeros(self.shape)
        action[:, self.motors] = -1.0
        return action


def test_a_policy_of_ones_own_needs_one_class_and_one_line(monkeypatch):
    monkeypatch.setitem(POLICIES, "backwards", Backwards)
    named = evaluate("backwards", TASK, 2, 5, task_kwargs=SHORT)
    mine = Backwards()
    given = evaluate(mine, TASK, 2, 5, task_kwargs=SHORT)
    assert named.to_dict() == given.to_dict()
    assert named.settings["observation"] == "tracking"
    assert [which.tolist() for which in mine.begun] == [[True, True]]


def test_a_policy_of_another_observation_is_refused_before_an_episode():
    """Two observations may have arrays of one size, which tell nothing."""
    player = load_policy("pretrained:type1_bca")
    env = suite.load("cathsim", TASK, {"observation": ["force", "goal"], **SHORT})
    words = "reads the observation .*, and the environment has force, goal; make it"
    with pytest.raises(ValueError, match=f"^{player.name} {words}"):
        record(env, player)
    assert not env.task.rollout.begun


def test_a_policy_is_told_which_simulations_begin_anew():
    """The shorter episodes go on with further ones until the longest has ended."""
    begun = []

    class Steer(Policy):
        name = "steer"

        def reset(self, view, which):
            begun.append(which.copy())

        def act(self, observation):
            point = observation["observation_vector"][:, -6:-3]
            action = torch.zeros(len(point), synthetic_env.ACTIONS)
            action[:, :3] = (-10 * point).clamp(-1, 1)
            return action.numpy()

    result = evaluate(Steer(), "reach", 5, 50, make_env=synthetic_env.make_env)
    lengths = np.array([episode.length for episode in result.episodes])
    assert begun[0].all() and len(begun) > 1
    assert begun[1].tolist() == (lengths == lengths.min()).tolist()


def test_a_random_curl_is_one_direction_for_each_episode():
    task = suite.make_task(TASK, random=0)
    motors = len(task.scene.catheter.tip_motors)

    class Many:
        num_simulations, num_actions = 200, motors + 1

    Many.task = task
    policy = policies.make_policy("random_curl", seed=3)
    policy.reset(Many(), np.ones(200, bool))
    first = policy.act(None)
    tip = first[:, :motors].reshape(200, -1, 2)
    assert (tip == tip[:, :1]).all() and (first[:, motors] == 1.0).all()
    size = np.linalg.norm(tip[:, 0], axis=-1)
    assert size.max() <= 1.0 and size.min() < 0.1 and size.max() > 0.9
    # To all sides.
    assert (np.abs(tip[:, 0].mean(0)) < 0.15).all()
    again = policies.make_policy("random_curl", seed=3 + 7)
    again.reset(Many(), np.ones(200, bool))
    np.testing.assert_array_equal(first[7:], again.act(None)[:-7])
    # A new episode draws anew, and only for the simulations that begin one.
    begins = np.arange(200) < 5
    policy.reset(Many(), begins)
    assert ((policy.act(None) != first).any(-1) == begins).all()


@pytest.mark.slow
def test_functions_and_trained_policies_act_on_a_composer_timestep(tmp_path):
    from cathsim_dmc.agents import make_config

    config = make_config(
        "ppo", task=TASK, task_kwargs=SHORT, num_envs=4, num_threads=1,
        steps_per_update=64, epochs=1, total_frames=64, normalisation_frames=16,
    )  # fmt: skip
    train(config, tmp_path, progress=False)
    trained = load_policy(tmp_path)
    assert trained.task == TASK and trained.task_kwargs == SHORT
    result = evaluate(trained, episodes=2, seed=3, num_threads=1)
    assert result.settings["frames"] == 64
    environment = suite.load("cathsim", TASK, SHORT)
    episode = record(environment, trained, seed=4)
    environment.random_state.seed(4)
    first = environment.reset().observation
    vector = np.concatenate([np.ravel(first[name]) for name in sorted(first)])
    observation = TensorDict(
        {"observation_vector": torch.as_tensor(vector).float()[None]}, [1]
    )
    np.testing.assert_array_equal(episode.action[:1], trained.act(observation))

    def still(observation):
        assert observation["observation_vector"].ndim == 2
        return torch.zeros(*observation.batch_size, 21)

    assert load_policy(still).name == "still"
    episode = record(environment, load_policy(still))
    assert not episode.action.any()


def test_a_function_answers_with_arrays_or_is_named():
    seen = {"vector": np.zeros(3)}
    for answer in ([[0.5, 0.0]], np.array([[0.5, 0.0]]), torch.tensor([[0.5, 0.0]])):
        action = load_policy(lambda _, answer=answer: answer).act(seen)
        assert action.dtype == np.float32 and action.tolist() == [[0.5, 0.0]]

    def lost(observation):
        return None

    with pytest.raises(TypeError, match="policy lost answered with a NoneType.*action"):
        load_policy(lost).act(seen)


def test_a_network_in_training_acts_as_in_evaluation_and_goes_on_in_training():
    parts = torch.nn.Dropout(0.5), torch.nn.BatchNorm1d(4), torch.nn.Linear(4, 2)
    network = torch.nn.Sequential(*parts)
    parts[2].eval()
    module = TensorDictModule(network, [environments.VECTOR], ["action"])
    seen = TensorDict({environments.VECTOR: torch.ones(3, 4)}, batch_size=[3])
    action = load_policy(module).act(seen)
    assert [part.training for part in parts] == [True, True, False]
    np.testing.assert_array_equal(parts[1].running_mean, np.zeros(4))
    network.eval()
    np.testing.assert_array_equal(action, load_policy(module).act(seen))


def test_a_policy_reads_batch_and_single_environment_alike():
    seen, options = ["tracking", "image"], {"fluoroscopy": {"size": 32}}
    given = {"random": 0, "observation": seen, **options}
    one = suite.load("cathsim", TASK, given).reset().observation
    one = environments.as_batch(one)
    many = environments.make_env(TASK, observation=seen, task_kwargs=options).reset()
    assert environments.as_batch(many) is many
    for name in (environments.VECTOR, environments.PIXELS):
        assert torch.equal(one[name], many[name]), name


def test_what_is_no_policy_is_refused(tmp_path):
    with pytest.raises(ValueError, match="random, push, expert"):
        policies.make_policy("expret")
    with pytest.raises(RuntimeError, match="no policy.*random, push, exp.*--import"):
        load_policy(tmp_path / "expret")
    with pytest.raises(TypeError, match="policy is 3; it must be a name"):
        load_policy(3)
    with pytest.raises(
        ValueError, match="'push' was not trained.*type1_lcca.*`cathsim list`"
    ):
        evaluate("push")
    with pytest.raises(AttributeError, match="'task'"):
        evaluate("push", "reach", 1, make_env=synthetic_env.make_env)


def test_random_actions_of_a_simulation_do_not_depend_on_the_others():
    view = View(suite.load("cathsim", TASK, {"random": 0}))
    alone = policies.make_policy("random", seed=8)
    together = policies.make_policy("random", seed=6)

    class Three:
        num_simulations, num_actions = 3, view.num_actions

    alone.reset(view, np.ones(1, bool))
    together.reset(Three(), np.ones(3, bool))
    first = together.act(None)
    np.testing.assert_array_equal(first[2], alone.act(None)[0])
    # A further episode goes on, it does not repeat.
    alone.reset(view, np.ones(1, bool))
    assert not np.array_equal(alone.act(None)[0], first[2])


@pytest.mark.parametrize("name", ["push", "curl", "idle", "random_curl"])
def test_noise_on_an_action_does_not_stay_in_the_policy(name):
    env = suite.environment(suite.make_task(TASK))
    policy = make_policy(name)
    policy.reset(View(env), np.ones(1, dtype=bool))
    action = policy.act(None)
    told = action.copy()
    action += 0.5
    np.testing.assert_array_equal(policy.act(None), told)


class Counting(TensorDictModuleBase):
    """Counts the steps of an episode, as a recurrent module keeps its state."""

    in_keys = ("observation_vector", "count", "is_init")
    out_keys = ("action", ("next", "count"))

    def forward(self, tensordict):
        begun = tensordict["is_init"]
        count = tensordict.get("count", torch.zeros(begun.shape))
        count = torch.where(begun, 0.0, count) + 1.0
        tensordict["next", "count"] = count
        # Grows towards full speed, so that the outcome shows the memory.
        tensordict["action"] = (count / 20).clamp(max=1.0).expand(-1, 21)
        return tensordict


def test_a_recurrent_module_remembers_until_an_episode_ends():
    policy = load_policy(Counting())

    def steps(number=3):
        seen = {"observation_vector": torch.zeros(number, 2)}
        return (20 * policy.act(TensorDict(seen, [number]))[:, 0]).round().tolist()

    assert [steps(), steps()] == [[1] * 3, [2] * 3]
    policy.reset(None, np.array([False, True, False]))
    assert [steps(), steps()] == [[3, 1, 3], [4, 2, 4]]
    policy.reset(None, np.ones(3, bool))
    assert steps() == [1] * 3
    # Some of many: the policy acts on rows for all, of which the others are copies.
    part = policy.among(1, 3)
    part.reset(None, np.ones(2, bool))
    seen = TensorDict({"observation_vector": torch.zeros(2, 2)}, [2])
    assert (20 * part.act(seen)[:, 0]).round().tolist() == [1, 1]
    part.reset(None, np.array([True, False]))
    assert (20 * part.act(seen)[:, 0]).round().tolist() == [1, 2]


def test_a_recurrent_module_is_evaluated_and_recorded():
    """Also in an environment without a StepCounter."""

    def bare(*arguments, **options):
        env = BatchedEnv(*arguments, **options)
        key, seen = "observation_vector", "tracking_points"
        return TransformedEnv(env, CatTensors([seen], key, del_keys=False))

    options = {"max_steps": 12, "observation": "tracking"}
    done = evaluate(
        Counting(), TASK, 2, 5, make_env=bare, observation="tracking", task_kwargs=SHORT
    )
    env = suite.load("cathsim", TASK, options)
    for number, outcome in enumerate(done.episodes):
        episode = record(env, load_policy(Counting()), seed=5 + number)
        rounded = np.float32(np.arange(1, 13) / np.float32(20))
        np.testing.assert_array_equal(episode.action[:, -1], rounded[: episode.steps])
        assert outcome.length == episode.steps
        assert outcome.reward == sum(episode.reward.astype(np.float32).astype(float))
    with pytest.raises(TypeError, match=r"agents.load_policy\(policy\)"):
        record(env, Counting())
    with pytest.raises(ValueError, match=r"shape \(1, 21\), for a batch of one"):
        record(env, lambda observation: torch.zeros(1, 21), seed=5)
