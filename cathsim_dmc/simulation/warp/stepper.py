"""Steps N simulations of one task in MuJoCo Warp.

At the beginning of a control step, the state of all worlds is copied to the device; at
its end, the state and the readings are copied back. MuJoCo on the host does the forward
pass of a reset, the control steps that are repeated in shorter steps, and the check of
depths at the end of a control step.
"""

from __future__ import annotations

import concurrent.futures
import copy
import os
import threading
import types
from collections.abc import Callable, Iterable
from typing import Any

import mujoco
import numpy as np

from cathsim_dmc import rows
from cathsim_dmc.physics import forces
from cathsim_dmc.physics.dispatcher import Places
from cathsim_dmc.physics.effects import of_kind
from cathsim_dmc.physics.motion import Moving
from cathsim_dmc.physics.stepper import Stepper
from cathsim_dmc.simulation.warp.contacts import WallContacts
from cathsim_dmc.simulation.warp.devices import Device
from cathsim_dmc.simulation.warp.moving import MovingContacts
from cathsim_dmc.simulation.warp.passive import PassiveForces
from cathsim_dmc.simulation.warp.worlds import Worlds
from cathsim_dmc.tasks.cases import Case
from cathsim_dmc.tasks.navigation import Navigation
from cathsim_dmc.tasks.rollout import Rollout

# State of a simulation that the physics changes, and state that the effects write.
_STATE = ("qpos", "qvel", "act", "qacc_warmstart")
_GIVEN = ("userdata", "qfrc_applied")
_KEPT = (*_STATE, *_GIVEN, "time")
_LEAST_TOLERANCE = 1e-6  # of the solver, which has single precision


class WarpStepper(Stepper):
    """N simulations on one device.

    Attributes:
        lost: (N,) number of control steps in which a world had more contacts or
            constraint rows than room.
    """

    def __init__(
        self,
        task: Navigation,
        model: mujoco.MjModel,
        num_simulations: int,
        device: Device,
        num_threads: int,
    ):
        """Prepares the arrays; the first step copies the scene to the device.

        Raises:
            NotImplementedError: if Warp does not support an option of the task.
        """
        refuse(task)
        super().__init__(model, num_simulations, task.substeps)
        self._model, self._device = model, device
        self.warnings = np.zeros((num_simulations, 1), np.int64)
        self.lost = np.zeros(num_simulations, np.int64)
        self._names = tuple(dict.fromkeys((*_STATE, *task.data_fields)))
        self._read = [name for name in self._names if name not in _GIVEN]
        self.arrays, data = types.SimpleNamespace(), mujoco.MjData(model)
        for name in (*self._names, *_KEPT, "ctrl"):
            shape = num_simulations, *np.shape(getattr(data, name))
            setattr(self.arrays, name, np.zeros(shape))
        self._force = np.zeros((7, num_simulations))
        # Whether the last physics step was done on the device.
        self._on_device = np.zeros(num_simulations, bool)
        self._own: dict[str, np.ndarray] = {}
        effects = task.effects
        self._expand(name for effect in effects for name in effect.model_fields)
        self._dirty = set(self._own)
        self._each_step = {n for effect in effects for n in effect.step_fields}
        self._cases: dict[int, Case] = {}
        threads = num_threads or os.cpu_count() or 1
        self._pool = concurrent.futures.ThreadPoolExecutor(threads)
        self._local = threading.local()
        moves = of_kind(effects, Moving) is not None
        kind = MovingContacts if moves else WallContacts
        self.contacts = kind(device, model, num_simulations)
        self._begun = dict[str, np.ndarray]()
        self._worlds: Worlds | None = None
        self._stale = True

    def take(self, rollout: Rollout) -> None:
        """Takes the laws of the effects of the rollout that it steps.

        Raises:
            NotImplementedError: if there is a law that is not simulated on Warp.
        """
        places = Places.of(self._model, rollout.index)
        count = self.num_simulations
        self._passive = PassiveForces(self._device, places, rollout.effects, count)
        self.contacts.take(rollout.effects)

    # Fields of the model that differ between worlds.

    def _expand(self, names: Iterable[str]) -> None:
        for name in names:
            if name not in self._own:
                value = getattr(self._model, name)
                self._own[name] = np.repeat(value[None], self.num_simulations, axis=0)

    def field(self, index: int, name: str) -> np.ndarray:
        """A field of the model that one simulation has for itself, to be written."""
        if name not in self._own:
            raise KeyError(f"{name} is no field that an effect declares")
        self._dirty.add(name)
        return self._own[name][index]

    def load(self, index: int, case: Case) -> None:
        """Loads an anatomy into one simulation."""
        if self._cases.get(index) is case:
            return
        self._cases[index] = case
        self._expand(case.fields)
        for name, value in case.fields.items():
            self._own[name][index, : len(value)] = value
            self._dirty.add(name)
        if case.fields:
            self.contacts.enter([index], self._model_of(index), self._mine()[1])

    def _model_of(self, index: int) -> mujoco.MjModel:
        """A model of this thread with the fields of one simulation."""
        model = self._mine()[0]
        for name, values in self._own.items():
            getattr(model, name)[:] = values[index]
        if (case := self._cases.get(index)) is not None:
            case.write_statistics(model)
        return model

    def _mine(self) -> tuple[mujoco.MjModel, mujoco.MjData]:
        """Model and data of this thread."""
        if not hasattr(self._local, "made"):
            self._local.made = copy.copy(self._model), mujoco.MjData(self._model)
        return self._local.made

    # The sequence of a control step.

    def reset(self, indices: np.ndarray) -> None:
        """Resets some simulations (K,) to the default pose."""
        for name in (*_KEPT, "ctrl"):
            getattr(self.arrays, name)[indices] = 0.0
        self.arrays.qpos[indices] = self._model.qpos0
        self._stale = True

    def begin(self, control: np.ndarray) -> None:
        """Begins a control step with the control (N, U) of all its physics steps."""
        self.arrays.ctrl[:, self.driven] = control
        self._begun = {
            n: rows.copied(getattr(self.arrays, n)) for n in (*_STATE, "time")
        }
        # The physics does not change what the effects write.
        self._begun |= {name: getattr(self.arrays, name) for name in _GIVEN}
        self._warnings_before = self.warnings.copy()

    def step_device(self) -> None:
        """Does the physics steps of a control step on the device alone, for timing."""
        if self._worlds is not None:
            self._worlds.step()
            self._worlds.wait()

    def profile(self) -> dict[str, float]:
        """Seconds of the parts of the last control step on the device."""
        return {} if self._worlds is None else dict(self._worlds.seconds)

    def run(self) -> None:
        """Does the physics steps of a control step on the device."""
        if self._worlds is None or not self.contacts.is_bound:
            self.close()
            laws = self.contacts, self._passive
            self._worlds = Worlds(
                self._device, self._model, self._own, laws, self.substeps
            )
            self._dirty.clear()
            self._stale = True
        worlds = self._worlds
        worlds.write_model(self._own, self._dirty | self._each_step)
        self._dirty.clear()
        worlds.write(self.arrays, self._stale)
        worlds.step()
        totals = worlds.read(self.arrays, self._read)
        self._force[:] = totals.force
        self._force[4:6] /= self.substeps
        self.arrays.time += self.substeps * self._timestep
        self._stale = False
        self._on_device[:] = True
        self._note(totals.diverged != 0, totals.lost != 0)

    def close(self) -> None:
        """Frees the memory of the device; the next step allocates it again."""
        if self._worlds is not None:
            self._worlds.close()
            self._worlds = None

    def _note(self, diverged: np.ndarray, lost: np.ndarray) -> None:
        """Counts overflows and diverged worlds; restores the latter's last state."""
        self.lost += lost
        for index in np.flatnonzero(diverged).tolist():
            self.warnings[index] += 1
            for name, value in self._begun.items():
                getattr(self.arrays, name)[index] = value[index]
            self._on_host(index, mujoco.mj_forward)
            self._stale = True

    def _forces(self) -> tuple[forces.WallForce, np.ndarray]:
        return forces.WallForce._make(self._force[:6].copy()), self._force[6].copy()

    @property
    def contact_rows(self) -> np.ndarray:
        """Rows (N, 1, M * 14) of the wall's sensor in the last physics step."""
        return self.last_contacts[:, None]

    @property
    def last_contacts(self) -> np.ndarray:
        """Rows (N, M * 14) of the wall's sensor in the last physics step."""
        if self._worlds is not None:
            self._worlds.read_sensors(self.arrays.sensordata, self._on_device)
        return self.arrays.sensordata[:, self._contacts]

    def states(self, indices: np.ndarray | None = None) -> np.ndarray:
        """States (K, nstate) of some simulations, or all, mjSTATE_INTEGRATION."""
        chosen = range(self.num_simulations) if indices is None else indices.tolist()
        return np.array([self._state_of(index) for index in chosen])

    def _state_of(self, index: int) -> np.ndarray:
        model, data = self._mine()
        self._write(index, data, vars(self.arrays))
        kind = mujoco.mjtState.mjSTATE_INTEGRATION.value
        state = np.empty(mujoco.mj_stateSize(model, kind))
        mujoco.mj_getState(model, data, state, kind)
        return state

    def set_states(self, indices: np.ndarray, states: np.ndarray) -> None:
        """Writes states (K, nstate) of some simulations (K,)."""
        kind = mujoco.mjtState.mjSTATE_INTEGRATION.value
        for index, state in zip(indices.tolist(), states, strict=True):
            model, data = self._mine()
            mujoco.mj_setState(model, data, state, kind)
            for name in (*_KEPT, "ctrl"):
                getattr(self.arrays, name)[index] = getattr(data, name)
        self._stale = True

    def restore(self, indices: np.ndarray) -> None:
        """Does nothing: options of the host's models are restored after each use."""

    # What MuJoCo does on the host.

    def _write(self, index: int, data: mujoco.MjData, arrays: Any) -> None:
        """Writes the state of one simulation, of a dict of arrays, and its control."""
        for name in _KEPT:
            setattr(data, name, arrays[name][index])
        data.ctrl[:] = self.arrays.ctrl[index]

    def _on_host(
        self, index: int, act: Callable[[mujoco.MjModel, mujoco.MjData], Any],
        arrays: Any = None,
    ) -> Any:  # fmt: skip
        """Calls `act` on MuJoCo's model and data of one simulation; reads arrays."""
        model, data = self._model_of(index), self._mine()[1]
        mujoco.mj_resetData(model, data)
        self._write(index, data, vars(self.arrays) if arrays is None else arrays)
        result = act(model, data)
        self._on_device[index] = False
        for name in (*self._names, "time"):
            getattr(self.arrays, name)[index] = getattr(data, name)
        return result

    def forward_unactuated(self, indices: np.ndarray) -> None:
        """Does a forward pass with actuators off, as dm_control does at a reset."""
        flag = mujoco.mjtDisableBit.mjDSBL_ACTUATION.value

        def forward(model: mujoco.MjModel, data: mujoco.MjData) -> None:
            model.opt.disableflags |= flag
            try:
                mujoco.mj_forward(model, data)
            finally:
                model.opt.disableflags &= ~flag

        self._each(lambda index: self._on_host(index, forward), indices)

    def _keep_still(self, indices: np.ndarray) -> None:
        rows = self.arrays.sensordata[indices][:, None, self._contacts]
        self._keep_force(indices, rows)

    def _keep_force(self, indices: np.ndarray, rows: np.ndarray) -> None:
        """Keeps the force of some simulations (K,), see `forces.wall_force`."""
        force, depth = forces.wall_force(np.ascontiguousarray(rows))
        self._force[:, indices] = *force, depth

    def _each(self, act: Callable[[int], Any], indices: np.ndarray) -> list[Any]:
        return list(self._pool.map(act, indices.tolist()))

    def _refine(self, indices: np.ndarray, parts: int) -> np.ndarray:
        """Repeats the control step of some simulations in shorter physics steps."""
        self._stale = True
        return self._run(indices, parts)

    def _run(self, indices: np.ndarray, parts: int) -> np.ndarray:
        rows = np.stack(self._each(lambda i: self._again(i, parts), indices))
        self._keep_force(indices, rows[:, parts - 1 :: parts])
        return rows

    def _again(self, index: int, parts: int) -> np.ndarray:
        """Rows (S * parts, M * 14) of a control step in shorter physics steps."""
        size = self._contacts.stop - self._contacts.start
        rows = np.zeros((self.substeps * parts, size))

        def step(model: mujoco.MjModel, data: mujoco.MjData) -> None:
            whole = model.opt.timestep
            model.opt.timestep = whole / parts
            try:
                for row in rows:
                    mujoco.mj_step(model, data)
                    if data.warning.number.any():
                        self.warnings[index] += 1
                        break
                    row[:] = data.sensordata[self._contacts]
            finally:
                model.opt.timestep = whole

        self._on_host(index, step, self._begun)
        return rows

    def _forward(self, indices: np.ndarray) -> None:
        self._each(lambda index: self._on_host(index, mujoco.mj_forward), indices)


def refuse(task: Navigation) -> None:
    """Raise NotImplementedError if Warp does not support an option of the task."""
    if task.config.solver_tolerance < _LEAST_TOLERANCE:
        raise NotImplementedError(
            f"a solver_tolerance below {_LEAST_TOLERANCE:g}: not simulated on Warp; "
            "take simulation_device='cpu'"
        )
