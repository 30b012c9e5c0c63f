"""The composer environment of a task: compiled once, and clear about OpenGL."""

import os

import dm_env
import numpy as np
from dm_control import composer, mjcf

from cathsim_dmc.tasks.observation_kind import FrameObservable

# What composer does with an observable between physics steps, or to its values.
_SETTINGS = ("buffer_size", "delay", "aggregator", "corruptor")


class Environment(composer.Environment):
    """`composer.Environment`, but for the first reset, plain steps and rendering.

    Composer compiles at construction and once more at the first reset, for tasks that
    change their MJCF model before an episode. Where nothing does and
    `recompile_mjcf_every_episode` is off, the first model is kept: an environment is
    there in two thirds of the time, and `physics` stays what it is. What is to change
    in the MJCF model changes before the environment is made, see `suite.environment`.

    Where nobody but the task does anything between physics steps, and no observable is
    delayed, buffered or of an entity, these steps run in one loop.
    """

    _plain = False

    def reset(self):
        """Starts an episode.

        Returns:
            The first time step.
        """
        if not self._changes_model():
            self._mjcf_never_compiled = False
        timestep = super().reset()
        self._plain = self._is_plain()
        return timestep

    def step(self, action) -> dm_env.TimeStep:
        """Does a control step, or starts an episode after the end of one.

        Args:
            action: As `action_spec` says.
        """
        if self._reset_next_step or not self._plain or self._is_watched():
            return super().step(action)
        self._hooks.before_step(self._physics_proxy, action, self._random_state)
        self.task.run_substeps()
        self._hooks.after_step(self._physics_proxy, self._random_state)
        task, physics = self.task, self._physics_proxy
        seen = task.observation
        observation = {name: np.array(seen[name][0]) for name in self._enabled}
        ends = task.should_terminate_episode(physics)
        self._reset_next_step = ends or self._physics.time() >= self._time_limit
        kind = dm_env.StepType.LAST if self._reset_next_step else dm_env.StepType.MID
        reward, discount = task.get_reward(physics), task.get_discount(physics)
        return dm_env.TimeStep(kind, reward, discount, observation)

    def _is_watched(self) -> bool:
        """Whether somebody is called between physics steps."""
        hooks = self._hooks
        before, after = hooks._before_substep, hooks._after_substep  # noqa: SLF001
        called = before.entity_hooks or before.extra_hooks
        return bool(called or after.entity_hooks or after.extra_hooks)

    def _is_plain(self) -> bool:
        """Whether composer's own step would do no more for an episode."""
        seen = {n: o for n, o in self.task.observables.items() if o.enabled}
        self._enabled = tuple(seen)
        return not (
            self._legacy_step
            or self._raise_exception_on_physics_error
            or type(self.task).before_substep is not composer.Task.before_substep
            or any(not isinstance(one, FrameObservable) for one in seen.values())
            or any(getattr(one, s) for one in seen.values() for s in _SETTINGS)
            or any(one.update_interval not in (None, 1) for one in seen.values())
        )

    def _changes_model(self) -> bool:
        """Whether the task, an entity or a hook changes the MJCF model."""
        hook = self._hooks._initialize_episode_mjcf  # noqa: SLF001
        own = type(self.task).initialize_episode_mjcf
        none = composer.Task.initialize_episode_mjcf
        return own is not none or bool(hook.entity_hooks or hook.extra_hooks)

    def _recompile_physics(self):
        # As composer does it, whose own class it makes whatever one wants.
        if getattr(self, "_physics", None):
            self._physics.free()
        model = self.task.root_entity.mjcf_model
        self._physics = NavigationPhysics.from_mjcf_model(model)
        self._physics.legacy_step = self._legacy_step

    def __repr__(self) -> str:
        """The task and how long a control step is."""
        return (
            f"<Environment of {self.task!r}, control step "
            f"{1e3 * self.control_timestep():g} ms>"
        )


class NavigationPhysics(mjcf.Physics):
    """The simulator, with pictures that need OpenGL."""

    def _make_rendering_contexts(self):
        """Opens the off-screen context; RuntimeError says what to do without one."""
        try:
            super()._make_rendering_contexts()
        except Exception as error:  # every backend fails in its own way
            chosen = os.environ.get("MUJOCO_GL", "not set")
            raise RuntimeError(
                "MuJoCo's renderer (physics.render, from_pixels) needs OpenGL, which "
                f"does not start here (MUJOCO_GL is {chosen}: {type(error).__name__}: "
                f"{error}). Set MUJOCO_GL to egl (with a GPU), osmesa (software) or "
                "glfw (with a display) before Python starts. Without OpenGL: "
                "cathsim_dmc.show(env) draws the scene, cathsim_dmc.fluoroscopy(env) "
                'the X-ray image, and task_kwargs={"observation": "image"} makes the '
                "X-ray image the observation, in place of from_pixels."
            ) from error
