"""One state of an episode, with everything that a picture needs."""

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any

import numpy as np

from cathsim_dmc.imaging.angiograph import Angiograph
from cathsim_dmc.imaging.device import Shadow
from cathsim_dmc.imaging.fluoroscopy import Fluoroscope
from cathsim_dmc.imaging.options import FluoroscopyOptions
from cathsim_dmc.recording.episode import Episode
from cathsim_dmc.recording.geometry import force_scale
from cathsim_dmc.recording.recorder import EpisodeRecorder, begun_task_of
from cathsim_dmc.recording.records import CoaxialRecord, VesselRecord, XRayRecord


@dataclasses.dataclass(frozen=True, eq=False)
class Moment:
    """State of one simulation; lengths in metres, forces in newtons, world frame.

    Attributes:
        surface: Lumen surface with `vertices` (V, 3) and `faces` (F, 3), as moved.
        rest: The surface at rest, on which views are centred.
        device: (L + 1, 3) joints of the device from base to head.
        radius: (L,) radii of its links.
        outermost: (L,) number of the outermost of coaxial devices on each link, 0 for
            the innermost; None for a single device.
        ends: (K, 3) ends of coaxial devices, from the innermost outwards.
        goal: (3,) centre of the goal.
        goal_radius: Radius of the goal.
        position: (K, 3) contacts with the wall.
        force: (K, 3) force of the device on the wall at each.
        force_scale: Force of the last colour of the scale.
        path: (P, 3) past places of the head, or (0, 3).
        title: Text above the picture.
        x_ray: Fluoroscopy options, deviation of the C-arm and devices of the episode.
        shadows: X-ray shadows of the devices.
        upright: Whether the sides of the patient are known, see `is_upright`.
    """

    surface: Any
    rest: Any
    device: np.ndarray
    radius: np.ndarray
    goal: np.ndarray
    goal_radius: float
    position: np.ndarray
    force: np.ndarray
    force_scale: float
    path: np.ndarray
    title: str
    x_ray: XRayRecord
    shadows: list[Shadow]
    outermost: np.ndarray | None = None
    upright: bool = True
    ends: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros((0, 3)))

    @property
    def magnitude(self) -> np.ndarray:
        """(K,) magnitudes of the forces, N."""
        return np.linalg.norm(self.force, axis=-1)

    @classmethod
    def of(cls, env: Any) -> "Moment":
        """The present state of an environment; TypeError for any other object."""
        task = begun_task_of(env)
        episode = EpisodeRecorder(env, task.name).present()
        distance = 1e3 * episode.meta["distance"][-1]
        rest, moving = task.scene.anatomy.surface, task.rollout.moving
        return dataclasses.replace(
            cls.of_episode(episode, rest),
            surface=rest if moving is None else moving.surface(0),
            path=np.zeros((0, 3)),
            shadows=_first(task.rollout.shadows),
            title=f"{task.name}: {distance:.0f} mm to {task.scene.goal.name}",
        )

    @classmethod
    def of_episode(cls, episode: Episode, surface: Any, step: int = -1) -> "Moment":
        """A state of a recorded episode.

        Args:
            step: Number of the state; negative ones count from the end.

        Raises:
            IndexError: if the episode has no such state.
            ValueError: if the episode was recorded without a goal.
        """
        states = episode.steps + 1
        if not -states <= step < states:
            raise IndexError(f"step is {step}; the episode has {states} states")
        step %= states
        goal = episode.meta.get("goal_position")
        if goal is None:
            raise ValueError("the episode was recorded without a goal")
        # Contacts of state t + 1 belong to step t.
        there = episode.contact_step == step - 1
        now, own = surface, {"radius": episode.radii}
        x_ray = XRayRecord.of(episode)
        if (record := VesselRecord.of(episode)) is not None:
            now = record.surface(surface, step)
            goal = record.series["goal"][step]
        if (coaxial := CoaxialRecord.of(episode)) is not None:
            own = {"outermost": coaxial.outermost(episode.catheter)[step]}
            own["ends"] = coaxial.ends(episode.catheter)[step]
            own["radius"] = coaxial.radii[own["outermost"]]
        return cls(
            surface=now,
            rest=surface,
            device=episode.catheter[step],
            goal=np.asarray(goal, np.float64),
            goal_radius=float(episode.meta["goal_radius"]),
            position=episode.contact_position[there],
            force=episode.contact_force[there],
            # One scale for the whole episode.
            force_scale=force_scale(np.linalg.norm(episode.contact_force, axis=-1)),
            path=episode.head[: step + 1],
            title=f"{episode.task}, {episode.time[step] - episode.time[0]:.1f} s",
            x_ray=x_ray,
            upright=episode.meta.get("upright", True),
            shadows=_first(x_ray.shadows(episode, slice(step, step + 1))),
            **own,
        )


def _first(shadows: Sequence[Shadow]) -> list[Shadow]:
    """Shadows of the first state of a batch."""
    return [dataclasses.replace(each, points=each.points[0]) for each in shadows]


def on_screen(options: FluoroscopyOptions, **changes: Any) -> FluoroscopyOptions:
    """Options for a picture: one plane without noise, zoomed in on an arch.

    Args:
        changes: Fields that differ from this.
    """
    zoom = max(options.magnification, 1.0 if options.centre else 1.3)
    looks = {"size": 400, "noise": False, "biplane": None, "magnification": zoom}
    return dataclasses.replace(options, **(looks | changes))


_machine = functools.lru_cache(maxsize=8)(Angiograph)  # each holds some megabytes


def fluoroscope_of(moment: Moment, options: FluoroscopyOptions) -> Fluoroscope:
    """The frontal plane of the episode's C-arm, with the vessel at rest."""
    return _machine(moment.rest, options).planes(moment.x_ray.deviation)[0]


def xray(moment: Moment, options: FluoroscopyOptions, seed: int = 0) -> np.ndarray:
    """Renders the X-ray image (rows, columns) uint8 of a moment; `seed` of noise."""
    state = np.random.RandomState(seed) if options.noise else None
    fluoroscope = fluoroscope_of(moment, options)
    if moment.surface is not moment.rest:
        fluoroscope = fluoroscope.around(moment.surface)
    return fluoroscope.render(moment.shadows, state)[..., 0]
