"""The composer environment of a task, which is compiled once."""

import dm_env
import numpy as np
from dm_control import composer

from cathsim_dmc.tasks.observation_kind import FrameObservable
from cathsim_dmc.tasks.snapshot import Snapshot

# What composer does with an observable between physics steps, or to its values.
_SETTINGS = ("buffer_size", "delay", "aggregator", "corruptor")


class Environment(composer.Environment):
    """`composer.Environment`, but for the first reset and plain steps.

    Composer compiles at construction and once more at the first reset. Where nothing
    changes the MJCF model in between, the first model is kept. Where nobody but the
    task does anything between physics steps, and no observable is delayed, buffered or
    of an entity, these steps run in one loop.
    """

    _plain = False

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
        timestep = super().reset()
        seen = {n: o for n, o in self.task.observables.items() if o.enabled}
        self._enabled = tuple(seen)
        self._plain = not (
            self._legacy_step
            or not self._strip_singleton_obs_buffer_dim
            or self._raise_exception_on_physics_error
            or _overridden(self.task, "before_substep")
            or any(not isinstance(one, FrameObservable) for one in seen.values())
            or any(getattr(one, s) for one in seen.values() for s in _SETTINGS)
            or any(one.update_interval not in (None, 1) for one in seen.values())
        )
        return timestep

    def step(self, action) -> dm_env.TimeStep:
        """Does a control step, or starts an episode after the end of one.

        Args:
            action: As `action_spec` says.
        """
        hooks = self._hooks
        between = hooks._before_substep, hooks._after_substep  # noqa: SLF001
        watched = any(one.entity_hooks or one.extra_hooks for one in between)
        if self._reset_next_step or not self._plain or watched:
            return super().step(action)
        hooks.before_step(self._physics_proxy, action, self._random_state)
        self.task.stepper.run()
        hooks.after_step(self._physics_proxy, self._random_state)
        seen = self.task.observation
        observation = {name: np.array(seen[name][0]) for name in self._enabled}
        return self._timestep(observation)

    def _timestep(self, observation) -> dm_env.TimeStep:
        task, physics = self.task, self._physics_proxy
        ends = task.should_terminate_episode(physics)
        self._reset_next_step = ends or self._physics.time() >= self._time_limit
        kind = dm_env.StepType.LAST if self._reset_next_step else dm_env.StepType.MID
        reward, discount = task.get_reward(physics), task.get_discount(physics)
        return dm_env.TimeStep(kind, reward, discount, observation)

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
        return self._timestep(observation)

    def __repr__(self) -> str:
        """The task and how long a control step is."""
        return (
            f"<Environment of {self.task!r}, control step "
            f"{1e3 * self.control_timestep():g} ms>"
        )


def _overridden(task: composer.Task, hook: str) -> bool:
    return getattr(type(task), hook) is not getattr(composer.Task, hook)
