"""Cannulation by hand: keys, a window, a record of what was done."""

import importlib

_LAZY = {"play": "session", "Session": "session", "Controls": "controls"}

__all__ = list(_LAZY)


def __getattr__(name: str):
    if name in _LAZY:
        # `play.play` is a function, and no module has its name.
        return getattr(importlib.import_module(f"{__name__}.{_LAZY[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
