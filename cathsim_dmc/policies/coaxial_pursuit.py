"""Pursuit of a route by coaxial devices that are pushed and rotated at their bases.

Pure functions of arrays with a leading axis N of simulations. The K devices are
numbered from the innermost outwards: a guidewire, and a catheter around it.

**Steering.** A pre-shaped end bends to one side of its device, and rotating the base
rotates that side. Where the route bends away from the axis of the device before its
shaped end, the device is rotated until its side faces the bend, and advances meanwhile.
Twist reaches the end late and in jumps, so the rotation of the end is controlled.

**Guidewire first.** The guidewire advances, and the catheter follows at the lead of the
attempt. With a long lead the guidewire is flexible and follows the vessel; with a short
lead its bend and the catheter's add up to a sharper one.

**Catheter first.** A guidewire hardly enters a take-off that turns back, because its
stiffer shaft comes to lie in the bend. With a negative lead the guidewire stays inside
the catheter. The soft end of the catheter bends to its own shape, hooks the branch and
advances; the guidewire keeps the shaft in the aorta straight.

**In turns.** Where a branch leaves another branch close to its ostium, the catheter
advances first, slowly, its end turned to the branch. Past the branch it is withdrawn
until its end falls into the branch. It advances until it holds there, and the guidewire
continues alone.

**Retries** (`tasks.retry`) change the lead, the look-ahead and the direction. In every
other attempt the head's place on the route does not jump.
"""

import dataclasses

import numpy as np

from cathsim_dmc.entities.chain import MAX_PUSH_SPEED, MAX_ROTATION_SPEED
from cathsim_dmc.physics import forces
from cathsim_dmc.physics.device_points import gaps_of
from cathsim_dmc.physics.readings import CoaxialReadings, Readings
from cathsim_dmc.policies import attempts
from cathsim_dmc.policies.attempts import AttemptSettings, State
from cathsim_dmc.tasks import coaxial_ends, retry, take_offs
from cathsim_dmc.tasks.cases import Case
from cathsim_dmc.tasks.coaxial_ends import CoaxialEnds
from cathsim_dmc.tasks.config import CONTROL_TIMESTEP
from cathsim_dmc.tasks.retry import Memory, RetrySettings
from cathsim_dmc.tasks.route import Place, Route

# Translation (m) and rotation (rad) of a device by a full action in a control step.
_MOVE = MAX_PUSH_SPEED * CONTROL_TIMESTEP
_TURN = MAX_ROTATION_SPEED * CONTROL_TIMESTEP


@dataclasses.dataclass(frozen=True)
class CoaxialSettings(AttemptSettings):
    """Settings of the expert for coaxial devices.

    Attributes:
        gentle: slowest withdrawal, as a fraction of `withdrawal`; contact and push
            force slow a withdrawal as they slow an advance.
        lead_gain: fraction of the lead error that is corrected in a control step.
        aside: angle between route and device above which the device is rotated, rad.
        turning: fraction of the direction error by which a base is rotated in a
            control step.
    """

    retry: RetrySettings = retry.COAXIAL

    creep: float = 0.1
    aligned: float = 0.7
    misaligned: float = 0.0
    press: float = 0.0
    straightening: int = 0
    soft_push: float = 0.12
    hard_push: float = 0.25
    withdrawal: float = 0.4
    gentle: float = 0.5
    lead_gain: float = 0.2
    aside: float = 0.2
    turning: float = 0.2


# For a route whose first two take-offs are close to each other.
CLOSE = CoaxialSettings(aligned=0.9, misaligned=0.3)


@dataclasses.dataclass(frozen=True, eq=False)
class CoaxialPlan(Route):
    """Route and devices of a task with coaxial devices; world frame, SI units.

    Attributes:
        ends: the pre-shaped ends of the devices.
        ostium: arc length up to which the catheter follows, m: that of the first
            take-off, or of the last one close to it.
        settings: of the expert on this route.
    """

    ends: CoaxialEnds
    ostium: float
    settings: CoaxialSettings = CoaxialSettings()

    @classmethod
    def for_case(cls, case: Case) -> "CoaxialPlan":
        """Returns the plan of a case; ValueError if its objective has no route."""
        route = Route.of(case.objective)
        # A flexible guidewire reaches a later take-off better alone.
        ostium, close = take_offs.followed(route)
        return cls(
            **vars(route),
            ends=CoaxialEnds.of(case.scene.catheter),
            ostium=ostium,
            settings=CLOSE if close else cls.settings,
        )

    def fresh(self, shape: tuple[int, ...]) -> State:
        """Returns the state (N,) at the start of an episode."""
        return State.fresh(shape)

    def told(self, state: State, action: np.ndarray) -> State:
        """Returns the state unchanged: it holds no command."""
        return state

    def decide(
        self,
        settings: CoaxialSettings,
        state: State,
        memory: Memory,
        readings: Readings,
        wall_force: forces.WallForce,
        devices: CoaxialReadings,
    ) -> tuple[np.ndarray, State]:
        """Computes one control step of the expert; a pure function.

        Args:
            state: after the last step, arrays (N,).
            memory: of the attempts, arrays (N,).
            readings: of the chain, arrays (N, ...).
            wall_force: arrays (N,); its `mean_max` slows the devices down.

        Returns:
            Action (N, 2 K) in [-1, 1], translation before rotation for each device,
            and the new state.
        """
        place, ahead = attempts.aim(self, settings, state, memory, readings.head)
        error, away = _directions(self, readings, devices, place, ahead)
        error = error + retry.offset(settings.retry, memory)[:, None]
        turns = away > settings.aside
        action = np.zeros((len(error), 2 * error.shape[1]))
        rate = settings.turning * coaxial_ends.wrapped(error) / _TURN
        action[:, 1::2] = np.where(turns, rate, 0.0)
        leader = devices.insertion.argmax(axis=1)[:, None]
        looks = np.where(turns, np.cos(error), 1.0)
        cosine = np.take_along_axis(looks, leader, axis=1)[:, 0]
        contact, push = wall_force.mean_max, readings.push_force
        speed = attempts.translation(settings, memory, contact, push, cosine)
        ease = attempts.ease(settings, push)
        eased = settings.speed * np.maximum(ease, settings.creep)
        ease = np.minimum(ease, attempts.freedom(settings, contact))
        gently = speed * np.maximum(ease, settings.gentle)
        speed = np.where(memory.retracting, gently, np.minimum(speed, eased))
        deep = np.maximum(place.arc_length - self.ostium, 0.0)
        action[:, 0::2] = _led(settings, memory, devices.insertion, speed, deep)
        insertion, arc_length = np.array(readings.insertion), np.array(place.arc_length)
        state = state._replace(arc_length=arc_length, insertion=insertion)
        return np.clip(action, -1.0, 1.0), state


def _led(
    settings: CoaxialSettings,
    memory: Memory,
    insertion: np.ndarray,
    speed: np.ndarray,
    deep: np.ndarray,
) -> np.ndarray:
    """Returns the translations (N, K) that keep the leads.

    The fastest device moves at `speed` (N,). The leads result from slower or withdrawn
    devices, so no device is pushed against a force that slows the fastest, nor pushed
    in a withdrawal. A positive lead is at least `deep` (N,), m, so a guidewire enters a
    branch alone.
    """
    lead = retry.lead(settings.retry, memory)
    lead = np.where(lead > 0.0, np.maximum(lead, deep), lead)[:, None]
    wanted = insertion[:, :1] - lead * np.arange(insertion.shape[1])
    moves = speed[:, None] + settings.lead_gain * (wanted - insertion) / _MOVE
    moves -= moves.max(axis=1, keepdims=True) - speed[:, None]
    # In an advance the others wait; a guidewire with a negative lead is withdrawn.
    back, retracting = 0.5 * settings.withdrawal, memory.retracting[:, None]
    least = np.where(retracting, speed[:, None] - back, np.zeros(moves.shape))
    least[:, :1] -= np.where(~retracting & (lead < 0.0), back, 0.0)
    return np.maximum(moves, least)


def _directions(
    plan: CoaxialPlan,
    readings: Readings,
    devices: CoaxialReadings,
    place: Place,
    ahead: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Returns rotation and angle (N, K) from each end to the route, rad.

    The rotation is about the axis of the device, the angle is to that axis.
    """
    behind = gaps_of(devices.insertion)
    targets = plan.at(place.arc_length[:, None] - behind + ahead[:, None])
    ways = plan.ends.directions(readings, devices.insertion, targets)
    return coaxial_ends.turns(ways, devices.tip_rotation)
