"""Observations of a task as functions of a frame, for one simulation or for many."""

from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from dm_control.composer.observation import observable
from dm_env import specs

from cathsim_dmc.imaging.options import FluoroscopyOptions
from cathsim_dmc.tasks import forces, readings
from cathsim_dmc.tasks.cameras import CameraOptions

TRACKED_POINTS = 8
SEQUENCE_LENGTH = 3

Observation = dict[str, np.ndarray]


class Picture(NamedTuple):
    """What is on the operator's screen; None where no observation needs it.

    Attributes:
      image: (..., H, W, P) uint8, fluoroscopy of P planes.
      past_images: the same, one and two control steps before, newest first.
      masks: (..., H, W, 2 P) uint8, see `imaging.angiograph.masks`.
      pixels: (..., P, K + 1, 2), tracked points and goal, (column, row).
      views: pictures of MuJoCo's cameras by key.
    """

    image: np.ndarray | None = None
    past_images: tuple[np.ndarray, ...] = ()
    masks: np.ndarray | None = None
    pixels: np.ndarray | None = None
    views: Mapping[str, np.ndarray] = MappingProxyType({})

    def of(self, index: int) -> "Picture":
        """The picture of one of many simulations."""
        if self is DARK:
            return self
        return Picture(
            image=None if self.image is None else self.image[index],
            past_images=tuple(image[index] for image in self.past_images),
            masks=None if self.masks is None else self.masks[index],
            pixels=None if self.pixels is None else self.pixels[index],
            views={key: view[index] for key, view in self.views.items()},
        )


# A screen that is off.
DARK = Picture()


class Frame(NamedTuple):
    """What there is to observe after a control step.

    Attributes:
      readings: state of the device.
      wall_force: on the wall over the control step.
      action: (..., A), the action that was asked for, zeros after a reset.
      goal: (3,) or (..., 3), m.
      picture: on the operator's screen.
    """

    readings: readings.Readings
    wall_force: forces.WallForce
    action: np.ndarray
    goal: np.ndarray
    picture: Picture = DARK


def _flat(array: np.ndarray, axes: int) -> np.ndarray:
    """Joins the last `axes` axes."""
    return array.reshape(*array.shape[: array.ndim - axes], -1)


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


def image(frame: Frame) -> Observation:
    """One fluoroscopic image, a channel for each plane."""
    return {"image": frame.picture.image}


def sequential(frame: Frame) -> Observation:
    """Three consecutive images, oldest first."""
    images = (*reversed(frame.picture.past_images), frame.picture.image)
    return {"sequential": np.concatenate(images, axis=-1)}


def segmentation(frame: Frame) -> Observation:
    """Which pixels show the device, and which the vessel."""
    return {"segmentation": frame.picture.masks}


def tracked(line: np.ndarray) -> np.ndarray:
    """Tracked points (..., K, 3) of a centreline (..., n, 3).

    Equidistant joints along the steerable part and the shaft next to it, from
    proximal to the head.
    """
    chosen = np.linspace(line.shape[-2] // 2, line.shape[-2] - 1, TRACKED_POINTS)
    return line[..., np.round(chosen).astype(int), :]


def tracking(frame: Frame) -> Observation:
    """Points along the device in space, the goal, the insertion, the last action."""
    line = frame.readings.centreline
    return {
        "tracking_points": _flat(tracked(line), 2),
        "tracking_goal": np.broadcast_to(frame.goal, (*line.shape[:-2], 3)),
        **_operator(frame),
    }


def tracking_2d(frame: Frame) -> Observation:
    """The same points and the goal in pixels, as seen on the screen."""
    pixels = frame.picture.pixels
    return {
        "tracking_pixels": _flat(pixels[..., :-1, :], 3),
        "tracking_goal_pixels": _flat(pixels[..., -1, :], 2),
        **_operator(frame),
    }


def _operator(frame: Frame) -> Observation:
    return {
        "tracking_insertion": frame.readings.insertion[..., None],
        "tracking_action": frame.action,
    }


def goal(frame: Frame) -> Observation:
    """Where the goal is, in the world and from the head."""
    head = frame.readings.head
    return {
        "goal_position": np.broadcast_to(frame.goal, head.shape),
        "goal_from_head": frame.goal - head,
    }


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


def rgb(frame: Frame) -> Observation:
    """Colour images of MuJoCo's cameras."""
    return _views(frame, "rgb")


def depth(frame: Frame) -> Observation:
    """Distance images of MuJoCo's cameras."""
    return _views(frame, "depth")


def _views(frame: Frame, kind: str) -> Observation:
    views = frame.picture.views
    return {key: view for key, view in views.items() if key.startswith(kind)}


OBSERVATIONS: Mapping[str, Callable[[Frame], Observation]] = {
    "internal": internal,
    "image": image,
    "sequential": sequential,
    "segmentation": segmentation,
    "tracking": tracking,
    "tracking_2d": tracking_2d,
    "goal": goal,
    "force": force,
    "rgb": rgb,
    "depth": depth,
}
_FLUOROSCOPIC = ("image", "sequential", "segmentation", "tracking_2d")

# Keys of the observations of numbers; those of pictures depend on their options.
_NUMBERS: Mapping[str, tuple[str, ...]] = {
    "internal": (
        "position",
        "velocity",
        "com_inertia",
        "com_velocity",
        "actuator_force",
        "external_force",
    ),
    "tracking": (
        "tracking_points",
        "tracking_goal",
        "tracking_insertion",
        "tracking_action",
    ),
    "tracking_2d": (
        "tracking_pixels",
        "tracking_goal_pixels",
        "tracking_insertion",
        "tracking_action",
    ),
    "goal": ("goal_position", "goal_from_head"),
    "force": ("wall_force", "push_force", "load_cell"),
}


def resolve(names: str | Sequence[str]) -> tuple[str, ...]:
    """Returns the names of observations as a tuple.

    Raises:
      ValueError: if a name is unknown or comes twice, or if there is none.
    """
    chosen = (names,) if isinstance(names, str) else tuple(names)
    unknown = [name for name in chosen if name not in OBSERVATIONS]
    if unknown or not chosen or len(set(chosen)) < len(chosen):
        raise ValueError(
            f"observation is {names!r}; give one of {', '.join(OBSERVATIONS)}, "
            "or a list of different ones"
        )
    return chosen


def needs_fluoroscopy(names: Sequence[str]) -> bool:
    """Whether any of the observations needs the angiography machine."""
    return any(name in _FLUOROSCOPIC for name in names)


def observe(names: Sequence[str], frame: Frame) -> Observation:
    """Computes the named observations; arrays may share memory with the frame."""
    observation: Observation = {}
    for name in names:
        observation.update(OBSERVATIONS[name](frame))
    return observation


def entries(
    names: Sequence[str], fluoroscopy: FluoroscopyOptions, cameras: CameraOptions
) -> dict[str, specs.Array | None]:
    """Keys of the named observations, with the specs of those of pictures."""
    planes, size = fluoroscopy.planes, fluoroscopy.resolution
    grey = {
        "image": planes,
        "sequential": planes * SEQUENCE_LENGTH,
        "segmentation": planes * 2,
    }
    result: dict[str, specs.Array | None] = {}
    for name in names:
        if name in grey:
            result[name] = _picture((*size, grey[name]))
        elif name == "rgb":
            for camera in cameras.names:
                result[f"rgb_{camera}"] = _picture((*cameras.resolution, 3))
        elif name == "depth":
            for camera in cameras.names:
                shape = (*cameras.resolution, 1)
                result[f"depth_{camera}"] = specs.Array(shape, np.float32)
        else:
            result.update(dict.fromkeys(_NUMBERS[name]))
    return result


def _picture(shape: tuple[int, ...]) -> specs.BoundedArray:
    return specs.BoundedArray(shape, np.uint8, 0, 255)


class Seen(observable.Generic):
    """One entry of the observation, with the range of a picture in its spec."""

    def __init__(self, see: Callable, spec: specs.Array | None):
        super().__init__(see)
        self._spec = spec
        self.enabled = True

    @property
    def array_spec(self) -> specs.Array | None:
        """Spec of a picture; None for numbers, whose spec composer infers."""
        return self._spec
