"""Navigation of a catheter through an anatomy, as a composer task."""

import copy
import dataclasses
import functools
import itertools
from collections.abc import Iterable, Mapping
from typing import Any

import dm_env.specs
import mujoco
import numpy as np
from dm_control import composer

from cathsim_dmc import bounds
from cathsim_dmc.anatomy import Anatomy
from cathsim_dmc.physics import forces, readings
from cathsim_dmc.physics.effects import Effect
from cathsim_dmc.physics.readings import CoaxialReadings, copied, part
from cathsim_dmc.physics.stepper import SingleStepper, Stepper
from cathsim_dmc.tasks import cases, observations, rehearsal
from cathsim_dmc.tasks.common_chain import CommonChain
from cathsim_dmc.tasks.conditions import Conditions
from cathsim_dmc.tasks.config import CONTROL_TIMESTEP, NavigationConfig
from cathsim_dmc.tasks.objectives import Objective
from cathsim_dmc.tasks.observation_kind import FrameObservable, Sizes
from cathsim_dmc.tasks.rollout import Rollout
from cathsim_dmc.tasks.scene import Scene
from cathsim_dmc.tasks.snapshot import NotCopied, Snapshot
from cathsim_dmc.tasks.step import Step, info_types

_ONLY = np.zeros(1, dtype=int)  # number of the one simulation


class Navigation(composer.Task, NotCopied):
    """Composer's hooks over a `Rollout` of one simulation.

    Action: [-1, 1]^A with A = 21 for the published device: the tip motors from
    proximal to distal (x before y), the translation (1 = 40 mm/s forward) and, with
    `rotation=True`, the rotation of the base (1 = 3.14 rad/s about the device).
    Entries outside are clipped; NaN and infinity are refused.

    Reward and success come from the objective alone. The batched path does not call
    these hooks, so it refuses a subclass that overrides one, such as `get_reward`.

    Attributes:
        config: Options.
        options: Options given to `suite.make_task`; empty for a task made without it.
        num_actions: A, entries of an action.
        observation_names: Names of the observations, joined ones included.
        rollout: State of the episode; set when an environment compiles the model.
        stepper: Does the rollout's physics steps; set likewise.
    """

    rollout: Rollout
    stepper: SingleStepper

    def __init__(
        self,
        scene: Scene,
        objective: Objective,
        config: NavigationConfig | None = None,
        random: np.random.RandomState | int | None = None,
        others: Iterable[tuple[Scene, Objective]] | None = None,
        name: str | None = None,
    ):
        """Makes a task of a scene and an objective.

        Args:
            scene: Entities, attached to the arena, and their placement.
            config: Options; those that shape the scene must be the scene's. None for
                the scene's.
            random: Seed or source of randomness of the environment.
            others: Further scenes with their objectives; each episode then draws one
                of all scenes. They have other anatomies, the same device and goals of
                the same names, and no mesh (`drawn=False`). All are compiled here.
            name: Name of the task in texts; None for the name of the class.

        Raises:
            ValueError: if a scene was built with other options, the objective lacks
                something, is that of another scene or does not support the
                randomisation, or the scenes differ in more than their anatomies.
        """
        bounds.instance("scene", scene, Scene)
        config = scene.config if config is None else config
        scene.check(config)
        self.name = name or type(self).__name__
        self.options: dict[str, Any] = {}
        self._scene = scene
        self._objective = objective
        if others is None and (scan := scene.anatomy.scan) is not None:
            places = np.array([scene.anatomy.inlet.position, scene.goal.position])
            aimed = config.fluoroscopy.aimed(scan.vertices, places)
            config = dataclasses.replace(config, fluoroscopy=aimed)
        self.config = config
        self._random_state = bounds.random_state("random", random)
        if others is None:  # `compile_together` checks those of several scenes
            cases.check_objective(objective, scene)
        cases.check_shift(objective, config.randomisation)
        self.num_actions = len(scene.catheter.action_names)
        self.observation_names = observations.resolve(
            config.observation, scene.catheter.coaxial, config.vessel.living
        )
        self.set_timesteps(CONTROL_TIMESTEP, config.physics_timestep)
        self._cases: tuple[cases.Case, ...] = ()
        if others is not None:
            scenes = itertools.chain([(scene, objective)], others)
            self._cases = cases.compile_together(scenes, config)
        self._compiled = False
        self._step: Step | None = None

    def make_rollout(self, model: mujoco.MjModel, stepper: Stepper) -> Rollout:
        """Returns a rollout of the task in the simulations of a stepper.

        Raises:
            ValueError: if a time step has been set since the task was made.
        """
        self.config.check_timesteps(self.control_timestep, self.physics_timestep)
        chosen = self._cases or [
            cases.Case(self._scene, self._objective, model, self.config)
        ]
        names, specs = self.observation_names, self.observation_specs
        return Rollout(chosen, self.config, model, stepper, names, specs)

    @property
    def effects(self) -> list[Effect]:
        """Effects on the simulation, in their order; new objects at each access."""
        return self.config.effects_on(self._scene.catheter)

    @property
    def data_fields(self) -> tuple[str, ...]:
        """Fields of `mujoco.MjData` that an episode reads."""
        own = (name for effect in self.effects for name in effect.data_fields)
        return (*readings.ModelIndex.FIELDS, *own)

    def __repr__(self) -> str:
        """Name, anatomy, goal, device and names of the observations."""
        scene = self.scene
        anatomy = (
            f"{self.num_anatomies} anatomies"
            if self.num_anatomies > 1
            else f"anatomy {scene.anatomy.name!r}"
        )
        inner = " in ".join(repr(device.name) for device in scene.catheter.devices)
        return (
            f"<{self.name}: {anatomy}, goal {scene.goal.name!r} within "
            f"{1e3 * self.objective.goal_radius:g} mm, device {inner}, "
            f"{self.num_actions} actions, observation "
            f"{', '.join(self.observation_names)}>"
        )

    # Composer's hooks.

    @property
    def root_entity(self):
        """The arena."""
        return self._scene.arena

    @functools.cached_property
    def task_observables(self):
        """One observable per entry of the chosen observations."""
        return {
            key: FrameObservable(
                lambda _, key=key: self._current().observation[key][0], spec
            )
            for key, spec in self.observation_specs.items()
        }

    @property
    def observation(self) -> Mapping[str, np.ndarray]:
        """Observation after the last control step or at the start, arrays (1, ...)."""
        # What the rollout observes may share memory with its readings.
        found = self._current().observation
        return {key: np.array(value) for key, value in found.items()}

    @property
    def observation_specs(self) -> dict[str, dm_env.specs.Array]:
        """Spec of each entry of the observation of one simulation."""
        chain, config = self._scene.catheter, self.config
        common = CommonChain(chain, config.shaft_link)
        sizes = Sizes(
            actions=self.num_actions,
            joints=common.num_joints,
            links=common.num_links,
            devices=len(chain.devices) if chain.coaxial else 0,
            fluoroscopy=config.fluoroscopy,
            endoluminal=config.endoluminal_size,
            cameras=config.cameras,
        )
        return observations.entry_specs(self.observation_names, sizes)

    @property
    def info_types(self) -> dict[str, type]:
        """Type of each figure of `info`: float or bool."""
        return info_types(self._objective.terms, self.config.vessel.living)

    def action_spec(self, physics) -> dm_env.specs.BoundedArray:
        """Bounds [-1, 1] for each actuator."""
        names = self._scene.catheter.action_names
        return dm_env.specs.BoundedArray(
            shape=(len(names),),
            dtype=np.float64,
            minimum=np.full(len(names), -1.0),
            maximum=np.full(len(names), 1.0),
            name="\t".join(names),
        )

    def after_compile(self, physics, random_state):
        """Makes the stepper and the rollout of the compiled model."""
        model = physics.model.ptr
        data, fields = physics.data.ptr, self.data_fields
        if rehearsal.is_due(self.config):
            own = copy.copy(model)
            stepper = SingleStepper(own, mujoco.MjData(own), fields, self.substeps)
            rollout = self.make_rollout(own, stepper)
            rehearsal.rehearse(rollout, stepper, self.num_actions)
        self.stepper = SingleStepper(model, data, fields, self.substeps)
        self.rollout = self.make_rollout(model, self.stepper)
        self._compiled, self._step = True, None

    def initialize_episode(self, physics, random_state):
        """Draws the episode and lays the device in its start posture."""
        self._require(physics)
        self._step = None
        self.rollout.begin(_ONLY, [random_state])
        self._place_goal(physics)

    def snapshot(self) -> Snapshot:
        """The state between two steps; see `Environment.snapshot`."""
        if not self._compiled or self.rollout.begun:
            self._current()
        return self.rollout.snapshot(_ONLY)

    def restore(self, physics, snapshot: Snapshot, random_state) -> None:
        """Restores a snapshot; see `Environment.restore`."""
        self._require(physics)
        self._current()  # measures the start if no observable has done so
        self._step = self.rollout.restore(_ONLY, snapshot, [random_state])
        self._place_goal(physics)

    def _require(self, physics) -> None:
        """Raise ValueError unless physics is that of the last environment."""
        if physics.data.ptr is not self.stepper.data:
            raise ValueError(
                f"{self!r} belongs to another environment, which was made of it later; "
                "make a task for each environment, by suite.make_task or suite.load"
            )

    def _place_goal(self, physics) -> None:
        sites = self._scene.phantom.goals
        goal = sites.get(self._scene.goal.name, sites.get("own"))
        if goal is not None and self.config.randomisation.goal_shift:
            physics.bind(goal).pos = self.goal_position

    def before_step(self, physics, action, random_state):
        """Applies the action and moves the robot along."""
        self._require(physics)
        self._measured()  # measures the start if no observable has done so
        self.rollout.command(bounds.actions(action, (self.num_actions,))[None])

    @property
    def substeps(self) -> int:
        """Physics steps in a control step."""
        return self.physics_steps_per_control_step

    def after_substep(self, physics, random_state):
        """Keeps the contacts of a physics step."""
        self.stepper.keep()

    def after_step(self, physics, random_state):
        """Decides reward, success and end of the episode, once."""
        self._step = self.rollout.finish()

    def _current(self) -> Step:
        """Returns the last control step, or measures the start of the episode once."""
        if not self._compiled:
            raise RuntimeError(
                f"{self!r} has no environment yet; make one by suite.environment(task)"
            )
        if self._step is None:
            self._step = self.rollout.start(_ONLY)
        return self._step

    def _measured(self) -> Step:
        """As `_current`; RuntimeError before the first episode."""
        if self._compiled and not self.rollout.begun:
            own = "initialize_episode of a subclass calls that of super()"
            raise RuntimeError(f"no episode has begun; call reset() first; {own}")
        return self._current()

    def get_reward(self, physics) -> float:
        """Reward of the last control step, 0 if the physics failed in it."""
        return float(self._current().outcome.reward[0])

    def get_discount(self, physics) -> float:
        """0 where the task ends the episode; 1 otherwise, also at time-out."""
        return 0.0 if self._current().terminated[0] else 1.0

    def should_terminate_episode(self, physics) -> bool:
        """Whether the episode has ended."""
        return self.termination is not None

    # State of the task.

    @property
    def scene(self) -> Scene:
        """Entities and their placement, in the anatomy of this episode.

        In a batch that draws anatomies, each simulation has its own scene, see
        `Rollout.case`; this is the scene of the task's first anatomy.
        """
        return self.rollout.case().scene if self._compiled else self._scene

    @property
    def anatomies(self) -> list[Anatomy]:
        """Anatomies that an episode draws from."""
        return [case.scene.anatomy for case in self._cases] or [self._scene.anatomy]

    @property
    def num_anatomies(self) -> int:
        """How many anatomies an episode draws from."""
        return len(self._cases) or 1

    @property
    def objective(self) -> Objective:
        """Success and reward, with the goal of this episode."""
        return self.rollout.objectives[0][0] if self._compiled else self._objective

    @property
    def goal_position(self) -> np.ndarray:
        """Position (3,) of the goal now, m, world frame; it moves with its vessel."""
        goal = self.rollout.goal[0] if self._compiled else self._objective.goal
        return goal.copy()

    @property
    def readings(self) -> readings.Readings:
        """State of the device after the last control step, without a leading axis."""
        return copied(part(self._measured().readings, 0))

    @property
    def wall_force(self) -> forces.WallForce:
        """Force on the wall over the last control step, N, without a leading axis."""
        return copied(part(self._measured().wall_force, 0))

    @property
    def devices(self) -> CoaxialReadings | None:
        """State of coaxial devices, without a leading axis; None for a single one."""
        self._measured()
        return copied(part(self.rollout.devices, 0))

    @property
    def termination(self) -> str | None:
        """Why the episode ended: one of `recording.episode.TERMINATIONS`, or None."""
        step = self._step
        if step is None:
            return None
        if step.errors[0] is not None:
            return "physics_error"
        if step.terminated[0]:
            if step.outcome.success[0]:
                return "success"
            return "failed" if step.failed[0] else "given_up"
        return "truncated" if step.truncated[0] else None

    @property
    def error(self) -> str | None:
        """Physics error of the last control step, or None."""
        return None if self._step is None else self._step.errors[0]

    def info(self) -> dict[str, Any]:
        """Figures of the last control step, or of the start; see `Step.info`."""
        found = self._measured().info()
        return {name: value[0].item() for name, value in found.items()}

    @property
    def conditions(self) -> Conditions:
        """Drawn values of the present episode: friction, start, anatomy and others."""
        self._current()
        return self.rollout.conditions()

    def contacts(self, physics) -> forces.Contacts:
        """Contacts with the wall in the last physics step."""
        return self.rollout.index.contacts(physics.data.ptr.sensordata)

    # TorchRL seeds a dm_control environment by replacing `task._random`, and composer
    # draws from a RandomState of its own; both use this source.

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
