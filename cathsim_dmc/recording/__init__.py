"""Episodes: record them, keep them, look at them.

Rerun is imported only when a recording is written or opened, so that reading
episodes needs numpy alone.
"""

import importlib
from typing import TYPE_CHECKING

from cathsim_dmc.recording.episode import Episode

if TYPE_CHECKING:
    from cathsim_dmc.recording.recorder import EpisodeRecorder
    from cathsim_dmc.recording.rerun_log import write_rrd
    from cathsim_dmc.recording.scene import BodyGeom, body_geoms
    from cathsim_dmc.recording.viewer import ViewerError, open_viewer

_LAZY = {
    "EpisodeRecorder": "recorder",
    "BodyGeom": "scene",
    "body_geoms": "scene",
    "write_rrd": "rerun_log",
    "open_viewer": "viewer",
    "ViewerError": "viewer",
}

__all__ = [
    "BodyGeom",
    "Episode",
    "EpisodeRecorder",
    "ViewerError",
    "body_geoms",
    "open_viewer",
    "write_rrd",
]


def __getattr__(name: str):
    if name in _LAZY:
        module = importlib.import_module(f"{__name__}.{_LAZY[name]}")
        return getattr(module, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
