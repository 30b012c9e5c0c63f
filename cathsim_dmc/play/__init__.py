"""Cannulation by hand: keys, a window, a record of what was done."""

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from cathsim_dmc.play.controls import Controls
    from cathsim_dmc.play.session import Session, play

_LAZY = {"play": "session", "Session": "session", "Controls": "controls"}

__all__ = ["Controls", "Session", "play"]


def __getattr__(name: str):
    if name in _LAZY:
        # `play.play` is a function, and no module has its name.
        return getattr(importlib.import_module(f"{__name__}.{_LAZY[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
