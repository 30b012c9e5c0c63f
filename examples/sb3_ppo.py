"""PPO of Stable-Baselines3 on a cannulation task.

    pip install "cathsim-dmc[gym]" stable-baselines3
    python examples/sb3_ppo.py --steps 200000

Trains on the batched path through a small adapter, then evaluates on the single
Gymnasium environment and saves the policy.
"""

import argparse
from pathlib import Path

import gymnasium
import numpy as np
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecEnv, VecMonitor, VecNormalize

import cathsim_dmc.gym
from cathsim_dmc.simulation.gymnasium import CathSimVectorEnv


class BatchedVecEnv(VecEnv):
    """The vector environment with the interface of Stable-Baselines3."""

    def __init__(self, vector: CathSimVectorEnv, seed: int):
        """Wraps a vector environment; `seed` is that of its first simulation."""
        self._vector, self._first_seed = vector, seed
        super().__init__(
            vector.num_envs, vector.single_observation_space, vector.single_action_space
        )

    def reset(self):
        """Starts all episodes, seeded the first time."""
        observation, _ = self._vector.reset(seed=self._first_seed)
        self._first_seed = None
        return observation

    def step_async(self, actions):
        """Keeps the actions."""
        self._actions = actions

    def step_wait(self):
        """Advances by one control step."""
        observation, reward, terminated, truncated, info = self._vector.step(
            self._actions
        )
        infos = [{} for _ in range(self.num_envs)]
        for i in np.flatnonzero(terminated | truncated):
            infos[i] = {
                "terminal_observation": {
                    key: rows[i] for key, rows in info["final_obs"].items()
                },
                "TimeLimit.truncated": bool(truncated[i]),
                "is_success": bool(info["final_info"]["success"][i]),
            }
        return observation, reward, terminated | truncated, infos

    def close(self):
        """Has nothing to release."""

    def get_attr(self, attr_name, indices=None):
        """Attribute of the vector environment, once for each simulation."""
        return [getattr(self._vector, attr_name)] * len(self._indices(indices))

    def set_attr(self, attr_name, value, indices=None):
        """Not supported: the simulations share one task."""
        raise NotImplementedError("the simulations share one task")

    def env_method(self, method_name, *args, indices=None, **kwargs):
        """Not supported: the simulations share one task."""
        raise NotImplementedError("the simulations share one task")

    def env_is_wrapped(self, wrapper_class, indices=None):
        """No simulation is wrapped."""
        return [False] * len(self._indices(indices))

    def _indices(self, indices):
        return range(self.num_envs) if indices is None else np.atleast_1d(indices)


def task_options(observation: str, max_steps: int) -> dict:
    """Options of the task: it pays for the way left to the goal."""
    reward = {"path": -1.0, "success": 10.0}
    return {"observation": observation, "max_steps": max_steps, "reward": reward}


def main() -> None:
    """Trains, evaluates, saves."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--task", default="type1_bca")
    parser.add_argument("--observation", default="tracking")
    parser.add_argument("--steps", type=int, default=200_000)
    parser.add_argument("--envs", type=int, default=16)
    parser.add_argument("--rollout", type=int, default=256)
    parser.add_argument("--max-steps", type=int, default=300)
    parser.add_argument("--episodes", type=int, default=5)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("runs/sb3_ppo"))
    options = parser.parse_args()

    task = task_options(options.observation, options.max_steps)
    vector = CathSimVectorEnv(options.envs, options.task, **task)
    env = VecMonitor(BatchedVecEnv(vector, options.seed))
    numbers = [k for k, v in env.observation_space.items() if v.dtype != np.uint8]
    env = VecNormalize(env, norm_reward=False, norm_obs_keys=numbers)
    model = PPO(
        "MultiInputPolicy",
        env,
        n_steps=options.rollout,
        batch_size=options.rollout * options.envs // 8,
        seed=options.seed,
        verbose=1,
    )
    model.learn(options.steps)
    options.out.mkdir(parents=True, exist_ok=True)
    model.save(options.out / "model.zip")
    env.save(options.out / "normalisation.pkl")

    single = gymnasium.make(
        f"cathsim/{options.task}-v{cathsim_dmc.gym.VERSION}", **task
    )
    successes = []
    for episode in range(options.episodes):
        observation, info = single.reset(seed=1_000_000 + episode)
        ended = False
        while not ended:
            action, _ = model.predict(
                env.normalize_obs(observation), deterministic=True
            )
            observation, _, terminated, truncated, info = single.step(action)
            ended = terminated or truncated
        successes.append(info["success"])
        print(f"episode {episode}: {info}")
    print(f"success {np.mean(successes):.0%} of {options.episodes} episodes")


if __name__ == "__main__":
    main()
