"""The physics steps of a control step, for N simulations of any engine.

`SingleStepper` adapts the simulation that composer steps to `Stepper`,
`simulation.batch` those of `mujoco.batch`.
"""

import abc
import functools
import types
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import mujoco
import numpy as np

from cathsim_dmc import rows
from cathsim_dmc.entities.chain import TIMESTEP
from cathsim_dmc.physics import deep_links, forces, readings

PHYSICS_TIMESTEP = TIMESTEP
CONTROL_TIMESTEP = 0.04  # s, one frame of fluoroscopy
_STATE = mujoco.mjtState.mjSTATE_INTEGRATION.value
_ACTUATION = mujoco.mjtDisableBit.mjDSBL_ACTUATION.value
_ALL = slice(None)


class Stepper(abc.ABC):
    """Steps N simulations of one compiled scene.

    Attributes:
        arrays: Views of the state, with MuJoCo's names and a leading axis N, among them
            `readings.ModelIndex.FIELDS`. `qpos`, `ctrl` and `userdata` are written.
        warnings: (N, ...) int, numbers of MuJoCo's warnings, a view.
        before: (N, nstate), mjSTATE_INTEGRATION, states before the physics steps of the
            last control step, with its control.
        repeated: (N,) int, number of control steps repeated in shorter physics steps.
        deepest: Contact depth, m, above which a control step is repeated; None for
            `forces.DEEPEST`.
        driven: Columns of `ctrl` that are the device's; others are the scene's own.
        num_simulations: N.
        substeps: S, physics steps in a control step.
        has_snapshots: Whether `kept` and `put_back` are supported.
        has_hooks: Whether hooks of composer may write all fields of the model.
    """

    arrays: Any
    warnings: np.ndarray
    driven = slice(None)
    has_snapshots = False
    has_hooks = False

    def __init__(self, model: mujoco.MjModel, num_simulations: int, substeps: int):
        """Finds the wall, its sensor and the links that may touch it in the scene."""
        self.num_simulations, self.substeps = num_simulations, substeps
        self.repeated = np.zeros(num_simulations, np.int64)
        self._shortened = False  # whether any time step has been shortened
        self.deepest: float | None = None
        self._contacts = readings.sensor(model, "wall_contacts")
        self.before = self._warnings_before = np.empty(0)
        self._timestep, self._scratch = model.opt.timestep, mujoco.MjData(model)
        self._wall = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_GEOM, "wall")
        self._links = deep_links.moving(model)

    @abc.abstractmethod
    def _model_of(self, index: int) -> mujoco.MjModel:
        """The model that one simulation runs on."""

    def field(self, index: int, name: str) -> np.ndarray:
        """A field of one simulation's own model, to be written."""
        return getattr(self._model_of(index), name)

    @abc.abstractmethod
    def load(self, index: int, case: Any) -> None:
        """Loads the fields of a `tasks.cases.Case` into the model of one simulation."""

    @abc.abstractmethod
    def states(self, indices: np.ndarray | slice = _ALL) -> np.ndarray:
        """States (K, nstate) of some simulations, mjSTATE_INTEGRATION, a copy."""

    @abc.abstractmethod
    def set_states(self, indices: np.ndarray, states: np.ndarray) -> None:
        """Writes states (K, nstate) of some simulations (K,)."""

    @property
    @abc.abstractmethod
    def contact_rows(self) -> np.ndarray:
        """Rows (N, S, M * 14) of the wall's sensor in the last control step."""

    @abc.abstractmethod
    def _run(self, indices: np.ndarray, parts: int) -> np.ndarray:
        """Does S * parts physics steps; keeps the contacts of every `parts`-th one.

        Returns:
            Rows (K, S * parts, M * 14) of the wall's sensor in all of them.
        """

    @abc.abstractmethod
    def _keep_still(self, indices: np.ndarray) -> None:
        """Keeps the present contacts, without a physics step."""

    @abc.abstractmethod
    def _forward(self, indices: np.ndarray) -> None:
        """Computes what MuJoCo derives from the states of some simulations."""

    def _change(
        self, indices: np.ndarray, option: str, change: Callable[[Any], Any]
    ) -> None:
        """Changes an option of the models of some simulations."""
        for options in {id(m): m.opt for m in map(self._model_of, indices)}.values():
            setattr(options, option, change(getattr(options, option)))

    def begin(self, control: np.ndarray) -> None:
        """Begins a control step with the control (N, U) of all its physics steps."""
        self.arrays.ctrl[:, self.driven] = control
        self.before = self.states()
        self._warnings_before = self.warnings.copy()

    def end(self) -> tuple[forces.WallForce, np.ndarray]:
        """Ends a control step, repeated in shorter steps where it was too coarse.

        Returns:
            Force on the wall over the control step, and whether MuJoCo has warned in
            it, (N,) bool; where it is repeated, whether in the last repetition.
        """
        warned, (force, depth) = self._warned(), self._forces()
        limit = forces.DEEPEST if self.deepest is None else self.deepest
        way, doubt = self._way(force.peak_max, depth, limit)
        if not (doubt or np.count_nonzero(warned)):
            return force, warned
        depth = self._depth_at_end(depth, way, warned, limit)
        again: list[tuple[np.ndarray, forces.WallForce]] = []
        # Half the step usually suffices for a compliant wall.
        for parts in (forces.REFINEMENT,) if self.deepest is None else (2, 8):
            coarse = (force.peak_max > forces.HARDEST) | (depth > limit) | warned
            if not np.count_nonzero(coarse):
                break
            indices = np.flatnonzero(coarse)
            self.repeated[indices] += 1
            # A warning resets the data and sets the number of warnings to one.
            self.warnings[indices] = self._warnings_before[indices] = 0
            finer, _ = forces.wall_force(self._refine(indices, parts))
            again.append((indices, finer))
            warned, (force, depth) = self._warned(), self._forces()
        for indices, finer in again:  # all shorter steps count, not only kept ones
            for whole, each in zip(force, finer, strict=True):
                whole[indices] = each
        return force, warned

    @functools.cached_property
    def _motion(self) -> deep_links.Motion:  # a batch looks a field up at each access
        return deep_links.Motion._make(
            getattr(self.arrays, name) for name in deep_links.Motion._fields
        )

    def _forces(self) -> tuple[forces.WallForce, np.ndarray]:
        """Force on the wall over a control step, and its deepest contact (N,), m."""
        return forces.wall_force(self.contact_rows)

    @property
    def last_contacts(self) -> np.ndarray:
        """Rows (N, M * 14) of the wall's sensor in the last physics step."""
        return self.contact_rows[:, -1]

    def still(self, indices: np.ndarray) -> forces.WallForce:
        """Force on the wall, where simulations `indices` have not moved yet."""
        self._keep_still(indices)
        force, _ = self._forces()
        force.mean_sum[indices] = force.sum[indices]
        force.mean_max[indices] = force.max[indices]
        return force

    def restore(self, indices: np.ndarray) -> None:
        """Restores options that an interrupted reset or control step leaves changed."""
        self._change(indices, "disableflags", lambda flags: flags & ~_ACTUATION)
        if self._shortened:
            self._change(indices, "timestep", lambda _: self._timestep)

    def kept(self, indices: np.ndarray, fields: Sequence[str]) -> dict[str, np.ndarray]:
        """State that some simulations (K,) resume from, arrays (K, ...) by name.

        Args:
            fields: Names of fields of the model that differ between simulations.
        """
        return {
            "state": self.states(indices),
            "contacts": self.contact_rows[indices, -1],
            "repeated": self.repeated[indices],
            **{f"field_{name}": self._fields_of(indices, name) for name in fields},
        }

    def _fields_of(self, indices: np.ndarray, name: str) -> np.ndarray:
        """A field of the models of some simulations, (K, ...), a copy."""
        return np.stack([self.field(index, name) for index in indices.tolist()])

    def put_back(self, indices: np.ndarray, kept: Mapping[str, np.ndarray]) -> None:
        """Restores simulations (K,) from `kept` arrays; their cases must be loaded."""
        self.restore(indices)
        for name, values in kept.items():
            if name.startswith("field_"):
                for index, value in zip(indices.tolist(), values, strict=True):
                    self.field(index, name.removeprefix("field_"))[:] = value
        self.set_states(indices, kept["state"])
        self._forward(indices)  # updates the quantities that MuJoCo derives
        self.set_states(indices, kept["state"])
        # After an error their numbers would hide an equal warning, see `_warned`.
        self.warnings[indices] = 0
        self.repeated[indices] = kept["repeated"]
        self._put_contacts(indices, kept["contacts"])

    def _put_contacts(self, indices: np.ndarray, rows: np.ndarray) -> None:
        """Writes the last of `contact_rows`, (K, M * 14), of some simulations."""
        raise NotImplementedError

    def forward_unactuated(self, indices: np.ndarray) -> None:
        """Forward pass with actuators off, as dm_control does at a reset."""
        try:
            self._change(indices, "disableflags", lambda flags: flags | _ACTUATION)
            self._forward(indices)
        finally:
            self._change(indices, "disableflags", lambda flags: flags & ~_ACTUATION)

    def _way(
        self, peak: np.ndarray, depth: np.ndarray, limit: float
    ) -> tuple[np.ndarray, bool]:
        """Largest displacement (N,) m of the devices in the last physics step.

        Args:
            peak: (N,), largest force of a contact in the control step, N.
            depth: (N,), depth of the deepest contact in it, m.
            limit: Depth above which a control step is too coarse, m.

        Returns:
            The displacement, without its part along the devices, and whether any of the
            control steps was too coarse, or may end too deep.
        """
        limits, way = (forces.HARDEST, limit, self._timestep), np.empty_like(depth)
        if len(way) < rows.MANY:  # slices of all fields take longer than the work
            motion, links = self._motion, self._links
            return way, deep_links.in_doubt(peak, depth, limits, motion, links, way)
        doubt: list[bool] = []

        def measure(own: slice) -> None:
            motion, links = readings.part(self._motion, own), self._links
            found = deep_links.in_doubt(
                peak[own], depth[own], limits, motion, links, way[own]
            )
            doubt.append(found)

        rows.each(len(way), measure)
        return way, any(doubt)

    def _depth_at_end(
        self, depth: np.ndarray, way: np.ndarray, warned: np.ndarray, limit: float
    ) -> np.ndarray:
        """Depth (N,) m of the deepest contact in a control step, its end included.

        Contacts are computed once more where the displacement `way` (N,) m in the last
        physics step may have moved a link too deep.
        """
        suspect = (depth + way > limit) & (depth <= limit) & ~warned
        indices = np.flatnonzero(suspect)
        states = self.states(indices) if indices.size else ()
        for index, state in zip(indices.tolist(), states, strict=True):
            model, data = self._model_of(index), self._scratch
            mujoco.mj_setState(model, data, state, _STATE)
            mujoco.mj_kinematics(model, data)
            mujoco.mj_collision(model, data)
            at_wall = data.contact.geom2 == self._wall
            end = -data.contact.dist.min(initial=0.0, where=at_wall)
            depth[index] = max(depth[index], end)
        return depth

    def _refine(self, indices: np.ndarray, parts: int) -> np.ndarray:
        """Repeats the control step of simulations, in steps `parts` times shorter."""
        self.set_states(indices, self.before[indices])
        self._shortened = True
        try:
            self._change(indices, "timestep", lambda _: self._timestep / parts)
            return self._run(indices, parts)
        finally:
            self._change(indices, "timestep", lambda _: self._timestep)

    def _warned(self) -> np.ndarray:
        """Whether MuJoCo has warned in each simulation (N,) in the control step."""
        if self.warnings.tobytes() == self._warnings_before.tobytes():
            return np.zeros(self.num_simulations, dtype=bool)
        changed = self.warnings != self._warnings_before
        return changed.reshape(self.num_simulations, -1).any(-1)


class SingleStepper(Stepper):
    """One simulation, stepped by `step`, or by `advance` and `keep` around hooks.

    Attributes:
        data: The simulation.
        stopped: Whether MuJoCo has warned in this control step, which ends it.
        substep: Number of physics steps of this control step whose contacts are kept.
    """

    has_snapshots = True
    has_hooks = True

    def __init__(
        self,
        model: mujoco.MjModel,
        data: mujoco.MjData,
        fields: Sequence[str],
        substeps: int,
    ):
        """Takes views, which stay valid as long as `data` lives."""
        super().__init__(model, 1, substeps)
        self._model, self.data = model, data
        views = {name: getattr(data, name) for name in (*fields, "ctrl", "userdata")}
        self.arrays = types.SimpleNamespace(**{n: v[None] for n, v in views.items()})
        self.warnings = data.warning.number[None]
        self._case: Any = None
        self._sensor = data.sensordata[self._contacts]
        # Contacts of each physics step; 0 where there is none.
        self._rows = np.zeros((substeps, len(self._sensor)))
        self.substep, self._size = 0, mujoco.mj_stateSize(model, _STATE)
        self.stopped, self._known_warnings = False, b""  # of the control step

    def begin(self, control: np.ndarray) -> None:
        """Begins a control step with the control (1, U) of all its physics steps."""
        super().begin(control)
        self.substep, self.stopped = 0, False
        self._known_warnings = self._warnings_before.tobytes()

    def keep(self) -> None:
        """Keeps the contacts of the last physics step."""
        self._rows[self.substep] = 0.0 if self.stopped else self._sensor
        self.substep += 1

    @property
    def contact_rows(self) -> np.ndarray:
        """Rows (1, S, M * 14) of the wall's sensor in the last control step."""
        return self._rows[None]

    def _model_of(self, index: int) -> mujoco.MjModel:
        return self._model

    def load(self, index: int, case: Any) -> None:
        """Writes a case into the model and resets the data."""
        if case is not self._case:
            self._case = None  # until the case is written completely
            case.write(self._model)
            self._case = case
        # Clears the results of a pass in the last anatomy.
        mujoco.mj_resetData(self._model, self.data)

    def states(self, indices: np.ndarray | slice = _ALL) -> np.ndarray:
        """State (1, nstate), mjSTATE_INTEGRATION, a copy."""
        state = np.empty((1, self._size))
        mujoco.mj_getState(self._model, self.data, state[0], _STATE)
        return state

    def set_states(self, indices: np.ndarray, states: np.ndarray) -> None:
        """Writes the state (1, nstate)."""
        mujoco.mj_setState(self._model, self.data, states[0], _STATE)

    def step(self) -> None:
        """Does a physics step, and keeps its contacts."""
        self.advance()
        self.substep += 1

    def run(self) -> None:
        """Does all physics steps of a control step."""
        self.before = self.states()  # with what hooks after `begin` have written
        for row in self._rows:
            self._advance(row)
        self.substep = self.substeps

    def advance(self) -> None:
        """Does a physics step; none after a warning, as in a batch."""
        if not self.substep:
            self.before = self.states()  # as in `run`
        self._advance(self._rows[self.substep])

    def _advance(self, row: np.ndarray) -> None:
        if not self.stopped:
            mujoco.mj_step(self._model, self.data)
            self.stopped = self.warnings.tobytes() != self._known_warnings
        row[:] = 0.0 if self.stopped else self._sensor

    def _run(self, indices: np.ndarray, parts: int) -> np.ndarray:
        self.stopped, self._known_warnings = False, self._warnings_before.tobytes()
        rows = np.empty((self.substeps * parts, self._rows.shape[1]))
        for row in rows:
            self._advance(row)
        self._rows[:] = rows[parts - 1 :: parts]
        return rows[None]

    def _keep_still(self, indices: np.ndarray) -> None:
        self._rows[:-1], self._rows[-1] = 0.0, self._sensor

    def _put_contacts(self, indices: np.ndarray, rows: np.ndarray) -> None:
        self._rows[:-1], self._rows[-1], self._sensor[:] = 0.0, rows[0], rows[0]

    def _forward(self, indices: np.ndarray) -> None:
        mujoco.mj_forward(self._model, self.data)
