"""Gamepad and SpaceMouse as input devices; the gamepad vibrates with the force."""

import math
import os
from typing import Any, Protocol

from cathsim_dmc import extras

HANDS = ("keyboard", "gamepad", "spacemouse")
# Largest reading of a resting or worn axis, as a fraction of its range.
DEAD_ZONE = 0.15
# Contact force of the strongest vibration, N: the proposed threshold of rupture. The
# strength grows with the square root of the force, so 15 mN give a tenth.
FULL_FORCE = 1.5
FELT = 0.1  # s, duration of a vibration; each control step starts a new one
_FULL_AXIS = 32767
# Buttons that act once per press, with the keys of `controls.ONCE` that do the same.
_BUTTONS = {"A": "space", "START": "r", "BACK": "Escape"}


class Hand(Protocol):
    """A device in the operator's hand.

    Attributes:
        help: Text that explains its axes and buttons.
    """

    help: str

    def read(self) -> tuple[dict[str, float], set[str]]:
        """Read the deflections and the buttons.

        Returns:
            Deflections in [-1, 1] by the key with the same effect ("Up", "Right", "w",
            "a"), 1 as the held key, negative as the opposite key; and the keys of the
            buttons that are down and act once.
        """
        ...

    def feel(self, force: float) -> None:
        """Vibrate with the largest contact force, N."""
        ...

    def close(self) -> None:
        """Release the device."""
        ...


def without_rest(value: float) -> float:
    """Return a reading in [-1, 1] with the dead zone as 0 and the rest rescaled."""
    beyond = abs(value) - DEAD_ZONE
    return math.copysign(min(max(beyond / (1 - DEAD_ZONE), 0.0), 1.0), value)


def strength(force: float) -> float:
    """Strength in [0, 1] of the vibration of a contact force, N."""
    return min(math.sqrt(max(force, 0.0) / FULL_FORCE), 1.0)


def hand(name: str) -> Hand | None:
    """Open an input device by its name in `HANDS`; return None for the keyboard.

    Raises:
        ModuleNotFoundError: the extra `hands` is not installed.
        ValueError: no such device is connected.
    """
    if name == "keyboard":
        return None
    return Gamepad() if name == "gamepad" else SpaceMouse()


class Gamepad:
    """The first gamepad that SDL recognises, read by pygame.

    A disconnected gamepad reads as at rest, and works again once reconnected.
    """

    help = (
        "right stick: bend (or the guidewire)   left stick: push/pull, rotate   "
        "triggers: push (right), pull (left)   A: straighten   Start: again   "
        "Back: quit"
    )

    def __init__(self) -> None:
        extras.require("hands", "pygame")
        # SDL reads gamepads in its video system; the dummy driver opens no window.
        os.environ.setdefault("SDL_VIDEODRIVER", "dummy")
        os.environ.setdefault("SDL_JOYSTICK_ALLOW_BACKGROUND_EVENTS", "1")
        os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
        import pygame
        from pygame._sdl2 import controller

        self._pygame, self._kind = pygame, controller
        pygame.display.init()
        controller.init()
        pygame.event.pump()
        self._pad: Any = None
        if not self._connected():
            self.close()
            raise ValueError(
                "no gamepad is connected, or SDL knows none of those that are; connect "
                "one, or play with --hands keyboard"
            )

    def _connected(self) -> bool:
        if self._pad is not None and self._pad.attached():
            return True
        count = self._kind.get_count()
        known = [i for i in range(count) if self._kind.is_controller(i)]
        self._pad = self._kind.Controller(known[0]) if known else None
        return self._pad is not None

    def read(self) -> tuple[dict[str, float], set[str]]:
        """See `Hand.read`."""
        self._pygame.event.pump()
        if not self._connected():
            return {}, set()
        axes = {
            name: without_rest(self._pad.get_axis(getattr(self._pygame, number)) / full)
            for name, number, full in (
                ("Right", "CONTROLLER_AXIS_RIGHTX", _FULL_AXIS),
                ("Up", "CONTROLLER_AXIS_RIGHTY", -_FULL_AXIS),
                ("a", "CONTROLLER_AXIS_LEFTX", -_FULL_AXIS),
                ("w", "CONTROLLER_AXIS_LEFTY", -_FULL_AXIS),
                ("in", "CONTROLLER_AXIS_TRIGGERRIGHT", _FULL_AXIS),
                ("out", "CONTROLLER_AXIS_TRIGGERLEFT", _FULL_AXIS),
            )
        }
        push = axes["w"] + max(axes.pop("in"), 0.0) - max(axes.pop("out"), 0.0)
        axes["w"] = min(max(push, -1.0), 1.0)
        pressed = {
            key
            for name, key in _BUTTONS.items()
            if self._pad.get_button(getattr(self._pygame, f"CONTROLLER_BUTTON_{name}"))
        }
        return axes, pressed

    def feel(self, force: float) -> None:
        """Vibrate the low-frequency motor, and above half strength the other one."""
        if self._pad is not None and self._pad.attached():
            heavy = strength(force)
            self._pad.rumble(heavy, max(0.0, 2 * heavy - 1), round(1e3 * FELT))

    def close(self) -> None:
        """Release the gamepad and SDL."""
        if self._pad is not None:
            self._pad.stop_rumble()
        self._kind.quit()
        self._pygame.display.quit()


class SpaceMouse:
    """The first SpaceMouse, read by pyspacemouse.

    A disconnected SpaceMouse reads as at rest.
    """

    help = (
        "push the cap away/towards you: push/pull   twist: rotate   tilt towards "
        "you/right: as the arrows up/right   first button: straighten   second: again"
    )

    def __init__(self) -> None:
        extras.require("hands", "pyspacemouse")
        import pyspacemouse

        try:
            # x right, y away from the user, z up, right-handed.
            convention = pyspacemouse.AxisConvention.HID_Z_UP
            self._mouse: Any = pyspacemouse.open(axis_convention=convention)
        except Exception as error:  # of the library, of hidapi, or of the system
            line = " ".join(str(error).split())[:300]
            raise ValueError(
                f"no SpaceMouse can be read: {line or type(error).__name__}; connect "
                "it, allow this user to read it (on Linux a udev rule), or play with "
                "--hands keyboard"
            ) from error

    def read(self) -> tuple[dict[str, float], set[str]]:
        """See `Hand.read`."""
        before = None
        # Read all reports since the last call; the newest one counts.
        for _ in range(100):
            try:
                state = self._mouse.read()
            except Exception:  # hidapi's, where the device is disconnected
                return {}, set()
            if state.t == before:
                break
            before = state.t
        leaning = {
            "w": state.y,
            "a": state.yaw,
            "Up": state.roll,
            "Right": state.pitch,
        }
        axes = {key: without_rest(value) for key, value in leaning.items()}
        down = [bool(one) for one in state.buttons]
        return axes, {key for key, on in zip(("space", "r"), down, strict=False) if on}

    def feel(self, force: float) -> None:
        """Do nothing: a SpaceMouse has no motor."""

    def close(self) -> None:
        """Release the SpaceMouse."""
        self._mouse.close()
