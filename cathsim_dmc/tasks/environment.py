"""The composer environment of a task, which is compiled once."""

from typing import Any

import dm_env
import numpy as np
from dm_control import composer

from cathsim_dmc.tasks.navigation import Navigation
from cathsim_dmc.tasks.snapshot import NotCopied, Snapshot


class Environment(composer.Environment, NotCopied):
    """`composer.Environment` that compiles once and runs physics steps in one loop.

    Composer compiles at construction and once more at the first reset. The second
    compilation is skipped if no hook changes the MJCF model.

    Attributes:
        restored: Number of restored snapshots; a policy begins anew after each.
    """

    restored = 0

    def reset(self):
        """Starts an episode.

        Returns:
            The first time step.

        Raises:
            RuntimeError: if the environment is closed.
        """
        self._require_open()
        self._reset_next_step = True  # also if this reset raises
        before = self._hooks._initialize_episode_mjcf  # noqa: SLF001
        changes = _overridden(self.task, "initialize_episode_mjcf")
        if not (changes or before.entity_hooks or before.extra_hooks):
            self._mjcf_never_compiled = False
        return super().reset()

    def step(self, action):
        """Does a control step; its physics steps run in one loop if no hook needs them.

        Composer calls hooks, checks MuJoCo's warnings and schedules observables around
        each physics step. The stepper checks the warnings itself.

        Returns:
            The time step; the first one of a new episode if the last one has ended.

        Raises:
            RuntimeError: if the environment is closed.
        """
        self._require_open()
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
        """Returns the time step of a completed control step."""
        task, physics = self.task, self._physics_proxy
        reward, discount = task.get_reward(physics), task.get_discount(physics)
        ends = task.should_terminate_episode(physics)
        self._reset_next_step = ends or self._physics.time() >= self._time_limit
        kind = dm_env.StepType.LAST if self._reset_next_step else dm_env.StepType.MID
        return dm_env.TimeStep(kind, reward, discount, observation)

    def _is_watched(self) -> bool:
        """Whether a hook or composer's handling of warnings needs each physics step."""
        hooks = self._hooks
        before, after = hooks._before_substep, hooks._after_substep  # noqa: SLF001
        return bool(
            self._composed
            or _overridden(self.task, "before_substep")
            or _overridden(self.task, "after_substep", of=Navigation)
            or before.entity_hooks
            or before.extra_hooks
            or after.entity_hooks
            or after.extra_hooks
        )

    @property
    def _composed(self) -> bool:
        """Whether composer's own physics step is asked for."""
        return self._legacy_step or self._raise_exception_on_physics_error

    def _substep(self, action):
        """Does a physics step with its hooks; after a warning it only keeps zeros.

        The stepper repeats a control step with a warning, for which composer would end
        the episode.
        """
        stepper = self.task.stepper
        number = stepper.substep
        if self._composed:
            super()._substep(action)
        elif not self._watched or stepper.stopped:
            stepper.step()
        else:
            physics, random_state = self._physics_proxy, self._random_state
            self._hooks.before_substep(physics, action, random_state)
            stepper.advance()
            if not stepper.stopped:
                self._hooks.after_substep(physics, random_state)
        if stepper.substep == number:  # after_substep of a subclass need not call super
            stepper.keep()

    def snapshot(self) -> Snapshot:
        """Returns the state between two steps; an episode continues from it exactly.

        A user's observables with a delay, buffer or corruptor of composer are not part
        of it.

        Raises:
            RuntimeError: if no episode has begun, or an error has interrupted its last
                step.
        """
        return self.task.snapshot()

    def restore(self, snapshot: Snapshot) -> dm_env.TimeStep:
        """Restores a snapshot; replaces a reset.

        Args:
            snapshot: Snapshot of one simulation of the same task; it may come from a
                batch or another process.

        Returns:
            The time step after which the snapshot was taken.

        Raises:
            ValueError: if the snapshot is of another task, or of several simulations.
            RuntimeError: if the environment is closed.
        """
        self._require_open()
        task, physics = self.task, self._physics_proxy
        if not task.rollout.begun or task.rollout.half_done.any():
            self.reset()
        task.restore(physics, snapshot, self._random_state)
        self.restored += 1
        self._observation_updater.reset(physics, self._random_state)
        observation = self._observation_updater.get_observation()
        if not task.rollout.steps[0]:
            self._reset_next_step = False
            return dm_env.restart(observation)
        return self._time_step(observation)

    def close(self) -> None:
        """Frees the simulation; closing twice does nothing."""
        if self._physics is not None:
            super().close()

    def _require_open(self) -> None:
        if self._physics is None:
            raise RuntimeError("the environment is closed; make another one")

    def __repr__(self) -> str:
        """The task and how long a control step is."""
        return (
            f"<Environment of {self.task!r}, control step "
            f"{1e3 * self.control_timestep():g} ms>"
        )


def _is_plain(enabled: Any) -> bool:
    """Whether an observable equals the value of its function after a control step.

    This holds without a delay, buffer, update interval and aggregator.
    """
    if enabled.observable.aggregator or enabled.buffer._has_buffer_dim:  # noqa: SLF001
        return False
    return enabled.update_interval == 1 and enabled.delay == 0


def _overridden(
    task: composer.Task, hook: str, of: type[composer.Task] = composer.Task
) -> bool:
    return getattr(type(task), hook) is not getattr(of, hook)
