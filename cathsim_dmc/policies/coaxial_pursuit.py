"""Pursuit of a route by coaxial devices that are pushed and turned at their bases.

Pure functions of arrays with a leading axis N of simulations; K devices, numbered from
the innermost outwards, which leads: a guidewire, and a catheter around it.

**Steering.** A pre-shaped end leads to one side of its device, and turning the base
turns that side. Where the route bends away from how a device lies before its shaped
end, the device is turned until its side looks there, and advances as that comes about.
Twist reaches the end late and in leaps, so it is the rotation of the end that counts.

**Wire first, catheter after.** The wire goes ahead, the catheter follows at the lead
of the attempt. Far ahead the wire is limp and follows the vessel; close ahead its bend
and the catheter's add up to a sharper one.

**Or the catheter alone.** Into a take-off that turns back on the way there, a wire
leads badly: its shaft, the stiffer one, comes to lie in the bend. With a negative lead
the wire stays behind in the catheter, whose soft end takes its shape, hooks the branch
and goes up; the wire holds the shaft in the aorta straight.

**Or in turns.** Where a branch leaves another one close to its ostium, the catheter
goes first, its end turned to the branch, slowly. When it has passed the branch, it
comes back until its end falls in. It goes up far enough to hold there, and the wire
goes on from it alone.

**Retries** (`tasks.retry`) have another lead, look-ahead and direction, and every other
time no jumps of the head's place on the route.
"""

import dataclasses

import numpy as np

from cathsim_dmc.entities.chain import MAX_PUSH_SPEED, MAX_ROTATION_SPEED
from cathsim_dmc.physics import forces
from cathsim_dmc.physics.readings import CoaxialReadings, Readings
from cathsim_dmc.policies import attempts
from cathsim_dmc.policies.attempts import AttemptSettings, State
from cathsim_dmc.tasks import coaxial_ends, retry, take_offs
from cathsim_dmc.tasks.cases import Case
from cathsim_dmc.tasks.coaxial_ends import CoaxialEnds
from cathsim_dmc.tasks.config import CONTROL_TIMESTEP
from cathsim_dmc.tasks.retry import Memory, RetrySettings
from cathsim_dmc.tasks.route import Place, Route

# What a full action moves (m) and turns (rad) a device by in a control step.
_MOVE = MAX_PUSH_SPEED * CONTROL_TIMESTEP
_TURN = MAX_ROTATION_SPEED * CONTROL_TIMESTEP


@dataclasses.dataclass(frozen=True)
class CoaxialSettings(AttemptSettings):
    """Settings of the expert of coaxial devices.

    Attributes:
        gentle: slowest withdrawal, as a part of `withdrawal`; the forces that slow an
            advance slow it.
        lead_gain: share of the error of the lead corrected in a control step.
        aside: by how much the route must bend away for a device to be turned, rad.
        turning: share of the error of direction that a base is turned by in a control
            step.
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


# Of a route whose first two take-offs are close to each other.
CLOSE = CoaxialSettings(aligned=0.9, misaligned=0.3)


@dataclasses.dataclass(frozen=True)
class CoaxialPlan(Route):
    """Route and devices of a task with coaxial devices; world frame, SI units.

    Attributes:
        ends: the pre-shaped ends of the devices.
        ostium: arc length of the first take-off, or of one that follows close to it;
            up to there the catheter follows.
        settings: of the expert on this route.
    """

    ends: CoaxialEnds
    ostium: float
    settings: CoaxialSettings = CoaxialSettings()

    @classmethod
    def for_case(cls, case: Case) -> "CoaxialPlan":
        """Reads off an anatomy of a task."""
        route = Route.of(case.objective)
        # To a take-off farther on, a limp wire goes better alone.
        ostium, close = take_offs.followed(route)
        return cls(
            **vars(route),
            ends=CoaxialEnds.of(case.scene.catheter),
            ostium=ostium,
            settings=CLOSE if close else cls.settings,
        )

    def fresh(self, shape: tuple[int, ...]) -> State:
        """Memory (N,) at the start of an episode."""
        return State.fresh(shape)

    def told(self, state: State, action: np.ndarray) -> State:
        """The memory as it is, which no action is part of."""
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
        """One control step of the expert: a pure function.

        Args:
            state: after the last step, arrays (N,).
            memory: of the attempts, arrays (N,).
            readings: of the chain, arrays (N, ...).
            wall_force: arrays (N,); its `mean_max` slows the devices down.

        Returns:
            Action (N, 2 K) in [-1, 1] and the new state.
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
    """Translations (N, K) at the leads; a leading wire deep in a branch goes alone.

    The fastest device moves at `speed` (N,). The leads come about as others are slower
    or withdrawn, so that none is pushed against a force that slows the first, nor at
    all in a withdrawal.
    """
    lead = retry.lead(settings.retry, memory)
    lead = np.where(lead > 0.0, np.maximum(lead, deep), lead)[:, None]
    wanted = insertion[:, :1] - lead * np.arange(insertion.shape[1])
    moves = speed[:, None] + settings.lead_gain * (wanted - insertion) / _MOVE
    moves -= moves.max(axis=1, keepdims=True) - speed[:, None]
    # While one goes on, the other waits for it; a wire that is to be behind comes back.
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
    """Rotations (N, K) of the ends to the route, and its bends (N, K) away, rad."""
    behind = coaxial_ends.gaps(devices.insertion)
    targets = plan.at(place.arc_length[:, None] - behind + ahead[:, None])
    ways = plan.ends.directions(readings, devices.insertion, targets)
    return coaxial_ends.turns(ways, devices.tip_rotation)
