"""Pictures of a state or an episode in one call, without OpenGL.

The functions take the environment that `cathsim_dmc.suite.load` returns.
`cathsim_dmc` itself offers `show`, `record`, `plot`, `forces` and `fluoroscopy`, so
that `import cathsim_dmc` is enough in a notebook.
"""

import dataclasses
import importlib
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from cathsim_dmc.pictures.curves import plot
    from cathsim_dmc.pictures.moment import Moment
    from cathsim_dmc.pictures.readout import ForceReadout, forces
    from cathsim_dmc.pictures.recorded import record, write
    from cathsim_dmc.recording.episode import Episode

__all__ = [
    "Episode",
    "ForceReadout",
    "Moment",
    "fluoroscopy",
    "forces",
    "plot",
    "record",
    "show",
    "write",
]
_MODULES = {
    "Episode": "cathsim_dmc.recording.episode",
    "ForceReadout": "cathsim_dmc.pictures.readout",
    "Moment": "cathsim_dmc.pictures.moment",
    "forces": "cathsim_dmc.pictures.readout",
    "plot": "cathsim_dmc.pictures.curves",
    "record": "cathsim_dmc.pictures.recorded",
    "write": "cathsim_dmc.pictures.recorded",
}


def __getattr__(name: str) -> Any:
    # Lazy, so that a picture of an anatomy alone does not load the simulation.
    if name in _MODULES:
        return getattr(importlib.import_module(_MODULES[name]), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def show(
    env: Any, episode: "Episode | None" = None, *, step: int = -1, **options: Any
) -> Any:
    """Draw anatomy, device, goal and contact forces.

    Args:
        env: What `cathsim_dmc.suite.load` returns.
        episode: An episode recorded in it, whose state `step` is drawn; None draws the
            present state of the environment.
        step: Number of the episode's state; negative ones count from the end.
        **options: Options of `pictures.figure.scene_figure`, such as `views` and
            `fluoroscopy`.

    Returns:
        The figure; a notebook draws it, `.savefig(path)` writes it.

    Raises:
        TypeError: `env` is no environment of this package, or an option does not exist.
        ValueError: the environment does not have the anatomy of the episode.
        RuntimeError: no episode is given, and none has begun.
    """
    from cathsim_dmc.pictures.figure import scene_figure
    from cathsim_dmc.pictures.moment import Moment
    from cathsim_dmc.pictures.recorded import surface_of

    _check(options, scene_figure.__kwdefaults__ or ())
    if episode is None:
        return scene_figure(Moment.of(env), **options)
    moment = Moment.of_episode(episode, surface_of(episode, env), step)
    return scene_figure(moment, **options)


def fluoroscopy(env: Any, *, seed: int = 0, **options: Any) -> np.ndarray:
    """Render the X-ray image of an environment's present state.

    Args:
        env: What `cathsim_dmc.suite.load` returns, after a reset.
        seed: Seed of the quantum noise, used with `noise=True`.
        **options: Fields of `FluoroscopyOptions` that differ from the task's,
            such as `view="LAO45"`, `size=512`, `contrast=False`; not those of further
            planes and roadmaps, but `biplane="best"` beside `view="best"`.

    Returns:
        (rows, columns) uint8, dark = opaque.

    Raises:
        TypeError: `env` is no environment of this package, or an option does not exist.
        ValueError: an option's value is not possible.
        RuntimeError: no episode has begun.
    """
    from cathsim_dmc.imaging.options import is_best
    from cathsim_dmc.pictures.moment import Moment, xray
    from cathsim_dmc.recording.recorder import navigation_of

    other = {"biplane", "third", "roadmap_errors"}  # no part of this image
    if is_best(options.get("biplane")):
        other.remove("biplane")
    own = vars(navigation_of(env).config.fluoroscopy)
    _check(options, [name for name in own if name not in other])
    moment = Moment.of(env)
    return xray(moment, dataclasses.replace(moment.x_ray.options, **options), seed)


def _check(options: Iterable[str], known: Iterable[str]) -> None:
    if unknown := [name for name in options if name not in known]:
        raise TypeError(f"no option {', '.join(unknown)}; there are {', '.join(known)}")
