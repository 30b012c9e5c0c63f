"""The composer environment of a task, which is compiled once."""

import dm_env
from dm_control import composer

from cathsim_dmc.tasks.snapshot import Snapshot


class Environment(composer.Environment):
    """`composer.Environment`, but for the first reset and the physics steps.

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

    def _substep(self, action):
        """Does a physics step, by composer's own function where somebody watches it.

        That function calls hooks and looks for MuJoCo's warnings around each physics
        step, 11 % of a control step of type1_lcca with random actions. The stepper
        looks for warnings, too; this function takes 1 %.
        """
        hooks = self._hooks
        before, after = hooks._before_substep, hooks._after_substep  # noqa: SLF001
        if (
            self._legacy_step
            or self._raise_exception_on_physics_error
            or _overridden(self.task, "before_substep")
            or before.entity_hooks
            or before.extra_hooks
            or after.entity_hooks
            or after.extra_hooks
        ):
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
        ends = task.should_terminate_episode(physics)
        self._reset_next_step = ends or self._physics.time() >= self._time_limit
        kind = dm_env.StepType.LAST if self._reset_next_step else dm_env.StepType.MID
        reward, discount = task.get_reward(physics), task.get_discount(physics)
        return dm_env.TimeStep(kind, reward, discount, observation)

    def __repr__(self) -> str:
        """The task and how long a control step is."""
        return (
            f"<Environment of {self.task!r}, control step "
            f"{1e3 * self.control_timestep():g} ms>"
        )


def _overridden(task: composer.Task, hook: str) -> bool:
    return getattr(type(task), hook) is not getattr(composer.Task, hook)
