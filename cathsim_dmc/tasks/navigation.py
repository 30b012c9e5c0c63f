"""Navigation of a catheter through an anatomy, as a composer task."""

import dm_env.specs
import mujoco
import numpy as np
from dm_control import composer

from cathsim_dmc.anatomy import Anatomy, Goal
from cathsim_dmc.entities import devices
from cathsim_dmc.entities.catheter import Catheter
from cathsim_dmc.entities.phantom import Phantom
from cathsim_dmc.entities.robot import Robot, follower_posture
from cathsim_dmc.entities.sheath import Sheath
from cathsim_dmc.imaging import angiograph
from cathsim_dmc.tasks import (
    cameras,
    forces,
    image_sensors,
    objectives,
    observations,
    physics_errors,
    placement,
    readings,
    variations,
)
from cathsim_dmc.tasks.config import PHYSICS_TIMESTEP, NavigationConfig
from cathsim_dmc.tasks.scene import Scene

_STATE = mujoco.mjtState.mjSTATE_INTEGRATION.value

__all__ = ["PHYSICS_TIMESTEP", "Navigation", "NavigationConfig"]


class Navigation(composer.Task):
    """Steer the head of a catheter into a branch.

    Action: [-1, 1]^A with A = 21 for the published device: the tip motors from
    proximal to distal (x before y), the translation (1 = 40 mm/s forward) and, with
    `rotation=True`, the rotation of the base (1 = 3.14 rad/s about the device).
    """

    def __init__(
        self,
        anatomy: Anatomy,
        goal: str | Goal,
        config: NavigationConfig | None = None,
        random: np.random.RandomState | int | None = None,
    ):
        """Builds arena, phantom, sheath, catheter and robot.

        Args:
          anatomy: where to navigate.
          goal: name in `anatomy.goals`, or a goal inside the lumen.
          config: options.
          random: seed or source of randomness of the environment.
        """
        self._config = config = config or NavigationConfig()
        self._random_state = (
            random
            if isinstance(random, np.random.RandomState)
            else np.random.RandomState(random)
        )
        self._anatomy = anatomy
        self._goal = placement.resolve_goal(anatomy, goal)
        self._observation_names = observations.resolve(config.observation)
        self._usual_meaning = self._meaning = placement.cannulation_task(
            anatomy,
            self._goal,
            reward=config.reward,
            goal_radius=config.goal_radius,
            max_steps=config.max_steps,
            spare=max((0.0, *(config.randomisation.goal_shift or ()))),
        )
        self._device = devices.get(config.device)
        self._placement = placement.place_device(
            anatomy, self._meaning.route.length, self._device, config.working_length
        )
        self._angiograph = None
        if observations.needs_fluoroscopy(self._observation_names):
            self._angiograph = angiograph.Angiograph(
                anatomy.surface.vertices, anatomy.surface.faces, config.fluoroscopy
            )
        self._scene = Scene.build(anatomy, self._device, self._placement, config)
        if set(cameras.KINDS) & set(self._observation_names):
            cameras.add_tip_camera(self._scene.arena, self._scene.catheter)
        self._num_actions = len(self._scene.catheter.actuators)
        self.set_timesteps(objectives.CONTROL_TIMESTEP, config.physics_timestep)
        self._layout = None
        self._observables = None

    def _restart(self):
        self._outcome = None
        self._readings = None
        self._wall_force = None
        self._observation = None
        self._step = 0
        self._termination = None
        self._error = None
        self._action = np.zeros(self._num_actions)

    # Composer's own interface.

    @property
    def root_entity(self):
        """The arena."""
        return self._scene.arena

    @property
    def task_observables(self):
        """One observable per key of the chosen observations."""
        if self._observables is None:
            entries = observations.entries(
                self._observation_names, self._config.fluoroscopy, self._config.cameras
            )
            self._observables = {
                key: observations.Seen(
                    lambda physics, key=key: self._see(physics)[key], spec
                )
                for key, spec in entries.items()
            }
        return self._observables

    def action_spec(self, physics) -> dm_env.specs.BoundedArray:
        """Bounds [-1, 1] for each actuator."""
        del physics
        names = [actuator.name for actuator in self._scene.catheter.actuators]
        return dm_env.specs.BoundedArray(
            shape=(len(names),),
            dtype=np.float64,
            minimum=-1.0,
            maximum=1.0,
            name="\t".join(names),
        )

    def after_compile(self, physics, random_state):
        """Finds the task's quantities in the new model."""
        del random_state
        model = physics.model.ptr
        self._layout = readings.Layout(
            model,
            self._scene.catheter.mjcf_model.model,
            self._scene.phantom.mjcf_model.model,
        )
        self._substeps = self.substeps  # which asks the MJCF model, and takes its time
        self._robot_qpos = physics.bind(self._scene.robot.joints).qposadr
        self._variation = self.model_variation(model)
        self._screen = self.screen(model, 1)
        self._delay = self.action_delay(1)
        self._monitor = self.monitor(1)
        self._travel = objectives.Travel(1)
        self._state = np.zeros(mujoco.mj_stateSize(model, _STATE))
        self._restart()
        # Composer looks once before the first reset, which must not draw noise.
        self._noise = None
        places = self._layout.wall_contacts
        self._contact_history = forces.ContactHistory(
            self.substeps, places.stop - places.start
        )

    def initialize_episode(self, physics, random_state):
        """Draws what differs between episodes and puts the device to its start."""
        self._restart()
        self._monitor.restart(0)
        self._noise = [random_state]
        episode = self._config.randomisation.draw(random_state)
        model, data = physics.model.ptr, physics.data.ptr
        fields = {name: getattr(model, name) for name in self._variation.fields}
        self._variation.write(fields, episode)
        self._delay.restart(0, episode.delay)
        self._screen.restart(0, episode.deviation)
        if episode.goal_shift is not None:
            self._meaning = self._usual_meaning.shifted(episode.goal_shift)
            goal = self._scene.phantom.goals.get(self._goal.name)
            if goal is not None:  # only looks
                physics.bind(goal).pos = self._meaning.goal
        data.qpos[:] = self.start_qpos(data.qpos, episode.displacement)

    def start_qpos(self, qpos: np.ndarray, displacement: np.ndarray) -> np.ndarray:
        """Start configuration (..., nq) with the tip displaced by (..., 3) m.

        Args:
          qpos: (..., nq), configuration to start from.
          displacement: in the frame of the inlet, whose z points into the lumen.
        """
        qpos = np.array(qpos)
        joints = placement.start_joints(
            self._scene.catheter.link_lengths, self._placement.start_depth, displacement
        )
        columns = np.arange(self._layout.qpos.start, self._layout.qpos.stop)
        names = [joint.name for joint in self._scene.catheter.joints]
        for name, value in joints.items():
            qpos[..., columns[names.index(name)]] = value
        return self.posed_robot(qpos)

    def posed_robot(self, qpos: np.ndarray) -> np.ndarray:
        """Poses the follower's joints after the device, in place: qpos (..., nq)."""
        insertion, rotation = self._layout.insertion_qpos, self._layout.rotation_qpos
        pushed = qpos[..., insertion]
        turned = 0.0 if rotation is None else qpos[..., rotation]
        if qpos.ndim == 1:
            pushed, turned = float(pushed), float(turned)
        qpos[..., self._robot_qpos] = follower_posture(pushed, turned)
        return qpos

    def before_step(self, physics, action, random_state):
        """Applies the action and moves the robot along."""
        del random_state
        self._action = objectives.check_action(action, (self._num_actions,))
        data = physics.data.ptr
        data.ctrl[:] = self._delay.pass_on(self._action[None])[0]
        self.posed_robot(data.qpos)
        if not self._step:
            self._warnings = data.warning.number.tobytes()
            mujoco.mj_getState(physics.model.ptr, data, self._state, _STATE)
        self._monitor.before_step([self._state], [self._action])
        self._contact_history.clear()
        self._substep = 0

    @property
    def physics_steps_per_control_step(self) -> int:
        """What composer is to step: the last two, see `before_substep`."""
        return 2

    @property
    def substeps(self) -> int:
        """Physics steps in a control step."""
        return round(self.control_timestep / self.physics_timestep)

    def before_substep(self, physics, action, random_state):
        """Runs all physics steps of the control step but the two that composer does.

        Composer's bookkeeping between two of them takes as long as a fifth of a free
        step. (With a single one, its schedule of observations takes longer still.)
        The contacts of each are kept, as peaks within the step count.
        """
        del action, random_state
        if self._substep:
            return
        self._substep = self._substeps - self.physics_steps_per_control_step
        model, data = physics.model.ptr, physics.data.ptr
        contacts = data.sensordata[self._layout.wall_contacts]  # not a copy
        for substep in range(self._substep):
            mujoco.mj_step(model, data)
            if contacts[0]:
                self._contact_history.keep(substep, contacts)

    def after_substep(self, physics, random_state):
        """Keeps the contacts of the physics step that composer did."""
        del random_state
        contacts = physics.data.ptr.sensordata[self._layout.wall_contacts]
        self._contact_history.keep(self._substep, contacts)
        self._substep += 1

    def after_step(self, physics, random_state):
        """Decides reward, success and end of the episode, once."""
        del random_state
        self._step += 1
        self._observation = None
        self._measure(physics)
        self._travel.add(self._readings.head[None])
        self._outcome = self._meaning.outcome(self._readings.head)
        warnings = physics.data.ptr.warning.number.tobytes()
        warned, self._warnings = warnings != self._warnings, warnings
        (self._error,) = self._monitor.errors(
            [warned], self._readings.centreline[None], [self._wall_force.peak_max]
        )
        if self._error is not None:
            self._termination = "physics_error"
        elif self._outcome.success:
            self._termination = "success"
        elif self._step >= self._meaning.max_steps:
            self._termination = "truncated"

    def get_reward(self, physics):
        """Reward of the last control step, 0 if the physics failed in it."""
        del physics
        if self._error is not None:
            return 0.0
        return float(self._outcome.reward)

    def get_discount(self, physics):
        """0 at success or an error of physics, 1 otherwise; the time limit keeps 1."""
        del physics
        return 0.0 if self._termination in ("success", "physics_error") else 1.0

    def should_terminate_episode(self, physics):
        """Whether the episode has ended."""
        del physics
        return self._termination is not None

    # Measurement.

    def _measure(self, physics):
        data = physics.data.ptr
        self._readings = self._layout.read(data)
        if not self._step:
            self._contact_history.clear()
            contacts = data.sensordata[self._layout.wall_contacts]
            self._contact_history.keep(-1, contacts)
        self._wall_force = forces.wall_force(self._contact_history.magnitudes())

    def _see(self, physics) -> observations.Observation:
        if self._observation is None:
            if not self._step:
                self._measure(physics)
                head = self._readings.head[None]
                self._travel.restart(np.zeros(1, dtype=int), head, self._meaning)
            picture = self._screen.take(
                self._readings.centreline[None],
                self.goal_position,
                physics.data.ptr.qpos[None],
                self._noise,
                None if self._step else np.zeros(1, dtype=int),
            )
            self._observation = observations.observe(
                self._observation_names,
                observations.Frame(
                    self._readings,
                    self._wall_force,
                    self._action,
                    self.goal_position,
                    picture.of(0),
                ),
            )
        return self._observation

    # What the batched path builds anew for its own simulations.

    def model_variation(self, model) -> variations.ModelVariation:
        """Writes randomised fields of the compiled model."""
        return variations.ModelVariation(
            model,
            self._config.randomisation,
            self._scene.catheter.mjcf_model.model,
            self._scene.phantom.mjcf_model.model,
        )

    def screen(self, model, simulations: int) -> image_sensors.Screen:
        """Takes the pictures of a number of simulations."""
        return image_sensors.Screen(
            self._observation_names,
            self._angiograph,
            self._device.outer_radius,
            simulations,
            image_sensors.open_cameras(
                self._observation_names,
                model,
                self._config.cameras,
                self._scene.catheter.mjcf_model.model,
            ),
        )

    def action_delay(self, simulations: int) -> variations.ActionDelay:
        """Holds back the actions of a number of simulations."""
        return variations.ActionDelay(
            simulations,
            self._num_actions,
            self._config.randomisation.longest_delay,
        )

    def monitor(self, simulations: int) -> physics_errors.Monitor:
        """Watches a number of simulations for errors of physics."""
        return physics_errors.Monitor(
            self._anatomy,
            simulations,
            {
                "anatomy": self._anatomy.name,
                "goal": self._goal.name,
                "config": repr(self._config),
            },
        )

    # What others may read.

    @property
    def config(self) -> NavigationConfig:
        """Options."""
        return self._config

    @property
    def meaning(self) -> objectives.Cannulation:
        """Goal, reward and success rule of the episode."""
        return self._meaning

    @property
    def usual_meaning(self) -> objectives.Cannulation:
        """The same without randomisation."""
        return self._usual_meaning

    @property
    def anatomy(self) -> Anatomy:
        """Lumen, wall and goals."""
        return self._anatomy

    @property
    def goal(self) -> Goal:
        """Where to go."""
        return self._goal

    @property
    def goal_position(self) -> np.ndarray:
        """Position (3,) of the goal in this episode, m, world frame."""
        return self._meaning.goal

    @property
    def goal_radius(self) -> float:
        """δ, m."""
        return self._meaning.goal_radius

    @property
    def placement(self) -> placement.Placement:
        """Where device, sheath and robot stand."""
        return self._placement

    @property
    def fluoroscope(self) -> angiograph.Fluoroscope | None:
        """The frontal C-arm of this episode, or None without such observations."""
        return self._screen.fluoroscope

    @property
    def observation_names(self) -> tuple[str, ...]:
        """Names of the chosen observations."""
        return self._observation_names

    @property
    def catheter(self) -> Catheter:
        """The device."""
        return self._scene.catheter

    @property
    def phantom(self) -> Phantom:
        """Wall, goals and load cell."""
        return self._scene.phantom

    @property
    def robot(self) -> Robot:
        """The follower."""
        return self._scene.robot

    @property
    def sheath(self) -> Sheath:
        """The introducer sheath."""
        return self._scene.sheath

    @property
    def layout(self) -> readings.Layout:
        """Places of the task's quantities in the compiled model."""
        return self._layout

    @property
    def readings(self) -> readings.Readings:
        """State of the device after the last control step."""
        return self._readings

    @property
    def outcome(self) -> objectives.Outcome:
        """Reward terms, distance and success of the last control step."""
        return self._outcome

    @property
    def path_ratio(self) -> float:
        """Way of the head so far over the shortest way to the goal."""
        return float(self._travel.path_ratio[0])

    @property
    def wall_force(self) -> forces.WallForce:
        """Force on the wall over the last control step, N."""
        return self._wall_force

    @property
    def contact_history(self) -> forces.ContactHistory:
        """Contacts with the wall in each physics step of the last control step."""
        return self._contact_history

    @property
    def termination(self) -> str | None:
        """Why the episode ended: "success", "truncated", "physics_error", or None."""
        return self._termination

    @property
    def error(self) -> str | None:
        """What went wrong with the physics, if the episode ended by that."""
        return self._error

    def contacts(self, physics) -> forces.Contacts:
        """Contacts with the wall in the last substep."""
        return self._layout.contacts(physics.data.ptr.sensordata)

    # TorchRL seeds a dm_control environment by replacing `task._random`; composer
    # draws from a RandomState of its own. Both are this one.

    @property
    def random(self) -> np.random.RandomState:
        """Source of randomness of the environment."""
        return self._random_state

    @property
    def _random(self) -> np.random.RandomState:
        return self._random_state

    @_random.setter
    def _random(self, random_state: np.random.RandomState):
        self._random_state.set_state(random_state.get_state())
