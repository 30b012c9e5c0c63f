"""The course of an episode, for any number of simulations and whoever steps them.

    begin → (forward pass) → start → command → (physics steps) → finish → command → …

The composer environment steps a `Rollout` of one simulation, the batched simulation
one of N; so both draw, command, judge and observe alike, bit for bit.
"""

from collections.abc import Sequence
from typing import cast

import mujoco
import numpy as np

from cathsim_dmc.imaging import endoluminal
from cathsim_dmc.imaging.angiograph import Planes
from cathsim_dmc.imaging.device import Shadow
from cathsim_dmc.imaging.fluoroscopy import Fluoroscope
from cathsim_dmc.physics import forces, readings, vessel
from cathsim_dmc.physics.effects import Effects, World
from cathsim_dmc.physics.motion import Moving
from cathsim_dmc.physics.readings import CoaxialReadings
from cathsim_dmc.physics.sliding import SingleDevice
from cathsim_dmc.physics.stepper import CONTROL_TIMESTEP, Stepper
from cathsim_dmc.tasks import observations
from cathsim_dmc.tasks.cases import Case, model_index
from cathsim_dmc.tasks.common_chain import CommonChain
from cathsim_dmc.tasks.config import NavigationConfig
from cathsim_dmc.tasks.frame import Frame
from cathsim_dmc.tasks.image_sensors import ImageSensors
from cathsim_dmc.tasks.measured import Measured, Path, merged
from cathsim_dmc.tasks.objective_pool import part, together
from cathsim_dmc.tasks.objectives import (
    Measurement,
    Objective,
    Shiftable,
    judge,
    straight,
)
from cathsim_dmc.tasks.observation_kind import Observation
from cathsim_dmc.tasks.physics_errors import PhysicsMonitor
from cathsim_dmc.tasks.route import Routes
from cathsim_dmc.tasks.step import Step
from cathsim_dmc.tasks.tracking_noise import TrackingNoise


class Rollout:
    """Episodes of N simulations of one task.

    Attributes:
        index: Places of the task's quantities in the compiled model.
        objective: Goals, which may differ between simulations, reward and success rule.
        steps: Control steps (N,) since each episode began.
        moving: What moves the vessels; None where they rest.
        resting: Readings, with places where they are in the vessel at rest: judged
            there.
    """

    resting: readings.Readings

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
            stepper: Steps the N simulations.
        """
        self._cases = tuple(cases)
        num_simulations = stepper.num_simulations
        self._case_of = np.zeros(num_simulations, dtype=int)
        self.objective: Objective = cases[0].objective
        scene = cases[0].scene
        self._config = config
        self._stepper = stepper
        self._state = state = stepper.arrays
        living = config.vessel_options.living
        self._names = observations.resolve(config.observation, scene.coaxial, living)
        self.index = model_index(scene, model)
        self._read = self.index.reader(state)
        num_actions = len(scene.catheter.action_names)
        listed = config.effects_on(scene.catheter)
        self._listed, stepper.deepest = listed, config.vessel_options.deepest
        moving = [effect for effect in listed if isinstance(effect, Moving)]
        self.moving: Moving | None = moving[0] if moving else None
        self._devices = cast(SingleDevice, listed[-1])
        self._effects = Effects(
            listed,
            World(
                model,
                scene.catheter,
                self.index,
                scene.placement.start_depth,
                state,
                stepper.field,
                state.userdata,
            ),
        )
        for index in range(num_simulations):
            self._effects.enter(index, scene.anatomy)
        self._routes: Routes | None = None
        if observations.needs(self._names, "routed"):
            self._routes = Routes([case.objective for case in cases])
        self._chain = CommonChain(scene.catheter, config.shaft_link)
        self._sensors = ImageSensors(
            self._names,
            cases[0].angiograph,
            num_simulations,
            self._chain,
            self._endoscope,
        )
        self._tracking = TrackingNoise(config.ranges.tracking_noise, num_simulations)
        self._monitor = PhysicsMonitor(scene, num_simulations)
        still = np.zeros((num_simulations, 3))
        self._path = Path(still, still[:, 0], np.ones(num_simulations))
        # None before the first episode.
        self._random_states: list[np.random.RandomState] | None = None
        self._goal_shift = np.zeros(num_simulations)
        self.steps = np.zeros(num_simulations, dtype=int)
        self._action = np.zeros((num_simulations, num_actions))
        self._previous_action = self._action
        # There from the first measurement on.
        self._measured: Measured
        self._errors: tuple[str | None, ...]

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
        self._choose_objective()
        self.steps[indices] = 0
        # New arrays: those handed out before stay what they were.
        self._action = self._action.copy()
        self._action[indices] = 0.0
        self._previous_action = self._action

    def _choose_objective(self) -> None:
        """Takes the objective of each simulation's anatomy, with its goal."""
        self.objective = together(
            [case.objective for case in self._cases], self._case_of
        )
        if self._config.ranges.goal_shift is not None:
            # Navigation has made sure that it can be shifted.
            shiftable = cast(Shiftable, self.objective)
            self.objective = shiftable.shifted(self._goal_shift)

    def _draw(self, index: int, random_state: np.random.RandomState) -> None:
        """Draws the episode of one simulation and puts its device to the start."""
        ranges = self._config.ranges
        number, episode = ranges.draw_in(random_state, len(self._cases))
        if len(self._cases) > 1:
            self.case(index).scene.anatomy.lumen.release()
            self._case_of[index] = number
            self._stepper.load(index, self.case(index))
            self._effects.enter(index, self.case(index).scene.anatomy)
        case = self.case(index)
        posture = case.start.draw(random_state)
        case.start.write(self._state.qpos[index], episode, posture)
        self._effects.restart(index, episode, random_state)
        self._monitor.restart(index, case.scene)
        self._sensors.restart(index, case.angiograph, episode.deviation)
        self._goal_shift[index] = episode.goal_shift or 0.0

    def _pose_robot(self) -> None:
        self._state.qpos[:, self.index.robot_qpos] = self._devices.follower_posture()

    def command(self, action: np.ndarray) -> None:
        """Takes the actions of a control step; its physics steps must follow.

        Args:
            action: (N, A) float64 as `actions.check_action` returns it.
        """
        self._previous_action, self._action = self._action, action
        self._pose_robot()
        self._stepper.begin(self._effects.act(action, self.readings))

    def start(self, indices: np.ndarray) -> Step:
        """First measurement of new episodes, after the forward pass.

        Args:
            indices: (K,) numbers of the simulations that have begun an episode.

        Returns:
            All simulations as they stand; no episode ends at its start.
        """
        self._measure(self._stepper.still(indices), indices)
        head = self.resting.head
        shortest = self.objective.path_distance(head)
        begun = Path(head, np.zeros(len(head)), shortest)
        self._path = merged(self._path, part(begun, indices), indices)
        self._errors = (None,) * len(head)
        return self._step(indices, np.zeros(len(head), dtype=bool))

    def finish(self) -> Step:
        """Measures, judges and observes after the physics steps of a control step."""
        force, warned = self._stepper.end()
        self.steps += 1
        self._measure(force)
        resting = self.resting
        self._path = self._path.to(resting.head)
        self._errors = self._monitor.errors(
            warned, self.steps, resting.centreline, force.peak_max
        )
        return self._step()

    def _measure(self, force: forces.WallForce, rows: np.ndarray | None = None) -> None:
        """Measures all simulations, or some, when the others have not moved."""
        now = self._read()
        time, last = CONTROL_TIMESTEP * self.steps, self._stepper.contact_rows[:, -1]
        vessel_now = vessel.read(self._listed, time, now, last)
        new = Measured(now, force, self._devices.read(now), vessel_now)
        if rows is not None and hasattr(self, "_measured"):
            new = self._measured.updated(new, rows)
        self._measured = new
        self.resting = self._at_rest(self.readings)

    def _at_rest(self, state: readings.Readings) -> readings.Readings:
        """Readings with places where they are in the vessel at rest."""
        return state if self.moving is None else self.moving.at_rest(state)

    def _step(
        self, fresh: np.ndarray | None = None, ended: np.ndarray | None = None
    ) -> Step:
        """Judges and observes what was measured.

        Args:
            fresh: (K,) numbers of simulations that have just begun an episode: only
                their images are captured. None for all, one control step on.
            ended: (N,) bool, None for what the objective and the physics say.
        """
        errors, goal, resting = self._errors, self.objective.goal, self.resting
        distance = straight(resting.head, goal)
        failed = None
        if errors.count(None) < len(errors):
            failed = np.array([error is not None for error in errors])
        outcome = judge(
            self.objective,
            Measurement(
                resting,
                self.wall_force,
                self._action,
                self._previous_action,
                distance,
            ),
            failed,
        )
        terminated = outcome.success if ended is None else ended
        if failed is not None:
            terminated = terminated | failed
        return Step(
            observation=self._observe(self.goal, fresh),
            outcome=outcome,
            terminated=terminated,
            truncated=~terminated & (self.steps >= self._config.max_steps),
            errors=errors,
            readings=self.readings,
            wall_force=self.wall_force,
            distance=distance,
            path_ratio=self._path.ratio,
            vessel=self._measured.vessel,
        )

    def _observe(self, goal: np.ndarray, fresh: np.ndarray | None) -> Observation:
        if self._tracking.on and self._random_states is not None:
            devices = self._measured.devices
            self._tracking.draw(self.readings, devices, self._random_states, fresh)
        state, devices = self._tracking.seen(self.readings, self.devices)
        ahead, images = None, {}
        if self._sensors.on:
            images = self._sensors.capture(
                state.centreline,
                self.shadows,
                goal,
                self._random_states,
                fresh,
                None if devices is None else devices.points,
                None if self.moving is None else self.around,
                self._handles(),
            )
        if self._routes is not None:
            seen = self._at_rest(state) if self._tracking.on else self.resting
            ahead = self._routes.ahead(self._case_of, seen.head, state.head_frame)
        frame = Frame(
            *(state, self.wall_force, self._action, goal, self._chain),
            *(images, ahead, devices, self._measured.vessel),
        )
        return observations.observe(self._names, frame)

    def _handles(self) -> np.ndarray:
        """Orientations (N, 3, 3) of the handles, axes in columns."""
        slide, hinge = self.index.handle_dofs
        z, x = self._state.cdof[:, slide, 3:], self._state.cdof[:, hinge, :3]
        return np.stack([x, np.cross(z, x), z], axis=-1)

    def _endoscope(self, indices: np.ndarray) -> dict[str, np.ndarray]:
        """What the heads of some simulations (K,) see of the wall, by name."""
        moving, state = self.moving, self.readings
        warps = [
            endoluminal.AT_REST if moving is None else moving.warp(i) for i in indices
        ]
        grey, distance = endoluminal.views(
            [self.case(index).scene.anatomy.lumen for index in indices],
            warps,
            state.head[indices],
            state.head_frame[indices],
            self._config.endoluminal_resolution,
        )
        return {"endoluminal": grey, "endoluminal_distance": distance}

    # What others may read.

    @property
    def repeated(self) -> np.ndarray:
        """Number (N,) of control steps done again in shorter physics steps, a view."""
        return self._stepper.repeated

    def case(self, index: int = 0) -> Case:
        """Anatomy and objective of the episode of one simulation."""
        return self._cases[self._case_of[index]]

    @property
    def readings(self) -> readings.Readings:
        """State of the devices after the last step or reset."""
        return self._measured.readings

    @property
    def goal(self) -> np.ndarray:
        """(3,) or (N, 3) m, the goal in space, which moves with its vessel."""
        goal = self.objective.goal
        if self.moving is None:
            return goal
        every = np.broadcast_to(goal, self.readings.head.shape)
        return self.moving.to_space(every.copy())

    @property
    def vessel(self) -> vessel.VesselReadings | None:
        """State of the vessels; None for rigid ones with blood at rest."""
        return self._measured.vessel

    def around(self, planes: Planes, index: int = 0) -> Planes:
        """A machine's planes with one simulation's vessel where it is now."""
        if self.moving is None:
            return planes
        surface = self.moving.surface(index)
        return tuple(plane.around(surface) for plane in planes)

    @property
    def shadows(self) -> Sequence[Shadow]:
        """The devices as X-rays meet them, with points (N, n, 3)."""
        return self._devices.shadows(self.readings.centreline)

    @property
    def devices(self) -> CoaxialReadings | None:
        """State of coaxial devices after the last step or reset; None for one alone."""
        return self._measured.devices

    @property
    def slipped(self) -> np.ndarray:
        """Way by which the clamps have slipped, see `SingleDevice.slipped`."""
        return self._devices.slipped.copy()

    @property
    def wall_force(self) -> forces.WallForce:
        """Force on the wall over the last step."""
        return self._measured.wall_force

    @property
    def fluoroscope(self) -> Fluoroscope | None:
        """Frontal C-arm of the first simulation, or None without fluoroscopy."""
        return self._sensors.fluoroscope
