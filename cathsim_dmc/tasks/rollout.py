"""The course of an episode, for any number of simulations and whoever steps them.

    begin → (forward pass) → start → command → (physics steps) → finish → command → …

The composer environment steps a `Rollout` of one simulation, the batched simulation
one of N; so both draw, command, judge and observe alike, bit for bit.
"""

from collections.abc import Sequence
from typing import cast

import mujoco
import numpy as np

from cathsim_dmc.imaging.device import Shadow
from cathsim_dmc.imaging.fluoroscopy import Fluoroscope
from cathsim_dmc.physics import forces, readings
from cathsim_dmc.physics.effects import Effects, World
from cathsim_dmc.physics.randomisation import Episode
from cathsim_dmc.physics.sliding import CoaxialReadings, SingleDevice
from cathsim_dmc.physics.stepper import Stepper
from cathsim_dmc.tasks import observations
from cathsim_dmc.tasks.cases import Case, model_index
from cathsim_dmc.tasks.config import NavigationConfig
from cathsim_dmc.tasks.frame import NO_IMAGES, Frame
from cathsim_dmc.tasks.image_sensors import ImageSensors, open_cameras
from cathsim_dmc.tasks.objective_pool import together
from cathsim_dmc.tasks.objectives import (
    Measurement,
    Objective,
    Shiftable,
    judge,
    straight,
)
from cathsim_dmc.tasks.observation_kind import Observation
from cathsim_dmc.tasks.path_tracker import PathTracker
from cathsim_dmc.tasks.physics_errors import PhysicsMonitor
from cathsim_dmc.tasks.route import Routes
from cathsim_dmc.tasks.step import Step


class Rollout:
    """Episodes of N simulations of one task."""

    def __init__(
        self,
        cases: Sequence[Case],
        config: NavigationConfig,
        model: mujoco.MjModel,
        stepper: Stepper,
    ):
        """Prepares what an episode needs; no episode has begun yet.

        Args:
          cases: Anatomies with their objectives; an episode draws one of them, if
            there are several.
          config: Options of the task.
          model: The compiled scene of the first case.
          stepper: Steps the N simulations.
        """
        self._cases = tuple(cases)
        num_simulations = stepper.num_simulations
        self._case_of = np.zeros(num_simulations, dtype=int)
        self._objective = cases[0].objective
        scene = cases[0].scene
        self._config = config
        self._stepper = stepper
        self._state = state = stepper.arrays
        self._names = observations.resolve(config.observation, scene.coaxial)
        catheter = scene.catheter.mjcf_model.model
        self._index = model_index(scene, model)
        self._views = self._index.views(state)
        num_actions = len(scene.catheter.action_names)
        listed = config.effects_on(scene.catheter)
        self._devices = cast(SingleDevice, listed[-1])
        self._effects = Effects(
            listed,
            World(
                model,
                scene.catheter,
                self._index,
                scene.placement.start_depth,
                state,
                stepper.field,
                state.userdata,
            ),
        )
        self._routes: Routes | None = None
        if observations.needs(self._names, "routed"):
            self._routes = Routes([case.objective for case in cases])
        self._sensors = ImageSensors(
            self._names,
            cases[0].angiograph,
            num_simulations,
            open_cameras(self._names, model, config.camera_options, catheter),
        )
        self._monitor = PhysicsMonitor(
            scene,
            num_simulations,
            {"goal": scene.goal.name, "config": repr(config)},
        )
        self._path = PathTracker(num_simulations)
        # None before the first episode.
        self._random_states: list[np.random.RandomState] | None = None
        self._goal_shift = np.zeros(num_simulations)
        self._steps = np.zeros(num_simulations, dtype=int)
        self._action = np.zeros((num_simulations, num_actions))
        self._previous_action = self._action
        # There from the first measurement on.
        self._readings: readings.Readings
        self._wall_force: forces.WallForce

    # The course of an episode.

    def begin(
        self, indices: np.ndarray, random_states: Sequence[np.random.RandomState]
    ) -> None:
        """Draws new episodes and puts the devices to their start.

        A forward pass must follow, then `start`.

        Args:
          indices: (K,) numbers of the simulations, whose state has been reset.
          random_states: N sources of randomness; those of other simulations are left
            alone.
        """
        self._random_states = list(random_states)
        for index in indices:
            self._draw(index, random_states[index])
        self._pose_robot()
        self._objective = together(
            [case.objective for case in self._cases], self._case_of
        )
        if self._config.ranges.goal_shift is not None:
            # Navigation has made sure that it can be shifted.
            shiftable = cast(Shiftable, self._objective)
            self._objective = shiftable.shifted(self._goal_shift)
        self._steps[indices] = 0
        # New arrays: those handed out before stay what they were.
        self._action = self._action.copy()
        self._action[indices] = 0.0
        self._previous_action = self._action

    def _draw(self, index: int, random_state: np.random.RandomState) -> None:
        """Draws the episode of one simulation and puts its device to the start."""
        if len(self._cases) > 1:
            self._case_of[index] = random_state.randint(len(self._cases))
            self._stepper.load(index, self.case(index))
        case = self.case(index)
        episode = self._config.ranges.draw(random_state)
        displacement = case.start.clear_of_wall(episode.displacement)
        number = case.start.draw(random_state)
        qpos = self._state.qpos[index]
        case.start.write(qpos, displacement, episode.roll, number)
        self.take(index, episode, random_state)

    def take(
        self, index: int, episode: Episode, random_state: np.random.RandomState
    ) -> None:
        """Takes what was drawn for one simulation, whose device is at its start.

        Args:
          index: Number of the simulation.
          episode: What was drawn; its displacement is in the state already.
          random_state: Source of what the effects draw.
        """
        case = self.case(index)
        self._effects.restart(index, episode, random_state)
        self._monitor.restart(index, case.scene, episode)
        self._sensors.restart(index, case.angiograph, episode.deviation)
        self._goal_shift[index] = episode.goal_shift or 0.0

    def _pose_robot(self) -> None:
        """Poses the follower's joints after the devices."""
        self._state.qpos[:, self._index.robot_qpos] = self._devices.follower_posture()

    def command(self, action: np.ndarray) -> None:
        """Takes the actions of a control step; its physics steps must follow.

        Args:
          action: (N, A) float64 as `actions.check_action` returns it.
        """
        self._previous_action, self._action = self._action, action
        self._pose_robot()
        self._monitor.before_step(self._stepper.states, action)
        self._stepper.begin(self._effects.act(action, self._readings))

    def start(self, indices: np.ndarray) -> Step:
        """First measurement of new episodes, after the forward pass.

        Args:
          indices: (K,) numbers of the simulations that have begun an episode.

        Returns:
          All simulations as they stand; no episode ends at its start.
        """
        self._measure(self._stepper.still(indices))
        head = self._readings.head
        self._path.restart(indices, head, self._objective.path_distance(head))
        going_on = np.zeros(len(head), dtype=bool)
        return self._step([None] * len(head), indices, going_on)

    def finish(self) -> Step:
        """Measures, judges and observes after the physics steps of a control step."""
        magnitudes, warned = self._stepper.end()
        self._steps += 1
        self._measure(magnitudes)
        self._path.add(self._readings.head)
        errors = self._monitor.errors(
            warned, self._readings.centreline, self._wall_force.peak_max
        )
        return self._step(errors)

    def _measure(self, magnitudes: np.ndarray):
        self._readings = self._views.read()
        self._wall_force = forces.wall_force(magnitudes)

    def _step(
        self,
        errors: Sequence[str | None],
        fresh: np.ndarray | None = None,
        ended: np.ndarray | None = None,
    ) -> Step:
        """Judges and observes what was measured.

        Args:
          errors: N errors of physics, None where there is none.
          fresh: (K,) numbers of simulations that have just begun an episode: only
            their images are captured. None for all, one control step on.
          ended: (N,) bool, None for what the objective and the physics say.
        """
        goal = self._objective.goal
        distance = straight(self._readings.head, goal)
        failed = None
        if errors.count(None) < len(errors):
            failed = np.array([error is not None for error in errors])
        outcome = judge(
            self._objective,
            Measurement(
                self._readings,
                self._wall_force,
                self._action,
                self._previous_action,
                distance,
            ),
            failed,
        )
        terminated = outcome.success.copy() if ended is None else ended
        if failed is not None:
            terminated = terminated | failed
        return Step(
            observation=self._observe(goal, fresh),
            outcome=outcome,
            terminated=terminated,
            truncated=~terminated & (self._steps >= self._config.max_steps),
            errors=tuple(errors),
            readings=self._readings,
            wall_force=self._wall_force,
            distance=distance,
            path_ratio=self._path.ratio,
        )

    def _observe(self, goal: np.ndarray, fresh: np.ndarray | None) -> Observation:
        devices, images = self.devices, NO_IMAGES
        if self._sensors.on:
            images = self._sensors.capture(
                self._readings.centreline,
                self.shadows,
                goal,
                self._state.qpos,
                self._random_states,
                fresh,
                None if devices is None else devices.points,
            )
        state, ahead = self._readings, None
        if self._routes is not None:
            ahead = self._routes.ahead(self._case_of, state.head, state.head_frame)
        frame = Frame(
            state, self._wall_force, self._action, goal, images, ahead, devices
        )
        return observations.observe(self._names, frame)

    # What others may read.

    @property
    def objective(self) -> Objective:
        """Goals, which may differ between simulations, reward and success rule."""
        return self._objective

    def case(self, index: int = 0) -> Case:
        """Anatomy and objective of the episode of one simulation."""
        return self._cases[self._case_of[index]]

    @property
    def case_of(self) -> np.ndarray:
        """(N,) int, number of the case that each simulation has drawn."""
        return self._case_of.copy()

    @property
    def index(self) -> readings.ModelIndex:
        """Places of the task's quantities in the compiled model."""
        return self._index

    @property
    def readings(self) -> readings.Readings:
        """State of the devices after the last step or reset."""
        return self._readings

    @property
    def shadows(self) -> Sequence[Shadow]:
        """The devices as X-rays meet them, with points (N, n, 3)."""
        return self._devices.shadows(self._readings.centreline)

    @property
    def devices(self) -> CoaxialReadings | None:
        """State of coaxial devices after the last step or reset; None for one alone."""
        return self._devices.read(self._readings)

    @property
    def wall_force(self) -> forces.WallForce:
        """Force on the wall over the last step."""
        return self._wall_force

    @property
    def steps(self) -> np.ndarray:
        """Control steps (N,) since each episode began."""
        return self._steps

    @property
    def fluoroscope(self) -> Fluoroscope | None:
        """Frontal C-arm of the first simulation, or None without fluoroscopy."""
        return self._sensors.fluoroscope
