"""The composer environment of a task, which is compiled once."""

from typing import Any

import dm_env
import numpy as np
from dm_control import composer

from cathsim_dmc.tasks.snapshot import Snapshot


class Environment(composer.Environment):
    """`composer.Environment`, but for the first reset and the loop of physics steps.

    Composer compiles at construction and once more at the first reset. Where nothing
    changes the MJCF model in between, the first model is kept.
    """

    def reset(self):
        """Starts an episode.

        Returns:
            The first time step.
        """
        self._reset_next_step = True  # until it has ended
        before = self._hooks._initialize_episode_mjcf  # noqa: SLF001
        changes = _overridden(self.task, "initialize_episode_mjcf")
        if not (changes or before.entity_hooks or before.extra_hooks):
            self._mjcf_never_compiled = False
        return super().reset()

    def step(self, action):
        """Does a control step, its physics steps in one loop where nobody watches them.

        Composer calls hooks, looks for MuJoCo's warnings and schedules observables
        around each physics step. The stepper looks for warnings, too.

        Returns:
            The time step; the first of an episode after the last of one.
        """
        enabled = self._observation_updater._enabled_structure  # noqa: SLF001
        self._watched, plain = self._is_watched(), isinstance(enabled, dict)
        if (
            self._reset_next_step
            or self._watched
            or not plain
            or not all(map(_is_plain, enabled.values()))
        ):
            return super().step(action)
        task, physics, random_state = self.task, self._physics_proxy, self._random_state
        self._hooks.before_step(physics, action, random_state)
        task.stepper.run()
        self._hooks.after_step(physics, random_state)
        observation = type(enabled)()
        for name, each in enabled.items():
            observation[name] = np.array(each.observation_callable())
        return self._time_step(observation)

    def _time_step(self, observation) -> dm_env.TimeStep:
        """What a control step that has been done returns."""
        task, physics = self.task, self._physics_proxy
        reward, discount = task.get_reward(physics), task.get_discount(physics)
        ends = task.should_terminate_episode(physics)
        self._reset_next_step = ends or self._physics.time() >= self._time_limit
        kind = dm_env.StepType.LAST if self._reset_next_step else dm_env.StepType.MID
        return dm_env.TimeStep(kind, reward, discount, observation)

    def _is_watched(self) -> bool:
        """Whether anything acts between physics steps, or after a warning in one."""
        hooks = self._hooks
        before, after = hooks._before_substep, hooks._after_substep  # noqa: SLF001
        return bool(
            self._legacy_step
            or self._raise_exception_on_physics_error
            or _overridden(self.task, "before_substep")
            or before.entity_hooks
            or before.extra_hooks
            or after.entity_hooks
            or after.extra_hooks
        )

    def _substep(self, action):
        """Does a physics step, by composer's own function where somebody watches it."""
        if self._watched:
            super()._substep(action)
        else:
            self.task.stepper.step()

    def snapshot(self) -> Snapshot:
        """The state between two steps, from which an episode goes on bit for bit.

        Observables of one's own with a delay, buffer or corruptor of composer begin
        anew.

        Raises:
            RuntimeError: if no episode has begun, or an error has interrupted its last
                step.
        """
        return self.task.snapshot()

    def restore(self, snapshot: Snapshot) -> dm_env.TimeStep:
        """Puts the environment to a snapshot, in place of a reset.

        Args:
            snapshot: Of one simulation of the same task, perhaps of a batch or of
                another process.

        Returns:
            The time step that was the last one when the snapshot was taken.

        Raises:
            ValueError: if the snapshot is of another task, or of several simulations.
        """
        task, physics = self.task, self._physics_proxy
        if not task.rollout.begun or task.rollout.half_done.any():
            self.reset()
        task.restore(physics, snapshot, self._random_state)
        self._observation_updater.reset(physics, self._random_state)
        observation = self._observation_updater.get_observation()
        if not task.rollout.steps[0]:
            self._reset_next_step = False
            return dm_env.restart(observation)
        return self._time_step(observation)

    def __repr__(self) -> str:
        """The task and how long a control step is."""
        return (
            f"<Environment of {self.task!r}, control step "
            f"{1e3 * self.control_timestep():g} ms>"
        )


def _is_plain(enabled: Any) -> bool:
    """Whether an enabled observable is what its function returns after a control step.

    It has no delay, buffer, interval and aggregator then.
    """
    if enabled.observable.aggregator or enabled.buffer._has_buffer_dim:  # noqa: SLF001
        return False
    return enabled.update_interval == 1 and enabled.delay == 0


def _overridden(task: composer.Task, hook: str) -> bool:
    return getattr(type(task), hook) is not getattr(composer.Task, hook)
