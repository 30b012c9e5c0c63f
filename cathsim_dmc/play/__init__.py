"""Cannulation by hand: input devices, a fluoroscopy window, recorded episodes."""

from cathsim_dmc.play.controls import Controls
from cathsim_dmc.play.session import play

__all__ = ["Controls", "play"]
