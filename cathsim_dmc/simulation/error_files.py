"""Files of physics errors: the state before the control step, its action, the task.

`cathsim replay-error FILE` repeats the control step.
"""

import contextlib
import dataclasses
import logging
import os
import uuid
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from cathsim_dmc import bounds, files, json_options, suite
from cathsim_dmc.simulation.batch import BatchSimulation
from cathsim_dmc.tasks.rollout import Rollout
from cathsim_dmc.tasks.snapshot import (
    Snapshot,
    packed,
    read_arrays,
    versions,
    write_arrays,
)
from cathsim_dmc.tasks.step import Step

KEPT = 8  # files in a folder; a new one removes the oldest
_KIND = "physics error"
_ACTION, _RANDOM = "error.action", "_random_states"
_LOG = logging.getLogger(__name__)


@dataclasses.dataclass(frozen=True, eq=False)
class PhysicsError:
    """A control step in which the physics failed.

    Attributes:
        reason: Physics error, one of `tasks.physics_errors`.
        task: Name of the task.
        options: Options of the task, JSON-able.
        whole: Whether the options suffice to make the task; objects among them, such as
            effects, are kept only as texts.
        snapshot: State of the simulation before the step, except for the source of
            randomness, which is that after the step: only images and tracking noise
            draw from it in a step.
        action: (A,) in [-1, 1], action of the step.
    """

    reason: str
    task: str
    options: Mapping[str, Any]
    whole: bool
    snapshot: Snapshot
    action: np.ndarray

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Writes an .npz file; see `Snapshot.save`."""
        meta = {
            "reason": self.reason,
            "name": self.task,
            "options": dict(self.options),
            "whole": self.whole,
            "task": self.snapshot.task,
            "versions": self.snapshot.versions,
        }
        arrays = {**self.snapshot.arrays, _ACTION: self.action[None]}
        return write_arrays(path, _KIND, meta, arrays)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> "PhysicsError":
        """Reads a file that `save` has written.

        Raises:
            OSError: if there is no such file, or it is a directory.
            ValueError: if the file is damaged or holds no physics error.
        """
        way = "a file of the folder errors/ of a training or an evaluation"
        meta, arrays = read_arrays(files.require_source(path, way), _KIND)
        with files.refused(
            ValueError, f"{path} holds no physics error", (KeyError, TypeError)
        ):
            action = bounds.array("action", arrays.pop(_ACTION)[0], "f", (-1,))
            snapshot = Snapshot.of(path, meta, arrays)
            name, options = bounds.text("task", meta["name"]), dict(meta["options"])
            return cls(meta["reason"], name, options, meta["whole"], snapshot, action)

    def replay(self, num_threads: int = 1) -> Step:
        """Repeats the control step in a new simulation of the task.

        Args:
            num_threads: Number of threads of the simulation.

        Returns:
            State of the simulation after the step; `errors` has the physics error.

        Raises:
            ValueError: if the options do not suffice to make the task, or the task has
                changed.
        """
        if not self.whole:
            raise ValueError(
                f"{self.task} had objects as options, {bounds.shown(self.options)}: "
                "make the task in Python, and give its BatchSimulation.restore the "
                "snapshot of simulation.error_files.PhysicsError.load"
            )
        task = suite.make_task(self.task, **self.options)
        simulation = BatchSimulation(task, 1, num_threads=num_threads)
        simulation.restore(self.snapshot)
        return simulation.step(self.action[None])


class ErrorFiles:
    """Writes the first physics error of each episode of N simulations to a folder.

    Attributes:
        folder: Folder of the last `KEPT` files; made with the first file.
    """

    def __init__(
        self,
        folder: str | os.PathLike[str],
        task: str,
        options: Mapping[str, Any] | None = None,
    ):
        """Takes the task's name and options, from which a replay makes it."""
        self.folder, self._task = files.as_path("folder", folder), task
        self._options = json_options.as_texts(options or {})
        self._whole = not json_options.split(options or {})[1]

    def before(self, rollout: Rollout) -> Snapshot:
        """The state of all simulations before a control step."""
        return rollout.snapshot(np.arange(len(rollout.steps)), random=False)

    def after(
        self, before: Snapshot, action: np.ndarray, step: Step, rollout: Rollout
    ) -> None:
        """Writes the episodes' first errors in the control step; logs an OSError.

        Args:
            before: Snapshot of `before`.
            action: (N, A), actions of the step.
            step: State after the step.
            rollout: Rollout of the simulations.
        """
        old = before.arrays["rollout._errors"].tolist()
        pairs = enumerate(zip(step.errors, old, strict=True))
        new = [index for index, (error, last) in pairs if error and not last]
        for index in new[:KEPT]:
            rows, snapshot = np.array([index]), before[index]
            drawn = packed(f"rollout.{_RANDOM}", getattr(rollout, _RANDOM), rows)
            snapshot = Snapshot(snapshot.task, {**snapshot.arrays, **drawn}, versions())
            failed = PhysicsError(
                str(step.errors[index]),
                self._task,
                self._options,
                self._whole,
                snapshot,
                action[index].copy(),
            )
            try:
                path = self._write(failed)
            except OSError as error:  # must not end the other simulations
                _LOG.error("the file of a physics error is lost: %s", error)
                return
            how = "with: cathsim replay-error" if self._whole else "in Python, from"
            _LOG.error("repeat the failed step %s %s", how, path)

    def _write(self, error: PhysicsError) -> Path:
        files.require_folder(self.folder, make=True)
        path = self.folder / f"{error.task}-{uuid.uuid4().hex[:12]}.npz"
        error.save(path)
        others = [one for one in self.folder.glob("*.npz") if one != path]
        with contextlib.suppress(OSError):  # another process removes them too
            others.sort(key=lambda one: one.stat().st_mtime_ns)
            for oldest in others[: 1 - KEPT]:
                oldest.unlink()
        return path
