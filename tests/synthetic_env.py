"""A small batched environment with the key layout of the simulated tasks."""

import numpy as np
import torch
from tensordict import TensorDict
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

from cathsim_dmc.physics.forces import NAMES
from cathsim_dmc.simulation.environments import standard_observations

ACTIONS = 21
GOAL_RADIUS = 0.15
# Entries per observation beyond the three that matter.
SIZES = {"position": 3, "velocity": 3, "com_inertia": 10, "external_force": 4}
INFO = (*NAMES, "success", "physics_error", "path_ratio", "distance")


class ReachEnv(EnvBase):
    """Points that must reach the origin, moved by the first three actions."""

    batch_locked = True

    def __init__(self, num_envs, seed=0, max_steps=40, image=False, numbers=True):
        super().__init__(batch_size=[num_envs])
        self.max_steps = max_steps
        self.image, self.numbers = image, numbers
        n = num_envs
        entries = {
            name: Unbounded((n, size), dtype=torch.float64)
            for name, size in SIZES.items()
        }
        if not numbers:
            entries = {}
        if image:
            entries["image"] = Bounded(0, 255, (n, 128, 128, 1), dtype=torch.uint8)
        self.observation_spec = Composite(
            entries
            | {"info": Composite({k: Unbounded((n, 1)) for k in INFO}, shape=(n,))},
            shape=(n,),
        )
        self.action_spec = Bounded(-1.0, 1.0, (n, ACTIONS))
        self.reward_spec = Unbounded((n, 1))
        flag = {
            k: Bounded(0, 1, (n, 1), dtype=torch.bool)
            for k in ("done", "terminated", "truncated")
        }
        self.done_spec = Composite(flag, shape=(n,))
        self.point = np.zeros((n, 3))
        self.moved = np.zeros((n, 3))
        self.count = np.zeros(n, dtype=int)
        self._set_seed(seed)

    def _set_seed(self, seed):
        self.random = [
            np.random.default_rng(seed + i) for i in range(self.batch_size[0])
        ]

    def _observation(self, force):
        n = self.batch_size[0]
        distance = np.linalg.norm(self.point, axis=1)
        inertia = 1e-8 + 1e-10 * np.repeat(self.point[:, :1], 10, axis=1)
        inertia[:, 5:] = 3e-9
        external = np.zeros((n, 4))
        external[:, 0] = force
        entries = {
            "position": self.point,
            "velocity": self.moved,
            "com_inertia": inertia,
            "external_force": external,
        }
        out = {
            name: torch.as_tensor(value.copy())
            for name, value in entries.items()
            if self.numbers
        }
        if self.image:
            pixels = np.zeros((n, 128, 128, 1), np.uint8)
            centre = np.clip((self.point[:, :2] + 1) * 64, 4, 123).astype(int)
            for i, (x, y) in enumerate(centre):
                pixels[i, y - 4 : y + 4, x - 4 : x + 4] = 255
            out["image"] = torch.as_tensor(pixels)
        info = {
            **dict(zip(NAMES, 3 * (force, 0.5 * force), strict=True)),
            "physics_error": np.zeros(n),
            "path_ratio": np.ones(n),
            "success": distance < GOAL_RADIUS,
            "distance": distance,
        }
        out["info"] = TensorDict(
            {
                name: torch.as_tensor(np.asarray(value, np.float32))[:, None]
                for name, value in info.items()
            },
            [n],
        )
        return out, distance

    def _reset(self, tensordict=None, **kwargs):
        n = self.batch_size[0]
        mask = np.ones(n, bool)
        if tensordict is not None and "_reset" in tensordict.keys():
            mask = tensordict["_reset"].reshape(n).numpy()
        for i in np.flatnonzero(mask):
            self.point[i] = self.random[i].uniform(-0.8, 0.8, 3)
            self.moved[i] = 0.0
            self.count[i] = 0
        entries, _ = self._observation(np.zeros(n))
        return TensorDict(entries | _flags(np.zeros(n, bool), np.zeros(n, bool)), [n])

    def _step(self, tensordict):
        n = self.batch_size[0]
        action = tensordict["action"].numpy()[:, :3].astype(np.float64)
        self.moved = 0.1 * action
        wanted = self.point + self.moved
        self.point = np.clip(wanted, -1.0, 1.0)
        force = np.abs(wanted - self.point).sum(1)
        self.count += 1
        entries, distance = self._observation(force)
        terminated = distance < GOAL_RADIUS
        truncated = (self.count >= self.max_steps) & ~terminated
        reward = np.where(terminated, 10.0, -distance)

        reward = torch.as_tensor(reward, dtype=torch.float32)[:, None]
        return TensorDict(
            entries | _flags(terminated, truncated) | {"reward": reward}, [n]
        )


def _flags(terminated, truncated):
    ends = {"terminated": terminated, "truncated": truncated}
    ends["done"] = terminated | truncated
    return {name: torch.as_tensor(value)[:, None] for name, value in ends.items()}


def make_env(
    task,
    *,
    observation="internal",
    num_envs=1,
    num_threads=None,
    seed=0,
    task_kwargs=None,
):
    names = (observation,) if isinstance(observation, str) else observation
    kinds = {"image": "image" in names, "numbers": "internal" in names}
    env = ReachEnv(num_envs, seed, **kinds, **(task_kwargs or {}))
    return standard_observations(env)


def calling(action, at=3):
    """`make_env` whose environment calls a function at a control step."""

    def make(task, **kwargs):
        env = make_env(task, **kwargs)
        steps, count = env.base_env._step, 0

        def step(tensordict):
            nonlocal count
            count += 1
            if count == at:
                action()
            return steps(tensordict)

        env.base_env._step = step
        return env

    return make
