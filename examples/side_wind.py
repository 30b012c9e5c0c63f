"""A user-defined force: a constant wind from the side on every link of the device.

    python examples/side_wind.py --wind 0 0 0.3

The effect is one class; nothing in the package changes. Its compiled law acts in every
physics step, in the composer environment and in batches.
"""

import argparse
from typing import Any, NamedTuple

import numpy as np

from cathsim_dmc import suite
from cathsim_dmc.laws.parameters import Array
from cathsim_dmc.physics.effects import Effect


class Wind(NamedTuple):
    """Parameters of the law, for one simulation."""

    force_per_length: Any = Array(3)  # N/m, world frame
    lengths: Any = Array("links")  # m


class SideWind(Effect):
    """Effect with the same force per length on every link."""

    parameters = Wind

    def __init__(self, force_per_length):
        """Takes the force per length (3,), N/m, world frame."""
        self._wind = np.asarray(force_per_length, dtype=float)

    def restart(self, index, episode, random_state):
        """Writes the parameters of one simulation."""
        self.world.parameters.force_per_length[index] = self._wind
        self.world.parameters.lengths[index] = self.world.chain.link_lengths

    @staticmethod
    def law(wind, time, links):
        """Adds the force on each link; compiled, called in every physics step."""
        for link in range(len(wind.lengths)):
            for axis in range(3):
                force = wind.lengths[link] * wind.force_per_length[axis]
                links.xfrc_applied[link, axis] += force


def main():
    """Prints how far the wind moves the tip of a device at rest."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--task", default="type1_lcca")
    parser.add_argument(
        "--wind", type=float, nargs=3, default=(0.0, 0.0, 0.3), help="N/m"
    )
    parser.add_argument("--steps", type=int, default=50)
    options = parser.parse_args()
    heads = []
    for effects in ([], [SideWind(options.wind)]):
        env = suite.load("cathsim", options.task, {"random": 0, "effects": effects})
        env.reset()
        for _ in range(options.steps):
            env.step(np.zeros(env.action_spec().shape))
        heads.append(env.task.readings.head)
    moved = 1e3 * (heads[1] - heads[0])
    print(f"the wind moves the tip by {np.round(moved, 2).tolist()} mm")


if __name__ == "__main__":
    main()
