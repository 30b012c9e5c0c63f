"""What a network reads from an image: brightness, or difference from the mean image.

    python docs/scripts/image_inputs.py

Collects images of `type1_lcca` under random actions, and fits the convolutions of the
preset `tuned_image` to the points along the device ("tracking") by regression. Prints
the share of their variance that the fit explains on held-out episodes, for
docs/training.md.
"""

import argparse

import torch
from torch import nn

from cathsim_dmc.agents import make_config
from cathsim_dmc.agents.exploration import CorrelatedNoise
from cathsim_dmc.agents.networks import Convolutions
from cathsim_dmc.agents.normalisation import ImageNormaliser, ObservationNormaliser
from cathsim_dmc.simulation.environments import PIXELS, VECTOR, make_env

SIMULATIONS, HELD_OUT, STEPS = 32, 6, 150
MINIBATCH, SHOWN = 256, (50, 125, 250)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--task", default="type1_lcca")
    options = parser.parse_args()
    torch.set_num_threads(1)
    config = make_config("ppo", "tuned_image", task=options.task)
    images, points = collect(config)
    for subtract in (False, True):
        name = "difference from the mean image" if subtract else "brightness"
        for steps, share in fit(config, images, points, subtract):
            print(f"{name}: {share:.2f} explained after {steps} steps", flush=True)


def collect(config):
    """Images (simulations, steps, c, h, w) and points (simulations, steps, n)."""
    torch.manual_seed(0)
    env = make_env(
        config.task,
        observation=("image", "tracking"),
        num_envs=SIMULATIONS,
        task_kwargs=config.training_kwargs,
    )
    noise = CorrelatedNoise(0.9, 0.8, env.base_env.action_groups)

    def act(tensordict):
        drawn = noise.draw(torch.zeros(SIMULATIONS, env.action_spec.shape[-1]))
        drawn[:, 0] += 0.5  # forward
        tensordict["action"] = torch.tanh(0.8 * drawn)
        return tensordict

    rollout = env.rollout(STEPS, act, break_when_any_done=False)
    return rollout[PIXELS], rollout[VECTOR]


def fit(config, images, points, subtract):
    """Yields numbers of steps of Adam, and the share of variance explained then."""
    torch.manual_seed(0)
    scaled = ObservationNormaliser(points.shape[-1], 10.0)
    scaled.update(points[HELD_OUT:])
    read = ImageNormaliser(tuple(images.shape[2:]), subtract)
    read.update(images[HELD_OUT:])
    targets = scaled(points)
    moving = targets[HELD_OUT:].flatten(0, 1).std(0) > 0
    training, held = (
        (images[part].flatten(0, 1), targets[part].flatten(0, 1)[:, moving])
        for part in (slice(HELD_OUT, None), slice(HELD_OUT))
    )
    network = nn.Sequential(
        read,
        Convolutions(tuple(images.shape[2:]), config),
        nn.Linear(config.cnn_features, int(moving.sum())),
    )
    for layer in network.modules():
        if isinstance(layer, nn.Linear | nn.Conv2d):
            nn.init.orthogonal_(layer.weight, 2**0.5)
            nn.init.zeros_(layer.bias)
    optimiser = torch.optim.Adam(network.parameters(), config.learning_rate)
    for step in range(1, SHOWN[-1] + 1):
        chosen = torch.randint(len(training[0]), (MINIBATCH,))
        error = network(training[0][chosen]) - training[1][chosen]
        optimiser.zero_grad()
        error.square().mean().backward()
        optimiser.step()
        if step in SHOWN:
            with torch.no_grad():
                left = (network(held[0]) - held[1]).square().mean(0)
            yield step, float((1.0 - left / held[1].var(0)).mean())


if __name__ == "__main__":
    main()
