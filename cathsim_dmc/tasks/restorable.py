"""Snapshots of a rollout: gathers and restores its whole state.

The state is what holders name in their attribute `state`, and what the stepper keeps.
`tests/test_tasks_snapshot.py` fails where an attribute of a holder changes during an
episode and is neither named nor derived from named ones.
"""

import hashlib
from collections.abc import Mapping, Sequence
from typing import Any

import mujoco
import numpy as np
from numpy.random import RandomState

from cathsim_dmc import bounds
from cathsim_dmc.entities.device import Device
from cathsim_dmc.entities.devices import DEVICES
from cathsim_dmc.imaging.angiograph import Deviation
from cathsim_dmc.physics.effect_checks import check_state
from cathsim_dmc.physics.effects import Effect, Layout
from cathsim_dmc.physics.stepper import Stepper
from cathsim_dmc.tasks.cases import Case
from cathsim_dmc.tasks.conditions import Conditions, DrawnConditions, completed
from cathsim_dmc.tasks.config import NavigationConfig
from cathsim_dmc.tasks.image_sensors import ImageSensors
from cathsim_dmc.tasks.progress import Progress
from cathsim_dmc.tasks.scene import Scene
from cathsim_dmc.tasks.snapshot import Snapshot, packed, restored
from cathsim_dmc.tasks.step import Step
from cathsim_dmc.tasks.tracking_noise import TrackingNoise


def describe(
    scene: Scene,
    cases: Sequence[Case],
    effects: Sequence[Effect],
    model: mujoco.MjModel,
    config: NavigationConfig,
) -> dict[str, Any]:
    """Returns what two tasks must share to restore each other's snapshots, JSON-able.

    Friction, time limit and reward may differ, and observations that keep no state.
    Devices and sheath may not: a snapshot holds stiffnesses of hinges, those held by
    the sheath too, and masses of links, some of which keep their values of the start.
    """
    flow = config.vessel.flow
    starts, numbered = {}, []  # numbered by the case number that a state holds
    for case in cases:
        anatomy, start = case.scene.anatomy, 1e3 * case.scene.placement.start
        starts[f"{anatomy.name} {anatomy.digest}"] = np.round(start, 2).tolist()
        numbered.append([anatomy.name, case.scene.goal.name])
    return {
        "goal": scene.goal.name,
        "anatomies": starts,
        "devices": list(map(_named, scene.catheter.devices)),
        "links": np.round(1e3 * scene.catheter.link_lengths, 3).tolist(),
        "sheath_clearance": config.sheath_clearance,
        "lead": config.lead,
        "actions": list(scene.catheter.action_names),
        "effects": [
            [type(effect).__name__, *getattr(effect.parameters, "_fields", ())]
            for effect in effects
        ],
        "timestep": model.opt.timestep,
        **({"split of the flow": flow.split} if flow else {}),
        **({"cases": numbered} if len(cases) > 1 else {}),
    }


def _named(device: Device) -> str:
    """Name of a device, followed by a digest if it is not one of the library."""
    if DEVICES.get(device.name) == device:
        return device.name
    return f"{device.name} {hashlib.sha256(repr(device).encode()).hexdigest()[:8]}"


class Restorable:
    """The part of a `Rollout` that takes and restores snapshots."""

    deviations: list[Deviation]
    effects: list[Effect]
    progress: Progress
    _case_of: np.ndarray
    _cases: Sequence[Case]
    _description: Mapping[str, Any]
    _drawn: DrawnConditions
    _layout: Layout
    _open: np.ndarray
    _random_states: list[RandomState] | None
    _sensors: ImageSensors
    _stepper: Stepper
    _tracking: TrackingNoise

    def holders(self) -> dict[str, Any]:
        """Objects with state in Python, by name; `state` names their attributes."""
        effects = {f"effect_{n}": effect for n, effect in enumerate(self.effects)}
        return {
            "rollout": self,
            "tracking": self._tracking,
            "images": self._sensors,
            "sight": self._sensors.sight,
            "progress": self.progress,
            "conditions": self._drawn,
            **effects,
        }

    @property
    def half_done(self) -> np.ndarray:
        """(N,) bool, whether an error has left the last step or reset half done."""
        return self._open.copy()

    def snapshot(self, indices: np.ndarray, random: bool = True) -> Snapshot:
        """Returns the state of some simulations (K,) between two control steps.

        Args:
            indices: Their numbers.
            random: Whether the sources of randomness are included.

        Raises:
            RuntimeError: if no episode has begun, or a step is half done.
            NotImplementedError: if the stepper has no snapshots.
            ValueError: if an effect names a state that cannot be restored.
        """
        if not self._stepper.has_snapshots:
            raise NotImplementedError(
                f"{type(self._stepper).__name__} has no snapshots; simulate on the CPU "
                "with BatchSimulation, or in a composer environment"
            )
        if self._random_states is None or self._open[indices].any():
            raise RuntimeError("there is no episode to keep; call reset() first")
        arrays: dict[str, np.ndarray] = {}
        for name, holder in self.holders().items():
            for attribute in holder.state:
                if attribute == "_random_states" and not random:
                    continue
                if isinstance(holder, Effect):
                    check_state(holder, attribute, len(self._open))
                value = getattr(holder, attribute, None)
                arrays |= packed(f"{name}.{attribute}", value, indices)
        fields = {name for effect in self.effects for name in effect.model_fields}
        kept = self._stepper.kept(indices, sorted(fields))
        arrays |= {f"stepper.{name}": array for name, array in kept.items()}
        return Snapshot(self._description, arrays)

    def restore(
        self,
        indices: np.ndarray,
        snapshot: Snapshot,
        random_states: Sequence[RandomState],
    ) -> Step:
        """Restores a snapshot to some simulations (K,), each of which has an episode.

        Args:
            indices: Their numbers, in ascending order.
            snapshot: Snapshot of K simulations of this task; it may come from another
                process.
            random_states: N sources of randomness; those of the K are restored.

        Returns:
            State of all simulations.

        Raises:
            ValueError: if the snapshot is of another task.
            RuntimeError, NotImplementedError: as of `snapshot`.
        """
        if not isinstance(snapshot, Snapshot):
            kind = (
                "a Snapshot; read a file by Snapshot.load of cathsim_dmc.tasks.snapshot"
            )
            bounds.refuse("the snapshot", snapshot, kind)
        snapshot = completed(snapshot)
        snapshot.require(self.snapshot(indices))
        numbers = snapshot.arrays["rollout._case_of"]
        if not ((numbers >= 0) & (numbers < len(self._cases))).all():
            raise ValueError(f"the snapshot is of the anatomies {numbers.tolist()}")
        self._open[indices] = True  # until the restore is complete
        self._random_states = list(random_states)
        if len(self._cases) > 1:
            for index, number in zip(indices.tolist(), numbers.tolist(), strict=True):
                self._load(index, number)
        self._stepper.put_back(indices, snapshot.part("stepper"))
        for name, holder in self.holders().items():
            for attribute in holder.state:
                old, full = getattr(holder, attribute), f"{name}.{attribute}"
                new = restored(full, old, snapshot.arrays, indices)
                if isinstance(holder, Effect) and isinstance(old, np.ndarray):
                    old[:] = new  # others may hold the same array
                else:  # others may have been given the old value
                    setattr(holder, attribute, new)
        self._layout.begin(indices)
        step = self._derive(indices)
        self._open[indices] = False
        return step

    def _place_machine(self, index: int) -> None:
        """Sets the planes of one simulation to its case and its machine's deviation."""
        if self._sensors.planes:
            machine = self.case(index).angiograph
            self._sensors.planes[index] = machine.planes(self.deviations[index])
            self._sensors.thirds[index] = machine.third(self.deviations[index])

    @property
    def camera_matrices(self) -> np.ndarray:
        """(N, P, 3, 4): project (x, y, z, 1), m, to (column w, row w, w) of P planes.

        P is 0 without an observation of fluoroscopy.
        """
        planes = self._sensors.planes or [()] * len(self._case_of)
        found = [[plane.carm.matrix for plane in machine] for machine in planes]
        return np.array(found).reshape(len(planes), -1, 3, 4)

    def conditions(self, index: int = 0) -> Conditions:
        """Drawn values of the episode of one simulation; RuntimeError before any."""
        if self._random_states is None:
            raise RuntimeError("no episode has begun; call reset() first")
        return self._drawn.of(index, self.case(index).scene, self.effects)

    @property
    def start_insertions(self) -> list[float | None]:
        """Insertion at the start of each simulation's episode, m, see `Conditions`."""
        return self._drawn.insertions

    def case(self, index: int = 0) -> Case:
        """Anatomy and objective of the episode of one simulation."""
        return self._cases[self._case_of[index]]

    def _load(self, index: int, number: int) -> None:
        """Loads one of several cases into one simulation."""
        raise NotImplementedError

    def _derive(self, indices: np.ndarray) -> Step:
        """Derives the other quantities after some simulations (K,) are restored."""
        raise NotImplementedError
