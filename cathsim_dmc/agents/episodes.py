"""Outcomes of episodes from batches of steps, for training logs and evaluation."""

from dataclasses import dataclass

import numpy as np
import torch
from tensordict import TensorDictBase

from cathsim_dmc.analysis.force_statistics import EpisodeForces, ForceTracker
from cathsim_dmc.physics.forces import NAMES


@dataclass(frozen=True)
class EpisodeOutcome:
    """One finished episode.

    Attributes:
        env: Index of the environment it ran in.
        reward: Sum of the rewards over the episode.
        length: Number of control steps.
        terminated: Whether the task ended it, not the limit of steps.
        success: Whether the goal was reached.
        forces: Forces on the wall, N, such as `forces.mean_force`, without the control
            step of a physics error.
        physics_error: Whether the simulation diverged, which ended it.
        path_ratio: Length of the head's path divided by the shortest way to the goal;
            below 1 where the head cuts the corner of the route at an ostium.
        failed: Whether the objective ended it without success, as at a limit of force.
        start_insertion: Insertion at its start beyond the task's own start, m; None
            where it is not known.
    """

    env: int
    reward: float
    length: int
    terminated: bool
    success: bool
    forces: EpisodeForces
    physics_error: bool
    path_ratio: float
    failed: bool = False
    start_insertion: float | None = None

    @property
    def given_up(self) -> bool:
        """Whether the task ended it by its option `give_up`."""
        others = self.success or self.failed or self.physics_error
        return self.terminated and not others


class EpisodeTracker:
    """Sums over the running episode of each of `num_envs` environments."""

    def __init__(self, num_envs: int):
        self.reward = np.zeros(num_envs)
        self.length = np.zeros(num_envs, dtype=np.int64)
        self.forces = ForceTracker(num_envs)

    def add(self, batch: TensorDictBase) -> list[EpisodeOutcome]:
        """Add steps (num_envs, steps); return the episodes that ended, in order.

        An episode whose end is never seen, because its process was lost, is left out,
        if the steps have a "step_count".
        """

        def read(value: torch.Tensor) -> np.ndarray:
            return value.reshape(batch.shape).numpy()

        after, info = batch["next"], batch["next", "info"]
        names = "success", "physics_error", "path_ratio"
        success, error, ratio = (read(info[name]) for name in names)
        failed = np.zeros(batch.shape, bool)
        if "failed" in info.keys():  # not in every environment of `make_env`
            failed = read(info["failed"])
        names = "reward", "done", "terminated"
        reward, done, terminated = (read(after[name]) for name in names)
        forces = [read(info[name]) for name in NAMES]
        counted = batch.get("step_count", None)
        lost = np.zeros(batch.shape, bool) if counted is None else read(counted) == 0
        finished = []
        for step in range(batch.shape[1]):
            for env in map(int, np.flatnonzero(lost[:, step] & (self.length > 0))):
                self.forces.finish(env)
                self.reward[env] = self.length[env] = 0
            self.reward += reward[:, step]
            self.length += 1
            self.forces.add([one[:, step] for one in forces], error[:, step])
            for env in map(int, np.flatnonzero(done[:, step])):
                finished.append(
                    EpisodeOutcome(
                        env=env,
                        reward=float(self.reward[env]),
                        length=int(self.length[env]),
                        terminated=bool(terminated[env, step]),
                        success=bool(success[env, step]),
                        forces=self.forces.finish(env),
                        physics_error=bool(error[env, step]),
                        path_ratio=float(ratio[env, step]),
                        failed=bool(failed[env, step]),
                    )
                )
                self.reward[env] = self.length[env] = 0
        return finished
