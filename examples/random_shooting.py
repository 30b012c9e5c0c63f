"""Random shooting: a planner that tries actions from the state of an episode.

`python examples/random_shooting.py` cannulates the BCA of a small arch. Before each
action a batch is put to a snapshot of the episode, plays random actions from it, and
the first ones of the best sequence are done. Neither training nor a model of the vessel
is needed, only the simulator.
"""

import argparse

import numpy as np

from cathsim_dmc import suite
from cathsim_dmc.simulation.batch import BatchSimulation


def best_actions(
    planner: BatchSimulation, snapshot, horizon: int, random: np.random.Generator
) -> np.ndarray:
    """Actions (horizon, A) with the largest sum of rewards among random sequences.

    Args:
        planner: Batch with a simulation for each sequence.
        snapshot: State of one simulation, from which the sequences begin.
        horizon: Number of control steps of a sequence.
        random: Source of randomness of the sequences.
    """
    count = planner.num_simulations
    planner.restore(snapshot.repeat(count))
    # Actions that are held for some steps reach farther than white noise.
    held = random.uniform(-1.0, 1.0, (horizon // 5 + 1, count, planner.num_actions))
    pushes = list(planner.task.scene.catheter.translations)
    held[..., pushes] = np.abs(held[..., pushes])  # forward
    sequences = np.repeat(held, 5, axis=0)[:horizon]
    total, running = np.zeros(count), np.ones(count, bool)
    for actions in sequences:
        step = planner.step(actions)
        total += running * step.outcome.reward
        running &= ~(step.terminated | step.truncated)
    return sequences[:, np.argmax(total)]


def main() -> None:
    """Plays one episode and prints the final distance to the goal."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--task", default="simple1_bca")
    parser.add_argument("--sequences", type=int, default=32)
    parser.add_argument("--horizon", type=int, default=15)
    parser.add_argument("--steps", type=int, default=200)
    given = parser.parse_args()
    environment = suite.load("cathsim", given.task, {"random": 0})
    planner = BatchSimulation(suite.make_task(given.task), given.sequences)
    random, timestep, steps = np.random.default_rng(0), environment.reset(), 0
    while steps < given.steps and not timestep.last():
        plan = best_actions(planner, environment.snapshot(), given.horizon, random)
        for action in plan[:5]:
            timestep, steps = environment.step(action), steps + 1
            if timestep.last():
                break
    info = environment.task.info()
    print(f"{steps} steps, {1e3 * info['distance']:.1f} mm, success {info['success']}")


if __name__ == "__main__":
    main()
