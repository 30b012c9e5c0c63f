"""Pursuit of a route by a steerable tip: the expert's decisions as pure functions.

Arrays have leading batch axes, written `...`: one simulation, or many side by side.

**Steering.** The head pursues the point of the route at the look-ahead. The rotation
vector that turns the head towards this point, in the world frame, has a component along
each of the two hinges of every tip joint: the bend that this hinge lacks. A positive
`bend_x` turns the distal part from +z towards -y of its link, a positive `bend_y` from
+z towards +x (right-hand rule). Every control step adds a fraction of these bends to
the motor commands, most to the distal joints. As the device advances, the command of a
joint moves to its proximal neighbour, and back as the device is withdrawn (follow the
leader), so the tip keeps the shape of its path.

**Retries** (`tasks.retry`) change the look-ahead. In every other attempt the head's
place on the route does not jump. Before a withdrawal the tip is straightened: a bent
tip is caught at an ostium and snaps out of it.
"""

import dataclasses
from typing import ClassVar

import numpy as np

from cathsim_dmc.entities import devices
from cathsim_dmc.physics import forces
from cathsim_dmc.physics.readings import CoaxialReadings, Readings
from cathsim_dmc.policies import attempts
from cathsim_dmc.policies.attempts import AttemptSettings, State
from cathsim_dmc.tasks.cases import Case
from cathsim_dmc.tasks.coaxial_ends import turned
from cathsim_dmc.tasks.retry import Memory
from cathsim_dmc.tasks.route import Route


@dataclasses.dataclass(frozen=True)
class Settings(AttemptSettings):
    """Settings of the expert for a steerable device.

    None of the values is critical. The published tasks were solved without a retry
    with 0.5 to 1.6 times the gain or the speed, with 0.75 to 1.4 times the look-ahead,
    and with shares from 0.4 to 0.85.

    Attributes:
        gain: fraction of the direction error corrected in a control step. The drives
            and the damping of the tip respond within about 0.25 s, six steps; a gain
            well above 1/6 overshoots.
        share: ratio of a joint's correction to that of its distal neighbour.
        max_bend_rate: largest correction of one hinge in a control step, rad.
    """

    gain: float = 0.12
    share: float = 0.65
    max_bend_rate: float = 0.08


@dataclasses.dataclass(frozen=True, eq=False)
class Plan(Route):
    """Route and device of a task; world frame, SI units.

    Attributes:
        hinges: column in `Readings.joint_positions` and axis (0, 1, 2 for x, y, z) of
            every hinge of the chain, from proximal to distal.
        tip: (M, 2) int, indices in `hinges` of the x and y hinges of the tip motors.
        steering_angle: largest bend of an unloaded joint by its motor, rad.
        link_length: length of the most distal link, m.
        num_actions: number A of entries of an action.
    """

    hinges: tuple[tuple[int, int], ...]
    tip: np.ndarray
    steering_angle: float
    link_length: float
    num_actions: int
    settings: ClassVar = Settings()

    @classmethod
    def for_case(cls, case: Case) -> "Plan":
        """Returns the plan of a case; ValueError if the tip has no motors."""
        catheter = case.scene.catheter
        if not catheter.device.steerable:
            steerable = [d.name for d in devices.DEVICES.values() if d.steerable]
            raise ValueError(
                f"device {catheter.device.name!r} has no motors in its tip, so the "
                f"expert cannot steer it; choose one of {', '.join(steerable)}"
            )
        columns = {joint.name: n for n, joint in enumerate(catheter.joints)}
        found = catheter.mjcf_model.find_all("joint")
        axes = {j.name: int(np.argmax(j.axis)) for j in found if j.type != "slide"}
        numbers = {name: number for number, name in enumerate(axes)}
        motors = [numbers[motor.joint.name] for motor in catheter.tip_motors]
        return cls(
            **vars(Route.of(case.objective)),
            hinges=tuple((columns[name], axis) for name, axis in axes.items()),
            tip=np.array(motors).reshape(-1, 2),
            steering_angle=catheter.device.steering_angle,
            link_length=float(catheter.link_lengths[-1]),
            num_actions=len(catheter.actuators),
        )

    def fresh(self, shape: tuple[int, ...]) -> State:
        """Returns the state (...) at the start of an episode."""
        return State.fresh(shape, len(self.tip))

    def told(self, state: State, action: np.ndarray) -> State:
        """Returns the state with its command replaced by that of an action (..., A)."""
        bend = action[..., : self.tip.size] * self.steering_angle
        return state._replace(bend=bend.reshape(state.bend.shape))

    def decide(
        self,
        settings: Settings,
        state: State,
        memory: Memory,
        readings: Readings,
        wall_force: forces.WallForce,
        devices: CoaxialReadings | None = None,
    ) -> tuple[np.ndarray, State]:
        """Computes one control step of the expert; a pure function.

        Args:
            state: after the last step, arrays (...).
            memory: of the attempts, arrays (...).
            readings: of the devices, arrays (...).
            wall_force: arrays (...); its `mean_max` slows the device down.
            devices: of coaxial devices; not used.

        Returns:
            Action (..., A) in [-1, 1] and the new state.
        """
        place, way = attempts.aim(self, settings, state, memory, readings.head)
        axes, direction = tip_frames(self, readings)
        target = self.at(place.arc_length + way)
        turn, cosine = _rotation_to(direction, target - readings.head)
        bend = _follow_the_leader(self, state, readings.insertion)
        still = memory.retracting | memory.given_up
        correction = _correction(settings, axes, turn)
        left = attempts.relaxed(settings, memory, wall_force.mean_max)[..., None, None]
        bend = left * (bend + np.where(still[..., None, None], 0.0, correction))
        bend = np.clip(bend, -self.steering_angle, self.steering_angle)
        contact, push = wall_force.mean_max, readings.push_force
        speed = attempts.translation(settings, memory, contact, push, cosine)
        action = np.zeros((*speed.shape, self.num_actions))
        motors = self.tip.size
        action[..., :motors] = (bend / self.steering_angle).reshape((*speed.shape, -1))
        action[..., motors] = speed
        insertion, arc_length = np.array(readings.insertion), np.array(place.arc_length)
        return action, State(arc_length, insertion, bend)


def tip_frames(plan: Plan, readings: Readings) -> tuple[np.ndarray, np.ndarray]:
    """Returns the hinge axes of the tip and the direction of the head, world frame.

    They are computed from the head backwards, so they hold for any roll of the device.

    Returns:
        Axes (..., M, 2, 3) of the x and y hinges of the tip and direction (..., 3).
    """
    first, frame = plan.tip.min(), readings.head_frame
    joints, direction = readings.joint_positions, frame[..., 2]
    axes = []
    for column, axis in reversed(plan.hinges[first:]):
        axes.append(frame[..., axis])
        frame = turned(frame, axis, -joints[..., column])
    stacked = np.stack(axes[::-1], axis=-2)
    return stacked[..., plan.tip - first, :], direction


def _rotation_to(direction: np.ndarray, way: np.ndarray) -> tuple[np.ndarray, ...]:
    """Returns the rotation vector (..., 3), rad, from `direction` to `way`; its cosine.

    Args:
        direction: (..., 3), of length 1.
        way: (..., 3), of any length.
    """
    way = way / np.maximum(np.linalg.norm(way, axis=-1, keepdims=True), 1e-9)
    cosine = np.einsum("...i,...i->...", direction, way)
    axis = np.cross(direction, way)
    sine = np.linalg.norm(axis, axis=-1)
    angle = np.arctan2(sine, cosine)
    return axis * (angle / np.maximum(sine, 1e-9))[..., None], cosine


def _follow_the_leader(plan: Plan, state: State, insertion: np.ndarray) -> np.ndarray:
    """Returns the bends (..., M, 2), rad, shifted by the advance of the device."""
    moved = np.where(np.isnan(state.insertion), 0.0, insertion - state.insertion)
    part = np.clip(moved / plan.link_length, -1.0, 1.0)[..., None, None]
    bend = state.bend
    distal = np.concatenate([bend[..., 1:, :], bend[..., -1:, :]], axis=-2)
    proximal = np.concatenate([bend[..., :1, :], bend[..., :-1, :]], axis=-2)
    forward, backward = np.maximum(part, 0.0), np.maximum(-part, 0.0)
    return bend + forward * (distal - bend) + backward * (proximal - bend)


def _correction(settings: Settings, axes: np.ndarray, turn: np.ndarray) -> np.ndarray:
    """Returns the change (..., M, 2) of the bends, rad, that turns the head."""
    weight = settings.share ** np.arange(axes.shape[-3])[::-1]
    weight = settings.gain * weight / weight.sum()
    needed = np.einsum("...jai,...i->...ja", axes, turn)
    limit = settings.max_bend_rate
    return np.clip(weight[:, None] * needed, -limit, limit)
