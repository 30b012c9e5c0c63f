"""Actions of a task from held keys and from a gamepad or SpaceMouse."""

import numpy as np

from cathsim_dmc.play.hands import Hand
from cathsim_dmc.tasks.scene import Scene

# Tk keys that act while held: axis, sign for a steerable device, sign for coaxial
# devices. The axes of a steerable device are bend about x and y, translation, rotation;
# those of coaxial devices translation and rotation of the innermost, then outermost.
HELD = {
    "w": (2, 1.0, 1.0),
    "s": (2, -1.0, -1.0),
    "a": (3, 1.0, 1.0),
    "d": (3, -1.0, -1.0),
    "Up": (0, 1.0, 1.0),
    "Down": (0, -1.0, -1.0),
    "Left": (1, -1.0, 1.0),
    "Right": (1, 1.0, -1.0),
}
# Keys that act once per press.
ONCE = {"space": "straight", "r": "restart", "Escape": "quit"}
_ALWAYS = "R: again", "Esc: quit"

BEND_RATE = 1.0  # share of the full deflection per second while a key is held

_BEND = "arrows: bend the tip as seen from the front (up: towards you)"
_INNERMOST = "arrows: push/pull (up/down) and rotate (left/right) the guidewire"


class Controls:
    """Maps held keys to speeds and to the bend of a steerable tip, which persists.

    In the AP view, "Right" bends the tip to the right of the image and "Up" towards
    the observer, as long as the base is not rotated. With coaxial devices, the keys
    move the innermost and the outermost; a single device is both.

    Attributes:
        help: Text that explains the keys.
        requested: "restart" or "quit" since the last `restart`, or None.
        bend: Deflection (2,) of the tip about x and y in [-1, 1], of the full one.
    """

    def __init__(
        self,
        tip_joints: int = 0,
        rotation: bool = False,
        devices: int = 0,
        *,
        watching: bool = False,
        hand: Hand | None = None,
    ):
        """Starts with nothing held and a straight tip.

        Args:
            tip_joints: Number of steerable joints of the device, two motors each.
            rotation: Whether the action has a rotation.
            devices: Number K of coaxial devices; 0 for a steerable device.
            watching: Whether a policy gives the actions.
            hand: A gamepad or SpaceMouse beside the keys.
        """
        self._tip_joints, self._rotation, self._devices = tip_joints, rotation, devices
        mine = [] if watching else [*([hand.help] if hand else []), *self._keys()]
        self.help = "   ".join([*mine, *_ALWAYS])
        self._hand, self._down = hand, set[str]()
        self._held: set[str] = set()
        self.restart()

    @classmethod
    def of(
        cls, scene: Scene, *, watching: bool = False, hand: Hand | None = None
    ) -> "Controls":
        """Returns the controls for the devices of a scene."""
        chain, how = scene.catheter, {"watching": watching, "hand": hand}
        if scene.catheter.coaxial:
            return cls(devices=len(chain.devices), **how)
        turns = chain.rotation is not None
        return cls(len(chain.tip_motors) // 2, turns, **how)

    def _keys(self) -> list[str]:
        """Returns the explanations of the keys that drive the device."""
        if self._devices == 1:
            return ["arrows or W/S and A/D: push/pull and rotate the device"]
        if self._devices:
            return [_INNERMOST, "W/S: push/pull the catheter", "A/D: rotate it"]
        bend = [_BEND] if self._tip_joints else []
        turn = ["A/D: rotate"] if self._rotation else []
        straighten = ["space: straighten"] if self._tip_joints else []
        return [*bend, "W/S: push/pull", *turn, *straighten]

    def press(self, key: str) -> None:
        """Holds a key of `HELD` until `release`; performs one of `ONCE`."""
        if key in HELD:
            self._held.add(key)
        elif ONCE.get(key) == "straight":
            self.bend = np.zeros(2)
        else:
            self.requested = ONCE.get(key, self.requested)

    def release(self, key: str) -> None:
        """Releases a key."""
        self._held.discard(key)

    def poll(self) -> None:
        """Reads the gamepad or SpaceMouse; a button acts once per press."""
        if self._hand is not None:
            self._leaning, down = self._hand.read()
            for key in down - self._down:
                self.press(key)
            self._down = down

    def feel(self, force: float) -> None:
        """Makes the gamepad vibrate with the largest contact force, N."""
        if self._hand is not None:
            self._hand.feel(force)

    def restart(self) -> None:
        """Releases all keys and straightens the tip."""
        self._held.clear()
        self._leaning: dict[str, float] = {}
        self.requested: str | None = None
        self.bend = np.zeros(2)

    def action(self, duration: float) -> np.ndarray:
        """Returns the action of the next control step, of a duration in seconds.

        Returns:
            (A,) float64 in [-1, 1], rounded to single precision so that a demonstration
            can be repeated exactly through float32 interfaces. A is 2 K with coaxial
            devices.
        """
        held = np.zeros(4)
        for key, share in [*((key, 1.0) for key in self._held), *self._leaning.items()]:
            axis, *signs = HELD[key]
            held[axis] += share * signs[self._devices > 0]
        held = np.clip(held, -1.0, 1.0)
        if self._devices:
            action = np.zeros(2 * self._devices)
            action[:2] = held[:2]
            action[-2:] += held[2:]
            return np.clip(action, -1.0, 1.0).astype(np.float32).astype(np.float64)
        self.bend = np.clip(self.bend + BEND_RATE * duration * held[:2], -1.0, 1.0)
        moved = held[2 : 3 + self._rotation]
        action = np.array([*np.tile(self.bend, self._tip_joints), *moved])
        return action.astype(np.float32).astype(np.float64)
