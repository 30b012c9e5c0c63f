"""The table of observations: what each holds, beside the function that computes it.

An observation is a function of a `Frame`, for one simulation or for many. To add one,
write it here and register it with its entries.
"""

import math
from collections.abc import Callable, Sequence
from typing import cast

import numpy as np
from dm_env import specs

from cathsim_dmc.physics.sliding import DEVICE_PLACES
from cathsim_dmc.tasks.frame import Frame
from cathsim_dmc.tasks.observation_kind import (
    Entry,
    ImageOptions,
    Observation,
    ObservationKind,
)
from cathsim_dmc.tasks.route import AHEAD, into_frame

TRACKED_POINTS = 8
SEQUENCE_LENGTH = 3

OBSERVATIONS: dict[str, ObservationKind] = {}


def _register(*entries: Entry, fluoroscopic: bool = False, routed: bool = False):
    """Puts the decorated function into the table under its own name."""

    def add(function: Callable[[Frame], Observation]):
        OBSERVATIONS[function.__name__] = ObservationKind(
            function, entries, fluoroscopic, routed
        )
        return function

    return add


def _captured(array: np.ndarray | None) -> np.ndarray:
    """What the image sensors took, as they do where an observation asks for it."""
    assert array is not None
    return array


_POINTS = f"{TRACKED_POINTS} points along the device, proximal to head"
_OPERATOR = (
    Entry(
        "tracking_insertion",
        "m",
        "slide of the base, 0 at the start of the stroke; its stops are soft",
        -0.001,
    ),
    Entry("tracking_action", "1", "the last action, zeros after a reset", -1, 1),
)


def _operator(frame: Frame) -> Observation:
    return {
        "tracking_insertion": frame.readings.insertion[..., None],
        "tracking_action": frame.action,
    }


def _flat(array: np.ndarray, axes: int) -> np.ndarray:
    """Joins the last `axes` axes."""
    return array.reshape(array.shape[:-axes] + (-1,))


@_register(
    Entry(
        "position",
        "m, rad",
        "joints in the order of the chain: slide of the base, then hinges",
    ),
    Entry("velocity", "m/s, rad/s", "of the same joints"),
    Entry(
        "com_inertia",
        "kg·m², kg·m, kg",
        "10 numbers a link: inertia about the subtree's centre of mass (`cinert`)",
    ),
    Entry(
        "com_velocity",
        "rad/s, m/s",
        "6 numbers a link: rotation, translation (`cvel`)",
    ),
    Entry("actuator_force", "N, N·m", "of the motors, by joint"),
    Entry(
        "external_force",
        "N·m, N",
        "6 numbers a link: contact torque, contact force (`cfrc_ext`)",
    ),
)
def internal(frame: Frame) -> Observation:
    """State of joints and links, as published."""
    state = frame.readings
    return {
        "position": state.joint_positions,
        "velocity": state.joint_velocities,
        "com_inertia": _flat(state.com_inertia, 2),
        "com_velocity": _flat(state.com_velocity, 2),
        "actuator_force": state.actuator_force,
        "external_force": _flat(state.external_force, 2),
    }


@_register(
    Entry(
        "image",
        "grey level",
        "fluoroscopy, dark = opaque, one channel a plane",
        0,
        255,
        np.uint8,
        lambda options: options.fluoroscopic(1),
    ),
    fluoroscopic=True,
)
def image(frame: Frame) -> Observation:
    """One fluoroscopic image, a channel for each plane."""
    return {"image": _captured(frame.images.image)}


@_register(
    Entry(
        "sequential",
        "grey level",
        "three consecutive images, oldest first; equal after a reset",
        0,
        255,
        np.uint8,
        lambda options: options.fluoroscopic(SEQUENCE_LENGTH),
    ),
    fluoroscopic=True,
)
def sequential(frame: Frame) -> Observation:
    """Three consecutive images, oldest first."""
    images = (*reversed(frame.images.past_images), _captured(frame.images.image))
    return {"sequential": np.concatenate(images, axis=-1)}


@_register(
    Entry(
        "segmentation",
        "0 or 255",
        "channels: device, vessel (of each plane)",
        0,
        255,
        np.uint8,
        lambda options: options.fluoroscopic(2),
    ),
    fluoroscopic=True,
)
def segmentation(frame: Frame) -> Observation:
    """Which pixels show the device, and which the vessel."""
    return {"segmentation": _captured(frame.images.masks)}


def tracked(line: np.ndarray) -> np.ndarray:
    """Tracked points (..., K, 3) of a centreline (..., n, 3).

    Equidistant joints along the steerable part and the shaft next to it, from
    proximal to the head.
    """
    chosen = np.linspace(line.shape[-2] // 2, line.shape[-2] - 1, TRACKED_POINTS)
    return line[..., np.round(chosen).astype(int), :]


@_register(
    Entry("tracking_points", "m", f"{_POINTS}, world frame"),
    Entry("tracking_goal", "m", "centre of the goal, world frame"),
    *_OPERATOR,
)
def tracking(frame: Frame) -> Observation:
    """Points along the device in space, the goal, the insertion, the last action."""
    line = frame.readings.centreline
    return {
        "tracking_points": _flat(tracked(line), 2),
        "tracking_goal": np.broadcast_to(frame.goal, (*line.shape[:-2], 3)),
        **_operator(frame),
    }


@_register(
    Entry(
        "tracking_pixels",
        "pixel",
        f"{_POINTS}: column, row (plane by plane); pixel centres are whole numbers. "
        "Those of each coaxial device follow",
    ),
    Entry("tracking_goal_pixels", "pixel", "goal: column, row"),
    *_OPERATOR,
    fluoroscopic=True,
)
def tracking_2d(frame: Frame) -> Observation:
    """The same points and the goal in pixels, as fluoroscopy shows them."""
    pixels = _captured(frame.images.pixels)
    return {
        "tracking_pixels": _flat(pixels[..., :-1, :], 3),
        "tracking_goal_pixels": _flat(pixels[..., -1, :], 2),
        **_operator(frame),
    }


@_register(
    Entry(
        "route_points",
        "m",
        f"{len(AHEAD)} points of the centreline of the route, every "
        f"{1e3 * AHEAD[1]:g} mm from the place of the head on, tip frame",
    ),
    Entry("route_radii", "m", "of the lumen at these points", 0),
    Entry("route_goal", "m", "centre of the goal, tip frame"),
    Entry(
        "route_device",
        "m",
        f"{TRACKED_POINTS - 1} points along the device, proximal to the head and "
        "without it, tip frame",
    ),
    Entry("route_action", "1", "the last action, zeros after a reset", -1, 1),
    routed=True,
)
def route(frame: Frame) -> Observation:
    """The way ahead as the tip sees it: nothing tells one anatomy from another."""
    ahead, state = frame.ahead, frame.readings
    assert ahead is not None
    head, axes = state.head[..., None, :], state.head_frame
    device = tracked(state.centreline)[..., :-1, :] - head
    goal = np.broadcast_to(frame.goal, state.head.shape)[..., None, :] - head
    return {
        "route_points": _flat(ahead.points, 2),
        "route_radii": ahead.radii,
        "route_goal": into_frame(goal, axes)[..., 0, :],
        "route_device": _flat(into_frame(device, axes), 2),
        "route_action": frame.action,
    }


@_register(
    Entry("goal_position", "m", "centre of the goal, world frame"),
    Entry("goal_from_head", "m", "from the head to the goal, world frame"),
)
def goal(frame: Frame) -> Observation:
    """Where the goal is, in the world and from the head."""
    head = frame.readings.head
    return {
        "goal_position": np.broadcast_to(frame.goal, head.shape),
        "goal_from_head": frame.goal - head,
    }


@_register(
    Entry(
        "wall_force",
        "N",
        "on the wall: sum and largest contact at the end of the step, and their "
        "peaks within it",
        0,
    ),
    Entry(
        "push_force",
        "N, N·m",
        "force and torque of the base on the device, positive forward",
    ),
    Entry("load_cell", "N", "force of the phantom on its support, world frame"),
)
def force(frame: Frame) -> Observation:
    """Force sensing beside any other observation."""
    wall, state = frame.wall_force, frame.readings
    return {
        "wall_force": np.stack(
            [wall.sum, wall.max, wall.peak_sum, wall.peak_max], axis=-1
        ),
        "push_force": np.stack([state.push_force, state.push_torque], axis=-1),
        "load_cell": state.load_cell,
    }


@_register(
    Entry(
        "rgb_<camera>",
        "colour level",
        "red, green, blue",
        0,
        255,
        np.uint8,
        lambda options: (*options.cameras.resolution, 3),
    )
)
def rgb(frame: Frame) -> Observation:
    """Colour images of MuJoCo's cameras."""
    return _views(frame, "rgb")


@_register(
    Entry(
        "depth_<camera>",
        "m",
        "distance along the optical axis",
        0,
        math.inf,
        np.float32,
        lambda options: (*options.cameras.resolution, 1),
    )
)
def depth(frame: Frame) -> Observation:
    """Distance images of MuJoCo's cameras."""
    return _views(frame, "depth")


def _views(frame: Frame, kind: str) -> Observation:
    views = frame.images.views
    return {key: view for key, view in views.items() if key.startswith(kind)}


# What coaxial devices add to the observations of numbers.


def _driven(frame: Frame) -> Observation:
    """How far the operator has pushed and turned each coaxial device."""
    state = frame.devices
    assert state is not None
    return {
        "device_insertion": state.insertion,
        "device_rotation": state.rotation,
    }


def _lying(frame: Frame) -> Observation:
    """Where each coaxial device lies, and what it bears."""
    state = frame.devices
    assert state is not None
    return {
        "device_tip_rotation": state.tip_rotation,
        "device_points": _flat(state.points, 3),
        "device_load": np.stack([state.leading_load, state.lumen_friction], axis=-1),
    }


DRIVEN = ObservationKind(
    _driven,
    (
        Entry(
            "device_insertion",
            "m",
            "of each device from the innermost outwards: way of its end, 0 where the "
            "chain's end is at the start of the stroke",
        ),
        Entry("device_rotation", "rad", "of the rotary unit of each device"),
    ),
)
LYING = ObservationKind(
    _lying,
    (
        Entry("device_tip_rotation", "rad", "of the end of each device"),
        Entry(
            "device_points",
            "m",
            f"{len(DEVICE_PLACES)} points along each device, every "
            f"{1e3 * DEVICE_PLACES[-2]:g} mm, proximal to its end, world frame",
        ),
        Entry(
            "device_load",
            "N",
            "axial force in the device that reaches farthest where it leaves the "
            "others, and friction between the devices that slide",
        ),
    ),
)


_IN_SPACE = {"internal", "tracking", "route"}
_OF_NUMBERS = {*_IN_SPACE, "tracking_2d"}


def _kinds(names: Sequence[str], coaxial: bool) -> list[ObservationKind]:
    kinds = [OBSERVATIONS[name] for name in names]
    if coaxial and _OF_NUMBERS.intersection(names):
        kinds.append(DRIVEN)
        if _IN_SPACE.intersection(names):
            kinds.append(LYING)
    return kinds


# The use of the table.


def resolve(names: str | Sequence[str]) -> tuple[str, ...]:
    """Returns the names of observations as a tuple.

    Raises:
      ValueError: if a name is unknown or comes twice, or if there is none.
    """
    listed = isinstance(names, Sequence) and not isinstance(names, str | bytes)
    chosen = tuple(names) if listed else (names,)
    unknown = [n for n in chosen if not isinstance(n, str) or n not in OBSERVATIONS]
    if unknown or not chosen or len(set(chosen)) < len(chosen):
        raise ValueError(
            f"observation is {names!r}; give one of {', '.join(OBSERVATIONS)}, "
            "or a list of different ones"
        )
    return cast(tuple[str, ...], chosen)


def needs_fluoroscopy(names: Sequence[str]) -> bool:
    """Whether any of the observations needs the angiography machine."""
    return any(OBSERVATIONS[name].fluoroscopic for name in names)


def needs_route(names: Sequence[str]) -> bool:
    """Whether any of the observations needs the route to the goal."""
    return any(OBSERVATIONS[name].routed for name in names)


def observe(names: Sequence[str], frame: Frame) -> Observation:
    """Computes the named observations; arrays may share memory with the frame."""
    observation: Observation = {}
    for kind in _kinds(names, frame.devices is not None):
        observation.update(kind.observe(frame))
    return observation


def entry_specs(
    names: Sequence[str], options: ImageOptions, coaxial: bool = False
) -> dict[str, specs.Array | None]:
    """Keys of the named observations, with the specs of those that are images.

    Args:
      names: of observations.
      options: on which the shapes of images depend.
      coaxial: whether the devices are coaxial ones.
    """
    return {
        key: entry.spec(options)
        for kind in _kinds(names, coaxial)
        for entry in kind.entries
        for key in entry.keys(options)
    }
