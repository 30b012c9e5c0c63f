"""Compiled loop over the drives of simulations; see `drives`."""

from cathsim_dmc.compiled import compiled


@compiled
def follow(qpos, qvel, act, places, constants, told, slipped, command, slip):
    """Corrects servos for their loads, before a control step.

    Args:
        qpos: (N, nq).
        qvel: (N, nv).
        act: (N, na), written.
        places: (3, D) of the drives in these arrays.
        constants: (5, D), gain, stiffness, damping, largest force, and the way of a
            control step at full command.
        told: (N, D), m and rad, written.
        slipped: (N, D), m and rad, written.
        command: (N, D) in [-1, 1].
        slip: (N, D) of zeros, written with the ways by which the clamps have slipped.
    """
    for i in range(len(qpos)):
        for k in range(places.shape[1]):
            gain, stiffness, damping, limit, reach = constants[:, k]
            place = qpos[i, places[0, k]]
            brake = damping * qvel[i, places[1, k]]
            effort = gain * act[i, places[2, k]] - (stiffness * place + brake)
            if abs(effort) >= limit:
                slip[i, k] = told[i, k] - place
                told[i, k] -= slip[i, k]
                slipped[i, k] += abs(slip[i, k])
                effort = min(max(effort, -limit), limit)
            act[i, places[2, k]] = (stiffness * told[i, k] + effort + brake) / gain
            told[i, k] += command[i, k] * reach
