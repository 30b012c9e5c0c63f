"""Units, ranges and meanings of the entries of an observation, for people to read."""

import dataclasses
import math

from cathsim_dmc.tasks import observations


@dataclasses.dataclass(frozen=True)
class Description:
    """What an entry holds.

    Attributes:
      unit: of its numbers, by part where parts differ.
      meaning: layout and frame.
      low: least value, -inf if there is no bound.
      high: greatest value.
    """

    unit: str
    meaning: str
    low: float = -math.inf
    high: float = math.inf


_GREY = 255
_OPERATOR = {
    "tracking_insertion": Description(
        "m",
        "slide of the base, 0 at the start of the stroke; its stops are soft",
        -0.001,
    ),
    "tracking_action": Description("1", "the last action, zeros after a reset", -1, 1),
}
_POINTS = f"{observations.TRACKED_POINTS} points along the device, proximal to head"

# By observation and key; `<camera>` stands for the name of a camera.
DESCRIPTIONS: dict[str, dict[str, Description]] = {
    "internal": {
        "position": Description(
            "m, rad", "joints in the order of the chain: slide of the base, then hinges"
        ),
        "velocity": Description("m/s, rad/s", "of the same joints"),
        "com_inertia": Description(
            "kg·m², kg·m, kg",
            "10 numbers a link: inertia about the subtree's centre of mass (`cinert`)",
        ),
        "com_velocity": Description(
            "rad/s, m/s", "6 numbers a link: rotation, translation (`cvel`)"
        ),
        "actuator_force": Description("N, N·m", "of the motors, by joint"),
        "external_force": Description(
            "N·m, N", "6 numbers a link: contact torque, contact force (`cfrc_ext`)"
        ),
    },
    "image": {
        "image": Description(
            "grey level", "fluoroscopy, dark = opaque, one channel a plane", 0, _GREY
        )
    },
    "sequential": {
        "sequential": Description(
            "grey level",
            "three consecutive images, oldest first; equal after a reset",
            0,
            _GREY,
        )
    },
    "segmentation": {
        "segmentation": Description(
            "0 or 255", "channels: device, vessel (of each plane)", 0, _GREY
        )
    },
    "tracking": {
        "tracking_points": Description("m", f"{_POINTS}, world frame"),
        "tracking_goal": Description("m", "centre of the goal, world frame"),
        **_OPERATOR,
    },
    "tracking_2d": {
        "tracking_pixels": Description(
            "pixel",
            f"{_POINTS}: column, row (plane by plane); pixel centres are whole numbers",
        ),
        "tracking_goal_pixels": Description("pixel", "goal: column, row"),
        **_OPERATOR,
    },
    "goal": {
        "goal_position": Description("m", "centre of the goal, world frame"),
        "goal_from_head": Description("m", "from the head to the goal, world frame"),
    },
    "force": {
        "wall_force": Description(
            "N",
            "on the wall: sum and largest contact at the end of the step, and their "
            "peaks within it",
            0,
        ),
        "push_force": Description(
            "N, N·m",
            "force and torque of the base on the device, positive forward",
        ),
        "load_cell": Description(
            "N", "force of the phantom on its support, world frame"
        ),
    },
    "rgb": {
        "rgb_<camera>": Description("colour level", "red, green, blue", 0, _GREY),
    },
    "depth": {
        "depth_<camera>": Description("m", "distance along the optical axis", 0),
    },
}
