"""Many simulations of one navigation task on a thread pool.

Bit-identical to as many composer environments with the same seeds and actions: the
same compiled model, the same `mj_step`, the same pure functions of arrays.
"""

import dataclasses
from collections.abc import Sequence

import mujoco
import numpy as np
from dm_control import mjcf
from mujoco import batch as mujoco_batch

from cathsim_dmc.tasks import forces, navigation, objectives, observations, readings


@dataclasses.dataclass(frozen=True)
class Step:
    """Result of one control step of N simulations.

    Attributes:
      observation: arrays (N, ...).
      outcome: reward, success and distance, arrays (N,).
      terminated: (N,) bool, success or a physics error.
      truncated: (N,) bool, out of time.
      physics_error: (N,) bool, the physics failed (logged with a dump that replays
        it); such an episode says nothing about the policy.
      readings: state of the devices.
      wall_force: on the wall over the control step.
    """

    observation: observations.Observation
    outcome: objectives.Outcome
    terminated: np.ndarray
    truncated: np.ndarray
    physics_error: np.ndarray
    readings: readings.Readings
    wall_force: forces.WallForce


class BatchSimulation:
    """N simulations of one task.

    A simulation that has ended must be reset before the next step; stepping it on is
    allowed and goes on with the state as it is.
    """

    def __init__(
        self,
        task: navigation.Navigation,
        num_simulations: int,
        *,
        num_threads: int = 0,
        seeds: Sequence[int] | int = 0,
    ):
        """Compiles the task's model and starts the threads.

        Args:
          task: a task that no environment owns; the batch takes it over.
          num_simulations: N.
          num_threads: worker threads, 0 for one per core.
          seeds: of each simulation, or of the first, the others counting up.
        """
        if num_simulations < 1:
            raise ValueError(f"num_simulations is {num_simulations}; at least 1")
        self._task = task
        physics = mjcf.Physics.from_mjcf_model(task.root_entity.mjcf_model)
        task.after_compile(physics, None)
        self._model = physics.model.ptr
        self._layout = task.layout
        self._substeps = task.substeps
        self._batch = mujoco_batch.Batch(self._model, num_simulations, num_threads)
        for field in self._layout.FIELDS:
            self._batch.bind(field)
        self._rows = np.zeros(
            (num_simulations, self._substeps, self._model.nsensordata)
        )
        self._steps = np.zeros(num_simulations, dtype=int)
        self._action = np.zeros((num_simulations, len(task.catheter.actuators)))
        self._screen = task.screen(self._model, num_simulations)
        self._delay = task.action_delay(num_simulations)
        self._monitor = task.monitor(num_simulations)
        self._travel = objectives.Travel(num_simulations)
        self._variation = task.model_variation(self._model)
        fields = self._variation.fields
        self._fields = {name: self._batch.expand(name) for name in fields}
        self._goal_shift = np.zeros(num_simulations)
        self._meaning = task.usual_meaning
        self.seed(seeds)

    def seed(self, seeds: Sequence[int] | int) -> None:
        """Gives each simulation its own source of randomness."""
        if np.ndim(seeds) == 0:
            seeds = [int(seeds) + index for index in range(self.num_simulations)]
        if len(seeds) != self.num_simulations:
            raise ValueError(
                f"{len(seeds)} seeds for {self.num_simulations} simulations; give one "
                "each, or the first"
            )
        self._random_states = [np.random.RandomState(seed) for seed in seeds]

    def reset(self, indices: np.ndarray | None = None) -> observations.Observation:
        """Starts new episodes.

        Args:
          indices: of the simulations to reset, all if None.

        Returns:
          Observations (N, ...) of all simulations.
        """
        task = self._task
        everyone = np.arange(self.num_simulations)
        indices = everyone if indices is None else np.unique(indices)
        if len(indices):
            displacement = np.stack([self._draw(index) for index in indices])
            if task.config.randomisation.goal_shift is not None:
                self._meaning = task.usual_meaning.shifted(self._goal_shift)
            # Without a pass at the default pose, whose solution would warm-start ours.
            self._batch.reset(indices, stage=mujoco.mjtStage.mjSTAGE_NONE.value)
            qpos = self._batch.qpos
            qpos[indices] = task.start_qpos(qpos[indices], displacement)
            self._forward_unactuated(indices)
            self._rows[indices] = self._batch.sensordata[indices, None]
            self._steps[indices] = 0
            self._action[indices] = 0
        self._measure()
        self._travel.restart(indices, self._readings.head, self._meaning)
        return self._observe(indices)

    def _draw(self, index: int) -> np.ndarray:
        """Draws the episode of one simulation; returns its displacement (3,)."""
        episode = self._task.config.randomisation.draw(self._random_states[index])
        fields = {name: values[index] for name, values in self._fields.items()}
        self._variation.write(fields, episode)
        self._delay.restart(index, episode.delay)
        self._monitor.restart(index)
        self._screen.restart(index, episode.deviation)
        self._goal_shift[index] = episode.goal_shift or 0.0
        return episode.displacement

    def _forward_unactuated(self, indices: np.ndarray):
        """What dm_control does at a reset, when there is no control yet."""
        actuation = mujoco.mjtDisableBit.mjDSBL_ACTUATION.value
        flags = self._batch.expand("opt.disableflags")
        flags[indices] |= actuation
        self._batch.forward(indices)
        flags[indices] &= ~actuation

    def step(self, action: np.ndarray) -> Step:
        """Advances every simulation by one control step.

        Args:
          action: (N, A) in [-1, 1].

        Raises:
          ValueError: if the action has the wrong shape or is not finite.
        """
        action = objectives.check_action(action, self._action.shape)
        self._action = action.copy()
        self._batch.ctrl[:] = self._delay.pass_on(action)
        self._task.posed_robot(self._batch.qpos)
        self._monitor.before_step(self._batch.state, action)
        warnings = self._batch.warning.copy()
        self._batch.rollout(
            self._substeps,
            record=("sensordata",),
            out={"sensordata": self._rows},
        )
        changed = self._batch.warning != warnings
        self._steps += 1
        self._measure()
        reasons = self._monitor.errors(
            changed.reshape(self.num_simulations, -1).any(-1),
            self._readings.centreline,
            self._wall_force.peak_max,
        )
        error = np.array([reason is not None for reason in reasons])
        self._travel.add(self._readings.head)
        outcome = self._meaning.outcome(self._readings.head)
        if error.any():
            outcome = outcome._replace(
                success=outcome.success & ~error,
                reward=np.where(error, 0.0, outcome.reward),
            )
        terminated = outcome.success | error
        return Step(
            observation=self._observe(),
            outcome=outcome,
            terminated=terminated,
            truncated=~terminated & (self._steps >= self._meaning.max_steps),
            physics_error=error,
            readings=self._readings,
            wall_force=self._wall_force,
        )

    def _measure(self):
        self._readings = self._layout.read(self._batch)
        self._wall_force = forces.wall_force(
            forces.magnitudes(self._rows[..., self._layout.wall_contacts])
        )

    def _observe(self, fresh: np.ndarray | None = None) -> observations.Observation:
        """Observations of all; `fresh` are in the first step of an episode."""
        goal = self._meaning.goal
        picture = self._screen.take(
            self._readings.centreline,
            goal,
            self._batch.qpos,
            self._random_states,
            fresh,
        )
        frame = observations.Frame(
            self._readings, self._wall_force, self._action, goal, picture
        )
        observation = observations.observe(self._task.observation_names, frame)
        # The caller's own, as composer's buffers make them for an environment.
        return {key: np.array(value) for key, value in observation.items()}

    @property
    def num_simulations(self) -> int:
        """N."""
        return self._batch.nsim

    @property
    def num_actions(self) -> int:
        """A, entries of an action."""
        return self._action.shape[-1]

    @property
    def task(self) -> navigation.Navigation:
        """The task that all simulations run."""
        return self._task

    @property
    def meaning(self) -> objectives.Cannulation:
        """Goals, which may differ between simulations, reward and success rule."""
        return self._meaning

    @property
    def batch(self) -> mujoco_batch.Batch:
        """The simulations; `expand` gives model fields of their own to each."""
        return self._batch

    @property
    def readings(self) -> readings.Readings:
        """State of the devices after the last step or reset."""
        return self._readings

    @property
    def wall_force(self) -> forces.WallForce:
        """Force on the wall over the last step."""
        return self._wall_force

    @property
    def path_ratio(self) -> np.ndarray:
        """Way of each head (N,) so far over the shortest way to the goal."""
        return self._travel.path_ratio

    @property
    def sensor_rows(self) -> np.ndarray:
        """Sensor rows (N, S, nsensordata) of the S substeps of the last step."""
        return self._rows

    @property
    def steps(self) -> np.ndarray:
        """Control steps (N,) since the last reset of each."""
        return self._steps
