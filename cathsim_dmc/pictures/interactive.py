"""Rerun's viewer of an environment, in a notebook."""

from __future__ import annotations

from typing import Any

from cathsim_dmc.pictures.readout import forces
from cathsim_dmc.pictures.recorded import film_options, xray_film
from cathsim_dmc.recording.episode import Episode
from cathsim_dmc.recording.recorder import EpisodeRecorder, navigation_of
from cathsim_dmc.recording.scene import body_geoms


def rerun_viewer(env: Any, episode: Episode | None = None, **options: Any) -> Any:
    """Rerun's viewer of an episode, or of the present state.

    Args:
        env: What `cathsim_dmc.suite.load` returns.
        episode: An episode recorded in it; None shows the present state.
        **options: `width` and `height` of the viewer, pixels.

    Raises:
        ImportError: `rerun-notebook` is not installed; says what to install.
    """
    from cathsim_dmc.recording.notebook import episode_viewer

    task = navigation_of(env)
    surface = task.scene.anatomy.surface
    if episode is None:
        readout = forces(env)
        episode = EpisodeRecorder(env, task.name).present()
        options["contacts"] = (readout.position, readout.force)
    return episode_viewer(
        episode,
        surface,
        robot_geoms=body_geoms(env.physics),
        fluoroscopy=xray_film(episode, surface, film_options(task)),
        **options,
    )
