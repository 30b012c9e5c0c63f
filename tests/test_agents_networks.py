import pytest
import synthetic_env
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from torchrl.envs import check_env_specs
from torchrl.envs.utils import ExplorationType, set_exploration_type

from cathsim_dmc.agents import ConfigError, PPOConfig, SACConfig, make_config
from cathsim_dmc.agents.exploration import CorrelatedExploration, CorrelatedNoise
from cathsim_dmc.agents.networks import NetworkShapes, make_policy, network_of
from cathsim_dmc.agents.normalisation import (
    SHADOW,
    ImageNormaliser,
    ObservationNormaliser,
)
from cathsim_dmc.agents.ppo import PPO
from cathsim_dmc.agents.sac import SAC
from cathsim_dmc.simulation.environments import VECTOR


def test_normaliser_equals_the_statistics_of_all_data_whatever_the_batches():
    torch.manual_seed(0)
    # Metres beside inertias, as the internal observation mixes them.
    data = torch.randn(1_000, 3) * torch.tensor([0.1, 1e-9, 20.0])
    data = data + torch.tensor([0.5, 3e-8, -7.0])
    normaliser = ObservationNormaliser(3, clip=10.0)
    for part in data.split([1, 9, 490, 500]):
        normaliser.update(part)
    expected = (data - data.mean(0)) / data.std(0, unbiased=False)
    torch.testing.assert_close(normaliser(data), expected, rtol=1e-3, atol=1e-3)


@settings(max_examples=30)
@given(
    st.floats(-1e3, 1e3, width=32),
    st.sampled_from([0.0, 1e-7, 1e-9]),
    st.integers(0, 5),
)
def test_nearly_constant_entries_never_blow_up(value, noise, seed):
    torch.manual_seed(seed)
    data = value * (1.0 + noise * torch.randn(200, 1))
    normaliser = ObservationNormaliser(1, clip=10.0)
    normaliser.update(data)
    out = normaliser(data)
    assert torch.isfinite(out).all()
    # What rounding alone can produce must not be amplified.
    assert out.abs().max() == 0


def test_normaliser_refuses_what_is_not_finite():
    normaliser = ObservationNormaliser(2, clip=5.0)
    with pytest.raises(ValueError, match=r"\[1\] are not finite"):
        normaliser.update(torch.tensor([[0.0, float("nan")]]))
    assert normaliser.count == 0


def test_the_mean_image_is_subtracted_whatever_the_batches():
    torch.manual_seed(0)
    images = torch.randint(0, 256, (30, 1, 4, 5), dtype=torch.uint8)
    normaliser = ImageNormaliser((1, 4, 5), subtract=True)
    for part in images.split([1, 9, 20]):
        normaliser.update(part)
    expected = (images.float() - images.float().mean(0)) / SHADOW
    torch.testing.assert_close(normaliser(images), expected, rtol=0, atol=1e-4)
    plain = ImageNormaliser((1, 4, 5), subtract=False)
    plain.update(images)
    assert torch.equal(plain(images), images.float() / 255.0)


def observation_of(shapes, batch):
    entries = {}
    if shapes.vector:
        entries["observation_vector"] = torch.randn(*batch, shapes.vector)
    if shapes.pixels:
        entries["pixels"] = torch.randint(
            0, 256, (*batch, *shapes.pixels), dtype=torch.uint8
        )
    return TensorDict(entries, batch)


@pytest.mark.parametrize("config", [PPOConfig(), SACConfig()], ids=["ppo", "sac"])
@pytest.mark.parametrize(
    "shapes",
    [
        NetworkShapes(30, None, 21),
        NetworkShapes(0, (1, 128, 128), 21),
        NetworkShapes(0, (3, 128, 128), 22),
        NetworkShapes(5, (1, 128, 128), 21),
    ],
    ids=["internal", "image", "sequential", "image and forces"],
)
def test_actions_are_bounded_and_deterministic_ones_repeat(config, shapes):
    torch.manual_seed(0)
    policy = make_policy(shapes, config)
    observation = observation_of(shapes, (4, 2))
    with set_exploration_type(ExplorationType.RANDOM):
        sampled = [policy(observation.clone())["action"] for _ in range(2)]
    assert sampled[0].shape == (4, 2, shapes.actions)
    assert not torch.equal(*sampled)
    assert all(action.abs().max() <= 1 for action in sampled)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        chosen = [policy(observation.clone())["action"] for _ in range(2)]
    assert torch.equal(*chosen)


def test_convolutions_that_do_not_fit_the_image_are_refused():
    config = PPOConfig(convolutions=((8, 8, 8), (8, 17, 1)))
    with pytest.raises(ConfigError, match=r"convolutions .*16 x 16\).*17 x 17"):
        make_policy(NetworkShapes(0, (1, 128, 128), 21), config)
    smaller = config.replace(convolutions=((8, 8, 8), (8, 16, 1)))
    assert make_policy(NetworkShapes(0, (1, 128, 128), 21), smaller)


@pytest.mark.parametrize("observation", ["internal", "image"])
def test_standard_observations_satisfy_torchrl(observation):
    env = synthetic_env.make_env("reach", observation=observation, num_envs=3)
    check_env_specs(env)
    shapes = NetworkShapes.of(env.observation_spec, env.action_spec)
    if observation == "image":
        assert shapes == NetworkShapes(0, (1, 128, 128), synthetic_env.ACTIONS)
    else:
        size = sum(synthetic_env.SIZES.values())
        assert shapes == NetworkShapes(size, None, synthetic_env.ACTIONS)
        seeded = [synthetic_env.make_env("reach", num_envs=3, seed=5) for _ in "ab"]
        parts = seeded[0].base_env.reset()
        names = sorted(synthetic_env.SIZES)
        joined = torch.cat([parts[name] for name in names], -1).float()
        assert torch.equal(seeded[1].reset()["observation_vector"], joined)


def test_an_update_begins_at_the_policy_that_acted_also_at_the_bounds(tmp_path):
    torch.manual_seed(0)
    learner = PPO(PPOConfig(), NetworkShapes(3, None, 2), tmp_path)
    env = synthetic_env.make_env("reach")
    learner.attach(env.base_env)  # an environment without transforms
    network_of(learner.network).mean.bias.data.fill_(8.0)
    batch = TensorDict({VECTOR: torch.randn(64, 3)}, [64])
    with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
        learner.policy(batch)
    batch["advantage"], batch["value_target"] = torch.randn(2, 64, 1)
    losses = learner.loss(batch)
    assert losses["kl_approx"].abs() < 1e-5 and losses["clip_fraction"] == 0


def test_truncation_bootstraps_and_termination_does_not(tmp_path):
    config = PPOConfig(num_envs=1, steps_per_update=32, hidden=(8,))
    torch.manual_seed(0)
    learner = PPO(config, NetworkShapes(3, None, 2), tmp_path)
    steps = 4
    observation = torch.randn(2, steps, 3)
    following = torch.randn(2, steps, 3)
    ends = torch.zeros(2, steps, 1, dtype=torch.bool)
    ends[:, 1] = True
    terminated = ends.clone()
    terminated[1] = False  # the second environment only ran out of time
    batch = TensorDict(
        {
            "observation_vector": observation,
            "next": {
                "observation_vector": following,
                "reward": torch.randn(2, steps, 1),
                "done": ends,
                "terminated": terminated,
            },
        },
        [2, steps],
    )
    learner.normalise(batch)
    learner._add_advantages(batch)
    with torch.no_grad():
        clip = config.observation_clip
        value = learner.critic.module(observation.clamp(-clip, clip))[..., 0]
        after = learner.critic.module(following.clamp(-clip, clip))[..., 0]
    reward = batch["next", "reward"][..., 0]
    for env in range(2):
        advantage = 0.0
        for step in reversed(range(steps)):
            goes_on = 0.0 if terminated[env, step] else 1.0
            delta = (
                reward[env, step]
                + config.gamma * goes_on * after[env, step]
                - value[env, step]
            )
            carried = 0.0 if ends[env, step] else advantage
            advantage = delta + config.gamma * config.gae_lambda * carried
            torch.testing.assert_close(
                batch["advantage"][env, step, 0], advantage, rtol=1e-4, atol=1e-5
            )


@pytest.mark.parametrize(("given", "expected"), [(None, -2.0), (-0.5, -0.5)])
def test_sac_steers_to_an_entropy_of_minus_the_number_of_actions(
    tmp_path, given, expected
):
    config = SACConfig(hidden=(8,), target_entropy=given)
    learner = SAC(config, NetworkShapes(3, None, 2), tmp_path)
    assert float(learner.loss.target_entropy) == expected


def test_correlated_noise_lasts_and_is_shared_and_stays_standard_normal():
    torch.manual_seed(0)
    noise = CorrelatedNoise(0.9, 0.8, [0, 1, 0, 1, 2])
    drawn = torch.stack([noise.draw(torch.zeros(64, 5)).clone() for _ in range(2_000)])
    assert drawn.mean().abs() < 0.02
    assert (drawn.std((0, 1)) - 1.0).abs().max() < 0.02
    flat = drawn.reshape(-1, 5).T
    among = torch.corrcoef(flat)
    assert among[0, 2] == pytest.approx(0.8, abs=0.02)
    assert among[0, 1].abs() < 0.03 and among[0, 4].abs() < 0.03
    now, following = drawn[:-1, :, 0].reshape(-1), drawn[1:, :, 0].reshape(-1)
    after = torch.corrcoef(torch.stack([now, following]))[0, 1]
    assert after == pytest.approx(0.9, abs=0.02)


def test_correlated_exploration_says_how_likely_its_actions_are():
    """As the policy itself would say it, which the loss compares it with."""
    shapes = NetworkShapes(vector=4, pixels=None, actions=3)
    config = make_config("ppo", noise_correlation=0.9)
    policy = make_policy(shapes, config)
    explorer = CorrelatedExploration(policy, CorrelatedNoise(0.9, 0.0, range(3)))
    observed = TensorDict({VECTOR: torch.randn(6, 4)}, [6])
    explored = explorer(observed.clone())
    assert explored["action"].abs().max() < 1.0
    own = policy[-1].get_dist(policy[0](observed)).log_prob(explored["action"])
    torch.testing.assert_close(explored["action_log_prob"], own, atol=1e-4, rtol=1e-4)
