"""Playing coaxial devices by hand: every key from the window to the simulation.

There is no display in these tests: tkinter is replaced by one that presses keys at
given pictures and remembers what is drawn, everything behind it is the real thing.
"""

import sys
import types

import numpy as np
import pytest

from cathsim_dmc.play import controls, play, window
from cathsim_dmc.play.controls import Controls
from cathsim_dmc.recording.episode import Episode
from cathsim_dmc.recording.records import CoaxialRecord

TASK = "simple1_lcca_pair"
STEP = 0.04
# Entry of the action of a wire in a catheter, and what it is, by key.
MEANING = {
    "Up": (0, 1.0),
    "Down": (0, -1.0),
    "Left": (1, 1.0),
    "Right": (1, -1.0),
    "w": (2, 1.0),
    "s": (2, -1.0),
    "a": (3, 1.0),
    "d": (3, -1.0),
}


@pytest.mark.parametrize("key", MEANING)
def test_each_hand_holds_a_device(key):
    hands = Controls(devices=2)
    assert not hands.action(STEP).any()
    hands.press(key)
    place, value = MEANING[key]
    for _ in range(3):
        np.testing.assert_array_equal(hands.action(STEP), value * np.eye(4)[place])
    hands.release(key)
    assert not hands.action(STEP).any()
    hands.press(key)
    hands.restart()
    assert not hands.action(STEP).any()


class Screen(types.ModuleType):
    """What `window` needs of tkinter, with keys that come by the number of pictures.

    Attributes:
      keys: (picture, "KeyPress" or "KeyRelease", name of a key) to come.
      pictures: shown so far.
      texts: drawn since the panel was last cleared.
      said: texts of labels.
      bars: length and colour of the bar of force in each picture.
    """

    TclError = RuntimeError

    def __init__(self, keys):
        super().__init__("tkinter")
        self.keys = sorted(keys)
        self.pictures = 0
        self.texts, self.said, self.bars = [], [], []
        self.bound = {}
        self.Tk = lambda **_: Widget(self)
        self.Canvas = self._canvas
        self.Label = self._label
        self.PhotoImage = self._picture

    def _canvas(self, *_, **options):
        # The panel is black, the screen is not.
        return Panel(self) if "background" in options else Widget(self)

    def _label(self, *_, text, **__):
        self.said.append(text)
        return Widget(self)

    def _picture(self, *, data, **_):
        assert data.startswith(b"P5 512 512 255 ")
        return data

    def deliver(self):
        while self.keys and self.keys[0][0] <= self.pictures:
            _, kind, name = self.keys.pop(0)
            self.bound[f"<{kind}>"](types.SimpleNamespace(keysym=name))


class Widget:
    def __init__(self, screen):
        self.screen = screen

    def bind(self, event, handler):
        self.screen.bound[event] = handler

    def update(self):
        self.screen.deliver()

    def create_image(self, *_, **__):
        self.screen.pictures += 1

    def __getattr__(self, name):
        return lambda *_, **__: None


class Panel(Widget):
    def delete(self, *_):
        self.screen.texts = []

    def create_text(self, *_, text, **__):
        self.screen.texts.append(text)

    def create_rectangle(self, left, _, right, *__, fill, **___):
        self.screen.bars.append((right - left, fill))


def held(key, first, last):
    return [(first, "KeyPress", key), (last, "KeyRelease", key)]


def test_an_operator_moves_wire_and_catheter_in_the_window(monkeypatch, tmp_path):
    keys = [
        *held("Up", 2, 12),  # wire forward
        *held("w", 6, 16),  # and catheter
        *held("Left", 18, 28),  # wire turned
        *held("d", 20, 26),  # catheter turned the other way
        *held("s", 30, 34),
        *held("Down", 32, 36),
        (40, "KeyPress", "r"),  # the next episode
        *held("A", 44, 48),  # with caps lock
        (50, "KeyPress", "Escape"),
    ]
    screen = Screen(keys)
    monkeypatch.setitem(sys.modules, "tkinter", screen)
    monkeypatch.setattr(window, "_REPEAT", 0.0)
    written = play(TASK, out=tmp_path, seed=4, speed=1e3)
    assert screen.said == [controls.Controls(devices=2).help]
    first, second = (Episode.load(path) for path in written)
    devices = [CoaxialRecord.of(episode) for episode in (first, second)]

    def pressed(entry):
        """Control steps of the first episode in which it was asked for, and its sign.

        The action after the n-th picture is that of control step n - 1.
        """
        steps = np.flatnonzero(first.action[:, entry])
        return steps + 1, np.unique(first.action[steps, entry])

    for entry, (start, stop), sign in ((1, (18, 28), 1.0), (3, (20, 26), -1.0)):
        steps, signs = pressed(entry)
        assert signs == [sign]
        assert abs(steps[0] - start) <= 1 and abs(steps[-1] + 1 - stop) <= 2
        assert (np.diff(steps) == 1).all()
    assert set(first.action[:17, 0]) == set(first.action[:17, 2]) == {0.0, 1.0}
    assert set(first.action[28:, 0]) == set(first.action[28:, 2]) == {0.0, -1.0}
    # The devices did as they were told: 1.6 mm and 7.2 degrees in a control step.
    way = np.cumsum(first.action[:, [0, 2]], axis=0)[-1] * 1.6e-3
    moved = devices[0].insertion[-1] - devices[0].insertion[0]
    np.testing.assert_allclose(moved, way, atol=1e-3)
    turned = devices[0].rotation[-1]
    expected = first.action[:, [1, 3]].sum(axis=0) * 3.14 * STEP
    np.testing.assert_allclose(turned, expected, atol=1e-9)
    assert second.action[:, 3].max() == 1.0 and not second.action[:, :3].any()
    assert (first.seed, second.seed) == (4, 5)
    # What is read beside the picture, at the last one shown.
    assert {"guidewire", "catheter"} <= set(screen.texts)
    assert screen.texts.count("turned") == 2
    angle = np.degrees(devices[1].rotation[-2:, 1])
    shown = [float(text[:-1]) for text in screen.texts if text.endswith("°")]
    assert shown[0] == 0.0 and np.abs(shown[1] - angle).min() < 1.0
