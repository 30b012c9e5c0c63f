"""Gamepads and SpaceMouses: what hands hold, and force as vibration."""

import math
import os
from typing import Any, Protocol

from cathsim_dmc import extras

HANDS = ("keyboard", "gamepad", "spacemouse")
# Share of an axis that rest and wear move it by.
DEAD_ZONE = 0.15
# Largest contact that vibrates with full strength, N: the proposed threshold of
# rupture. Strength grows with the root, so that 15 mN are felt (a tenth).
FULL_FORCE = 1.5
FELT = 0.1  # s, of a vibration; a control step begins the next one
_FULL_AXIS = 32767
# Buttons that act once, by what they do (keys of `controls.ONCE`).
_BUTTONS = {"A": "space", "START": "r", "BACK": "Escape"}


class Hand(Protocol):
    """A device in the operator's hand.

    Attributes:
        help: What it does.
    """

    help: str

    def read(self) -> tuple[dict[str, float], set[str]]:
        """How far it leans and what is pressed.

        Returns:
            By the key that does the same ("Up", "Right", "w", "a"), a share of what
            the key does while it is held, negative for the opposite key; and the keys
            of buttons that are down and act once.
        """
        ...

    def feel(self, force: float) -> None:
        """Vibrate with the largest contact force, N."""
        ...

    def close(self) -> None:
        """Let it go."""
        ...


def without_rest(value: float) -> float:
    """A reading in [-1, 1] without the dead zone, which is 0."""
    beyond = abs(value) - DEAD_ZONE
    return math.copysign(min(max(beyond / (1 - DEAD_ZONE), 0.0), 1.0), value)


def strength(force: float) -> float:
    """Strength in [0, 1] of the vibration of a contact force, N."""
    return min(math.sqrt(max(force, 0.0) / FULL_FORCE), 1.0)


def hand(name: str) -> Hand | None:
    """A device by its name in `HANDS`; None for the keyboard.

    Raises:
        ModuleNotFoundError: the extra `hands` is not installed.
        ValueError: no such device is connected.
    """
    if name == "keyboard":
        return None
    return Gamepad() if name == "gamepad" else SpaceMouse()


class Gamepad:
    """The first gamepad that SDL knows, by way of pygame.

    A gamepad that is pulled out is at rest, and goes on when it is back.
    """

    help = (
        "right stick: bend (or the guidewire)   left stick: push/pull, rotate   "
        "triggers: push (right), pull (left)   A: straighten   Start: again   "
        "Back: quit"
    )

    def __init__(self) -> None:
        extras.require("hands", "pygame")
        # SDL reads gamepads by its video system, and pygame opens no window of it.
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
        """Vibrate: the heavy motor with the force, the light one above half of it."""
        if self._pad is not None and self._pad.attached():
            heavy = strength(force)
            self._pad.rumble(heavy, max(0.0, 2 * heavy - 1), round(1e3 * FELT))

    def close(self) -> None:
        """Let it go, and SDL."""
        if self._pad is not None:
            self._pad.stop_rumble()
        self._kind.quit()
        self._pygame.display.quit()


class SpaceMouse:
    """The first SpaceMouse, by way of pyspacemouse; it has no motor.

    One that is pulled out is at rest.
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
        # Reports that have come since the last call; the newest counts.
        for _ in range(100):
            try:
                state = self._mouse.read()
            except Exception:  # of hidapi: it is gone
                return {}, set()
            if state.t == before:
                break
            before = state.t
        leaning = {
            "w": state.y,
            "a": state.yaw,
            "Up": -state.roll,
            "Right": state.pitch,
        }
        axes = {key: without_rest(value) for key, value in leaning.items()}
        down = [bool(one) for one in state.buttons]
        return axes, {key for key, on in zip(("space", "r"), down, strict=False) if on}

    def feel(self, force: float) -> None:
        """Nothing: it cannot vibrate."""

    def close(self) -> None:
        """Let it go."""
        self._mouse.close()
