"""Compiled loop over the postures of the follower; see `robot`."""

import numpy as np

from cathsim_dmc.compiled import compiled


@compiled
def clamp(insertion, offset, cycle):
    """Travel of a pair's platform from home, and opening of each of its jaws, m.

    A platform moves with the device while its jaws are closed, opening or closing, and
    returns in between:
    ``travel = phase - stroke / 2 - cycle * smoothstep(return progress)``. Position and
    speed are continuous. Both depend on the insertion alone, so a withdrawal reverses
    the motion.
    """
    length, stroke, jaws, back, opening = cycle
    # The jaws are closed over phases [0, stroke].
    phase = (insertion + offset) % length
    swung = smoothstep((phase - (stroke + jaws)) / back)
    opened = smoothstep((phase - stroke) / jaws)
    closed = smoothstep((phase - (length - jaws)) / jaws)
    return phase - stroke / 2 - length * swung, opening * (opened - closed)


@compiled
def smoothstep(u):
    """0 before 0, 1 after 1, and smooth between."""
    u = min(max(u, 0.0), 1.0)
    return u * u * (3.0 - 2.0 * u)


@compiled
def postures(given, phases, cycle, radius, ratio):
    """Joints (N, 16) in the order of `JOINTS`, see `robot.postures`.

    Args:
        given: (4, N), insertion and rotation, and those of the guidewire, m and rad.
        phases: (2) m, of front and rear clamps at insertion 0.
        cycle: (5) m, length of the cycle, insertion over which a pair is closed, in
            which its jaws open and it returns, and opening of a jaw.
        radius: m, of the rollers.
        ratio: teeth of a ring over those of a pinion.
    """
    count = given.shape[1]
    joints = np.empty((count, 16))
    for i in range(count):
        pushed, turned, wire_pushed, wire_turned = given[:, i]
        front, front_opening = clamp(pushed, phases[0], cycle)
        rear, rear_opening = clamp(wire_pushed, phases[1], cycle)
        # The catheter unit stays half-way between the clamps, so the free lengths of
        # shaft on both sides are equal; the guidewire unit moves with the rear clamps.
        middle = (front + rear) / 2
        own = joints[i]
        own[0], own[1], own[2], own[3] = front, middle, rear, rear
        own[4:6], own[6:8] = front_opening, rear_opening
        # Ring, pinion and rollers of the two units.
        own[8], own[9], own[10] = turned, -turned * ratio, (pushed - middle) / radius
        own[12], own[13] = wire_turned, -wire_turned * ratio
        own[14] = (wire_pushed - rear) / radius
        own[11], own[15] = -own[10], -own[14]
    return joints
