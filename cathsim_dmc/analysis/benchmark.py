"""How fast the simulator is: what `cathsim benchmark speed` measures.

Real-time factor: simulated seconds per CPU second of this process, one thread. Every
figure is the median of repeated runs after a warm-up; ratios compare runs that
alternate, so that a machine whose speed drifts does not bend them.
"""

import dataclasses
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Sequence

import mujoco
import numpy as np

from cathsim_dmc import suite
from cathsim_dmc.analysis.validation.checks import Check, Report
from cathsim_dmc.tasks import navigation

DEPTHS = (0.0, 0.1, 0.2, 0.3, np.inf)  # m of insertion, edges of the bins
NUM_SIMULATIONS = 16
# Long enough that the deepest bin is reached, m.
_LONG = 0.42
_NEVER = 1e-6  # m, goal radius that no policy meets
_RUNS = 5


@dataclasses.dataclass(frozen=True)
class Drive:
    """A policy of the benchmark: the action (A,) at a control step."""

    name: str
    action: Callable[[int, np.random.Generator, int], np.ndarray]


def _still(step: int, generator: np.random.Generator, size: int) -> np.ndarray:
    return np.zeros(size)


def _random(step: int, generator: np.random.Generator, size: int) -> np.ndarray:
    return generator.uniform(-1, 1, size)


def _push(step: int, generator: np.random.Generator, size: int) -> np.ndarray:
    action = np.zeros(size)
    action[-1] = 1.0
    return action


def _curl(step: int, generator: np.random.Generator, size: int) -> np.ndarray:
    action = np.ones(size)
    action[1:-1:2] = 0.0
    return action


IDLE, RANDOM = Drive("idle", _still), Drive("random", _random)
PUSH, CURL = Drive("push", _push), Drive("curl", _curl)


@dataclasses.dataclass(frozen=True)
class Pace:
    """Speed of one episode.

    Attributes:
      insertion: (T,), m, after each control step.
      seconds: (T,), CPU seconds of each control step.
      contacts: (T,), with the wall at its end.
    """

    insertion: np.ndarray
    seconds: np.ndarray
    contacts: np.ndarray

    @property
    def factor(self) -> float:
        """Real-time factor of the whole episode."""
        return len(self.seconds) * _CONTROL / self.seconds.sum()

    def by_depth(self) -> dict[str, dict[str, float]]:
        """Real-time factor and mean number of contacts by insertion depth."""
        table = {}
        for low, high in zip(DEPTHS[:-1], DEPTHS[1:], strict=True):
            chosen = (self.insertion >= low) & (self.insertion < high)
            if chosen.any():
                end = "+" if np.isinf(high) else f"–{1e3 * high:.0f}"
                table[f"{1e3 * low:.0f}{end} mm"] = {
                    "real_time_factor": chosen.sum()
                    * _CONTROL
                    / self.seconds[chosen].sum(),
                    "steps_per_second": chosen.sum() / self.seconds[chosen].sum(),
                    "contacts": float(self.contacts[chosen].mean()),
                }
        return table


_CONTROL = navigation.cannulation.CONTROL_TIMESTEP


def _environment(task: str, **options):
    options.setdefault("goal_radius", _NEVER)
    return suite.load(suite.DOMAIN, task, task_kwargs={"random": 0, **options})


def pace(environment, drive: Drive, steps: int, seed: int = 0) -> Pace:
    """Runs an episode of a suite environment and times every control step."""
    generator = np.random.default_rng(seed)
    size = environment.action_spec().shape[0]
    environment.reset()
    insertion, seconds, contacts = [], [], []
    for step in range(steps):
        action = drive.action(step, generator, size)
        start = time.process_time()
        environment.step(action)
        seconds.append(time.process_time() - start)
        insertion.append(float(environment.task.readings.insertion))
        contacts.append(float(environment.task.contacts(environment.physics).found))
    return Pace(np.array(insertion), np.array(seconds), np.array(contacts))


def _median_pace(environment, drive: Drive, steps: int) -> tuple[float, Pace]:
    paces = [pace(environment, drive, steps) for _ in range(_RUNS)]
    factors = [each.factor for each in paces]
    middle = statistics.median(factors)
    return middle, paces[int(np.argmin(np.abs(np.array(factors) - middle)))]


def suite_overhead(steps: int = 150) -> float:
    """CPU time of suite environment steps over that of their bare mj_step calls."""
    environment = _environment("type1_bca")
    ratios = []
    for seed in range(_RUNS + 1):
        generator = np.random.default_rng(seed)
        environment.reset()
        task, physics = environment.task, environment.physics
        model, data = physics.model.ptr, physics.data.ptr
        bare = mujoco.MjData(model)
        mujoco.mj_copyData(bare, model, data)
        ours = theirs = 0.0
        substeps = task.substeps
        for step in range(steps):
            action = (RANDOM if seed % 2 else PUSH).action(step, generator, 21)
            start = time.process_time()
            environment.step(action)
            middle = time.process_time()
            bare.ctrl[:] = action
            for _ in range(substeps):
                mujoco.mj_step(model, bare)
            theirs += time.process_time() - middle
            ours += middle - start
        ratios.append(ours / theirs)
    return statistics.median(ratios[1:])


def _batch(threads: int, seed: int = 0, **options):
    from cathsim_dmc.simulation import batch

    environment = _environment("type1_bca", **options)
    return batch.BatchSimulation(
        environment.task, NUM_SIMULATIONS, num_threads=threads, seeds=seed
    )


def thread_scaling(steps: int = 30) -> tuple[float, dict[str, float]]:
    """Throughput of bare batches: two threads over one, and control steps a second."""
    batches = {threads: _batch(threads) for threads in (1, 2)}
    rates: dict[int, list[float]] = {1: [], 2: []}
    for run in range(_RUNS + 1):
        for threads, simulation in batches.items():
            simulation.reset()
            generator = np.random.default_rng(run)
            shape = (NUM_SIMULATIONS, simulation.num_actions)
            substeps = simulation.task.substeps
            start = time.perf_counter()
            for _ in range(steps):
                simulation.batch.ctrl[:] = generator.uniform(-1, 1, shape)
                simulation.batch.step(nstep=substeps)
            elapsed = time.perf_counter() - start
            rates[threads].append(steps * NUM_SIMULATIONS / elapsed)
    ratios = [two / one for one, two in zip(rates[1][1:], rates[2][1:], strict=True)]
    per_second = {f"{n} threads": statistics.median(r[1:]) for n, r in rates.items()}
    return statistics.median(ratios), per_second


def torchrl_overhead(steps: int = 30, threads: int = 1) -> tuple[float, float]:
    """Time of TorchRL batched steps over bare `Batch.step`, and steps a second."""
    import torch

    from cathsim_dmc.simulation.torchrl import BatchedEnv

    torch.set_num_threads(1)
    env = BatchedEnv(
        "type1_bca",
        NUM_SIMULATIONS,
        num_threads=threads,
        task_kwargs={"goal_radius": _NEVER},
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
    return statistics.median(ratios[1:]), statistics.median(rates[1:])


_OBSERVED = ("internal", "image")


def image_ratio(steps: int = 60) -> float:
    """Rate of the image environment over that of the internal one, same actions."""
    environments = [_environment("type1_bca", observation=o) for o in _OBSERVED]
    ratios = []
    for run in range(_RUNS + 1):
        internal, image = (
            pace(environment, RANDOM, steps, seed=run).seconds.sum()
            for environment in environments
        )
        ratios.append(internal / image)
    return statistics.median(ratios[1:])


def batched_image_ratio(steps: int = 20) -> float:
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
    return statistics.median(ratios[1:])


def _timed(function: Callable[[], object], runs: int = _RUNS) -> float:
    seconds = []
    for _ in range(runs + 1):
        start = time.perf_counter()
        function()
        seconds.append(time.perf_counter() - start)
    return statistics.median(seconds[1:])


def construction() -> tuple[float, float, float]:
    """Seconds to construct a task, to reset it, and to make a new random anatomy."""
    from cathsim_dmc.anatomy import arch

    environment = _environment("type1_bca")
    environment.reset()
    random_state = np.random.RandomState(0)

    def new_anatomy():
        arch.build_arch(arch.sample(random_state, "II"))

    construct = _timed(lambda: _environment("type1_bca").close())
    return construct, _timed(environment.reset, 20), _timed(new_anatomy)


def _in_fresh_process(code: str, runs: int = _RUNS) -> float:
    """Median of the number that a fresh interpreter prints."""
    values = []
    for _ in range(runs):
        result = subprocess.run(
            [sys.executable, "-c", code], capture_output=True, text=True, check=True
        )
        values.append(float(result.stdout.split()[-1]))
    return statistics.median(values)


def _import_seconds(statement: str) -> float:
    return _in_fresh_process(
        f"import time; start = time.perf_counter(); {statement}; "
        "print(time.perf_counter() - start)"
    )


def peak_memory() -> float:
    """Peak memory of a process that loads a task and steps it, MB."""
    # The kernel's high-water mark of the address space: ru_maxrss would hold what the
    # parent had when it forked.
    return _in_fresh_process(
        "from cathsim_dmc import suite; "
        "env = suite.load('cathsim', 'type1_bca'); env.reset(); "
        "env.step([0.0] * 21); "
        "print([int(line.split()[1]) / 1024 for line in open('/proc/self/status') "
        "if line.startswith('VmHWM')][0])",
        runs=3,
    )


def speed(say: Callable[[str], None] = lambda text: None) -> Report:
    """All figures of `cathsim benchmark speed` as checks and tables."""
    checks: list[Check] = []
    depth = {}
    say("real-time factors")
    bars: Sequence[tuple[Drive, float]] = ((PUSH, 12), (RANDOM, 20), (CURL, 5))
    environment = _environment("type1_bca")
    for drive, bar in bars:
        factor, one = _median_pace(environment, drive, 150)
        checks.append(
            Check.at_least(
                f"real-time factor, {drive.name}",
                factor,
                bar,
                "x",
                f"{one.contacts.mean():.1f} contacts, {one.insertion[-1] * 1e3:.0f} mm",
            )
        )
    long = _environment("type1_bca", working_length=_LONG)
    for drive in (IDLE, RANDOM, PUSH, CURL):
        say(f"by insertion depth: {drive.name}")
        depth[drive.name] = _median_pace(long, drive, 215)[1].by_depth()
    say("overheads")
    checks.append(Check.at_most("suite step / mj_step", suite_overhead(), 1.25, "x"))
    ratio, rate = torchrl_overhead()
    checks.append(Check.at_most("TorchRL batched step / Batch.step", ratio, 1.2, "x"))
    scaling, rates = thread_scaling()
    checks.append(Check.at_least("two threads / one", scaling, 1.85, "x"))
    checks += [
        Check.at_least(f"image / internal, {name}", ratio(), 0.8, "x")
        for name, ratio in (("batched", batched_image_ratio), ("suite", image_ratio))
    ]
    say("construction, memory, imports")
    construct, reset, anatomy = construction()
    checks += [
        Check.at_most("construct a task", construct, 1.0, "s"),
        Check.at_most("reset", 1e3 * reset, 5.0, "ms"),
        Check.at_most("new parametric anatomy", anatomy, 0.5, "s"),
        Check.at_most("peak memory", peak_memory(), 300, "MB"),
        Check.at_most(
            "import cathsim_dmc", _import_seconds("import cathsim_dmc"), 0.1, "s"
        ),
        Check.at_most(
            "from cathsim_dmc import suite",
            _import_seconds("from cathsim_dmc import suite"),
            1.5,
            "s",
        ),
    ]
    findings = {
        "by_insertion_depth": depth,
        "batched_steps_per_second": {**rates, "TorchRL, 1 thread": rate},
    }
    return Report("speed, one core", checks, findings)
