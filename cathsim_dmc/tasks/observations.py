"""Observations of a task as functions of a frame, for one simulation or for many."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from cathsim_dmc.imaging import fluoroscopy
from cathsim_dmc.tasks import forces, readings

TRACKED_POINTS = 8
SEQUENCE_LENGTH = 3

Observation = dict[str, np.ndarray]


@dataclasses.dataclass(frozen=True)
class Frame:
    """What there is to observe after a control step.

    Attributes:
      readings: state of the device.
      wall_force: on the wall over the control step.
      action: (..., A), the action that led here, zeros after a reset.
      image: (..., H, W, 1) uint8, fluoroscopy, or None if no observation needs it.
      past_images: the same, one and two control steps before, newest first.
    """

    readings: readings.Readings
    wall_force: forces.WallForce
    action: np.ndarray
    image: np.ndarray | None = None
    past_images: tuple[np.ndarray, ...] = ()


def _flat(array: np.ndarray, axes: int) -> np.ndarray:
    """Joins the last `axes` axes."""
    return array.reshape(*array.shape[: array.ndim - axes], -1)


def internal(frame: Frame, goal: np.ndarray) -> Observation:
    """State of joints and links, as published."""
    del goal
    state = frame.readings
    return {
        "position": state.joint_positions,
        "velocity": state.joint_velocities,
        "com_inertia": _flat(state.com_inertia, 2),
        "com_velocity": _flat(state.com_velocity, 2),
        "actuator_force": state.actuator_force,
        "external_force": _flat(state.external_force, 2),
    }


def image(frame: Frame, goal: np.ndarray) -> Observation:
    """One fluoroscopic image (H, W, 1) uint8."""
    del goal
    return {"image": frame.image}


def sequential(frame: Frame, goal: np.ndarray) -> Observation:
    """Three consecutive images (H, W, 3) uint8, oldest first."""
    del goal
    images = (*reversed(frame.past_images), frame.image)
    return {"sequential": np.concatenate(images, axis=-1)}


def tracking(frame: Frame, goal: np.ndarray) -> Observation:
    """What an operator follows on the screen.

    Equidistant points along the steerable part and the shaft next to it, from proximal
    to the head, the goal, the insertion and the last action.
    """
    line = frame.readings.centreline
    chosen = np.linspace(line.shape[-2] // 2, line.shape[-2] - 1, TRACKED_POINTS)
    points = line[..., np.round(chosen).astype(int), :]
    return {
        "tracking_points": _flat(points, 2),
        "tracking_goal": np.broadcast_to(goal, (*line.shape[:-2], 3)),
        "tracking_insertion": frame.readings.insertion[..., None],
        "tracking_action": frame.action,
    }


def force(frame: Frame, goal: np.ndarray) -> Observation:
    """Force sensing, N and N·m.

    `wall_force`: sum and largest contact at the end of the step, and their peaks
    within it; `push_force`: push and torque at the base; `load_cell`: force of the
    phantom on its support, world frame.
    """
    del goal
    wall, state = frame.wall_force, frame.readings
    return {
        "wall_force": np.stack(
            [wall.sum, wall.max, wall.peak_sum, wall.peak_max], axis=-1
        ),
        "push_force": np.stack([state.push_force, state.push_torque], axis=-1),
        "load_cell": state.load_cell,
    }


OBSERVATIONS: Mapping[str, Callable[[Frame, np.ndarray], Observation]] = {
    "internal": internal,
    "image": image,
    "sequential": sequential,
    "tracking": tracking,
    "force": force,
}
_WITH_IMAGES = ("image", "sequential")


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


def needs_images(names: Sequence[str]) -> bool:
    """Whether any of the observations shows a fluoroscopic image."""
    return any(name in _WITH_IMAGES for name in names)


def observe(names: Sequence[str], frame: Frame, goal: np.ndarray) -> Observation:
    """Computes the named observations; arrays are the caller's own."""
    observation: Observation = {}
    for name in names:
        observation.update(OBSERVATIONS[name](frame, goal))
    return {key: np.array(value) for key, value in observation.items()}


def look(
    fluoroscope: fluoroscopy.Fluoroscope, state: readings.Readings, radius: float
) -> np.ndarray:
    """Fluoroscopic image (..., H, W, 1) uint8 of a device of a radius in m."""
    return fluoroscope.render(state.centreline, radius)
