"""The composer environment of a task: compiled once, and clear about OpenGL."""

import os

import dm_env
import mujoco
from dm_control import composer, mjcf
from dm_control.rl import control

from cathsim_dmc.tasks.snapshot import Snapshot


class Environment(composer.Environment):
    """`composer.Environment`, but for the first reset and `physics.render`.

    Composer compiles at construction and once more at the first reset, for tasks that
    change their MJCF model before an episode. Where nothing does and
    `recompile_mjcf_every_episode` is off, the first model is kept: an environment is
    there in two thirds of the time, and `physics` stays what it is. What is to change
    in the MJCF model changes before the environment is made, see `suite.environment`.
    """

    def reset(self):
        """Starts an episode.

        Returns:
            The first time step.
        """
        if not self._changes_model():
            self._mjcf_never_compiled = False
        return super().reset()

    def snapshot(self) -> Snapshot:
        """The state between two steps, from which an episode goes on bit for bit.

        Raises:
            RuntimeError: if no episode has begun.
        """
        return self.task.snapshot()

    def restore(self, snapshot: Snapshot) -> dm_env.TimeStep:
        """Puts the environment to a snapshot, in place of a reset.

        Args:
            snapshot: Of one simulation of the same task, perhaps of another process.

        Returns:
            The time step that was the last one when the snapshot was taken.

        Raises:
            ValueError: if the snapshot is of another task.
        """
        task, physics = self.task, self._physics_proxy
        task.restore(physics, snapshot, self._random_state)
        self._observation_updater.reset(physics, self._random_state)
        observation = self._observation_updater.get_observation()
        self._reset_next_step = task.termination is not None
        if not task.rollout.steps[0]:
            return dm_env.restart(observation)
        kind = dm_env.StepType.LAST if self._reset_next_step else dm_env.StepType.MID
        reward, discount = task.get_reward(physics), task.get_discount(physics)
        return dm_env.TimeStep(kind, reward, discount, observation)

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
    """The simulator: quick steps, and pictures that need OpenGL."""

    def step(self, nstep: int = 1) -> None:
        """Does physics steps.

        dm_control's own check for warnings takes a tenth of a step without contact.

        Raises:
            PhysicsError: if MuJoCo warns.
        """
        if self.legacy_step:
            return super().step(nstep)
        before = self._warnings.tobytes()
        mujoco.mj_step(self.model.ptr, self.data.ptr, nstep)
        if self._warnings.tobytes() != before:
            raise control.PhysicsError("MuJoCo has warned in a physics step")

    def _make_rendering_contexts(self):
        """Opens the off-screen context that pictures are drawn in.

        Raises:
            RuntimeError: there is no OpenGL; says what to do.
        """
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
