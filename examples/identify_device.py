"""System identification: stiffness and friction of a device from one trajectory.

    python examples/identify_device.py --stiffness 1.2 --friction 0.08

A device with unknown factor of stiffness and unknown friction is pushed along the outer
curve of an arch; its points and its push force are measured. A batch repeats the push
with a candidate in each simulation, and the cross-entropy method draws the next
candidates around the best ones. Nothing is compiled again.
"""

import argparse

import numpy as np
from dm_control.composer.variation.base import Variation

from cathsim_dmc import suite
from cathsim_dmc.simulation.batch import BatchSimulation

LOW, HIGH = np.array([0.5, 0.01]), np.array([2.0, 0.2])  # factor, coefficient
# Standard deviations of the measurement: of a tracked point, m, and of the force, N.
POINT, FORCE = 0.1e-3, 0.5e-3


class Given(Variation):
    """Values that are drawn one after the other, a value for each simulation."""

    def give(self, values: np.ndarray) -> None:
        """Sets the values (N,) that the next reset of N simulations draws."""
        self._values = iter(values)

    def __call__(self, initial_value=None, current_value=None, random_state=None):
        """Returns the next value."""
        return float(next(self._values))


class Bench:
    """Pushes devices and measures them, in N simulations at a time."""

    def __init__(self, task: str, count: int):
        """Compiles the simulations once."""
        self._given = {"stiffness": Given(), "friction": Given()}
        ranges = {**self._given, "start_radius": 0.0}
        observed = {"observation": ["tracking", "force"], "randomisation": ranges}
        made = suite.make_task(task, **observed)
        self._pushes = list(made.scene.catheter.translations)
        self._simulation = BatchSimulation(made, count)

    def push(self, devices: np.ndarray, steps: int) -> np.ndarray:
        """Measurements (N, steps, n) of devices (N, 2), in standard deviations."""
        for column, given in zip(devices.T, self._given.values(), strict=True):
            given.give(column)
        self._simulation.reset()
        action = np.zeros((len(devices), self._simulation.num_actions))
        action[:, self._pushes] = 1.0
        rows = []
        for _ in range(steps):
            seen = self._simulation.step(action).observation
            force = seen["push_force"][:, :1] / FORCE
            rows.append(np.hstack([seen["tracking_points"] / POINT, force]))
        return np.stack(rows, axis=1)


def main() -> None:
    """Fits a device to a measured push and prints it beside the true one."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--task", default="type1_lcca")
    parser.add_argument("--stiffness", type=float, default=1.2, help="true factor")
    parser.add_argument("--friction", type=float, default=0.08, help="true coefficient")
    parser.add_argument("--candidates", type=int, default=48)
    parser.add_argument("--rounds", type=int, default=8)
    parser.add_argument("--steps", type=int, default=60)
    options = parser.parse_args()
    true = np.array([options.stiffness, options.friction])
    random = np.random.default_rng(0)
    measured = Bench(options.task, 1).push(true[None], options.steps)
    measured = random.normal(measured, 1.0)
    bench = Bench(options.task, options.candidates)
    mean, spread = (LOW + HIGH) / 2, (HIGH - LOW) / 2
    for number in range(options.rounds):
        drawn = random.normal(mean, spread, (options.candidates, 2)).clip(LOW, HIGH)
        errors = ((bench.push(drawn, options.steps) - measured) ** 2).mean((1, 2))
        best = drawn[np.argsort(errors)[: options.candidates // 6]]
        # A wider spread than that of the best keeps it from shrinking too early.
        mean, spread = best.mean(0), 1.3 * best.std(0) + 1e-4
        print(f"round {number + 1}: stiffness {mean[0]:.3f}, friction {mean[1]:.4f}")
    print(f"true: {true[0]:.3f}, {true[1]:.4f}; found: {mean[0]:.3f}, {mean[1]:.4f}")


if __name__ == "__main__":
    main()
