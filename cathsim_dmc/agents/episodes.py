"""Episodes counted from batches of steps: what training logs and evaluation reports."""

from dataclasses import dataclass

import numpy as np
from tensordict import TensorDictBase

# Information of the environment about a step, beside the observation.
INFO = "info"


@dataclass(frozen=True)
class EpisodeOutcome:
    """One finished episode. None where the environment does not tell.

    Attributes:
        env: index of the environment it ran in.
        reward: sum over the episode.
        length: control steps.
        terminated: ended by the task, not by the clock.
        success: whether the goal was reached.
        mean_force: mean over steps of the force summed over the wall (N).
        max_force: largest single contact force on the wall at the end of a control
            step (N), as published.
        peak_force: the same within the control steps (N).
        physics_error: whether the simulation diverged, which ended it.
        path_ratio: length of the head's path over the route that was left; below 1
            where the head cuts the corner of the route at an ostium.
    """

    env: int
    reward: float
    length: int
    terminated: bool
    success: bool | None
    mean_force: float | None
    max_force: float | None
    peak_force: float | None = None
    physics_error: bool = False
    path_ratio: float | None = None


def information(batch: TensorDictBase, name: str) -> np.ndarray | None:
    """Info entry after each step as float64 (num_envs, steps), None if absent."""
    value = batch.get(("next", INFO, name), None)
    if value is None:
        return None
    return value.reshape(batch.shape).double().numpy()


class EpisodeTracker:
    """Sums over the running episode of each of `num_envs` environments."""

    def __init__(self, num_envs: int):
        self.reward = np.zeros(num_envs)
        self.length = np.zeros(num_envs, dtype=np.int64)
        self.force_sum = np.zeros(num_envs)
        self.force_max = np.zeros(num_envs)
        self.force_peak = np.zeros(num_envs)
        self.success = np.zeros(num_envs, dtype=bool)

    def add(self, batch: TensorDictBase) -> list[EpisodeOutcome]:
        """Add steps (num_envs, steps); return the episodes that ended, in order."""
        reward = batch["next", "reward"].reshape(batch.shape).double().numpy()
        done = batch["next", "done"].reshape(batch.shape).numpy()
        terminated = batch["next", "terminated"].reshape(batch.shape).numpy()
        force_sum = information(batch, "wall_force_sum")
        force_max = information(batch, "wall_force_max")
        success = information(batch, "success")
        force_peak = information(batch, "wall_force_peak_max")
        error = information(batch, "physics_error")
        path_ratio = information(batch, "path_ratio")
        finished = []
        for step in range(batch.shape[1]):
            self.reward += reward[:, step]
            self.length += 1
            if force_sum is not None:
                self.force_sum += force_sum[:, step]
            if force_max is not None:
                np.maximum(self.force_max, force_max[:, step], out=self.force_max)
            if force_peak is not None:
                np.maximum(self.force_peak, force_peak[:, step], out=self.force_peak)
            if success is not None:
                self.success |= success[:, step] > 0
            for env in np.flatnonzero(done[:, step]):
                length = int(self.length[env])
                finished.append(
                    EpisodeOutcome(
                        env=int(env),
                        reward=float(self.reward[env]),
                        length=length,
                        terminated=bool(terminated[env, step]),
                        success=None if success is None else bool(self.success[env]),
                        mean_force=None
                        if force_sum is None
                        else float(self.force_sum[env] / length),
                        max_force=None
                        if force_max is None
                        else float(self.force_max[env]),
                        peak_force=None
                        if force_peak is None
                        else float(self.force_peak[env]),
                        physics_error=error is not None and bool(error[env, step]),
                        path_ratio=None
                        if path_ratio is None
                        else float(path_ratio[env, step]),
                    )
                )
                self._clear(env)
        return finished

    def _clear(self, env: int) -> None:
        self.reward[env] = self.force_sum[env] = self.force_max[env] = 0.0
        self.force_peak[env] = 0.0
        self.length[env] = 0
        self.success[env] = False
