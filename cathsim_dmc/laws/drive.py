"""Drive of a device: a position servo that follows its command until its clamp slips.

The actuator pulls the platform with K (u - x) - d v, critically damped, and with the
force at which the clamp slips at most. u is the integral of the command, by which the
platform comes to rest where it has been told, and what the load on it compresses the
servo by. It moves in ramps, so a platform of mass m is accelerated by Δv √(K/m) / e at
most where the command changes by Δv; in motion it is 2 v √(m/K) behind, and it stops
without turning back. Where the clamp has slipped, so has the command.
"""

from typing import Any, NamedTuple

from cathsim_dmc.compiled import compiled

# Largest speed of a platform that makes up for a load, over that of the full command.
FASTEST = 1.1


class Servos(NamedTuple):
    """The D servos of a model, arrays (D,).

    Attributes:
        qpos, dof, act: Places of joint and command among MuJoCo's `qpos`, `qvel` and
            `act`.
        gain: Force by command, N/m or N·m/rad.
        stiffness: N/m or N·m/rad.
        damping: N·s/m or N·m·s/rad, with that of an implicit step, see `hinge_time` of
            `entities.chain`.
        limit: Largest force of the clamp, N or N·m.
        reach: Way of a control step at full command, m or rad.
        rise: Change of the load that moves the platform with its full speed when it is
            made up for at once, N or N·m.
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
    """What N simulations have been told, arrays (N, D), m and rad.

    Attributes:
        place: Where each base comes to rest if nothing more is commanded.
        slipped: Way by which each clamp has slipped in the episode.
    """

    place: Any
    slipped: Any


class State(NamedTuple):
    """State of N simulations, arrays (N, ...) of MuJoCo's."""

    qpos: Any
    qvel: Any
    act: Any


@compiled
def slip(servos, state, way):
    """Writes the way (N, D) by which clamps have slipped, m and rad.

    Args:
        servos: `Servos`.
        state: `State` after a control step.
        way: (N, D), positive where the device has stayed behind the command.
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
    """Lets clamps slip and makes up for loads, before a control step.

    Args:
        servos: `Servos`.
        state: `State`; `act` changes.
        command: (N, D) in [-1, 1], of the control step to come.
        load: (N, D), force of each platform on its device, N and N·m.
        told: `Told`, which changes.
        way: (N, D), by which the clamps have slipped in the last control step, written.
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
