"""Actions of a task from keys that are held."""

import numpy as np

# Commands that act while they are held: what they move, and sign.
_STEERABLE = {
    "push": ("translation", 1.0),
    "pull": ("translation", -1.0),
    "right": ("bend_y", 1.0),
    "left": ("bend_y", -1.0),
    "up": ("bend_x", 1.0),
    "down": ("bend_x", -1.0),
    "turn_left": ("rotation", 1.0),
    "turn_right": ("rotation", -1.0),
}
# The same with coaxial devices.
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
COMMANDS = (*_STEERABLE, *_ONCE)

BEND_RATE = 1.0  # share of the full deflection per second while a key is held

HELP = (
    "arrows: bend the tip as seen from the front (up: towards you)   "
    "W/S: push/pull   A/D: rotate   space: straighten   R: again   Esc: quit"
)
COAXIAL_HELP = (
    "arrows: push/pull (up/down) and rotate (left/right) the guidewire   "
    "W/S: push/pull the catheter   A/D: rotate it   R: again   Esc: quit"
)


class _Keys:
    """Commands that are held, and single requests.

    Attributes:
        requested: "restart" or "quit" since the last `restart`, or None.
    """

    help = ""
    _meaning: dict[str, tuple[str, float]] = {}

    def __init__(self):
        self._held: set[str] = set()
        self.requested: str | None = None

    def press(self, command: str) -> None:
        """Begins to hold a command until `release`."""
        if command not in COMMANDS:
            raise ValueError(f"no command {command!r}; there are {', '.join(COMMANDS)}")
        if command in self._meaning:
            self._held.add(command)
        elif command in ("restart", "quit"):
            self.requested = command

    def release(self, command: str) -> None:
        """Ends a command."""
        self._held.discard(command)

    def restart(self) -> None:
        """Ends all commands."""
        self._held.clear()
        self.requested = None

    def _axes(self) -> dict[str, float]:
        """Sum of the held commands of each axis."""
        axes = dict.fromkeys((axis for axis, _ in self._meaning.values()), 0.0)
        for command in self._held:
            axis, sign = self._meaning[command]
            axes[axis] += sign
        return axes


class CoaxialControls(_Keys):
    """Keys of the innermost and of the outermost of coaxial devices.

    One device alone is both.
    """

    help = COAXIAL_HELP
    _meaning = _COAXIAL

    def __init__(self, devices: int):
        """Starts with nothing held."""
        super().__init__()
        self._devices = devices

    def action(self, duration: float) -> np.ndarray:
        """Action (2 K,) float64 of the next control step of a duration in seconds.

        float32 holds it exactly, as that of `Controls`.
        """
        axes = self._axes()
        action = np.zeros(2 * self._devices)
        action[:2] = axes["guidewire"], axes["guidewire_rotation"]
        action[-2:] += axes["catheter"], axes["catheter_rotation"]
        return np.clip(action, -1.0, 1.0)


class Controls(_Keys):
    """Keys of a steerable device: speeds while a key is held, a bend that stays.

    In the AP view, "right" bends the tip to the right of the image and "up" towards
    the observer, as long as the base is not rotated.
    """

    help = HELP
    _meaning = _STEERABLE

    def __init__(self, tip_joints: int, rotation: bool):
        """Starts with nothing held and a straight tip.

        Args:
            tip_joints: number of steerable joints of the device, two motors each.
            rotation: whether the action has a rotation.
        """
        super().__init__()
        self._tip_joints = tip_joints
        self._has_rotation = rotation
        self._bend = np.zeros(2)

    def press(self, command: str) -> None:
        """Begins to hold a command until `release`."""
        super().press(command)
        if command == "straight":
            self._bend[:] = 0.0

    def restart(self) -> None:
        """Ends all commands and straightens the tip."""
        super().restart()
        self._bend[:] = 0.0

    def action(self, duration: float) -> np.ndarray:
        """Action of the next control step of a duration in seconds.

        Returns:
            (A,) float64 that float32 holds exactly, so that a demonstration can be
            repeated through interfaces of single precision.
        """
        axes = self._axes()
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
