"""Drive of a device: a position servo that follows its command until its clamp slips.

The force of the actuator is K (u - x) - d v, critically damped and limited to the force
at which the clamp slips. u is the integral of the command, at which the platform comes
to rest, plus the compression of the servo under its load. u changes in ramps: where the
commanded speed changes by Δv, a platform of mass m is accelerated by at most
Δv √(K/m) / e. In motion it lags by 2 v √(m/K), and it stops without overshoot. Slip of
the clamp shifts u by the same distance.
"""

from typing import Any, NamedTuple

from cathsim_dmc.compiled import compiled

# Largest speed of a platform that compensates a load, relative to full command.
FASTEST = 1.1


class Servos(NamedTuple):
    """The D servos of a model, arrays (D,).

    Attributes:
        qpos, dof, act: Indices of the joint and its command in MuJoCo's `qpos`, `qvel`
            and `act`.
        gain: Force per `act` (s at full command), N/s or N·m/s.
        stiffness: N/m or N·m/rad.
        damping: Damping, that of an implicit step included (see `hinge_time` of
            `entities.chain`), N·s/m or N·m·s/rad.
        limit: Largest force of the clamp, N or N·m.
        reach: Travel in a control step at full command, m or rad.
        rise: Load change whose compensation in one step moves the platform at its full
            speed, N or N·m.
    """

    qpos: Any
    dof: Any
    act: Any
    gain: Any
    stiffness: Any
    damping: Any
    limit: Any
    reach: Any
    rise: Any


class Told(NamedTuple):
    """Commanded places of the drives of N simulations, arrays (N, D), m and rad.

    Attributes:
        place: Place at which each base comes to rest without a further command.
        slipped: Distance by which each clamp has slipped in the episode.
    """

    place: Any
    slipped: Any


class State(NamedTuple):
    """MuJoCo's state of N simulations, arrays (N, ...)."""

    qpos: Any
    qvel: Any
    act: Any


@compiled
def slip(servos, state, way):
    """Writes the slip (N, D) of the clamps, m and rad.

    Args:
        servos: `Servos`.
        state: `State` after a control step.
        way: (N, D), written; positive where the device is behind the command.
    """
    for i in range(len(way)):
        for k in range(way.shape[1]):
            limit, stiffness = servos.limit[k], servos.stiffness[k]
            pull = servos.gain[k] * state.act[i, servos.act[k]]
            pull -= stiffness * state.qpos[i, servos.qpos[k]]
            pull -= servos.damping[k] * state.qvel[i, servos.dof[k]]
            way[i, k] = (pull - min(max(pull, -limit), limit)) / stiffness


@compiled
def follow(servos, state, command, load, told, way):
    """Subtracts slip from the commands and compensates loads, before a control step.

    Args:
        servos: `Servos`.
        state: `State`; `act` is written.
        command: (N, D) in [-1, 1], of the control step to come.
        load: (N, D), force of each platform on its device, N and N·m.
        told: `Told`, updated.
        way: (N, D), written: slip of the clamps in the last control step, m and rad.
    """
    slip(servos, state, way)
    for i in range(len(command)):
        for k in range(command.shape[1]):
            gain, stiffness = servos.gain[k], servos.stiffness[k]
            at, place = servos.act[k], told.place[i, k]
            speed = stiffness / gain * state.qvel[i, servos.dof[k]]
            rise = max(FASTEST - max(abs(command[i, k]), abs(speed)), 0.0)
            rise *= servos.rise[k]
            borne = gain * state.act[i, at] - stiffness * place
            borne += min(max(load[i, k] - borne, -rise), rise)
            place -= way[i, k]
            told.slipped[i, k] += abs(way[i, k])
            state.act[i, at] = (stiffness * place + borne) / gain
            told.place[i, k] = place + command[i, k] * servos.reach[k]
