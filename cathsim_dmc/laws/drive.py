"""Drive of a device: a position servo that follows its command until its clamp slips.

The actuator pulls with K (u - x) - d v, u the place to which its command, integrated,
points, and with the force at which the clamp slips at most. Once in a control step u is
set to where the servo, under its load, holds the base at the place that it has been
told; where the clamp has slipped, that place is where the base stands.
"""

from typing import Any, NamedTuple

from cathsim_dmc.compiled import compiled


class Servos(NamedTuple):
    """The D servos of a model, arrays (D,).

    Attributes:
        qpos, dof, act: Places of joint and command among MuJoCo's `qpos`, `qvel` and
            `act`.
        gain: Force by command, N/m or N·m/rad.
        stiffness: N/m or N·m/rad.
        damping: N·s/m or N·m·s/rad.
        limit: Largest force of the clamp, N or N·m.
        reach: Way of a control step at full command, m or rad.
    """

    qpos: Any
    dof: Any
    act: Any
    gain: Any
    stiffness: Any
    damping: Any
    limit: Any
    reach: Any


class Told(NamedTuple):
    """What N simulations have been told, arrays (N, D), m and rad.

    Attributes:
        place: Where each base is to be.
        slipped: Way by which each clamp has slipped in the episode.
        slip: That of the last control step.
    """

    place: Any
    slipped: Any
    slip: Any


class State(NamedTuple):
    """State of N simulations, arrays (N, ...) of MuJoCo's."""

    qpos: Any
    qvel: Any
    act: Any


@compiled
def follow(servos, state, command, told):
    """Corrects the servos for their loads, before a control step.

    Args:
        servos: `Servos`.
        state: `State`; `act` changes.
        command: (N, D) in [-1, 1], of the control step to come.
        told: `Told`, which changes.
    """
    for i in range(len(command)):
        for k in range(command.shape[1]):
            gain, stiffness = servos.gain[k], servos.stiffness[k]
            limit, at = servos.limit[k], servos.act[k]
            place = state.qpos[i, servos.qpos[k]]
            brake = servos.damping[k] * state.qvel[i, servos.dof[k]]
            effort = gain * state.act[i, at] - (stiffness * place + brake)
            told.slip[i, k] = 0.0
            if abs(effort) >= limit:
                told.slip[i, k] = told.place[i, k] - place
                told.place[i, k] -= told.slip[i, k]
                told.slipped[i, k] += abs(told.slip[i, k])
                effort = min(max(effort, -limit), limit)
            held = stiffness * told.place[i, k] + effort + brake
            state.act[i, at] = held / gain
            told.place[i, k] += command[i, k] * servos.reach[k]
