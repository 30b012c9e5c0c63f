"""Model, data and graph of MuJoCo Warp for N worlds, and transfers with the host."""

from __future__ import annotations

import copy
import time
from collections.abc import Iterable, Mapping
from typing import Any

import mujoco
import numpy as np

from cathsim_dmc import rows
from cathsim_dmc.simulation.warp.contacts import WallContacts
from cathsim_dmc.simulation.warp.devices import Device, warp_modules
from cathsim_dmc.simulation.warp.passive import PassiveForces
from cathsim_dmc.simulation.warp.reduction import Reduction, Totals

# Room for contacts and for rows of constraints, in each world.
CONTACTS, ROWS = 48, 128
_WRITTEN = ("qpos", "qvel", "act", "qacc_warmstart", "ctrl", "qfrc_applied", "time")
_ALWAYS = ("qpos", "act", "ctrl", "qfrc_applied", "time")
# Fields of a model that Warp does not read here: they serve MuJoCo's own collision,
# and islands that sleep.
_HOST_ONLY = ("geom_aabb", "geom_rbound", "mesh_", "dof_length")


class Worlds:
    """N worlds on one device.

    Attributes:
        seconds: Wall time of the parts of the last control step.
    """

    def __init__(
        self,
        device: Device,
        model: mujoco.MjModel,
        own: Mapping[str, np.ndarray],
        laws: tuple[WallContacts, PassiveForces],
        substeps: int,
    ):
        """Copies the compiled scene to the device.

        Args:
            device: Device of the simulations.
            model: Scene of the task.
            own: Fields (N, ...) that differ between worlds.
            laws: Contacts of the links with the walls, and passive forces.
            substeps: Physics steps in a control step.

        Raises:
            NotImplementedError: if a field differs that all worlds of Warp share.
        """
        self._warp, self._mjwarp = warp_modules()
        self._device, self._substeps = device, substeps
        contacts, self._passive = laws
        prepared = copy.copy(model)
        # `WallContacts` finds the contacts of the carriers.
        prepared.geom_contype[contacts.carriers] = 0
        # With a dense matrix of constraints, the solver visits the contacts of all
        # worlds one after the other; with a sparse one, only those of worlds that have
        # not converged.
        prepared.opt.jacobian = mujoco.mjtJacobian.mjJAC_SPARSE.value
        wall = model.sensor("wall_contacts")
        start, size = int(wall.adr[0]), int(wall.dim[0])
        with device.active():
            self.model = self._mjwarp.put_model(prepared)
            self.model.opt.contact_sensor_maxmatch = max(size // 14, CONTACTS)
            self.model.opt.warn_overflow = 0  # counted instead
            count = contacts.num_worlds
            # Warp's default size is that for its own contacts.
            entries = ROWS * model.nv
            sizes = {"nconmax": CONTACTS, "njmax": ROWS, "njmax_nnz": entries}
            self.data = self._mjwarp.make_data(prepared, nworld=count, **sizes)
            # The other geoms are only visual, and Warp does not read them.
            self._colliding = (model.geom_contype | model.geom_conaffinity) != 0
            self._fields: set[str] = set()
            for name, values in own.items():
                self._expand(name, values)
            contacts.bind(self.model, self.data)
            self._contacts = contacts
            self.model.callback.contactfilter = contacts
            self._passive.bind(self.model, self.data, model)
            self.model.callback.passive = self._act
            self._beside = np.r_[:start, start + size : model.nsensordata]
            self._reduction = Reduction(device, self.data, contacts, self._beside)
        self._staged: dict[str, Any] = {}
        self._graph: Any = None
        self.seconds: dict[str, float] = {}

    def close(self) -> None:
        """Frees the memory; the model's callbacks and the graph refer to it."""
        self.model.callback.contactfilter = self.model.callback.passive = None
        self._graph = None
        self._staged.clear()

    def _act(self, model: Any, data: Any) -> None:
        """Adds passive forces; mujoco_warp's callback after its own passive forces."""
        self._passive(model, data)
        self._contacts.carry()

    def _array(self, name: str) -> Any:
        """Warp's array of a field of the model; None if Warp does not read it."""
        return None if name.startswith(_HOST_ONLY) else getattr(self.model, name, None)

    def _expand(self, name: str, values: np.ndarray) -> None:
        """Gives each world its own values (N, ...) of a field, if Warp reads it."""
        array = self._array(name)
        if array is None:
            return
        if array.shape[0] != 1:
            self._check_shared(name, values)
            return
        inner = tuple(getattr(array.dtype, "_shape_", ()))  # of a vector or a matrix
        shape = (len(values), *array.shape[1:], *inner)
        kind = np.int32 if array.dtype is int else np.float32
        made = self._warp.array(
            np.ascontiguousarray(values.reshape(shape), kind),
            dtype=array.dtype,
            device=self._device.name,
        )
        setattr(self.model, name, made)
        self._fields.add(name)

    def _check_shared(self, name: str, values: np.ndarray) -> None:
        """Raise NotImplementedError if values (N, ...) of a shared field differ."""
        if name.startswith("geom_"):
            values = values[:, self._colliding]
        # Equal values in other frames differ by rounding.
        if not np.allclose(values, values[:1], rtol=1e-6, atol=1e-12):
            raise NotImplementedError(
                f"{name} cannot differ between worlds of Warp; "
                "take simulation_device='cpu'"
            )

    def write_model(self, own: Mapping[str, np.ndarray], names: Iterable[str]) -> None:
        """Writes fields of the model that have changed."""
        for name in names:
            if name in self._fields:
                self._put(name, self._array(name), own[name])
            elif self._array(name) is not None:
                self._check_shared(name, own[name])

    def write(self, arrays: Any, whole: bool) -> None:
        """Copies the state of all worlds to the device.

        Args:
            arrays: Arrays of the host, by MuJoCo's names.
            whole: Whether to copy the whole state, or only what the host changes in
                every control step.
        """
        began = time.perf_counter()
        self._passive.write(whole)
        if whole:
            self._contacts.write()
        for name in _WRITTEN if whole else _ALWAYS:
            self._put(name, getattr(self.data, name), getattr(arrays, name))
        self.seconds["write"] = time.perf_counter() - began

    def _put(self, name: str, array: Any, values: np.ndarray) -> None:
        """Writes values into an array of the device."""
        staged = self._stage(f"to {name}", array)
        there = staged.numpy()
        rows.copy(there, values.reshape(there.shape))
        self._warp.copy(array, staged)

    def _stage(self, key: str, array: Any) -> Any:
        """Page-locked host memory for a copy of an array."""
        if key not in self._staged:
            pinned = self._device.is_cuda
            self._staged[key] = self._warp.empty(
                array.shape, dtype=array.dtype, device="cpu", pinned=pinned
            )
        return self._staged[key]

    def step(self) -> None:
        """Does the physics steps of a control step."""
        self._contacts.begin()
        with self._device.active():
            if not self._device.is_cuda:
                self._steps()
                return
            if self._graph is None:
                self._graph = self._captured()
            self._warp.capture_launch(self._graph)

    def _steps(self) -> None:
        for number in range(self._substeps):
            self._step(number)

    def _step(self, number: int) -> None:
        """Does a physics step; only the last computes sensors and forces on links."""
        option, without = self.model.opt, mujoco.mjtDisableBit.mjDSBL_SENSOR.value
        last, kept = self._substeps - 1, option.disableflags
        option.run_rne_postconstraint = number == last
        option.disableflags = kept if number == last else kept | without
        try:
            self._mjwarp.step(self.model, self.data)
        finally:
            option.disableflags = kept
        self._reduction.add(number, last)

    def _captured(self) -> Any:
        """Captures the physics steps as a CUDA graph; the state does not change."""
        kept = {name: self._warp.clone(getattr(self.data, name)) for name in _WRITTEN}
        for number in (0, self._substeps - 1):  # compiles all kernels before
            self._step(number)
        self.wait()
        with self._device.captured() as capture:
            self._steps()
        for name, array in kept.items():
            self._warp.copy(getattr(self.data, name), array)
        return capture.graph

    def read(self, arrays: Any, names: Iterable[str]) -> Totals:
        """Copies arrays and the totals of the control step to the host.

        Args:
            arrays: Arrays of the host, by MuJoCo's names, (N, ...) float64; written.
            names: Names of the arrays to copy; of `sensordata`, the sensors other than
                those of contacts are copied in any case.
        """
        chosen = [name for name in names if name != "sensordata"]
        began = time.perf_counter()
        self.wait()
        stepped = time.perf_counter()
        for name in chosen:
            array = getattr(self.data, name)
            self._warp.copy(self._stage(name, array), array)
        self.wait()
        copied = time.perf_counter()
        for name in chosen:
            there = getattr(arrays, name)
            rows.copy(there, self._staged[name].numpy().reshape(there.shape))
        totals = self._reduction.read()
        arrays.sensordata[:, self._beside] = totals.beside
        done = time.perf_counter()
        self.seconds |= {"step": stepped - began, "copy": copied - stepped}
        self.seconds["convert"] = done - copied
        return totals

    def wait(self) -> None:
        """Waits until the device has finished all launched work."""
        self._warp.synchronize_device(self._device.name)

    def read_sensors(self, out: np.ndarray, chosen: np.ndarray) -> None:
        """Copies all sensors of the last physics step of some worlds to the host.

        Args:
            out: (N, nsensordata), written.
            chosen: (N,) bool, the worlds.
        """
        staged = self._stage("sensordata", self.data.sensordata)
        self._warp.copy(staged, self.data.sensordata)
        self.wait()
        there = staged.numpy()

        def convert(own: slice) -> None:
            np.copyto(out[own], there[own], where=chosen[own, None])

        rows.each(len(out), convert)
