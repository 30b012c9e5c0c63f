"""Follower of a CathBot-like catheter robot: geometry and joints, no forces.

A main rail carries four platforms. From the patient backwards: front clamps, catheter
rotary unit, rear clamps, guidewire rotary unit. The two pairs of clamps grip one device
in turn while it advances, or one of two devices each; the rotary units turn the devices
and let them slide between rollers.

``+z`` runs along the device towards the patient, the origin is the proximal mouth of
the introducer sheath, ``+y`` is down and ``+x`` the patient's left. `postures` gives
the position of every joint as a function of insertion and rotation, and the task writes
them. The joints bear no load, so they do not move in between.
"""

from pathlib import Path

import numpy as np
from dm_control import composer, mjcf
from numpy.typing import NDArray

from cathsim_dmc import bounds
from cathsim_dmc.compiled import compiled
from cathsim_dmc.entities.device import THICKEST

# The clamp-advance-release cycle, in metres of insertion.
# The stroke fits a rail of 0.35 m, and the clamps change about once a second at the
# fastest push (40 mm/s).
STROKE = 0.040  # m, insertion over which a pair of clamps stays closed
OVERLAP = 0.002  # m, insertion over which both pairs are closed at each change
JAW_TRAVEL = 0.004  # m, insertion during which the jaws open, or close
CYCLE = 2 * (STROKE - OVERLAP)  # m, insertion; the pairs are half a cycle apart
RETURN = CYCLE - STROKE - 2 * JAW_TRAVEL  # m, insertion while a platform returns
JAW_OPENING = 0.005  # m, each jaw, fully open

DEVICE_RADIUS = 0.835e-3  # m, 5 French
ROLLER_RADIUS = 0.005  # m
RING_TEETH, PINION_TEETH = 16, 8
MODEL = Path(__file__).parent / "data" / "robot.xml"

#: Order of the joints in a posture, and in ``Robot.joints``.
JOINTS = (
    *(f"{name}_platform" for name in ("front", "catheter", "rear", "guidewire")),
    *(f"{name}_jaw_{side}" for name in ("front", "rear") for side in ("left", "right")),
    *(
        f"{name}_{wheel}"
        for name in ("catheter", "guidewire")
        for wheel in ("ring", "pinion", "roller_left", "roller_right")
    ),
)


@compiled
def _clamp(insertion, offset):
    """Travel of a clamp pair's platform from home, and opening of each jaw, m.

    A platform moves with the device while its jaws are closed, opening or closing, and
    returns in between.
    """
    # The jaws are closed over phases [0, STROKE].
    phase = (insertion + offset) % CYCLE
    swung = _smoothstep((phase - (STROKE + JAW_TRAVEL)) / RETURN)
    opened = _smoothstep((phase - STROKE) / JAW_TRAVEL)
    closed = _smoothstep((phase - (CYCLE - JAW_TRAVEL)) / JAW_TRAVEL)
    return phase - STROKE / 2 - CYCLE * swung, JAW_OPENING * (opened - closed)


@compiled
def _smoothstep(u):
    """Smoothstep: 0 below 0, 1 above 1, a cubic in between."""
    u = min(max(u, 0.0), 1.0)
    return u * u * (3.0 - 2.0 * u)


@compiled
def postures(given: NDArray[np.float64]) -> NDArray[np.float64]:
    """Joint positions (N, len(JOINTS)) of N followers, m for slides, rad for hinges.

    They are continuous in every argument: angles do not wrap.

    Args:
        given: (4, N), insertion (m) and rotation (rad) since the start of the catheter
            in the front clamps, then of the guidewire in the rear clamps; equal ones if
            both pairs hold the same device.
    """
    count, ratio = given.shape[1], RING_TEETH / PINION_TEETH
    joints = np.empty((count, 16))
    for i in range(count):
        pushed, turned, wire_pushed, wire_turned = given[:, i]
        # Insertion 0 lies in the middle of an overlap: both pairs are closed.
        front, front_opening = _clamp(pushed, OVERLAP / 2)
        rear, rear_opening = _clamp(wire_pushed, OVERLAP / 2 + CYCLE / 2)
        # The catheter unit stays half-way between the clamps, so the free lengths of
        # shaft on both sides are equal; the guidewire unit moves with the rear clamps.
        middle = (front + rear) / 2
        own = joints[i]
        own[0], own[1], own[2], own[3] = front, middle, rear, rear
        own[4:6], own[6:8] = front_opening, rear_opening
        # Ring, pinion and rollers of the two units.
        own[8], own[9] = turned, -turned * ratio
        own[10] = (pushed - middle) / ROLLER_RADIUS
        own[12], own[13] = wire_turned, -wire_turned * ratio
        own[14] = (wire_pushed - rear) / ROLLER_RADIUS
        own[11], own[15] = -own[10], -own[14]
    return joints


@compiled
def pose(qpos, held, joints):
    """Writes the joint positions of N followers whose two pairs hold the same device.

    Args:
        qpos: (N, nq), MuJoCo's, written.
        held: (2,) int, indices in `qpos` of insertion and rotation of the device; a
            negative index means the value 0.
        joints: (len(JOINTS),) int, indices in `qpos` of the joints.
    """
    given = np.zeros((4, len(qpos)))
    for k in range(4):
        for i in range(len(qpos)):
            if held[k % 2] >= 0:
                given[k, i] = qpos[i, held[k % 2]]
    posed = postures(given)
    for i in range(len(qpos)):
        for k in range(len(joints)):
            qpos[i, joints[k]] = posed[i, k]


class Robot(composer.ModelWrapperEntity):
    """The follower; attach it to the arena at the mouth of the introducer sheath.

    Attributes:
        joints: The MJCF joints in the order of ``JOINTS``.
    """

    def _build(self, device_radius: float = DEVICE_RADIUS):
        """Builds the model.

        Args:
            device_radius: radius of the device between jaws and rollers, m.
        """
        most = THICKEST
        bounds.number("device_radius", device_radius, 0.0, most, "m", positive=True)
        root = mjcf.from_path(str(MODEL))
        super()._build(root)
        for joint in JOINTS:
            part, _, side = joint.rpartition("_")
            if side in ("left", "right"):
                body = root.find("body", joint)
                way = device_radius + ROLLER_RADIUS * part.endswith("roller")
                body.pos = (way if side == "left" else -way, 0, body.pos[2])
        self.joints = tuple(root.find("joint", name) for name in JOINTS)
