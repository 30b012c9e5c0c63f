"""From keys that are held to the action of a task."""

import numpy as np

# Commands that act while they are held: axis of the hand and sign.
_HELD = {
    "push": ("translation", 1.0),
    "pull": ("translation", -1.0),
    "right": ("bend_y", 1.0),
    "left": ("bend_y", -1.0),
    "up": ("bend_x", 1.0),
    "down": ("bend_x", -1.0),
    "turn_left": ("rotation", 1.0),
    "turn_right": ("rotation", -1.0),
}
# With coaxial devices the same hands hold another one: axis of the hand and sign.
_COAXIAL = {
    "push": ("catheter", 1.0),
    "pull": ("catheter", -1.0),
    "turn_left": ("catheter_rotation", 1.0),
    "turn_right": ("catheter_rotation", -1.0),
    "up": ("guidewire", 1.0),
    "down": ("guidewire", -1.0),
    "left": ("guidewire_rotation", 1.0),
    "right": ("guidewire_rotation", -1.0),
}
# Commands that act once.
_ONCE = ("straight", "restart", "quit")
COMMANDS = (*_HELD, *_ONCE)

BEND_RATE = 1.0  # share of the full deflection per second while a key is held

HELP = (
    "arrows: bend the tip as seen from the front (up: towards you)   "
    "W/S: push/pull   A/D: rotate   space: straighten   R: again   Esc: quit"
)
COAXIAL_HELP = (
    "arrows: push/pull (up/down) and rotate (left/right) the guidewire   "
    "W/S: push/pull the catheter   A/D: rotate it   R: again   Esc: quit"
)


class CoaxialControls:
    """What an operator's two hands hold: the innermost device and the outermost one.

    One device alone is both.
    """

    help = COAXIAL_HELP

    def __init__(self, devices: int):
        """Starts with nothing held.

        Args:
          devices: number of coaxial devices.
        """
        self._devices = devices
        self._held = _Held(_COAXIAL)
        self.requested: str | None = None

    def press(self, command: str, hold: float = np.inf) -> None:
        """Begins to hold a command, for `hold` seconds or until `release`."""
        if command not in COMMANDS:
            raise ValueError(f"no command {command!r}; there are {', '.join(COMMANDS)}")
        if command in _COAXIAL:
            self._held.press(command, hold)
        elif command in ("restart", "quit"):
            self.requested = command

    def release(self, command: str) -> None:
        """Lets go of a command."""
        self._held.release(command)

    def restart(self) -> None:
        """Lets go of everything."""
        self._held.clear()
        self.requested = None

    def action(self, duration: float) -> np.ndarray:
        """Action (2 K,) float64 of the next control step of a duration in seconds.

        float32 holds it exactly, as that of `Controls`.
        """
        axes = self._held.axes(duration)
        action = np.zeros(2 * self._devices)
        action[:2] = axes["guidewire"], axes["guidewire_rotation"]
        action[-2:] += axes["catheter"], axes["catheter_rotation"]
        return np.clip(action, -1.0, 1.0)


class _Held:
    """Commands that are held down, and for how long they still count as held."""

    def __init__(self, meaning: dict[str, tuple[str, float]]):
        self._meaning = meaning
        self._left: dict[str, float] = {}  # command -> seconds

    def press(self, command: str, hold: float) -> None:
        self._left[command] = hold

    def release(self, command: str) -> None:
        self._left.pop(command, None)

    def clear(self) -> None:
        self._left.clear()

    def axes(self, duration: float) -> dict[str, float]:
        """What is asked of each axis of the hands; so much time passes."""
        axes = dict.fromkeys((axis for axis, _ in self._meaning.values()), 0.0)
        for command in self._left:
            axis, sign = self._meaning[command]
            axes[axis] += sign
        self._left = {
            command: rest - duration
            for command, rest in self._left.items()
            if rest - duration > 1e-9
        }
        return axes


class Controls:
    """What an operator's hands hold: speeds while a key is down, a bend that stays.

    In the AP view, "right" bends the tip to the right of the image and "up" towards
    the observer, as long as the base is not rotated.
    """

    help = HELP

    def __init__(self, tip_joints: int, rotation: bool):
        """Starts with nothing held and a straight tip.

        Args:
          tip_joints: number of steerable joints of the device, two motors each.
          rotation: whether the action has a rotation.
        """
        self._tip_joints = tip_joints
        self._has_rotation = rotation
        self._held = _Held(_HELD)
        self._bend = np.zeros(2)
        self.requested: str | None = None

    def press(self, command: str, hold: float = np.inf) -> None:
        """Begins to hold a command, for `hold` seconds or until `release`."""
        if command not in COMMANDS:
            raise ValueError(f"no command {command!r}; there are {', '.join(COMMANDS)}")
        if command == "straight":
            self._bend[:] = 0.0
        elif command in _HELD:
            self._held.press(command, hold)
        else:
            self.requested = command

    def release(self, command: str) -> None:
        """Lets go of a command."""
        self._held.release(command)

    def restart(self) -> None:
        """Lets go of everything and straightens the tip."""
        self._held.clear()
        self._bend[:] = 0.0
        self.requested = None

    def action(self, duration: float) -> np.ndarray:
        """Action of the next control step of a duration in seconds.

        Returns:
          (A,) float64 that float32 holds exactly, so that a demonstration can be
          repeated through interfaces of single precision.
        """
        axes = self._held.axes(duration)
        self._bend += BEND_RATE * duration * np.array([axes["bend_x"], axes["bend_y"]])
        np.clip(self._bend, -1.0, 1.0, out=self._bend)
        action = [*np.tile(self._bend, self._tip_joints), axes["translation"]]
        if self._has_rotation:
            action.append(axes["rotation"])
        return np.array(action, dtype=np.float32).astype(np.float64)

    @property
    def bend(self) -> np.ndarray:
        """Deflection (2,) about x and y, shares of the full one."""
        return self._bend.copy()
