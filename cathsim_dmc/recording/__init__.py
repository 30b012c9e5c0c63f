"""Episodes: record them, keep them, look at them.

Rerun is imported only when a recording is written or opened, so that reading
episodes needs numpy alone.
"""

import importlib

from cathsim_dmc.recording.episode import Episode

_LAZY = {
    "EpisodeRecorder": "recorder",
    "BodyGeom": "scene",
    "body_geoms": "scene",
    "write_rrd": "rerun_log",
    "open_viewer": "viewer",
    "ViewerError": "viewer",
}

__all__ = ["Episode", *_LAZY]


def __getattr__(name: str):
    if name in _LAZY:
        module = importlib.import_module(f"{__name__}.{_LAZY[name]}")
        return getattr(module, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
