"""The sequence of an episode, for N simulations and any stepper.

begin → (forward pass) → start → command → (physics steps) → finish → command → …
"""

import logging
from collections.abc import Mapping, Sequence
from typing import cast

import dm_env.specs
import mujoco
import numpy as np
from numpy.random import RandomState

from cathsim_dmc import bounds
from cathsim_dmc.imaging.angiograph import Deviation, Planes
from cathsim_dmc.imaging.device import Shadow
from cathsim_dmc.physics import forces
from cathsim_dmc.physics import vessel as vessels
from cathsim_dmc.physics.effect_checks import check_action, check_begun
from cathsim_dmc.physics.effects import Layout, World, of_kind
from cathsim_dmc.physics.motion import Moving
from cathsim_dmc.physics.readings import ModelIndex, Readings, merged, part
from cathsim_dmc.physics.single_device import SingleDevice
from cathsim_dmc.physics.stepper import CONTROL_TIMESTEP, Stepper
from cathsim_dmc.tasks import observations, physics_errors
from cathsim_dmc.tasks.cases import Case, objectives_of
from cathsim_dmc.tasks.common_chain import CommonChain
from cathsim_dmc.tasks.conditions import DrawnConditions
from cathsim_dmc.tasks.config import NavigationConfig
from cathsim_dmc.tasks.image_sensors import Exposure, ImageSensors
from cathsim_dmc.tasks.judging import judge, path_distances
from cathsim_dmc.tasks.objectives import Measurement, straight
from cathsim_dmc.tasks.observation_kind import Frame, Observation
from cathsim_dmc.tasks.progress import Progress
from cathsim_dmc.tasks.restorable import Restorable, describe
from cathsim_dmc.tasks.retry import Memory
from cathsim_dmc.tasks.step import Step
from cathsim_dmc.tasks.tracking_noise import TrackingNoise
from cathsim_dmc.tasks.views import Views

_LOG = logging.getLogger(__name__)


class Rollout(Restorable):
    """Episodes of N simulations of one task.

    Attributes:
        index: Indices of the task's quantities in the compiled model.
        effects: Effects on the simulations, in the order in which they act.
        objectives: Objectives with the goals of these episodes, each with the rows of
            its simulations.
        resting_goal: (N, 3) m, goals in the vessel at rest, world frame.
        steps: Control steps (N,) since each episode began.
        deviations: Deviation of each episode's angiography machine from the options.
        moving: Effect that moves the vessels; None if they rest.
        progress: Places of the heads on their routes, and the memory of the attempts.
        readings: State of the devices after the last step or reset.
        resting: These readings, mapped to the vessel at rest, in which they are judged.
        wall_force: Force on the wall over the last step.
        devices: State of coaxial devices; None for a single one.
        vessel: State of the vessels; None for rigid ones with blood at rest.
    """

    state = ("steps", "deviations", "readings", "wall_force", "devices", "vessel")
    state += ("_goal_shift", "_action", "_previous_action", "_way", "_shortest")
    state += ("_errors", "_case_of", "_random_states")  # see `snapshot`
    readings: Readings
    wall_force: forces.WallForce

    def __init__(
        self,
        cases: Sequence[Case],
        config: NavigationConfig,
        model: mujoco.MjModel,
        stepper: Stepper,
        names: Sequence[str],
        specs: Mapping[str, dm_env.specs.Array],
    ):
        """Prepares the rollout; `begin` begins the episodes.

        Args:
            cases: Anatomies with their objectives; if there are several, each episode
                draws one.
            stepper: Steps the N simulations.
            names: Names of the observations, joined ones included.
            specs: Specs of the entries of the observation of one simulation.
        """
        self._cases, self._config, self._stepper = tuple(cases), config, stepper
        count, scene = stepper.num_simulations, cases[0].scene
        self._case_of = np.zeros(count, dtype=int)
        self._names, self._specs = names, specs
        self._state = state = stepper.arrays
        self.index = ModelIndex(model, scene.catheter, scene.robot)
        self._read = self.index.reader(state)
        self.effects = config.effects_on(scene.catheter)
        stepper.deepest, stepper.driven = config.vessel.deepest, self.index.driven
        self.moving = of_kind(self.effects, Moving)
        self._devices = cast(SingleDevice, of_kind(self.effects, SingleDevice))
        self._world = world = World(
            model=model,
            chain=scene.catheter,
            index=self.index,
            start_depth=np.full(count, scene.placement.start_depth),
            stroke=np.full(count, scene.placement.stroke),
            arrays=state,
            field=stepper.field,
            parameters=state.userdata,
        )
        self._layout = Layout(self.effects, world)
        self._description = describe(scene, cases, self.effects, model, config)
        for index in range(count):
            self._enter(index)
        self.progress = Progress(names, cases, count, config.give_up)
        self._chain = CommonChain(scene.catheter, config.shaft_link)
        self._sensors = ImageSensors(names, self._cases, count, self._chain)
        self.views = Views(names, config, world, self.effects, self._cases)
        self._tracking = TrackingNoise(config.randomisation.tracking_noise)
        # None before the first episode.
        self._random_states: list[RandomState] | None = None
        self._goal_shift, self._drawn = np.zeros(count), DrawnConditions(count)
        # Whether a reset or control step has begun and not ended.
        self._open = np.zeros(count, dtype=bool)
        self.deviations = [Deviation()] * count
        self.steps = np.zeros(count, dtype=int)
        self._action = np.zeros((count, len(scene.catheter.action_names)))
        self._previous_action = self._action
        # Length of the head's path so far, and of the route at the start, m.
        self._way, self._shortest = np.zeros(count), np.ones(count)
        self._errors: tuple[str | None, ...] = (None,) * count
        self._choose_objectives()

    def begin(self, indices: np.ndarray, random_states: Sequence[RandomState]) -> None:
        """Draws new episodes and lays the devices in their start posture.

        A forward pass must follow, then `start`.

        Args:
            indices: (K,) numbers of the simulations, whose state has been reset.
            random_states: N sources of randomness; only those of the K are used.
        """
        self._open[indices] = True
        self._random_states = list(random_states)
        self._stepper.restore(indices)
        for index in indices:
            self._draw(index, random_states[index])
        # After `_draw`, because loading an anatomy resets the simulation.
        self._layout.begin(indices)
        for effect in self.effects[-1 - len(self._config.effects) : -1]:
            check_begun(effect, indices)
        self._devices.pose_robot()
        self._choose_objectives()
        self.steps[indices] = 0
        # New arrays, because those returned before must not change.
        self._action = self._action.copy()
        self._previous_action = self._previous_action.copy()
        self._action[indices] = self._previous_action[indices] = 0.0

    def _choose_objectives(self) -> None:
        """Selects the objectives and goals of the simulations' anatomies."""
        shifted = self._config.randomisation.goal_shift is not None
        shift = self._goal_shift if shifted else None
        found = objectives_of(self._cases, self._case_of, shift)
        self.objectives, self.resting_goal = found

    def _draw(self, index: int, random_state: RandomState) -> None:
        """Draws one simulation's episode and lays its device in the start posture."""
        ranges = self._config.randomisation
        number, episode = ranges.draw_in(random_state, len(self._cases))
        if len(self._cases) > 1:
            self._load(index, number)
        case = self.case(index)
        place = case.start.write(self._state.qpos[index], episode, random_state)
        self._drawn.keep(index, episode, place)
        for effect in self.effects:
            effect.restart(index, episode, random_state)
        view, gain, kerma = episode.view, episode.gain, episode.kerma
        self.deviations[index] = Deviation(view[0], view[1], gain, kerma)
        self._place_machine(index)
        self._goal_shift[index] = episode.goal_shift or 0.0

    def _load(self, index: int, number: int) -> None:
        """Loads one of several cases into one simulation."""
        self.case(index).scene.anatomy.lumen.release()
        self._case_of[index] = number
        self._stepper.load(index, self.case(index))
        self._enter(index)

    def _enter(self, index: int) -> None:
        scene = self.case(index).scene
        self._world.start_depth[index] = scene.placement.start_depth
        self._world.stroke[index] = scene.placement.stroke
        for effect in self.effects:
            effect.enter(index, scene.anatomy)

    def command(self, action: np.ndarray) -> None:
        """Applies the actions of a control step; its physics steps must follow.

        Args:
            action: (N, A) float64 as `bounds.actions` returns it.

        Raises:
            RuntimeError: if an error or an interrupt has left the last control step,
                or the beginning of an episode, half done.
        """
        if self._open.any():
            raise RuntimeError(
                "an error or an interrupt has left the last step or reset of "
                f"simulations {bounds.shown(np.flatnonzero(self._open).tolist())} half "
                "done; call reset() first"
            )
        self._open[:] = True
        self._previous_action, self._action = self._action, action
        own = self._config.effects
        if own:  # effects of a user may write into the action
            action = action.copy()
        for effect in self.effects:
            if own and effect is self._devices:
                action = np.clip(action, -1.0, 1.0)
            action = effect.act(action, self.readings)
            if own and effect is not self._devices:
                check_action(effect, action, self._action.shape)
        self._stepper.begin(action)

    def start(self, indices: np.ndarray) -> Step:
        """Measures the start of new episodes, after the forward pass.

        Args:
            indices: (K,) numbers of the simulations that have begun an episode.

        Returns:
            State of all simulations; no episode ends at its start.

        Raises:
            ValueError: if an observation is not as its row declares.
            RuntimeError: if a law has failed in the forward pass.
        """
        self._layout.raise_fault(np.zeros(len(self.steps), dtype=bool))
        # The others have not moved and keep their measurements.
        self._measure(self._stepper.still(indices), indices)
        self._way[indices] = 0.0
        shortest = path_distances(self.objectives, self.resting.head, indices)
        self._shortest[indices] = shortest[indices]
        begun, old = set(indices.tolist()), enumerate(self._errors)
        self._errors = tuple(None if n in begun else error for n, error in old)
        step = self._step(indices, begins=True)
        # Composer observes before the first episode, where nothing has its place.
        placed = indices if self.begun else indices[:0]
        observations.check(step.observation, self._specs, placed)
        self._open[indices] = False
        return step

    def finish(self, *, logs: bool = True) -> Step:
        """Measures, judges and observes after the physics steps of a control step.

        Args:
            logs: whether physics errors are logged.

        Raises:
            RuntimeError: if a law has failed in a physics step.
        """
        force, warned = self._stepper.end()
        self._layout.raise_fault(warned)
        self.steps += 1
        before, everyone = self.resting.head, np.arange(len(self.steps))
        self._measure(force, everyone)
        self._way = self._way + straight(before, self.resting.head)
        old, nodes = self._errors, self.resting.centreline
        self._errors = physics_errors.found(
            self.case, self.steps, nodes, warned, force.peak_max, self._stepper.deepest
        )
        if logs and any(self._errors):
            for error, last, steps in zip(self._errors, old, self.steps, strict=True):
                if error is not None and last is None:
                    _LOG.error("%s after %d steps", error, steps)
        step = self._step(everyone)
        self._open[:] = False
        return step

    def _measure(self, force: forces.WallForce, begun: np.ndarray) -> None:
        """Measures the simulations (K,) that have moved or begun an episode."""
        new = self._read()
        devices = self._devices.read(new)
        if len(begun) < len(self.steps) and "readings" in vars(self):
            # The others keep theirs: a restore recomputes MuJoCo's derived quantities.
            force = merged(self.wall_force, part(force, begun), begun)
            new = merged(self.readings, part(new, begun), begun)
            devices = merged(self.devices, part(devices, begun), begun)
        self.readings, self.devices, self.wall_force = new, devices, force
        self.vessel = None
        if self._config.vessel.living:
            time, last = CONTROL_TIMESTEP * self.steps, self._stepper.last_contacts
            self.vessel = vessels.read(self.effects, time, self.readings, last)
        self.resting = self._at_rest(self.readings)

    def _at_rest(self, state: Readings) -> Readings:
        """Maps readings to the vessel at rest."""
        return state if self.moving is None else self.moving.at_rest(state)

    def _step(self, rows: np.ndarray, begins: bool = False) -> Step:
        """Judges and observes all simulations; captures images of those in `rows`."""
        distance = straight(self.resting.head, self.resting_goal)
        failed = None
        if any(self._errors):
            failed = np.array([error is not None for error in self._errors])
        measured = Measurement(
            self.resting, self.wall_force, self._action, self._previous_action, distance
        )
        outcome = judge(self.objectives, measured, failed)
        observation = self._observe(rows, begins)
        ended = outcome.success | outcome.failed | self.progress.given_up
        ended &= self.steps > 0
        return Step(
            observation=observation,
            outcome=outcome,
            terminated=ended,
            truncated=~ended & (self.steps >= self._config.max_steps),
            errors=self._errors,
            readings=self.readings,
            wall_force=self.wall_force,
            distance=distance,
            path_ratio=self._way / self._shortest,
            vessel=self.vessel,
        )

    def _observe(self, rows: np.ndarray, begins: bool) -> Observation:
        random, sensors, goal = self._random_states, self._sensors, self.goal
        state, devices = self._tracking.seen(self.readings, self.devices, random, rows)
        if sensors.planes and len(rows):
            ends = np.zeros((0, 3)) if devices is None else devices.points
            exposure = Exposure(
                line=state.centreline,
                ends=ends.reshape(len(goal), -1, 3),
                goal=goal,
                shadows=self.shadows,
                handles=self.index.handles(self._state.cdof),
                last=self.progress.steady(rows, begins),
            )
            sensors.capture(rows, begins, exposure, random, self.around)
        if self.views.wanted and len(rows):
            stepper, moving, begun = self._stepper, self.moving, self.begun
            found = self.views.see(
                rows, self._case_of, stepper, self.readings, moving, begun
            )
            for name, view in found.items():
                sensors.hold(name, view, rows)
        seen = self._at_rest(state) if self._tracking.deviation else self.resting
        self.progress.see(rows, begins, self._case_of, seen, sensors.images)
        ahead = self.progress.ahead(self._case_of, seen, devices)
        frame = Frame(
            state, self.wall_force, self._action, goal, self._chain, sensors.images,
            ahead, devices, self.vessel, self.progress.seen(state),
        )  # fmt: skip
        return observations.observe(self._names, frame)

    def _derive(self, indices: np.ndarray) -> Step:
        for index in indices.tolist():
            self._place_machine(index)
        self._sensors.sight.changed(indices)
        self._choose_objectives()
        self.resting = self._at_rest(self.readings)
        self.progress.restart(indices, self._case_of, self.resting)
        return self._step(indices[:0])

    @property
    def memory(self) -> Memory:
        """Memory of the attempts, arrays (N,); made at first use, see `Progress`."""
        return self.progress.remember(self._case_of, vars(self).get("resting"))

    @property
    def begun(self) -> bool:
        """Whether an episode has ever begun; until then there are no readings."""
        return self._random_states is not None

    @property
    def goal(self) -> np.ndarray:
        """(N, 3) m, the goals, world frame; they move with their vessels."""
        goal = self.resting_goal
        return goal if self.moving is None else self.moving.to_space(goal.copy())

    def around(self, planes: Planes, index: int = 0) -> Planes:
        """Returns a machine's planes with one simulation's vessel as moved by now."""
        # The vessel is at rest until an episode has begun.
        if self.moving is None or self._random_states is None:
            return planes
        surface = self.moving.surface(index)
        return tuple(plane.around(surface) for plane in planes)

    @property
    def shadows(self) -> Sequence[Shadow]:
        """X-ray shadows of the devices, with points (N, n, 3), m."""
        courses = self._devices.courses(self.readings.centreline)
        return [device.shadow(points) for device, points in courses]

    @property
    def slipped(self) -> np.ndarray:
        """Slip of the drives' clamps (N, D), m and rad, see `SingleDevice.slipped`."""
        return self._devices.slipped.copy()
