"""The table of observations: functions of a `Frame`, with their entries.

To add an observation, write it here as a row.
"""

from operator import attrgetter

import numpy as np

from cathsim_dmc.imaging.options import FARTHEST_WALL
from cathsim_dmc.physics.device_points import DEVICE_PLACES
from cathsim_dmc.tasks import route_observations
from cathsim_dmc.tasks.cameras import FARTHEST
from cathsim_dmc.tasks.common_chain import TRACKED_PLACES
from cathsim_dmc.tasks.observation_kind import (
    COAXIAL,
    FLUOROSCOPY,
    LIVING,
    OPENGL,
    Entry,
    Frame,
    Observation,
    ObservationKind,
    ObservationTable,
    Sizes,
    flat,
)

TRACKED_POINTS = len(TRACKED_PLACES)
SEQUENCE_LENGTH = 3

OBSERVATIONS = ObservationTable()


_actions, _joints, _devices = map(attrgetter, ("actions", "joints", "devices"))


def _fluoroscopic(key: str, channels: int, unit: str, meaning: str) -> Entry:
    """Entry of a fluoroscopic image with `channels` channels for each plane."""

    def shape(sizes: Sizes) -> tuple[int, ...]:
        return (*sizes.fluoroscopy.resolution, sizes.fluoroscopy.planes * channels)

    return Entry(key, shape, unit, meaning, 0, 255, np.uint8)


def _shown(entry: Entry, held: str = "", needs: str = "") -> None:
    """Adds a row of one image; sensors hold it as `held`, or under the entry's key."""
    key, source = entry.key, held or entry.key
    OBSERVATIONS[key] = ObservationKind(
        lambda frame: {key: frame.images[source]}, (entry,), needs
    )


def _action(key: str) -> Entry:
    return Entry(key, _actions, "1", "the last action, 0 after a reset", -1, 1)


_PLACES = ", ".join(f"{1e3 * place:.4g}" for place in TRACKED_PLACES)
_POINTS = f"{TRACKED_POINTS} points along the device, from proximal to the head"
_OPERATOR = (
    Entry(
        "tracking_insertion",
        1,
        "m",
        "position of the base, 0 at the start of its stroke; the stops are soft",
        -0.001,
    ),
    _action("tracking_action"),
)


def _operator(frame: Frame) -> Observation:
    return {
        "tracking_insertion": frame.readings.insertion[..., None],
        "tracking_action": frame.action,
    }


@OBSERVATIONS.row(
    Entry(
        "position",
        _joints,
        "m, rad",
        "of the joints: slides and rotation of the base, torsion, then the bending "
        "hinges; 0 for the hinges proximal of the simulated links",
    ),
    Entry("velocity", _joints, "m/s, rad/s", "of the same joints, in the same order"),
    Entry(
        "com_inertia",
        lambda sizes: 10 * sizes.links,
        "kg·m², kg·m, kg",
        "10 numbers per link: inertia about the device's centre of mass (`cinert`)",
    ),
    Entry(
        "com_velocity",
        lambda sizes: 6 * sizes.links,
        "rad/s, m/s",
        "6 numbers per link: angular, then linear velocity (`cvel`)",
    ),
    Entry("actuator_force", _joints, "N, N·m", "force of the motor of each joint"),
    Entry(
        "external_force",
        lambda sizes: 6 * sizes.links,
        "N·m, N",
        "6 numbers per link: contact torque, then contact force (`cfrc_ext`)",
    ),
    joined=("drives", "devices"),
)
def internal(frame: Frame) -> Observation:
    """State of joints and links, as published."""
    state, chain = frame.readings, frame.chain
    inertia, velocity, force = chain.links(state)
    return {
        "position": chain.joints(state.joint_positions),
        "velocity": chain.joints(state.joint_velocities),
        "com_inertia": flat(inertia, 2),
        "com_velocity": flat(velocity, 2),
        "actuator_force": chain.joints(state.actuator_force),
        "external_force": flat(force, 2),
    }


_shown(
    _fluoroscopic("image", 1, "grey level", "one channel per plane; dark is opaque"),
    held="past_0",
    needs=FLUOROSCOPY,
)


@OBSERVATIONS.row(
    _fluoroscopic(
        "sequential",
        SEQUENCE_LENGTH,
        "grey level",
        "three consecutive images, oldest first; all the same after a reset",
    ),
    needs=FLUOROSCOPY,
)
def sequential(frame: Frame) -> Observation:
    """Three consecutive images, oldest first."""
    ages = reversed(range(SEQUENCE_LENGTH))
    images = [frame.images[f"past_{age}"] for age in ages]
    return {"sequential": np.concatenate(images, axis=-1)}


_shown(
    _fluoroscopic(
        "segmentation", 2, "0 or 255", "channels device and vessel, per plane"
    ),
    held="masks",
    needs=FLUOROSCOPY,
)


@OBSERVATIONS.row(
    Entry(
        "tracking_points",
        3 * TRACKED_POINTS,
        "m",
        f"{_POINTS}: {_PLACES} mm from the head, world frame",
    ),
    Entry("tracking_goal", 3, "m", "centre of the goal, world frame"),
    *_OPERATOR,
    joined=("drives", "devices"),
)
def tracking(frame: Frame) -> Observation:
    """Points along the device in space, the goal, the insertion, the last action."""
    line = frame.readings.centreline
    return {
        "tracking_points": flat(frame.chain.tracked(line), 2),
        "tracking_goal": np.broadcast_to(frame.goal, (*line.shape[:-2], 3)),
        **_operator(frame),
    }


def _pixels(sizes: Sizes) -> int:
    points = TRACKED_POINTS + sizes.devices * len(DEVICE_PLACES)
    return 2 * sizes.fluoroscopy.planes * points


@OBSERVATIONS.row(
    Entry(
        "tracking_pixels",
        _pixels,
        "pixel",
        f"{_POINTS}, then points along each coaxial device: column and row, plane by "
        "plane; pixel centres have integer coordinates",
    ),
    Entry(
        "tracking_goal_pixels",
        lambda sizes: 2 * sizes.fluoroscopy.planes,
        "pixel",
        "column and row of the goal, plane by plane",
    ),
    *_OPERATOR,
    needs=FLUOROSCOPY,
    joined=("drives",),
)
def tracking_2d(frame: Frame) -> Observation:
    """Tracked points and goal in pixels of fluoroscopy."""
    pixels = frame.images["pixels"]
    return {
        "tracking_pixels": flat(pixels[..., :-1, :], 3),
        "tracking_goal_pixels": flat(pixels[..., -1, :], 2),
        **_operator(frame),
    }


route_observations.add_to(OBSERVATIONS)


@OBSERVATIONS.row(
    Entry("goal_position", 3, "m", "centre of the goal, world frame"),
    Entry("goal_from_head", 3, "m", "vector from the head to the goal, world frame"),
)
def goal(frame: Frame) -> Observation:
    """Position of the goal in the world frame, and relative to the head."""
    head = frame.readings.head
    return {
        "goal_position": np.broadcast_to(frame.goal, head.shape),
        "goal_from_head": frame.goal - head,
    }


@OBSERVATIONS.row(
    Entry(
        "wall_force",
        2,
        "N",
        "forces on the wall: sum, and largest contact; means over the control step",
        0,
    ),
    Entry(
        "push_force",
        2,
        "N, N·m",
        "force and torque of the base on the device; a positive force pushes forward",
    ),
    Entry("load_cell", 3, "N", "force of the phantom on its support, world frame"),
)
def force(frame: Frame) -> Observation:
    """Forces on wall, base and support."""
    wall, state = frame.wall_force, frame.readings
    return {
        "wall_force": np.stack([wall.mean_sum, wall.mean_max], axis=-1),
        "push_force": np.stack([state.push_force, state.push_torque], axis=-1),
        "load_cell": state.load_cell,
    }


@OBSERVATIONS.row(
    Entry("heart_phase", 2, "1", "sine and cosine of the phase of the heart", -1, 1),
    Entry("breath_phase", 2, "1", "sine and cosine of the phase of breathing", -1, 1),
    Entry("blood_velocity", 3, "m/s", "velocity of the blood at the head, world frame"),
    Entry(
        "indentation", 1, "m", "indentation of the wall under the deepest contact", 0
    ),
    needs=LIVING,
)
def vessel(frame: Frame) -> Observation:
    """Heart and breathing phase, blood velocity and indentation of a living vessel."""
    state = frame.vessel
    assert state is not None
    phases = 2 * np.pi * np.stack([state.heart_phase, state.breath_phase])
    heart, breath = np.stack([np.sin(phases), np.cos(phases)], axis=-1)
    return {
        "heart_phase": heart,
        "breath_phase": breath,
        "blood_velocity": state.blood_velocity,
        "indentation": state.indentation[..., None],
    }


for _key, _unit, _seen, _high, _dtype in (
    (
        "endoluminal",
        "grey level",
        "image of the wall, lit from the head",
        255,
        np.uint8,
    ),
    (
        "endoluminal_distance",
        "m",
        "distance to the wall along the ray of each pixel",
        FARTHEST_WALL,
        np.float32,
    ),
):
    _seen += (
        "; field of view 90° about the axis of the head, x of the tip frame to the "
    )
    _seen += "right, y down"
    _shown(Entry(_key, lambda s: (*s.endoluminal, 1), _unit, _seen, 0, _high, _dtype))


for _key, _unit, _seen, _planes, _high, _dtype in (
    ("rgb", "colour level", "red, green, blue", 3, 255, np.uint8),
    ("depth", "m", "distance along the optical axis", 1, FARTHEST, np.float32),
):
    _seen += ", of each of MuJoCo's cameras"

    def _size(sizes: Sizes, planes: int = _planes) -> tuple[int, ...]:
        return (*sizes.cameras.size, planes * len(sizes.cameras.names))

    _shown(Entry(_key, _size, _unit, _seen, 0, _high, _dtype), needs=OPENGL)


@OBSERVATIONS.row(
    Entry(
        "device_insertion",
        _devices,
        "m",
        "insertion of the end of each device, from the innermost outwards; 0 is the "
        "position of the most distal end at the start of the stroke",
    ),
    Entry(
        "device_rotation", _devices, "rad", "angle of the rotary unit of each device"
    ),
    needs=COAXIAL,
)
def drives(frame: Frame) -> Observation:
    """Insertion and rotation of each coaxial device."""
    state = frame.devices
    assert state is not None
    return {"device_insertion": state.insertion, "device_rotation": state.rotation}


@OBSERVATIONS.row(
    Entry("device_tip_rotation", _devices, "rad", "rotation of the end of each device"),
    Entry(
        "device_points",
        lambda sizes: 3 * sizes.devices * len(DEVICE_PLACES),
        "m",
        f"{len(DEVICE_PLACES)} points along each device, every "
        f"{1e3 * DEVICE_PLACES[-2]:g} mm, from proximal to its end, world frame",
    ),
    Entry(
        "device_load",
        2,
        "N",
        "axial force in the most distal device, where it leaves the others, and "
        "friction between the devices",
    ),
    needs=COAXIAL,
)
def devices(frame: Frame) -> Observation:
    """Tip rotations and points of the coaxial devices, and the loads on them."""
    state = frame.devices
    assert state is not None
    return {
        "device_tip_rotation": state.tip_rotation,
        "device_points": flat(state.points, 3),
        "device_load": np.stack([state.leading_load, state.lumen_friction], axis=-1),
    }


resolve, observe, needs = OBSERVATIONS.resolve, OBSERVATIONS.observe, OBSERVATIONS.needs
check, with_images = OBSERVATIONS.check, OBSERVATIONS.with_images
entries, entry_specs = OBSERVATIONS.entries, OBSERVATIONS.entry_specs
plain_keys = OBSERVATIONS.plain_keys
