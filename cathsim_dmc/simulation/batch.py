"""Many simulations of one navigation task on a thread pool.

Bit-identical to N composer environments with the same seeds and actions: the same
compiled model, the same `mj_step`, the same `Rollout`.
"""

import copy
import ctypes
import os
import weakref
from collections.abc import Callable, Sequence
from typing import Any

import mujoco
import numpy as np
from dm_control import mjcf
from mujoco import batch as mujoco_batch

from cathsim_dmc import bounds, rows
from cathsim_dmc.physics import forces, readings
from cathsim_dmc.physics.stepper import Stepper
from cathsim_dmc.tasks import rehearsal
from cathsim_dmc.tasks.cases import Case
from cathsim_dmc.tasks.conditions import Conditions
from cathsim_dmc.tasks.navigation import Navigation
from cathsim_dmc.tasks.rollout import Rollout
from cathsim_dmc.tasks.snapshot import NotCopied, Snapshot
from cathsim_dmc.tasks.step import Step

# Hooks that composer calls on a task. The batch steps the rollout instead, so it
# refuses a task that overrides one of these.
_HOOKS = (
    "initialize_episode_mjcf", "initialize_episode", "before_step", "before_substep",
    "after_substep", "after_step", "get_reward", "get_discount",
    "should_terminate_episode", "task_observables", "action_spec",
)  # fmt: skip
_ALIVE: weakref.WeakSet["BatchSimulation"] = weakref.WeakSet()


def _keep_in_fork():
    """Leaks batches in forked children, whose threads are gone."""
    for simulation in _ALIVE:
        ctypes.pythonapi.Py_IncRef(ctypes.py_object(simulation.batch))


if hasattr(os, "register_at_fork"):  # not on Windows, which has no fork
    os.register_at_fork(after_in_child=_keep_in_fork)


class BatchSimulation(NotCopied):
    """N simulations of one task.

    A simulation whose episode has ended is to be reset before the next step. Without a
    reset, `step` continues from its present state.

    Attributes:
        task: The task that all simulations run.
        num_simulations: N.
        num_actions: A, entries of an action.
        rollout: Objectives, readings and forces of all simulations.
        error_files: Writes physics errors, an `error_files.ErrorFiles`; None for none.
        stepper: Does their physics steps; `rows` (N, S, nsensordata) are the sensors in
            the S physics steps of the last step.
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
            task: Task that belongs to no environment; it then belongs to the batch.
            num_simulations: N.
            num_threads: Number of worker threads, 0 for one per core.
            seeds: Seeds of the simulations, or of the first; the others count up.

        Raises:
            ValueError: if the task overrides a hook of composer, a number is not
                allowed, or a camera needs OpenGL, which does not start.
        """
        num_simulations = bounds.whole(
            "num_simulations", num_simulations, 1, bounds.MOST_SIMULATIONS
        )
        num_threads = bounds.whole("num_threads", num_threads, 0, bounds.MOST_THREADS)
        if not isinstance(task, Navigation):
            bounds.refuse("task", task, "a task of suite.make_task")
        _refuse_overrides(type(task))
        self.task = task
        physics = mjcf.Physics.from_mjcf_model(task.root_entity.mjcf_model)
        self._model = physics.model.ptr
        self.stepper = self._made_stepper(num_simulations, num_threads)
        self.num_simulations, self.num_actions = num_simulations, task.num_actions
        self.rollout: Rollout = task.make_rollout(self._model, self.stepper)
        self.rollout.views.open()  # a batch cannot be forked anyway
        self.seed(seeds)
        self.error_files: Any = None
        self._begun = np.zeros(num_simulations, dtype=bool)
        self._process = os.getpid()
        _ALIVE.add(self)

    def _made_stepper(self, num_simulations: int, num_threads: int) -> Any:
        kind = _PoolStepper if self.task.num_anatomies > 1 else _BatchStepper
        task, model = self.task, self._model
        if rehearsal.is_due(task.config):
            # Two stand for all: arrays of one simulation have another numba type.
            own = copy.copy(model)
            stepper = kind(task, own, min(num_simulations, 2), 1)
            rollout = task.make_rollout(own, stepper)
            rehearsal.rehearse(rollout, stepper, task.num_actions)
        return kind(task, model, num_simulations, num_threads)

    @property
    def batch(self) -> mujoco_batch.Batch:
        """MuJoCo's batch; `expand` gives each simulation its own model fields."""
        return self.stepper.batch

    def seed(self, seeds: Sequence[int] | int) -> None:
        """Gives each simulation its own source of randomness.

        Args:
            seeds: Seeds of the simulations, or of the first; the others count up.

        Raises:
            ValueError: if `numpy.random.RandomState` does not take one of the seeds.
        """
        seeds = bounds.seeds("seeds", seeds, self.num_simulations)
        self._random_states = [np.random.RandomState(seed) for seed in seeds]

    @property
    def random_states(self) -> tuple[np.random.RandomState, ...]:
        """Source of randomness of each simulation."""
        return tuple(self._random_states)

    @property
    def conditions(self) -> list[Conditions]:
        """Drawn values of the present episode of each simulation."""
        return list(map(self.rollout.conditions, range(self.num_simulations)))

    def reset(self, indices: np.ndarray | None = None) -> Step:
        """Starts new episodes.

        Args:
            indices: (K,) numbers of the simulations to reset, K > 0; None for all.

        Returns:
            State of all simulations.

        Raises:
            ValueError: if an index is not the number of a simulation.
            RuntimeError: if the process has forked.
        """
        self._refuse_fork()
        indices = bounds.indices("indices", indices, self.num_simulations)
        self._begun[indices] = False
        self.stepper.reset(indices)
        self.rollout.begin(indices, self._random_states)
        self.stepper.forward_unactuated(indices)
        step = self.rollout.start(indices)
        self._begun[indices] = True
        return _own(step)

    def step(self, action: np.ndarray) -> Step:
        """Advances every simulation by one control step.

        Args:
            action: (N, A) in [-1, 1]; entries outside are clipped.

        Returns:
            State of all simulations.

        Raises:
            ValueError: if the action has the wrong shape or is not finite, or the
                objective returns no valid outcome.
            RuntimeError: if a simulation has not been reset, an error has interrupted
                its last step, or the process has forked.
        """
        self._refuse_fork()
        self._refuse_waiting(np.arange(self.num_simulations))
        action = bounds.actions(action, (self.num_simulations, self.num_actions))
        watched = self.error_files
        before = None if watched is None else watched.before(self.rollout)
        self.rollout.command(action)
        self.stepper.run()
        step = self.rollout.finish()
        if watched is not None and before is not None and step.physics_error.any():
            watched.after(before, action, step, self.rollout)
        return _own(step)

    def snapshot(self, indices: np.ndarray | None = None) -> Snapshot:
        """Returns the state between two steps; episodes continue from it bit for bit.

        Args:
            indices: (K,) numbers of the simulations, K > 0, in ascending order; None
                for all.

        Raises:
            ValueError: if the indices are not such numbers.
            RuntimeError: if one of them has not been reset, or an error has interrupted
                its last step.
            NotImplementedError: if these simulations have no snapshots.
        """
        indices = self._in_order(indices)
        self._refuse_waiting(indices)
        return self.rollout.snapshot(indices)

    def restore(self, snapshot: Snapshot, indices: np.ndarray | None = None) -> Step:
        """Restores a snapshot; replaces a reset.

        Args:
            snapshot: Snapshot of K simulations of the same task; it may come from a
                composer environment or another process.
            indices: (K,) numbers of the simulations, in ascending order; None for all.

        Returns:
            State of all simulations.

        Raises:
            ValueError: if the snapshot is of another task, or of another number of
                simulations, or the indices are not such numbers.
            RuntimeError: if the process has forked.
            NotImplementedError: if these simulations have no snapshots.
        """
        self._refuse_fork()
        indices = self._in_order(indices)
        waiting = indices[~self._begun[indices] | self.rollout.half_done[indices]]
        if len(waiting):
            self.reset(waiting)
        return _own(self.rollout.restore(indices, snapshot, self._random_states))

    def _in_order(self, indices: np.ndarray | None) -> np.ndarray:
        count = self.num_simulations
        return bounds.indices("indices", indices, count, ascending=True)

    def _refuse_waiting(self, indices: np.ndarray) -> None:
        waiting = indices[~self._begun[indices]].tolist()
        if waiting:
            raise RuntimeError(
                f"simulations {bounds.shown(waiting)} have no episode; call reset() "
                "first"
            )

    def _refuse_fork(self) -> None:
        if os.getpid() != self._process:
            raise RuntimeError(
                "the process has forked, and a fork has no threads of the batch; make "
                "the batch after the fork, or start processes by spawn"
            )

    def close(self) -> None:
        """Frees GPU memory; does nothing on the CPU."""

    def contacts(self) -> forces.Contacts:
        """Contacts with the wall in the last physics step, arrays (N, K, ...)."""
        return forces.Contacts.from_sensor(self.stepper.last_contacts)


class _BatchStepper(Stepper):
    """Simulations on a thread pool, in one anatomy."""

    has_snapshots = True

    def __init__(
        self,
        task: Navigation,
        model: mujoco.MjModel,
        num_simulations: int,
        num_threads: int,
    ):
        super().__init__(model, num_simulations, task.substeps)
        self.batch = mujoco_batch.Batch(model, num_simulations, num_threads)
        for field in task.data_fields:
            self.batch.bind(field)
        self.arrays, self.warnings = self.batch, self.batch.warning
        self.rows = np.zeros((num_simulations, self.substeps, model.nsensordata))
        self._copy, self._own_fields = copy.copy(model), set[str]()

    def reset(self, indices: np.ndarray) -> None:
        # No forward pass at the default pose: its solution would be a warm start.
        self.batch.reset(indices, stage=mujoco.mjtStage.mjSTAGE_NONE.value)

    def run(self) -> None:
        self.batch.rollout(
            self.substeps, record=("sensordata",), out={"sensordata": self.rows}
        )

    @property
    def contact_rows(self) -> np.ndarray:
        return self.rows[..., self._contacts]

    def field(self, index: int, name: str) -> np.ndarray:
        self._own_fields.add(name)
        return self.batch.expand(name)[index]

    def _fields_of(self, indices: np.ndarray, name: str) -> np.ndarray:
        return self.batch.expand(name)[indices]

    def _model_of(self, index: int) -> mujoco.MjModel:
        for name in self._own_fields:
            getattr(self._copy, name)[:] = self.batch.expand(name)[index]
        return self._copy

    def load(self, index: int, case: Case) -> None:
        """Nothing to load: all simulations share one anatomy."""

    def states(self, indices: np.ndarray | slice = slice(None)) -> np.ndarray:
        return np.array(self.batch.state[indices])

    def set_states(self, indices: np.ndarray, states: np.ndarray) -> None:
        self.batch.state[indices] = states

    def _run(self, indices: np.ndarray, parts: int) -> np.ndarray:
        record = self.batch.rollout(
            parts * self.substeps, record=("sensordata",), ids=indices
        )
        rows = record["sensordata"]
        self.rows[indices] = rows[:, parts - 1 :: parts]
        return rows[..., self._contacts]

    def _keep_still(self, indices: np.ndarray) -> None:
        self.rows[indices] = self.batch.sensordata[indices, None]

    def _put_contacts(self, indices: np.ndarray, rows: np.ndarray) -> None:
        self.rows[indices] = 0.0
        self.rows[indices, -1, self._contacts] = rows

    def _forward(self, indices: np.ndarray) -> None:
        self.batch.forward(indices)

    def _change(
        self, indices: np.ndarray, option: str, change: Callable[[Any], Any]
    ) -> None:
        values = self.batch.expand(f"opt.{option}")
        values[indices] = change(values[indices])


class _PoolStepper(_BatchStepper):
    """Simulations on a thread pool, each in the anatomy that it has drawn.

    If effects write model fields, each simulation has its own model. Otherwise
    simulations in the same anatomy share a model.
    """

    def __init__(self, task: Navigation, *arguments):
        super().__init__(task, *arguments)
        model = self.batch.model
        self._own = own = any(effect.model_fields for effect in task.effects)
        self._models = [copy.copy(model) if own else model for _ in self.rows]
        self._loaded: dict[int | Case, Any] = {}

    # Fields are those of the simulations' models, not those of the batch.
    field, _fields_of = Stepper.field, Stepper._fields_of

    def _model_of(self, index: int) -> mujoco.MjModel:
        return self._models[index]

    def load(self, index: int, case: Case) -> None:
        if self._own:
            if self._loaded.get(index) is not case:
                self._loaded.pop(index, None)  # until the write is complete
                case.write(self._models[index])
                self._loaded[index] = case
            return
        model = self._loaded.get(case)
        if model is None:
            model = copy.copy(self.batch.model)
            case.write(model)
        self._models[index] = self._loaded[case] = model
        kept = set(map(id, self._models))
        self._loaded = {c: m for c, m in self._loaded.items() if id(m) in kept}

    def _change(
        self, indices: np.ndarray, option: str, change: Callable[[Any], Any]
    ) -> None:
        Stepper._change(self, indices, option, change)
        self.batch.set_models(self._models)


def _own(step: Step) -> Step:
    """Copies observations, readings and forces, so that the caller may change them.

    composer's buffers copy observations too; the next control step uses the readings.
    """
    copies = {key: rows.copied(value) for key, value in step.observation.items()}
    state = readings.copied(step.readings), readings.copied(step.wall_force)
    return step._replace(observation=copies, readings=state[0], wall_force=state[1])


def _refuse_overrides(kind: type) -> None:
    changed = [n for n in _HOOKS if getattr(kind, n) is not getattr(Navigation, n)]
    if changed:
        raise ValueError(
            f"{kind.__name__} overrides {', '.join(changed)}, which composer calls and "
            "a batch does not; put reward and success into an Objective and pass that "
            "to Navigation (docs/architecture.md)"
        )
