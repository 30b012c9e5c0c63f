"""Playing by hand, with the keys of a display that nobody sees."""

import contextlib
import os
import shutil
import subprocess
import sys
import time

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cathsim_dmc import suite
from cathsim_dmc.play.controls import BEND_RATE, COMMANDS, Controls
from cathsim_dmc.recording import Episode

STEP = 0.04


def test_hands_push_while_a_key_is_held_and_keep_the_bend():
    hands = Controls(tip_joints=10, rotation=True)
    assert not hands.action(STEP).any()
    hands.press("push")
    hands.press("right")
    for _ in range(5):
        action = hands.action(STEP)
    bend = 5 * STEP * BEND_RATE
    np.testing.assert_allclose(action[1:20:2], bend, rtol=1e-6)
    np.testing.assert_array_equal(action[0:20:2], 0.0)
    assert action[20] == 1.0 and action[21] == 0.0
    hands.release("push")
    hands.release("right")
    action = hands.action(STEP)
    np.testing.assert_allclose(action[1:20:2], bend, rtol=1e-6)
    assert action[20] == 0.0
    hands.press("straight")
    assert not hands.action(STEP).any()
    # A press without release lasts for a moment.
    hands.press("pull", hold=2 * STEP)
    assert [hands.action(STEP)[20] for _ in range(4)] == [-1.0, -1.0, 0.0, 0.0]
    with pytest.raises(ValueError, match="push, pull"):
        hands.press("jump")


@given(st.lists(st.tuples(st.sampled_from(COMMANDS), st.booleans()), max_size=60))
def test_whatever_is_pressed_the_action_is_one(keys):
    hands = Controls(tip_joints=3, rotation=False)
    for command, down in keys:
        (hands.press if down else hands.release)(command)
        action = hands.action(STEP)
        assert action.shape == (7,) and np.abs(action).max() <= 1.0
        np.testing.assert_array_equal(action, action.astype(np.float32))


@contextlib.contextmanager
def display():
    """An X server of one's own, and its name."""
    for program in ("Xvfb", "xdotool"):
        if shutil.which(program) is None:
            pytest.skip(f"no {program} here")
    pytest.importorskip("tkinter")
    read, write = os.pipe()
    server = subprocess.Popen(
        ["Xvfb", "-displayfd", str(write), "-screen", "0", "1024x768x24"],
        pass_fds=[write],
        stderr=subprocess.DEVNULL,
    )
    os.close(write)
    try:
        with os.fdopen(read) as pipe:
            number = pipe.readline().strip()
        if not number:
            pytest.skip("Xvfb does not start here")
        yield f":{number}"
    finally:
        server.terminate()
        server.wait()


class Player:
    """A player in a process of its own, and the keys to it."""

    def __init__(self, screen, code, gl="disable"):
        self.environment = {
            **os.environ,
            "DISPLAY": screen,
            "MUJOCO_GL": gl,
            "OMP_NUM_THREADS": "1",
            "LIBGL_ALWAYS_SOFTWARE": "1",
        }
        self.process = subprocess.Popen(
            [sys.executable, "-c", code],
            env=self.environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )

    def xdotool(self, *words, check=True):
        return subprocess.run(
            ["xdotool", *words],
            env=self.environment,
            check=check,
            capture_output=True,
            text=True,
        ).stdout

    def find(self, name):
        """Waits for a window and gives it the keys."""
        for _ in range(300):
            found = self.xdotool("search", "--name", name, check=False).split()
            if found:
                self.xdotool("windowfocus", found[-1], check=False)
                return found[-1]
            if self.process.poll() is not None:
                break
            time.sleep(0.2)
        self.process.kill()
        raise AssertionError(f"no window {name}: {self.process.communicate()}")

    def press(self, key, seconds):
        self.xdotool("keydown", key)
        time.sleep(seconds)
        self.xdotool("keyup", key)

    def finish(self):
        out, error = self.process.communicate(timeout=120)
        assert self.process.returncode == 0, error
        return out


@pytest.fixture
def screen():
    with display() as name:
        yield name


def test_a_person_cannulates_in_the_fluoroscopy_window(screen, tmp_path):
    code = f"""
from cathsim_dmc.play import play
options = {{"max_steps": 500}}
print(play("type1_bca", out={str(tmp_path)!r}, seed=4, task_kwargs=options))
"""
    player = Player(screen, code)
    player.find("cathsim")
    time.sleep(1.0)
    player.press("w", 1.0)
    player.press("Right", 0.6)
    time.sleep(0.3)
    picture = subprocess.run(
        ["xdotool", "search", "--name", "cathsim", "getwindowgeometry"],
        env=player.environment,
        capture_output=True,
        text=True,
    )
    assert "Geometry" in picture.stdout
    player.xdotool("key", "r")  # the next episode
    time.sleep(1.0)
    player.press("s", 0.3)
    player.xdotool("key", "Escape")
    player.finish()

    first, second = (
        Episode.load(tmp_path / f"type1_bca_{i:03d}.npz") for i in range(2)
    )
    assert (first.task, first.seed, second.seed) == ("type1_bca", 4, 5)
    # Pushed for about a second, then bent for about 0.6 s; the bend stays.
    pushed = first.action[:, 20] == 1.0
    assert 10 <= pushed.sum() <= 60
    bend = first.action[:, 1]
    assert 0.2 < bend[-1] < 1.0 and (np.diff(bend) >= 0).all()
    np.testing.assert_array_equal(first.action[:, 0:20:2], 0.0)
    assert bend[np.flatnonzero(pushed)].max() < 0.2
    assert first.insertion[-1] - first.insertion[0] > 0.008
    assert first.termination == "truncated"
    assert not second.action[:, :20].any() and second.action[:, 20].min() == -1.0
    assert second.meta["task_kwargs"] == {"max_steps": 500}


def test_without_a_display_the_message_says_so(monkeypatch):
    from cathsim_dmc.play import play

    monkeypatch.delenv("DISPLAY", raising=False)
    with pytest.raises(ValueError, match="DISPLAY|tkinter"):
        play("simple1_bca")


def test_unknown_modes_and_tasks_are_refused():
    from cathsim_dmc.play import play

    with pytest.raises(ValueError, match="fluoroscopy, viewer"):
        play("type1_bca", "cinema")
    with pytest.raises(ValueError, match=next(iter(suite.SUITE))):
        play("type9_bca")
