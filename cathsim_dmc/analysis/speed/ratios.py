"""What we add to bare MuJoCo, what threads bring, what images cost: ratios.

The two sides of a ratio take turns, so that a machine whose speed drifts bends neither:
by episodes, for by steps each would find the caches full of the other's data. Every
function returns the ratios of its runs, after one to warm up.
"""

import statistics
import time

import numpy as np

from cathsim_dmc.analysis.speed.pace import (
    NEVER,
    RANDOM,
    against_bare_steps,
    load,
    pace,
)

NUM_SIMULATIONS = 16
_RUNS = 12


def suite_overhead(policy: str, steps: int = 150) -> list[float]:
    """CPU time of suite environment steps over that of their bare mj_step calls."""
    environment = load()
    ratios = []
    for run in range(2 * _RUNS + 1):
        ours, bare = against_bare_steps(environment, policy, steps, run)
        ratios.append(ours / bare)
    return ratios[1:]


def _batch(threads: int, seed: int = 0, **options):
    from cathsim_dmc.simulation import batch

    environment = load(**options)
    return batch.BatchSimulation(
        environment.task, NUM_SIMULATIONS, num_threads=threads, seeds=seed
    )


def thread_scaling(steps: int = 30) -> tuple[list[float], float, dict[str, float]]:
    """Throughput of bare batches on two threads over one.

    Returns:
      the ratios; their median if the same work took the same CPU time on two cores as
      on one, as it does where nobody else uses them; control steps a second.
    """
    batches = {threads: _batch(threads) for threads in (1, 2)}
    shape = (steps, NUM_SIMULATIONS, batches[1].num_actions)
    wall, cpu = [], []
    for run in range(2 * _RUNS + 1):
        actions = np.random.default_rng(run).uniform(-1, 1, shape)
        wall.append({})
        cpu.append({})
        for threads, simulation in batches.items():
            simulation.reset()
            start = time.perf_counter(), time.process_time()
            for action in actions:
                simulation.batch.ctrl[:] = action
                simulation.batch.step(nstep=simulation.task.substeps)
            wall[-1][threads] = time.perf_counter() - start[0]
            cpu[-1][threads] = time.process_time() - start[1]
    total = steps * NUM_SIMULATIONS
    rates = {
        f"{threads} thread{'s' * (threads > 1)}": statistics.median(
            total / run[threads] for run in wall
        )
        for threads in batches
    }
    ratios = [run[1] / run[2] for run in wall[1:]]
    slower = [run[2] / run[1] for run in cpu[1:]]
    undisturbed = statistics.median(np.multiply(ratios, slower))
    return ratios, undisturbed, rates


def torchrl_overhead(steps: int = 30, threads: int = 1) -> tuple[list[float], float]:
    """Time of TorchRL batched steps over bare `Batch.step`, and steps a second."""
    import torch

    from cathsim_dmc.simulation.torchrl import BatchedEnv

    torch.set_num_threads(1)
    env = BatchedEnv(
        "type1_bca",
        NUM_SIMULATIONS,
        num_threads=threads,
        task_kwargs={"goal_radius": NEVER},
    )
    bare = _batch(threads)
    substeps = bare.task.substeps
    ratios, rates = [], []
    for run in range(_RUNS + 1):
        current = env.reset()
        bare.reset()
        bare.batch.state[:] = env.simulation.batch.state
        torch.manual_seed(run)
        ours = theirs = 0.0
        for _ in range(steps):
            action = 2 * torch.rand(*env.action_spec.shape) - 1
            start = time.perf_counter()
            current["action"] = action
            current = env.step(current)["next"]
            middle = time.perf_counter()
            bare.batch.ctrl[:] = action.numpy()
            bare.batch.step(nstep=substeps)
            theirs += time.perf_counter() - middle
            ours += middle - start
        ratios.append(ours / theirs)
        rates.append(steps * NUM_SIMULATIONS / ours)
    return ratios[1:], statistics.median(rates[1:])


def frame_rates(frames: int = 100) -> dict[str, float]:
    """Fluoroscopic images per second on one core, of 128 x 128 pixels."""
    environment = load(observation="image")
    environment.reset()
    task = environment.task
    scope, radius = task.rollout.fluoroscope, task.scene.catheter.device.outer_radius
    line = task.readings.centreline
    many = np.repeat(line[None], NUM_SIMULATIONS, axis=0)
    random_state = np.random.RandomState(0)
    ways = {
        "one at a time": (1, lambda: scope.render(line, radius)),
        f"{NUM_SIMULATIONS} at a time": (
            NUM_SIMULATIONS,
            lambda: scope.render(many, radius),
        ),
        "with noise": (1, lambda: scope.render(line, radius, random_state)),
    }
    rates = {}
    for name, (count, render) in ways.items():
        runs = []
        for _ in range(_RUNS + 1):
            start = time.process_time()
            for _ in range(frames):
                render()
            runs.append(frames * count / (time.process_time() - start))
        rates[name] = statistics.median(runs[1:])
    return rates


_OBSERVED = ("internal", "image")


def image_ratio(steps: int = 60) -> list[float]:
    """Rate of the image environment over that of the internal one, same actions."""
    environments = [load(observation=o) for o in _OBSERVED]
    ratios = []
    for run in range(_RUNS + 1):
        internal, image = (
            pace(environment, RANDOM, steps, seed=run).seconds.sum()
            for environment in environments
        )
        ratios.append(internal / image)
    return ratios[1:]


def batched_image_ratio(steps: int = 20) -> list[float]:
    """The same ratio of two batched simulations on one thread."""
    simulations = [_batch(1, observation=o) for o in _OBSERVED]
    ratios = []
    for run in range(_RUNS + 1):
        seconds = []
        for simulation in simulations:
            simulation.seed(run)
            simulation.reset()
            generator = np.random.default_rng(run)
            shape = (NUM_SIMULATIONS, simulation.num_actions)
            start = time.process_time()
            for _ in range(steps):
                simulation.step(generator.uniform(-1, 1, shape))
            seconds.append(time.process_time() - start)
        ratios.append(seconds[0] / seconds[1])
    return ratios[1:]
