"""Navigation of a catheter through an anatomy, as a composer task."""

import dataclasses
import logging
from collections.abc import Sequence

import dm_env.specs
import numpy as np
from dm_control import composer
from dm_control.composer.observation import observable

from cathsim_dmc.anatomy import phantom as anatomies
from cathsim_dmc.entities import devices
from cathsim_dmc.entities.arena import AngiographyArena
from cathsim_dmc.entities.catheter import Catheter
from cathsim_dmc.entities.phantom import (
    CONTACT_SOLIMP,
    CONTACT_SOLREF,
    FRICTION,
    Phantom,
)
from cathsim_dmc.entities.robot import Robot, follower_posture
from cathsim_dmc.entities.sheath import Sheath
from cathsim_dmc.imaging import fluoroscopy
from cathsim_dmc.tasks import cannulation, forces, observations, placement, readings

PHYSICS_TIMESTEP = 0.004  # s

_LOG = logging.getLogger(__name__)


@dataclasses.dataclass(frozen=True)
class NavigationConfig:
    """Options of a navigation task; the anatomy and the goal come beside them.

    Attributes:
      observation: name or names in `observations.OBSERVATIONS`.
      device: name in `devices.DEVICES`, or a device.
      rotation: whether the action has a rotation of the base.
      reward: "distance" or "path", see `cannulation.Cannulation`.
      goal_radius: δ, m.
      max_steps: control steps until truncation.
      friction: Coulomb coefficient of device on wall.
      shaft_link: longest link of the shaft, m.
      torsion_joints: torsion hinges along the shaft; None for 4 with rotation and a
        torsionally rigid shaft without.
      working_length: simulated length of the device, m; None for what the goal needs.
      physics_timestep: s.
    """

    observation: str | Sequence[str] = "internal"
    device: str | devices.Device = "published"
    rotation: bool = False
    reward: str = "distance"
    goal_radius: float = cannulation.GOAL_RADIUS
    max_steps: int = cannulation.MAX_STEPS
    friction: float = FRICTION
    shaft_link: float = 0.0175
    torsion_joints: int | None = None
    working_length: float | None = None
    physics_timestep: float = PHYSICS_TIMESTEP


class Navigation(composer.Task):
    """Steer the head of a catheter into a branch.

    Action: [-1, 1]^A with A = 21 for the published device: the tip motors from
    proximal to distal (x before y), the translation (1 = 40 mm/s forward) and, with
    `rotation=True`, the rotation of the base (1 = 3.14 rad/s about the device).
    """

    def __init__(
        self,
        anatomy: anatomies.Anatomy,
        goal: str | anatomies.Goal,
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
        self._meaning = placement.cannulation_task(
            anatomy,
            self._goal,
            reward=config.reward,
            goal_radius=config.goal_radius,
            max_steps=config.max_steps,
        )
        self._device = devices.get(config.device)
        self._placement = placement.place_device(
            anatomy, self._meaning.route.length, self._device, config.working_length
        )
        self._fluoroscope = None
        if observations.needs_images(self._observation_names):
            self._fluoroscope = fluoroscopy.Fluoroscope.from_surface(
                anatomy.surface.vertices, anatomy.surface.faces
            )
        self._build_scene()
        self.set_timesteps(cannulation.CONTROL_TIMESTEP, config.physics_timestep)
        self._layout = None
        self._restart()
        self._observables = None

    def _build_scene(self):
        config, device = self._config, self._device
        area = np.pi * device.outer_radius**2
        self._arena = AngiographyArena(device_density=device.linear_density / area)
        self._phantom = Phantom(
            self._anatomy, config.friction, goal_radius=config.goal_radius
        )
        self._arena.attach(self._phantom)
        torsion = config.torsion_joints
        if torsion is None:
            torsion = 4 if config.rotation else 0
        self._catheter = Catheter(
            device,
            devices.Discretisation(
                working_length=self._placement.working_length,
                shaft_link=config.shaft_link,
                torsion_joints=torsion,
            ),
            stroke=self._placement.stroke,
            rotation=config.rotation,
            solref=CONTACT_SOLREF,
            solimp=CONTACT_SOLIMP,
            friction=config.friction,
        )
        self._sheath = Sheath(
            length=self._placement.working_length - self._placement.start_depth,
            device_radius=device.outer_radius,
            solref=CONTACT_SOLREF,
            solimp=CONTACT_SOLIMP,
        )
        self._robot = Robot(device_radius=device.outer_radius)
        mouth = self._placement
        frame = {"quat": mouth.quaternion}
        self._attach(self._sheath, pos=mouth.inlet, **frame)
        self._attach(self._catheter, pos=mouth.start, **frame)
        self._attach(self._robot, pos=mouth.robot, **frame)
        self._phantom.add_wall_sensor(self._catheter.links[0])
        placement.add_cameras(self._arena, self._anatomy)

    def _attach(self, entity, **frame):
        site = self._arena.mjcf_model.worldbody.add("site", group=5, **frame)
        self._arena.attach(entity, site)

    def _restart(self):
        self._outcome = None
        self._readings = None
        self._contacts = None
        self._wall_force = None
        self._observation = None
        self._images = []
        self._step = 0
        self._termination = None
        self._action = np.zeros(len(self._catheter.actuators))

    # Composer's own interface.

    @property
    def root_entity(self):
        """The arena."""
        return self._arena

    @property
    def task_observables(self):
        """One observable per key of the chosen observations."""
        if self._observables is None:
            keys = self._observation_keys()
            self._observables = {
                key: observable.Generic(lambda physics, k=key: self._see(physics)[k])
                for key in keys
            }
            for each in self._observables.values():
                each.enabled = True
        return self._observables

    def _observation_keys(self) -> list[str]:
        return list(
            observations.observe(
                self._observation_names, self._empty_frame(), self._goal.position
            )
        )

    def _empty_frame(self) -> observations.Frame:
        """A frame of zeros, which has the keys of every other."""
        joints, links = len(self._catheter.joints), len(self._catheter.links)
        zero = np.zeros(())
        state = readings.Readings(
            insertion=zero,
            joint_positions=np.zeros(joints),
            joint_velocities=np.zeros(joints),
            com_inertia=np.zeros((links, 10)),
            com_velocity=np.zeros((links, 6)),
            actuator_force=np.zeros(joints),
            external_force=np.zeros((links, 6)),
            centreline=np.zeros((links + 1, 3)),
            head=np.zeros(3),
            push_force=zero,
            push_torque=zero,
            load_cell=np.zeros(3),
        )
        image = np.zeros((1, 1, 1), dtype=np.uint8)
        return observations.Frame(
            readings=state,
            wall_force=forces.WallForce(zero, zero, zero, zero),
            action=self._action,
            image=image,
            past_images=(image, image),
        )

    def action_spec(self, physics) -> dm_env.specs.BoundedArray:
        """Bounds [-1, 1] for each actuator."""
        del physics
        names = [actuator.name for actuator in self._catheter.actuators]
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
            model, self._catheter.mjcf_model.model, self._phantom.mjcf_model.model
        )
        self._robot_qpos = physics.bind(self._robot.joints).qposadr
        self._restart()
        self._sensor_rows = np.zeros(
            (self.physics_steps_per_control_step, model.nsensordata)
        )

    def initialize_episode(self, physics, random_state):
        """Puts the device to its start, displaced by up to 1 mm."""
        self._restart()
        displacement = cannulation.start_displacement(random_state)
        data = physics.data.ptr
        data.qpos[:] = self.start_qpos(data.qpos, displacement)

    def start_qpos(self, qpos: np.ndarray, displacement: np.ndarray) -> np.ndarray:
        """Start configuration (..., nq) with the tip displaced by (..., 3) m.

        Args:
          qpos: (..., nq), configuration to start from.
          displacement: in the frame of the inlet, whose z points into the lumen.
        """
        qpos = np.array(qpos)
        joints = placement.start_joints(
            self._catheter.link_lengths, self._placement.start_depth, displacement
        )
        columns = np.arange(self._layout.qpos.start, self._layout.qpos.stop)
        names = [joint.name for joint in self._catheter.joints]
        for name, value in joints.items():
            qpos[..., columns[names.index(name)]] = value
        return self.posed_robot(qpos)

    def posed_robot(self, qpos: np.ndarray) -> np.ndarray:
        """Poses the follower's joints after the device, in place: qpos (..., nq)."""
        layout = self._layout
        rotation = layout.rotation_qpos
        qpos[..., self._robot_qpos] = follower_posture(
            qpos[..., layout.insertion_qpos],
            0.0 if rotation is None else qpos[..., rotation],
        )
        return qpos

    def before_step(self, physics, action, random_state):
        """Applies the action and moves the robot along."""
        del random_state
        self._action = cannulation.check_action(action, len(self._catheter.actuators))
        data = physics.data.ptr
        data.ctrl[:] = self._action
        self.posed_robot(data.qpos)
        self._substep = 0

    def after_substep(self, physics, random_state):
        """Keeps the sensors, whose peaks within the control step count."""
        del random_state
        self._sensor_rows[self._substep] = physics.data.ptr.sensordata
        self._substep += 1

    def after_step(self, physics, random_state):
        """Decides reward, success and end of the episode, once."""
        del random_state
        self._step += 1
        self._observation = None
        self._measure(physics)
        self._outcome = self._meaning.outcome(self._readings.head)
        if self._outcome.success:
            self._termination = "success"
        elif self._step >= self._meaning.max_steps:
            self._termination = "truncated"

    def get_reward(self, physics):
        """Reward of the last control step."""
        del physics
        return float(self._outcome.reward)

    def get_discount(self, physics):
        """0 at success, 1 otherwise; the time limit keeps 1."""
        del physics
        return 0.0 if self._termination == "success" else 1.0

    def should_terminate_episode(self, physics):
        """Whether the episode has ended."""
        del physics
        return self._termination is not None

    # Measurement.

    def _measure(self, physics):
        data = physics.data.ptr
        self._readings = self._layout.read(data)
        rows = self._sensor_rows if self._step else data.sensordata[None]
        self._wall_force = forces.wall_force(
            forces.magnitudes(rows[:, self._layout.wall_contacts])
        )

    def _see(self, physics) -> observations.Observation:
        if self._observation is None:
            if not self._step:
                self._measure(physics)
            self._remember_image()
            self._observation = observations.observe(
                self._observation_names, self._frame(), self._goal.position
            )
        return self._observation

    def _remember_image(self):
        if self._fluoroscope is None:
            return
        image = observations.look(
            self._fluoroscope, self._readings, self._device.outer_radius
        )
        if not self._images:
            self._images = [image] * observations.SEQUENCE_LENGTH
        self._images = [image, *self._images[: observations.SEQUENCE_LENGTH - 1]]

    def _frame(self) -> observations.Frame:
        return observations.Frame(
            readings=self._readings,
            wall_force=self._wall_force,
            action=self._action,
            image=self._images[0] if self._images else None,
            past_images=tuple(self._images[1:]),
        )

    # What others may read.

    @property
    def config(self) -> NavigationConfig:
        """Options."""
        return self._config

    @property
    def meaning(self) -> cannulation.Cannulation:
        """Goal, reward and success rule."""
        return self._meaning

    @property
    def anatomy(self) -> anatomies.Anatomy:
        """Lumen, wall and goals."""
        return self._anatomy

    @property
    def goal(self) -> anatomies.Goal:
        """Where to go."""
        return self._goal

    @property
    def goal_position(self) -> np.ndarray:
        """Position (3,) of the goal, m, world frame."""
        return self._goal.position

    @property
    def goal_radius(self) -> float:
        """δ, m."""
        return self._meaning.goal_radius

    @property
    def placement(self) -> placement.Placement:
        """Where device, sheath and robot stand."""
        return self._placement

    @property
    def fluoroscope(self) -> fluoroscopy.Fluoroscope | None:
        """The C-arm of the image observations, or None without them."""
        return self._fluoroscope

    @property
    def observation_names(self) -> tuple[str, ...]:
        """Names of the chosen observations."""
        return self._observation_names

    @property
    def catheter(self) -> Catheter:
        """The device."""
        return self._catheter

    @property
    def phantom(self) -> Phantom:
        """Wall, goals and load cell."""
        return self._phantom

    @property
    def robot(self) -> Robot:
        """The follower."""
        return self._robot

    @property
    def sheath(self) -> Sheath:
        """The introducer sheath."""
        return self._sheath

    @property
    def layout(self) -> readings.Layout:
        """Places of the task's quantities in the compiled model."""
        return self._layout

    @property
    def readings(self) -> readings.Readings:
        """State of the device after the last control step."""
        return self._readings

    @property
    def outcome(self) -> cannulation.Outcome:
        """Reward terms, distance and success of the last control step."""
        return self._outcome

    @property
    def wall_force(self) -> forces.WallForce:
        """Force on the wall over the last control step, N."""
        return self._wall_force

    @property
    def termination(self) -> str | None:
        """Why the episode ended: "success", "truncated", or None while it runs."""
        return self._termination

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
