"""PPO of Stable-Baselines3 on the batch, evaluated and recorded by the package.

    pip install -c constraints.txt -e '.[gym]' stable-baselines3
    python examples/sb3_ppo.py --frames 150000 --out runs/sb3
    python examples/sb3_ppo.py --policy examples/sb3_ppo.safetensors --out runs/shipped

The last command evaluates the policy beside this file, which the second one trained.
`PPO_SETTINGS` and `TRAINING` are the settings. All motors that bend the tip about one
axis get the same command, so the policy has three outputs: two bends and the
translation. The evaluation uses the reward, the start and the time limit of the task.
"""

import json
from pathlib import Path

# torchrl must be imported before dm_control.
from cathsim_dmc import agents  # isort: skip

import gymnasium
import numpy as np
import stable_baselines3
import torch
import tyro
from safetensors import safe_open
from safetensors.torch import save_file
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecEnv, VecMonitor, VecNormalize

import cathsim_dmc
import cathsim_dmc.gym
from cathsim_dmc import files, suite
from cathsim_dmc.simulation.environments import VECTOR

OBSERVATION = "internal"  # numbers, without images
# Short episodes start anywhere along the route; the reward is the remaining path.
TRAINING = {
    "observation": OBSERVATION,
    "max_steps": 120,
    "start_along_route": (0.0, 0.9),
    "reward": {"path": -1.0, "success": 10.0},
}
PPO_SETTINGS = {
    "learning_rate": 3e-4,
    "n_steps": 256,  # of each environment between two updates
    "batch_size": 256,
    "n_epochs": 10,
    "gamma": 0.99,
    "gae_lambda": 0.95,
    "clip_range": 0.2,
    "ent_coef": 0.0,
    "target_kl": 0.05,
    "policy_kwargs": {"net_arch": [128, 128], "log_std_init": -0.5},
}


def flat(observation: dict, axes: int = 0) -> np.ndarray:
    """Entries in the order of their names as one vector (..., n), after `axes` axes."""
    entries = [observation[name] for name in sorted(observation)]
    return np.concatenate([x.reshape(*x.shape[:axes], -1) for x in entries], axis=-1)


class Batch(VecEnv):
    """Adapts Gymnasium's vector environment of a task to Stable-Baselines3.

    The observation is one vector, the action has one entry for each group of motors.
    """

    def __init__(self, task: str, envs: int, **options):
        name = f"cathsim/{task}-v{cathsim_dmc.gym.VERSION}"
        # The step that ends an episode also begins the next one.
        mode = {"autoreset_mode": "SameStep"}
        self.env = gymnasium.make_vec(name, envs, **mode, **options)
        catheter = self.env.unwrapped.simulation.task.scene.catheter
        self.groups = np.array(catheter.action_groups)  # of each entry of an action
        action = gymnasium.spaces.Box(-1.0, 1.0, (self.groups.max() + 1,), np.float32)
        seen = gymnasium.spaces.flatten_space(self.env.single_observation_space)
        super().__init__(envs, seen, action)

    def reset(self):
        seeds = None if self._seeds[0] is None else self._seeds
        observation, _ = self.env.reset(seed=seeds)
        self._reset_seeds()
        return flat(observation, 1)

    def step_async(self, actions):
        self._actions = actions[:, self.groups]

    def step_wait(self):
        observation, reward, terminated, truncated, seen = self.env.step(self._actions)
        done = terminated | truncated
        infos = [{"TimeLimit.truncated": bool(cut)} for cut in truncated & ~terminated]
        for i in np.flatnonzero(done):
            infos[i]["terminal_observation"] = flat(seen["final_obs"][i])
        return flat(observation, 1), reward.astype(np.float32), done, infos

    def close(self):
        self.env.close()

    def env_is_wrapped(self, wrapper_class, indices=None):
        return [False] * self.num_envs

    def get_attr(self, attr_name, indices=None):
        return [getattr(self.env, attr_name)] * self.num_envs

    def set_attr(self, attr_name, value, indices=None):
        raise NotImplementedError("the simulations are one batch")

    env_method = set_attr


def policy_of(model: PPO, normalise: VecNormalize, groups: np.ndarray):
    """Policy for `evaluate`: a function from observations (N, …) to actions (N, A)."""

    def sb3_ppo(observation):
        seen = normalise.normalize_obs(observation[VECTOR].numpy())
        action, _ = model.predict(seen, deterministic=True)
        return torch.as_tensor(action[..., groups])

    return sb3_ppo


def untrained(task: str, envs: int, seed: int) -> tuple[PPO, VecNormalize]:
    """PPO with new networks, and the environments that it trains in."""
    env = VecMonitor(Batch(task, envs, **TRAINING))
    normalise = VecNormalize(env, norm_reward=False)
    return PPO("MlpPolicy", normalise, seed=seed, verbose=1, **PPO_SETTINGS), normalise


def save(path: Path, model: PPO, normalise: VecNormalize, **metadata) -> None:
    """Saves networks and normalisation as safetensors, which hold no code."""
    statistics = normalise.obs_rms
    tensors = {f"policy.{name}": x for name, x in model.policy.state_dict().items()}
    for name in ("mean", "var", "count"):
        tensors[name] = torch.as_tensor(getattr(statistics, name))
    save_file(tensors, path, {name: json.dumps(x) for name, x in metadata.items()})


def load(path: Path, task: str | None = None) -> tuple[PPO, VecNormalize, dict]:
    """Loads model, normalisation and metadata of `save`; `model.learn` trains on."""
    with safe_open(path, framework="pt") as file:
        metadata = {name: json.loads(x) for name, x in file.metadata().items()}
        tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    model, normalise = untrained(task or metadata["task"], 1, metadata["seed"])
    for name in ("mean", "var", "count"):
        setattr(normalise.obs_rms, name, tensors.pop(name).numpy())
    model.policy.load_state_dict(
        {name.removeprefix("policy."): x for name, x in tensors.items()}
    )
    return model, normalise, metadata


def main(
    task: str = "type1_lcca",
    frames: int = 200_000,
    envs: int = 8,
    seed: int = 0,
    policy: Path | None = None,
    episodes: int | None = None,
    out: Path = Path("runs/sb3"),
) -> None:
    """Trains, or loads `policy`; evaluates under both protocols, records an episode."""
    torch.set_num_threads(1)  # the networks are small
    files.require_folder(out, make=True)
    if policy:
        model, normalise, metadata = load(policy, task)
        print(", ".join(f"{name} {x}" for name, x in metadata.items()))
    else:
        model, normalise = untrained(task, envs, seed)
        model.learn(frames)
        steps = model.num_timesteps
        save(out / "policy.safetensors", model, normalise, task=task, steps=steps,
             seed=seed, stable_baselines3=stable_baselines3.__version__)  # fmt: skip
    play = policy_of(model, normalise, normalise.venv.venv.groups)
    for protocol in ("published", "varied"):
        result = agents.evaluate(
            play, task, episodes, protocol=protocol, observation=OBSERVATION,
            out_dir=out / protocol,
        )  # fmt: skip
        rate, safe = result.summary()["success"], result.safe_success(0.5)
        print(f"{protocol}: success {rate:.0%}, safe at 0.5 N {safe:.0%}")
    one = suite.load("cathsim", task, task_kwargs={"observation": OBSERVATION})
    cathsim_dmc.record(one, agents.load_policy(play), out / "episode.npz", seed=seed)


if __name__ == "__main__":
    tyro.cli(main)
