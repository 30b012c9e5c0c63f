"""Cannulation by hand: keys, a window, a record of what was done."""

from cathsim_dmc.play.controls import Controls
from cathsim_dmc.play.session import play

__all__ = ["Controls", "play"]
