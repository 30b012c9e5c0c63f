"""Episodes counted from batches of steps: what training logs and evaluation reports."""

from dataclasses import dataclass

import numpy as np
from tensordict import TensorDictBase

from cathsim_dmc.analysis.force_statistics import EpisodeForces, ForceTracker
from cathsim_dmc.physics.forces import NAMES, WallForce

# Information of the environment about a step, beside the observation.
INFO = "info"
# Force of a control step -> its name in the information.
_FORCES = dict(zip(WallForce._fields, NAMES, strict=True))


@dataclass(frozen=True)
class EpisodeOutcome:
    """One finished episode. None where the environment does not tell.

    Attributes:
        env: Index of the environment it ran in.
        reward: Sum of the rewards over the episode.
        length: Number of control steps.
        terminated: Whether it was ended by the task, not by the clock.
        success: Whether the goal was reached.
        forces: Forces on the wall, N, such as `forces.mean_force`.
        physics_error: Whether the simulation diverged, which ended it.
        path_ratio: Length of the head's path over the route that was left; below 1
            where the head cuts the corner of the route at an ostium.
    """

    env: int
    reward: float
    length: int
    terminated: bool
    success: bool | None
    forces: EpisodeForces
    physics_error: bool = False
    path_ratio: float | None = None


class EpisodeTracker:
    """Sums over the running episode of each of `num_envs` environments."""

    def __init__(self, num_envs: int):
        self.reward = np.zeros(num_envs)
        self.length = np.zeros(num_envs, dtype=np.int64)
        self.success = np.zeros(num_envs, dtype=bool)
        self.forces = ForceTracker(num_envs)

    def add(self, batch: TensorDictBase) -> list[EpisodeOutcome]:
        """Add steps (num_envs, steps); return the episodes that ended, in order."""

        def read(*name: str) -> np.ndarray | None:
            """Entry after each step (num_envs, steps), None if absent."""
            value = batch.get(("next", *name), None)
            return None if value is None else value.reshape(batch.shape).numpy()

        reward, done, terminated = map(read, ("reward", "done", "terminated"))
        assert reward is not None and done is not None and terminated is not None
        forces = {name: read(INFO, key) for name, key in _FORCES.items()}
        success, error, ratio = (
            read(INFO, name) for name in ("success", "physics_error", "path_ratio")
        )
        finished = []
        for step in range(batch.shape[1]):
            self.reward += reward[:, step]
            self.length += 1
            known = {n: one[:, step] for n, one in forces.items() if one is not None}
            self.forces.add(known)
            if success is not None:
                self.success |= success[:, step] > 0
            for env in map(int, np.flatnonzero(done[:, step])):
                finished.append(
                    EpisodeOutcome(
                        env=env,
                        reward=float(self.reward[env]),
                        length=int(self.length[env]),
                        terminated=bool(terminated[env, step]),
                        success=None if success is None else bool(self.success[env]),
                        forces=self.forces.finish(env),
                        physics_error=error is not None and bool(error[env, step]),
                        path_ratio=None if ratio is None else float(ratio[env, step]),
                    )
                )
                self.reward[env] = self.length[env] = 0
                self.success[env] = False
        return finished
