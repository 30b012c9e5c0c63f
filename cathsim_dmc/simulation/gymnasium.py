"""The tasks as Gymnasium environments: one simulation, or many in a batch."""

from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium
import numpy as np
from dm_env import specs
from gymnasium.envs.registration import EnvSpec
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from cathsim_dmc import bounds, suite
from cathsim_dmc.imaging import angiograph
from cathsim_dmc.simulation.batch import BatchSimulation
from cathsim_dmc.simulation.infos import final_info, masked, reset_mask
from cathsim_dmc.tasks.conditions import Conditions
from cathsim_dmc.tasks.config import CONTROL_TIMESTEP
from cathsim_dmc.tasks.rollout import Rollout
from cathsim_dmc.tasks.snapshot import Snapshot

RENDER_MODES = ("rgb_array",)
VERSION = 0  # of the ids
_NO_MODE = 'render() without a render_mode; make the environment with "rgb_array"'


def space(spec: specs.Array, dtype: np.dtype) -> gymnasium.spaces.Box:
    """Box of an array; numbers as `dtype`, images as uint8."""
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


def _float_type(dtype: str) -> np.dtype:
    return np.dtype(bounds.choice("dtype", dtype, ("float32", "float64")))


def _render_mode(mode: str | None) -> str | None:
    return None if mode is None else bounds.choice("render_mode", mode, RENDER_MODES)


def _fluoroscopy(rollout: Rollout) -> np.ndarray:
    """RGB images (N, rows, columns, 3) uint8, two planes side by side."""
    machines = [
        rollout.around(rollout.case(i).angiograph.planes(deviation), i)
        for i, deviation in enumerate(rollout.deviations)
    ]
    image = angiograph.images(machines, rollout.shadows)
    row = np.concatenate(list(np.moveaxis(image, -1, 0)), axis=2)
    return np.repeat(row[..., None], 3, axis=-1)


class CathSimEnv(gymnasium.Env):
    """One simulation of a task.

    `reset(seed=s)` starts the same episode as the suite's `random=s`. The observation
    is always a dictionary. `terminated` is success, a physics error
    (`info["physics_error"]`), `give_up`, or a failure by the objective; `truncated` is
    the time limit.

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
            dtype: type of the observed numbers and of the action, float32 or float64.
            **task_kwargs: options of the task, such as `observation`.
        """
        self.render_mode = _render_mode(render_mode)
        if "frameskip" in task_kwargs:  # TorchRL catches this and repeats frames itself
            raise TypeError("unexpected keyword argument 'frameskip'")
        self._dtype = _float_type(dtype)
        self.environment = suite.load(suite.DOMAIN, task, task_kwargs)
        entries = self.environment.task.observation_specs
        self.observation_space = space_of(entries, self._dtype)
        self.action_space = space(self.environment.action_spec(), self._dtype)
        self._ended: bool | None = None  # before the first episode
        self._closed = False

    def reset(self, *, seed: int | None = None, options: dict | None = None):
        """Starts an episode; see `gymnasium.Env.reset`. `options` is ignored."""
        _require_open(self._closed)
        super().reset(seed=seed)
        if seed is not None:
            self.environment.random_state.seed(seed)
        timestep = self.environment.reset()
        self._ended = False
        info = self.environment.task.info()
        return _converted(timestep.observation, self._dtype), info

    def step(self, action: np.ndarray):
        """Advances by one control step; see `gymnasium.Env.step`."""
        _require_open(self._closed)
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

    @property
    def conditions(self) -> Conditions:
        """Drawn values of the present episode; see `tasks.conditions`."""
        return self.environment.task.conditions

    def snapshot(self) -> Snapshot:
        """The state between two steps; see `tasks.environment.Environment.snapshot`."""
        _require_open(self._closed)
        return self.environment.snapshot()

    def restore(self, snapshot: Snapshot):
        """Restores a snapshot of one simulation of the environment's task.

        Returns:
            Observation and info, as `reset` does.

        Raises:
            ValueError: if the snapshot is of another task, or of several simulations.
        """
        _require_open(self._closed)
        timestep = self.environment.restore(snapshot)
        self._ended = timestep.last()
        info = self.environment.task.info()
        return _converted(timestep.observation, self._dtype), info

    def render(self) -> np.ndarray | None:
        """Fluoroscopy (rows, columns, 3) uint8, two planes side by side."""
        if self.render_mode is None:
            gymnasium.logger.warn(_NO_MODE)
            return None
        if self._ended is None:
            raise gymnasium.error.ResetNeeded("there is nothing to see before reset()")
        return _fluoroscopy(self.environment.task.rollout)[0]

    def close(self) -> None:
        """Frees the simulator; closing twice does nothing."""
        self.environment.close()
        self._closed, self._ended = True, None


class CathSimVectorEnv(gymnasium.vector.VectorEnv):
    """N simulations of a task in one batch.

    Simulation i gives what `CathSimEnv` gives for its seed and actions, bit for bit.
    `autoreset_mode` decides when an ended episode is reset. Infos are arrays (N, ...)
    with a mask "_name" (N,) each, as those of Gymnasium's `SyncVectorEnv`.

    Attributes:
        autoreset_mode: When the next episode begins.
        simulation: The batch.
    """

    def __init__(
        self,
        num_envs: int = 1,
        task: str = "type1_bca",
        render_mode: str | None = None,
        dtype: str = "float32",
        num_threads: int = 0,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        **task_kwargs: Any,
    ):
        """Starts the simulations.

        Args:
            num_envs: N.
            render_mode: "rgb_array" renders fluoroscopy of each, without OpenGL.
            dtype: Type of the observed numbers and of the action, float32 or float64.
            num_threads: Number of worker threads, 0 for one per core.
            autoreset_mode: "NextStep" as Gymnasium's wrappers of observations expect,
                "SameStep", or "Disabled", where `reset(options={"reset_mask": mask})`
                begins some episodes.
            **task_kwargs: Options of the task, such as `observation`, and `random`, a
                seed of the first simulation, from which the others count up, or one
                seed for each; without it they are seeded from the system.
                Gymnasium's `max_episode_steps` is `max_steps`.
        """
        self.render_mode = _render_mode(render_mode)
        self._dtype = _float_type(dtype)
        seed = task_kwargs.pop("random", None)
        most = task_kwargs.pop("max_episode_steps", None)
        if most is not None and task_kwargs.setdefault("max_steps", most) != most:
            usual = f"{task_kwargs['max_steps']}, as max_steps; give one of the two"
            bounds.refuse("max_episode_steps", most, usual)
        modes = [mode.value for mode in AutoresetMode]
        mode = getattr(autoreset_mode, "value", autoreset_mode)
        mode = bounds.choice("autoreset_mode", mode, modes)
        self.autoreset_mode = AutoresetMode(mode)
        self.metadata = {**CathSimEnv.metadata, "autoreset_mode": self.autoreset_mode}
        bounds.whole("num_envs", num_envs, 1, bounds.MOST_SIMULATIONS)
        self.simulation = BatchSimulation(
            suite.make_task(task, **task_kwargs), num_envs, num_threads=num_threads
        )
        self.num_envs = self.simulation.num_simulations
        if seed is not None:
            self.simulation.seed(bounds.seeds("random", seed, self.num_envs))
        else:
            for state in self.simulation.random_states:
                state.seed(None)
        entries = self.simulation.task.observation_specs
        self.single_observation_space = space_of(entries, self._dtype)
        size = self.simulation.num_actions
        action = specs.BoundedArray((size,), self._dtype, -1.0, 1.0)
        self.single_action_space = space(action, self._dtype)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._ended = np.zeros(self.num_envs, bool)

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: Mapping[str, Any] | None = None,
    ):
        """Starts episodes; see `gymnasium.vector.VectorEnv.reset`.

        Args:
            seed: Seed of the first simulation, from which the others count up, or one
                seed, or None, for each; None keeps their random states.
            options: {"reset_mask": mask} resets only the simulations where the mask
                (N,) bool is true.
        """
        _require_open(self.closed)
        mask = reset_mask(options, self.num_envs)
        if seed is not None:
            seeds = _seeds(seed, self.num_envs)
            super().reset(seed=seeds[0])
            for i, state in enumerate(self.simulation.random_states):
                if mask[i] and seeds[i] is not None:
                    state.seed(seeds[i])
        step = self.simulation.reset(np.flatnonzero(mask))
        self._ended &= ~mask
        return _converted(step.observation, self._dtype), masked(step.info(), mask)

    def step(self, actions: np.ndarray):
        """Advances all by one control step; see `gymnasium.vector.VectorEnv.step`.

        In the mode "SameStep", the next episode begins in the step in which one ends;
        the last observation and info of the ended one are in "final_obs" (N objects)
        and "final_info" of the infos.
        """
        _require_open(self.closed)
        waiting = self._ended
        if waiting.any() and self.autoreset_mode is AutoresetMode.DISABLED:
            raise gymnasium.error.ResetNeeded(
                f"the episodes of {np.flatnonzero(waiting).tolist()} have ended; call "
                'reset(options={"reset_mask": mask})'
            )
        # Simulations that wait for a reset are stepped too; their random states stay.
        states = self.simulation.random_states
        kept = {i: states[i].get_state() for i in np.flatnonzero(waiting)}
        step = self.simulation.step(actions)
        for i, state in kept.items():
            states[i].set_state(state)
        terminated, truncated = step.terminated & ~waiting, step.truncated & ~waiting
        reward = np.where(waiting, 0.0, step.outcome.reward)
        self._ended, final = terminated | truncated, {}
        if self.autoreset_mode is AutoresetMode.SAME_STEP and self._ended.any():
            waiting, self._ended = self._ended, np.zeros(self.num_envs, bool)
            last = _converted(step.observation, self._dtype)
            final = final_info(last, step.info(), waiting)
        if waiting.any():
            step = self.simulation.reset(np.flatnonzero(waiting))
        observation = _converted(step.observation, self._dtype)
        infos = {**masked(step.info(), np.ones(self.num_envs, bool)), **final}
        return observation, reward, terminated, truncated, infos

    @property
    def conditions(self) -> list[Conditions]:
        """Drawn values of the present episode of each simulation."""
        return self.simulation.conditions

    def snapshot(self) -> Snapshot:
        """The state of all simulations; see `BatchSimulation.snapshot`."""
        _require_open(self.closed)
        return self.simulation.snapshot()

    def restore(self, snapshot: Snapshot):
        """Restores a snapshot of N simulations.

        Episodes that had ended wait for their reset, see `autoreset_mode`.

        Returns:
            Observations and infos, as `reset` does.

        Raises:
            ValueError: if the snapshot is of another task or number of simulations.
        """
        _require_open(self.closed)
        step = self.simulation.restore(snapshot)
        self._ended = step.terminated | step.truncated
        info = masked(step.info(), np.ones(self.num_envs, bool))
        return _converted(step.observation, self._dtype), info

    def render(self) -> tuple[np.ndarray, ...] | None:
        """Fluoroscopy of each simulation, see `CathSimEnv.render`."""
        if self.render_mode is None:
            gymnasium.logger.warn(_NO_MODE)
            return None
        if not hasattr(self.simulation.rollout, "readings"):
            raise gymnasium.error.ResetNeeded("there is nothing to see before reset()")
        return tuple(_fluoroscopy(self.simulation.rollout))


def _require_open(closed: bool) -> None:
    if closed:
        raise gymnasium.error.ClosedEnvironmentError(
            "the environment is closed; make another one"
        )


def _seeds(seed: Any, count: int) -> Sequence[int | None]:
    """One seed, or None, for each of `count` simulations; ValueError for others."""
    if isinstance(seed, str) or not isinstance(seed, Sequence | np.ndarray):
        return bounds.seeds("seed", seed, count)
    known = bounds.seeds("seed", [0 if one is None else one for one in seed], count)
    return [
        None if one is None else value for one, value in zip(seed, known, strict=True)
    ]


def env_spec(task: str, **options: Any) -> EnvSpec:
    """Spec from which Gymnasium makes the environment, without wrappers."""
    return EnvSpec(
        id=f"{suite.DOMAIN}/{task}-v{VERSION}",
        entry_point=f"{__name__}:{CathSimEnv.__name__}",
        kwargs={"task": task, **options},
        disable_env_checker=True,
    )
