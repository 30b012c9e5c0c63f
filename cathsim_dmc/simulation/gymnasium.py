"""The tasks as Gymnasium environments."""

from collections.abc import Mapping
from typing import Any

import gymnasium
import numpy as np
from dm_env import specs
from gymnasium.envs.registration import EnvSpec

from cathsim_dmc import bounds, suite
from cathsim_dmc.imaging import angiograph
from cathsim_dmc.tasks.config import CONTROL_TIMESTEP

RENDER_MODES = ("rgb_array",)
VERSION = 0  # of the ids


def space(spec: specs.Array, dtype: np.dtype) -> gymnasium.spaces.Box:
    """Box of an array; numbers as `dtype`, pictures as they are."""
    if spec.dtype == np.uint8:
        return gymnasium.spaces.Box(0, 255, spec.shape, np.uint8)
    if isinstance(spec, specs.BoundedArray):
        low, high = (
            np.broadcast_to(bound, spec.shape).astype(dtype)
            for bound in (spec.minimum, spec.maximum)
        )
        return gymnasium.spaces.Box(low, high, spec.shape, dtype)
    return gymnasium.spaces.Box(-np.inf, np.inf, spec.shape, dtype)


def space_of(
    entries: Mapping[str, specs.Array], dtype: np.dtype
) -> gymnasium.spaces.Dict:
    """Spaces of named arrays, see `space`."""
    return gymnasium.spaces.Dict({k: space(spec, dtype) for k, spec in entries.items()})


def _converted(observation, dtype: np.dtype) -> dict[str, np.ndarray]:
    return {
        key: value.copy() if value.dtype == np.uint8 else value.astype(dtype)
        for key, value in observation.items()
    }


class CathSimEnv(gymnasium.Env):
    """One simulation of a task.

    `reset(seed=s)` starts the same episode as the suite's `random=s`. The observation
    is a dictionary, whatever it holds. `terminated` is success or, with
    `info["physics_error"]`, divergence; `truncated` is the end of the time.

    Attributes:
        environment: The composer environment.
    """

    metadata = {
        "render_modes": list(RENDER_MODES),
        "render_fps": round(1 / CONTROL_TIMESTEP),
    }

    def __init__(
        self,
        task: str = "type1_bca",
        render_mode: str | None = None,
        dtype: str = "float32",
        **task_kwargs: Any,
    ):
        """Loads the task.

        Args:
            render_mode: "rgb_array" renders fluoroscopy, which needs no OpenGL.
            dtype: of the numbers observed and of the action, float32 or float64.
            **task_kwargs: options of the task, such as `observation`.
        """
        if render_mode is not None:
            bounds.choice("render_mode", render_mode, RENDER_MODES)
        if "frameskip" in task_kwargs:  # TorchRL goes on without it
            raise TypeError("unexpected keyword argument 'frameskip'")
        self.render_mode = render_mode
        self._dtype = np.dtype(bounds.choice("dtype", dtype, ("float32", "float64")))
        self.environment = suite.load(suite.DOMAIN, task, task_kwargs)
        entries = self.environment.task.observation_specs
        self.observation_space = space_of(entries, self._dtype)
        self.action_space = space(self.environment.action_spec(), self._dtype)
        self._ended: bool | None = None  # before the first episode
        self._closed = False

    def reset(self, *, seed: int | None = None, options: dict | None = None):
        """Starts an episode; see `gymnasium.Env.reset`. `options` has no meaning."""
        super().reset(seed=seed)
        if seed is not None:
            self.environment.random_state.seed(seed)
        timestep = self.environment.reset()
        self._ended = False
        info = self.environment.task.info()
        return _converted(timestep.observation, self._dtype), info

    def step(self, action: np.ndarray):
        """Advances by one control step; see `gymnasium.Env.step`."""
        if self._ended is not False:
            raise gymnasium.error.ResetNeeded(
                "the episode has ended, or none has begun; call reset()"
            )
        timestep = self.environment.step(action)
        self._ended = timestep.last()
        terminated = self._ended and timestep.discount == 0
        observation = _converted(timestep.observation, self._dtype)
        reward, truncated = float(timestep.reward), self._ended and not terminated
        return observation, reward, terminated, truncated, self.environment.task.info()

    def render(self) -> np.ndarray | None:
        """Fluoroscopy (rows, columns, 3) uint8, two planes side by side."""
        if self.render_mode is None:
            gymnasium.logger.warn(
                'render() without a render_mode; make the environment with "rgb_array"'
            )
            return None
        if self._ended is None:
            raise gymnasium.error.ResetNeeded("there is nothing to see before reset()")
        rollout = self.environment.task.rollout
        machine = rollout.case().angiograph
        planes = rollout.around(machine.planes(rollout.deviations[0]))
        image = angiograph.images([planes], rollout.shadows)[0]
        row = np.concatenate(list(np.moveaxis(image, -1, 0)), axis=1)
        return np.repeat(row[..., None], 3, axis=-1)

    def close(self) -> None:
        """Frees the simulator; closing twice does nothing."""
        if not self._closed:
            self.environment.close()
        self._closed = True


def env_spec(task: str, **options: Any) -> EnvSpec:
    """Spec that makes an environment again, without wrappers."""
    return EnvSpec(
        id=f"{suite.DOMAIN}/{task}-v{VERSION}",
        entry_point=f"{__name__}:{CathSimEnv.__name__}",
        kwargs={"task": task, **options},
        disable_env_checker=True,
    )
