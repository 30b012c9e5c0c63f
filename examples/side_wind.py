"""A force of one's own: a constant wind from the side on every link of the device.

    python examples/side_wind.py --wind 0 0 0.3

The effect is one class; nothing in the package changes. It acts in every physics step,
compiled, in the composer environment and in batches alike.
"""

import argparse

import numpy as np

from cathsim_dmc import suite
from cathsim_dmc.physics.effects import Effect


class SideWind(Effect):
    """The same force per length on every link."""

    def __init__(self, force_per_length):
        """Takes (3,), N/m, world frame."""
        self._wind = np.asarray(force_per_length, dtype=float)

    def num_parameters(self, chain):
        """The wind, the first link's number among the bodies, lengths of the links."""
        return 4 + len(chain.links)

    def restart(self, index, episode, random_state):
        """Tells the compiled function what to do in one simulation."""
        links, lengths = self.world.index.links, self.world.chain.link_lengths
        self.world.parameters[index] = [*self._wind, links.start, *lengths]

    @staticmethod
    def forces(parameters, time, bodies):
        """Adds the force on each link; compiled, called in every physics step."""
        first = int(parameters[3])
        for link in range(len(parameters) - 4):
            for axis in range(3):
                force = parameters[4 + link] * parameters[axis]
                bodies.xfrc_applied[first + link, axis] += force


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
