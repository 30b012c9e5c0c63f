"""Gamepad and SpaceMouse: what they hold does what the keys do, and forces are felt."""

import ctypes
import sys
import types
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from test_play import STEP
from test_play_coaxial import Screen, held

from cathsim_dmc.physics.forces import WallForce
from cathsim_dmc.play import hands, play, session, window
from cathsim_dmc.play.controls import Controls
from cathsim_dmc.recording.episode import Episode
from cathsim_dmc.tasks.navigation import Navigation

_AXES = {"leftx": 0, "lefty": 1, "rightx": 2, "righty": 3, "out": 4, "in": 5}
_FULL = 32767


class Description(ctypes.Structure):
    """SDL_VirtualJoystickDesc of SDL 2.24 and later."""

    RUMBLE = ctypes.CFUNCTYPE(
        ctypes.c_int, ctypes.c_void_p, ctypes.c_uint16, ctypes.c_uint16
    )
    _fields_ = [
        *((name, ctypes.c_uint16) for name in (
            "version", "type", "axes", "buttons", "hats", "vendor", "product", "padding"
        )),
        ("button_mask", ctypes.c_uint32), ("axis_mask", ctypes.c_uint32),
        ("name", ctypes.c_char_p),
        *((name, ctypes.c_void_p) for name in ("userdata", "update", "player")),
        ("rumble", RUMBLE),
        *((name, ctypes.c_void_p) for name in ("triggers", "led", "effect")),
    ]  # fmt: skip


class Virtual:
    """A gamepad that SDL itself simulates, from its driver on the real thing."""

    def __init__(self, monkeypatch):
        pygame = pytest.importorskip("pygame", reason="needs the extra hands")
        monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
        from pygame._sdl2 import controller

        folder = Path(pygame.__file__).parents[1] / "pygame_ce.libs"
        found = sorted(folder.glob("libSDL2-2*.so*"))
        if not found or pygame.get_sdl_version() < (2, 24, 0):
            pytest.skip("needs SDL's virtual joystick")
        self._sdl = ctypes.CDLL(str(found[0]))
        self._sdl.SDL_JoystickOpen.restype = ctypes.c_void_p
        pygame.display.init()
        controller.init()
        self.felt = []

        def rumble(_, low, high):
            self.felt.append((low / 65535, high / 65535))
            return 0

        self._description = Description(
            version=1, type=1, axes=6, buttons=15, name=b"virtual",
            rumble=Description.RUMBLE(rumble),
        )  # fmt: skip
        self.plug()

    def plug(self):
        attach = self._sdl.SDL_JoystickAttachVirtualEx
        self.index = attach(ctypes.byref(self._description))
        assert self.index >= 0
        self._pad = ctypes.c_void_p(self._sdl.SDL_JoystickOpen(self.index))
        for axis in ("in", "out"):
            self.lean(axis, -1.0)  # triggers at rest

    def unplug(self):
        self._sdl.SDL_JoystickClose(self._pad)
        self._sdl.SDL_JoystickDetachVirtual(self.index)

    def lean(self, axis, share):
        value = ctypes.c_int16(round(share * _FULL))
        self._sdl.SDL_JoystickSetVirtualAxis(self._pad, _AXES[axis], value)

    def press(self, button, down):
        self._sdl.SDL_JoystickSetVirtualButton(self._pad, button, ctypes.c_uint8(down))


@pytest.fixture
def virtual(monkeypatch):
    made = Virtual(monkeypatch)
    yield made
    made.unplug()


def acted(pad, **options):
    controls = Controls(hand=pad, **options)
    controls.poll()
    return controls, controls.action(STEP)


@pytest.mark.parametrize(
    ("axis", "share", "key", "wanted"),
    [
        ("lefty", -1.0, "w", 1.0),
        ("lefty", 0.5, "w", -(0.5 - 0.15) / 0.85),
        ("leftx", -1.0, "a", 1.0),
        ("rightx", 1.0, "Right", 1.0),
        ("righty", -1.0, "Up", 1.0),
        ("in", 1.0, "w", 1.0),
        ("out", 1.0, "w", -1.0),
        ("lefty", 0.1, "w", 0.0),  # at rest
    ],
)
def test_a_stick_does_what_its_key_does(virtual, axis, share, key, wanted):
    pad = hands.Gamepad()
    virtual.lean(axis, share)
    for options in ({"tip_joints": 2, "rotation": True}, {"devices": 2}):
        keys = Controls(**options)
        keys.press(key)
        _, action = acted(pad, **options)
        np.testing.assert_allclose(action, wanted * keys.action(STEP), atol=1e-4)
    pad.close()


def test_buttons_act_once_and_a_lost_gamepad_is_at_rest(virtual):
    pad = hands.Gamepad()
    controls = Controls(3, hand=pad)
    controls.bend[:] = 0.4
    virtual.press(0, True)
    controls.poll()
    assert not controls.bend.any()
    controls.bend[:] = 0.4
    controls.poll()  # still down
    assert controls.bend.all() and controls.requested is None
    virtual.press(6, True)
    controls.poll()
    assert controls.requested == "restart"
    virtual.lean("lefty", -1.0)
    controls.poll()
    assert controls.action(STEP)[-1] == 1.0
    virtual.unplug()
    controls.poll()
    assert controls.action(STEP)[-1] == 0.0
    pad.feel(1.0)  # nothing is there to feel it
    virtual.plug()
    virtual.lean("lefty", -1.0)
    controls.poll()
    assert controls.action(STEP)[-1] == 1.0
    pad.close()


def test_force_is_vibration(virtual):
    pad = hands.Gamepad()
    pad.read()
    pad.feel(0.0)
    assert not any(low for low, _ in virtual.felt)
    for force in (0.015, 0.5, 1.5):
        pad.feel(force)
        assert virtual.felt[-1][0] == pytest.approx(hands.strength(force), abs=1e-4)
    assert virtual.felt[-1] == (1.0, 1.0)
    assert hands.strength(0.015) == pytest.approx(0.1)
    assert hands.strength(-1.0) == 0.0 and hands.strength(0.0) == 0.0
    pad.close()
    assert virtual.felt[-1] == (0.0, 0.0)
    asked = []
    pad._pad = types.SimpleNamespace(attached=lambda: True)
    pad._pad.rumble = lambda *how: asked.append(how)
    pad.feel(1.5 / 4)
    assert asked == [(0.5, 0.0, 100)]  # ms, longer than a control step


def test_without_a_gamepad_the_message_says_what_to_do(monkeypatch, cathsim):
    pytest.importorskip("pygame", reason="needs the extra hands")
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    code, _, told = cathsim("play", "simple1_bca", "--hands", "gamepad")
    assert code == 2 and "no gamepad is connected" in told
    monkeypatch.setitem(sys.modules, "pygame", None)
    code, _, told = cathsim("play", "simple1_bca", "--hands", "gamepad")
    assert code == 2 and ".[hands]" in told


def mouse(monkeypatch, states):
    """A pyspacemouse whose reports come one by one."""
    module = types.ModuleType("pyspacemouse")
    module.AxisConvention = types.SimpleNamespace(HID_Z_UP="hid_z_up")

    class Device:
        closed, t = False, -1.0
        state = types.SimpleNamespace(
            t=-1.0, x=0.0, y=0.0, z=0.0, roll=0.0, pitch=0.0, yaw=0.0, buttons=[0, 0]
        )

        def read(self):
            if states:
                vars(self.state).update(states.pop(0), t=self.state.t + 1)
            return self.state

        def close(self):
            self.closed = True

    module.open = lambda axis_convention: Device()
    monkeypatch.setitem(sys.modules, "pyspacemouse", module)
    return module


def test_a_spacemouse_does_what_the_keys_do(monkeypatch):
    reports = [{"y": 0.3}, {"y": 1.0, "yaw": 1.0}, {"pitch": -1.0, "buttons": [0, 1]}]
    mouse(monkeypatch, reports)
    hand = hands.hand("spacemouse")
    controls, action = acted(hand, tip_joints=1, rotation=True)
    # The newest report of those that have come.
    np.testing.assert_allclose(action, [0.0, -STEP, 1.0, 1.0], rtol=1e-6)
    assert controls.requested == "restart" and not reports

    def lost():
        raise OSError("read error")  # its own class of easyhid is an Exception

    hand._mouse.read = lost
    controls.poll()
    assert not controls.action(STEP)[-2:].any()
    hand.feel(1.0)
    hand.close()
    assert hand._mouse.closed


@pytest.mark.parametrize(
    ("axis", "place", "motor"), [("roll", (0, -1), 0), ("pitch", (1, 0), 1)]
)
def test_a_tilt_towards_you_is_up_and_one_to_the_right_is_right(
    monkeypatch, axis, place, motor
):
    """Turns are right-handed: about x (to the right), and about y (away from you)."""
    turn = Rotation.from_rotvec(np.eye(3)[["roll", "pitch"].index(axis)] * 0.1)
    np.testing.assert_array_equal(np.sign(turn.apply([0, 0, 1.0])[:2]), place)
    mouse(monkeypatch, [{axis: 1.0}])
    _, action = acted(hands.hand("spacemouse"), tip_joints=1, rotation=True)
    np.testing.assert_allclose(action, STEP * np.eye(4)[motor], rtol=1e-6)


def test_a_spacemouse_that_cannot_be_read_is_said(monkeypatch, cathsim):
    module = mouse(monkeypatch, [])

    def refuse(axis_convention):
        raise RuntimeError("No device found\nat all")

    module.open = refuse
    code, _, told = cathsim("play", "simple1_bca", "--hands", "spacemouse")
    assert code == 2 and "No device found at all" in told and "udev" in told


def test_an_episode_by_hand_is_recorded_and_felt(monkeypatch, tmp_path):
    """From the hand to the demonstration, with the window of a screen that is not."""

    class Pusher:
        help, felt, closed = "it pushes", [], False

        def read(self):
            return {"w": 0.5}, set()

        def feel(self, force):
            self.felt.append(force)

        def close(self):
            self.closed = True

    pusher = Pusher()
    monkeypatch.setattr(session, "hand", lambda name: pusher)
    screen = Screen([(20, "KeyPress", "Escape"), *held("Right", 2, 6)])
    monkeypatch.setitem(sys.modules, "tkinter", screen)
    monkeypatch.setattr(window, "_REPEAT", 0.0)
    force = WallForce(0.9, 0.8, 0.7, 0.6, mean_sum=0.5, mean_max=0.4)
    monkeypatch.setattr(Navigation, "wall_force", property(lambda _: force))
    (path,) = play("simple1_bca", tmp_path, speed=1e3, hands="gamepad")
    episode = Episode.load(path)
    assert (episode.action[1:, 20] == 0.5).all() and episode.action[-1, 1] > 0.0
    assert len(pusher.felt) >= episode.steps and pusher.closed
    assert set(pusher.felt) == {0.4}
    assert "it pushes" in screen.said[0]
    with pytest.raises(ValueError, match="hands is 'feet'"):
        play("simple1_bca", hands="feet")


@pytest.fixture(scope="module")
def by_hand(tmp_path_factory):
    """Folder of two episodes as a hand leaves them; the first one succeeds."""
    from cathsim_dmc import suite
    from cathsim_dmc.policies import in_environment, make_policy
    from cathsim_dmc.recording.recorder import EpisodeRecorder

    folder = tmp_path_factory.mktemp("hand")
    options = {"goal_radius": 0.045}
    kwargs = {"observation": "tracking", **options}
    env = suite.load("cathsim", "simple1_bca", kwargs)
    recorder = EpisodeRecorder(env, "simple1_bca", options)
    for number, steps in enumerate((None, 3)):
        act = in_environment(make_policy("expert", 0), env)
        episode = recorder.record_episode(act, 7 + number, max_steps=steps)
        assert episode.success is (steps is None)
        episode.save(folder / f"simple1_bca_{number:03d}.npz")
    return folder


@pytest.mark.slow
def test_episodes_of_a_hand_are_demonstrations(by_hand, tmp_path, cathsim, monkeypatch):
    for missing in ("gymnasium", "minari"):  # of the extra gym, which hands lacks
        monkeypatch.setitem(sys.modules, missing, None)
    monkeypatch.delitem(sys.modules, "cathsim_dmc.simulation.gymnasium", raising=False)
    from cathsim_dmc import agents
    from cathsim_dmc.agents.demonstrations import load_transitions
    from cathsim_dmc.agents.networks import NetworkShapes
    from cathsim_dmc.recording.dataset import DatasetError

    env = agents.make_env(
        "simple1_bca", observation="tracking", seed=7,
        task_kwargs={"goal_radius": 0.045},
    )  # fmt: skip
    shapes = NetworkShapes.of(env.observation_spec, env.action_spec)
    shown = load_transitions(by_hand, "tracking", shapes, task="simple1_bca")
    episode = Episode.load(by_hand / "simple1_bca_000.npz")
    assert len(shown) == episode.steps  # the other one did not succeed
    # They are what the environment gives for the actions of the hand.
    state = env.reset()
    for row in shown:
        np.testing.assert_array_equal(
            row["observation_vector"], state["observation_vector"][0]
        )
        state["action"] = row["action"][None]
        state = env.step(state)["next"]
        np.testing.assert_allclose(row["next", "reward"], state["reward"][0], rtol=1e-6)
    assert row["next", "terminated"].all()
    with pytest.raises(DatasetError, match="task is 'simple1_bca', not 'type1_bca'"):
        load_transitions(by_hand, "tracking", shapes, task="type1_bca")
    code, _, _ = cathsim(
        "train", "simple1_bca", "--algo", "bc", "--demonstrations", by_hand,
        "--observation", "tracking", "--goal-radius", "0.045", "--total-frames", "64",
        "--num-envs", "2", "--gradient-steps", "20", "--hidden", "8",
        "--out", tmp_path / "run",
    )  # fmt: skip
    assert code == 0 and (tmp_path / "run" / "checkpoints").is_dir()


def test_an_episode_is_repeated_with_the_end_that_it_had(by_hand):
    """One reaches its goal, and its operator has stopped the other."""
    from cathsim_dmc.recording.dataset import repeat_episodes

    won, stopped = repeat_episodes(by_hand, "tracking")
    steps = len(won.actions)
    assert won.terminations == [False] * (steps - 1) + [True]
    assert won.truncations == [False] * steps
    assert stopped.terminations == [False] * 3
    assert stopped.truncations == [False, False, True]


def test_an_option_with_its_default_value_is_the_default(by_hand, tmp_path):
    import dataclasses

    from cathsim_dmc.recording.dataset import DatasetError, repeat_episodes

    episode = Episode.load(by_hand / "simple1_bca_001.npz")
    options = {**episode.meta["task_kwargs"], "device": "steerable_5f"}
    meta = {**episode.meta, "task_kwargs": options}
    dataclasses.replace(episode, meta=meta).save(tmp_path / "a.npz")
    (one,) = repeat_episodes(tmp_path, "tracking", device=None)
    assert len(one.actions) == 3
    said = "its device is the default, not 'steerable_4f'"
    with pytest.raises(DatasetError, match=said):
        list(repeat_episodes(tmp_path, "tracking", device="steerable_4f"))


def test_an_episode_that_leads_elsewhere_is_refused(by_hand, tmp_path):
    import dataclasses

    from cathsim_dmc.recording.dataset import DatasetError, repeat_episodes

    episode = Episode.load(by_hand / "simple1_bca_000.npz")
    for changed, said in (
        ({"action": 0.9 * episode.action}, "does not repeat"),
        ({"seed": None}, "the seed None"),
        ({"task": "simple1_bc"}, "no demonstration"),
    ):
        dataclasses.replace(episode, **changed).save(tmp_path / "a.npz")
        with pytest.raises(DatasetError, match=said):
            list(repeat_episodes(tmp_path, "tracking"))
    (tmp_path / "a.npz").write_bytes(b"nothing")
    with pytest.raises(DatasetError, match="no demonstration"):
        list(repeat_episodes(tmp_path, "tracking"))
