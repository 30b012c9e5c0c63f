"""Many simulations of one navigation task on a thread pool.

Bit-identical to as many composer environments with the same seeds and actions: the
same compiled model, the same `mj_step`, the same `Rollout`.
"""

import copy
import ctypes
import os
import weakref
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import mujoco
import numpy as np
from dm_control import mjcf
from mujoco import batch as mujoco_batch

from cathsim_dmc import bounds
from cathsim_dmc.physics import forces, readings
from cathsim_dmc.physics.randomisation import ModelVariation
from cathsim_dmc.tasks.actions import check_action
from cathsim_dmc.tasks.cases import Case
from cathsim_dmc.tasks.navigation import Navigation
from cathsim_dmc.tasks.rollout import Rollout
from cathsim_dmc.tasks.step import Step

# What composer calls on a task; the batch steps the rollout instead, so a task that
# overrides one of these would mean something else here.
_HOOKS = (
    "initialize_episode_mjcf",
    "initialize_episode",
    "before_step",
    "before_substep",
    "after_substep",
    "after_step",
    "get_reward",
    "get_discount",
    "should_terminate_episode",
)


_ALIVE: weakref.WeakSet["BatchSimulation"] = weakref.WeakSet()


def _keep_in_fork():
    """Keeps batches for ever in a fork: freeing one waits for its threads."""
    for simulation in _ALIVE:
        ctypes.pythonapi.Py_IncRef(ctypes.py_object(simulation.batch))


if hasattr(os, "register_at_fork"):  # not on Windows, which has no fork
    os.register_at_fork(after_in_child=_keep_in_fork)


class BatchSimulation:
    """N simulations of one task.

    A simulation that has ended must be reset before the next step; stepping it on is
    allowed and goes on with the state as it is.
    """

    def __init__(
        self,
        task: Navigation,
        num_simulations: int,
        *,
        num_threads: int = 0,
        seeds: Sequence[int] | int = 0,
    ):
        """Compiles the task's model and starts the threads.

        Args:
          task: Task that no environment owns; the batch takes it over.
          num_simulations: N.
          num_threads: Number of worker threads, 0 for one per core.
          seeds: Seeds of the simulations, or of the first, the others counting up.

        Raises:
          ValueError: if the task overrides what composer calls, or a number is wrong.
        """
        bounds.whole("num_simulations", num_simulations, 1, bounds.MOST_SIMULATIONS)
        bounds.whole("num_threads", num_threads, 0, bounds.MOST_THREADS)
        _refuse_overrides(type(task))
        self._task = task
        physics = mjcf.Physics.from_mjcf_model(task.root_entity.mjcf_model)
        self._model = physics.model.ptr
        self._substeps = task.substeps
        self._batch = mujoco_batch.Batch(self._model, num_simulations, num_threads)
        for field in task.scene.fields:
            self._batch.bind(field)
        self._rows = np.zeros(
            (num_simulations, self._substeps, self._model.nsensordata)
        )
        self._models = _Fields(self._batch)
        if task.num_anatomies > 1:
            varies = bool(ModelVariation.fields_of(task.config.ranges))
            writes = varies or task.scene.coaxial
            self._models = _OwnModels(self._batch) if writes else _Models(self._batch)
        self._rollout = task.make_rollout(
            self._model, self._batch, self._models, num_simulations
        )
        self.seed(seeds)
        self._begun = np.zeros(num_simulations, dtype=bool)
        self._process = os.getpid()
        _ALIVE.add(self)

    def seed(self, seeds: Sequence[int | Sequence[int]] | int) -> None:
        """Gives each simulation its own source of randomness.

        Args:
          seeds: Seeds of the simulations, or of the first, the others counting up.

        Raises:
          ValueError: if a seed is none that `numpy.random.RandomState` takes.
        """
        seeds = bounds.seeds("seeds", seeds, self.num_simulations)
        self._random_states = [np.random.RandomState(seed) for seed in seeds]

    def reset(self, indices: np.ndarray | None = None) -> Step:
        """Starts new episodes.

        Args:
          indices: (K,) numbers of the simulations to reset, K > 0; None for all.

        Returns:
          All simulations as they stand.

        Raises:
          ValueError: if the indices are no such numbers.
          RuntimeError: if the process has forked.
        """
        self._refuse_fork()
        indices = bounds.indices("indices", indices, self.num_simulations)
        self._begun[indices] = True
        # Without a pass at the default pose, whose solution would warm-start ours.
        self._batch.reset(indices, stage=mujoco.mjtStage.mjSTAGE_NONE.value)
        self._rollout.begin(indices, self._random_states)
        self._forward_unactuated(indices)
        self._rows[indices] = self._batch.sensordata[indices, None]
        return _own(self._rollout.start(indices, self._magnitudes()))

    def _forward_unactuated(self, indices: np.ndarray):
        """What dm_control does at a reset, when there is no control yet."""
        with self._models.unactuated(indices):
            self._batch.forward(indices)

    def step(self, action: np.ndarray) -> Step:
        """Advances every simulation by one control step.

        Args:
          action: (N, A) in [-1, 1]; what lies outside is clipped.

        Raises:
          ValueError: if the action has the wrong shape or is not finite, or the
            objective's outcome is none.
          RuntimeError: if a simulation has not been reset, or the process has forked.
        """
        self._refuse_fork()
        if not self._begun.all():
            waiting = np.flatnonzero(~self._begun).tolist()
            raise RuntimeError(
                f"simulations {bounds.shown(waiting)} have no episode; call reset() "
                "before step()"
            )
        batch = self._batch
        action = check_action(action, (batch.nsim, self.num_actions))
        batch.ctrl[:] = self._rollout.command(action, lambda: batch.state)
        before, warnings = batch.state.copy(), batch.warning.copy()
        batch.rollout(
            self._substeps, record=("sensordata",), out={"sensordata": self._rows}
        )
        warned, magnitudes = self._warned(warnings), self._magnitudes()
        contacts = self._rows[..., self._rollout.index.wall_contacts]
        coarse = forces.too_coarse(magnitudes, contacts) & ~warned
        if coarse.any():
            self._refine(np.flatnonzero(coarse), before)
            warned, magnitudes = self._warned(warnings), self._magnitudes()
        return _own(self._rollout.finish(magnitudes, warned))

    def _refuse_fork(self):
        if os.getpid() != self._process:
            raise RuntimeError(
                "the process has forked, and a fork has no threads of the batch; make "
                "the batch after the fork, or start processes by spawn"
            )

    def _refine(self, indices: np.ndarray, before: np.ndarray) -> None:
        """Does the control step of some simulations again, with shorter steps.

        Args:
          indices: Numbers of the simulations.
          before: (N, nstate), states before the control step, with the commands.
        """
        self._batch.state[indices] = before[indices]
        with self._models.shorter_steps(indices):
            record = self._batch.rollout(
                forces.REFINEMENT * self._substeps, record=("sensordata",), ids=indices
            )
        last = slice(forces.REFINEMENT - 1, None, forces.REFINEMENT)
        self._rows[indices] = record["sensordata"][:, last]

    def _warned(self, before: np.ndarray) -> np.ndarray:
        """Whether MuJoCo has warned in each simulation (N,) since some counts."""
        changed = self._batch.warning != before
        return changed.reshape(self.num_simulations, -1).any(-1)

    def _magnitudes(self) -> np.ndarray:
        """Contact forces on the wall (N, S, M) in the S physics steps, N."""
        return forces.magnitudes(self._rows[..., self._rollout.index.wall_contacts])

    @property
    def num_simulations(self) -> int:
        """N."""
        return self._batch.nsim

    @property
    def num_actions(self) -> int:
        """A, entries of an action."""
        return self._task.num_actions

    @property
    def task(self) -> Navigation:
        """The task that all simulations run."""
        return self._task

    @property
    def rollout(self) -> Rollout:
        """Objective, readings and forces of all simulations."""
        return self._rollout

    @property
    def readings(self) -> readings.Readings:
        """State of the devices after the last step or reset, arrays (N, ...)."""
        return self._rollout.readings

    @property
    def wall_force(self) -> forces.WallForce:
        """Force on the wall over the last step, arrays (N,)."""
        return self._rollout.wall_force

    @property
    def batch(self) -> mujoco_batch.Batch:
        """The simulations; `expand` gives model fields of their own to each."""
        return self._batch

    @property
    def sensor_rows(self) -> np.ndarray:
        """Sensor rows (N, S, nsensordata) of the S physics steps of the last step."""
        return self._rows

    def contacts(self) -> forces.Contacts:
        """Contacts with the wall in the last physics step, arrays (N, K, ...)."""
        return self._rollout.index.contacts(self._rows[:, -1])


_ACTUATION = mujoco.mjtDisableBit.mjDSBL_ACTUATION.value


class _Fields:
    """One model for all simulations, with fields of their own."""

    def __init__(self, batch: mujoco_batch.Batch):
        self._batch = batch

    def field(self, index: int, name: str) -> np.ndarray:
        """A field of the model of one simulation, to be written."""
        return self._batch.expand(name)[index]

    def load(self, index: int, case: Case) -> None:
        """There is one anatomy."""

    @contextmanager
    def unactuated(self, indices: np.ndarray) -> Iterator[None]:
        """Switches the actuators of some simulations off for a while."""
        flags = self._batch.expand("opt.disableflags")
        flags[indices] |= _ACTUATION
        try:
            yield
        finally:
            flags[indices] &= ~_ACTUATION

    @contextmanager
    def shorter_steps(self, indices: np.ndarray) -> Iterator[None]:
        """Shortens the physics steps of some simulations for a while."""
        timesteps = self._batch.expand("opt.timestep")
        timesteps[indices] /= forces.REFINEMENT
        try:
            yield
        finally:
            timesteps[indices] *= forces.REFINEMENT


class _Models:
    """A model for each anatomy, shared by the simulations that have drawn it.

    Simulations whose episodes write to their models need `_OwnModels`.
    """

    def __init__(self, batch: mujoco_batch.Batch):
        self._batch = batch
        self._models = [batch.model] * batch.nsim
        self._by_case: dict[Case, mujoco.MjModel] = {}

    def field(self, index: int, name: str) -> np.ndarray:
        """A field of the model of one simulation, to be written."""
        return getattr(self._models[index], name)

    def load(self, index: int, case: Case) -> None:
        """Lets one simulation run in an anatomy, from `unactuated` on."""
        if case not in self._by_case:
            model = copy.copy(self._batch.model)
            case.write(model)
            self._by_case[case] = model
        self._models[index] = self._by_case[case]

    @contextmanager
    def unactuated(self, indices: np.ndarray) -> Iterator[None]:
        """Switches the actuators of some simulations off for a while."""
        chosen = self._chosen(indices)
        for model in chosen:
            model.opt.disableflags |= _ACTUATION
        self._batch.set_models(self._models)
        try:
            yield
        finally:
            for model in chosen:
                model.opt.disableflags &= ~_ACTUATION
            self._batch.set_models(self._models)

    @contextmanager
    def shorter_steps(self, indices: np.ndarray) -> Iterator[None]:
        """Shortens the physics steps of some simulations for a while."""
        chosen = self._chosen(indices)
        for model in chosen:
            model.opt.timestep /= forces.REFINEMENT
        self._batch.set_models(self._models)
        try:
            yield
        finally:
            for model in chosen:
                model.opt.timestep *= forces.REFINEMENT
            self._batch.set_models(self._models)

    def _chosen(self, indices: np.ndarray) -> list[mujoco.MjModel]:
        """The models of some simulations, each once."""
        return list({id(m): m for m in (self._models[i] for i in indices)}.values())


class _OwnModels(_Models):
    """A model for each simulation, into which its anatomy is written."""

    def __init__(self, batch: mujoco_batch.Batch):
        super().__init__(batch)
        self._models = [copy.copy(batch.model) for _ in range(batch.nsim)]
        self._cases: list[Case | None] = [None] * batch.nsim

    def load(self, index: int, case: Case) -> None:
        """Lets one simulation run in an anatomy, from `unactuated` on."""
        if case is not self._cases[index]:
            case.write(self._models[index])
            self._cases[index] = case


def _own(step: Step) -> Step:
    """Observations as the caller's own, as composer's buffers make them."""
    copies = {key: np.array(value) for key, value in step.observation.items()}
    return step._replace(observation=copies)


def _refuse_overrides(kind: type) -> None:
    changed = [n for n in _HOOKS if getattr(kind, n) is not getattr(Navigation, n)]
    if changed:
        raise ValueError(
            f"{kind.__name__} overrides {', '.join(changed)}, which composer calls and "
            "a batch does not; put reward and success into an Objective and pass that "
            "to Navigation (docs/architecture.md)"
        )
