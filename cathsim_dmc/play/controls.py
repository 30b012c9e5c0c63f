"""Actions of a task from keys that are held."""

import numpy as np

from cathsim_dmc.tasks.scene import Scene

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


class Controls:
    """Keys of a task: speeds while a key is held; the bend of a steerable tip stays.

    In the AP view, "right" bends the tip to the right of the image and "up" towards
    the observer, as long as the base is not rotated. Of coaxial devices the keys move
    the innermost and the outermost; one device alone is both.

    Attributes:
        help: What the keys do.
        requested: "restart" or "quit" since the last `restart`, or None.
        bend: Deflection (2,) of the tip about x and y, shares of the full one.
    """

    def __init__(self, tip_joints: int = 0, rotation: bool = False, devices: int = 0):
        """Starts with nothing held and a straight tip.

        Args:
            tip_joints: Number of steerable joints of the device, two motors each.
            rotation: Whether the action has a rotation.
            devices: Number K of coaxial devices; 0 for a steerable device.
        """
        self._tip_joints, self._rotation, self._devices = tip_joints, rotation, devices
        self._meaning = _COAXIAL if devices else _STEERABLE
        self.help = COAXIAL_HELP if devices else HELP
        self._held: set[str] = set()
        self.restart()

    @classmethod
    def of(cls, scene: Scene) -> "Controls":
        """The controls of the devices in a scene."""
        chain = scene.catheter
        if scene.coaxial:
            return cls(devices=len(chain.devices))
        return cls(len(chain.tip_motors) // 2, chain.rotation is not None)

    def press(self, command: str) -> None:
        """Begins to hold a command until `release`."""
        if command not in COMMANDS:
            raise ValueError(f"no command {command!r}; there are {', '.join(COMMANDS)}")
        if command == "straight":
            self.bend = np.zeros(2)
        elif command in self._meaning:
            self._held.add(command)
        else:
            self.requested = command

    def release(self, command: str) -> None:
        """Ends a command."""
        self._held.discard(command)

    def restart(self) -> None:
        """Ends all commands and straightens the tip."""
        self._held.clear()
        self.requested: str | None = None
        self.bend = np.zeros(2)

    def action(self, duration: float) -> np.ndarray:
        """Action of the next control step of a duration in seconds.

        Returns:
            (A,) float64 that float32 holds exactly, so that a demonstration can be
            repeated through interfaces of single precision. A is 2 K with coaxial
            devices.
        """
        axes = dict.fromkeys((axis for axis, _ in self._meaning.values()), 0.0)
        for command in self._held:
            axis, sign = self._meaning[command]
            axes[axis] += sign
        if self._devices:
            action = np.zeros(2 * self._devices)
            action[:2] = axes["guidewire"], axes["guidewire_rotation"]
            action[-2:] += axes["catheter"], axes["catheter_rotation"]
            return np.clip(action, -1.0, 1.0)
        change = BEND_RATE * duration * np.array([axes["bend_x"], axes["bend_y"]])
        self.bend = np.clip(self.bend + change, -1.0, 1.0)
        moved = [axes["translation"], axes["rotation"]][: 1 + self._rotation]
        action = np.array([*np.tile(self.bend, self._tip_joints), *moved])
        return action.astype(np.float32).astype(np.float64)
