"""Playing by hand, with the keys of a screen that is not there."""

import sys
import types

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from test_play_coaxial import Screen, held

from cathsim_dmc import suite
from cathsim_dmc.physics.forces import WallForce
from cathsim_dmc.play import play, session, window
from cathsim_dmc.play.controls import BEND_RATE, HELD, ONCE, Controls
from cathsim_dmc.recording.episode import Episode

STEP = 0.04


def test_hands_push_while_a_key_is_held_and_keep_the_bend():
    hands = Controls(tip_joints=10, rotation=True)
    assert not hands.action(STEP).any()
    hands.press("w")
    hands.press("Right")
    for _ in range(5):
        action = hands.action(STEP)
    bend = 5 * STEP * BEND_RATE
    np.testing.assert_allclose(action[1:20:2], bend, rtol=1e-6)
    np.testing.assert_array_equal(action[0:20:2], 0.0)
    assert action[20] == 1.0 and action[21] == 0.0
    hands.release("w")
    hands.release("Right")
    action = hands.action(STEP)
    np.testing.assert_allclose(action[1:20:2], bend, rtol=1e-6)
    assert action[20] == 0.0
    hands.press("space")
    assert not hands.action(STEP).any()


@given(
    st.lists(
        st.tuples(st.sampled_from([*HELD, *ONCE, "x"]), st.booleans()), max_size=60
    )
)
def test_whatever_is_pressed_the_action_is_one(keys):
    hands = Controls(tip_joints=3, rotation=False)
    for command, down in keys:
        (hands.press if down else hands.release)(command)
        action = hands.action(STEP)
        assert action.shape == (7,) and np.abs(action).max() <= 1.0
        np.testing.assert_array_equal(action, action.astype(np.float32))


def test_opposite_keys_do_the_opposite():
    for one, other in (("w", "s"), ("a", "d"), ("Up", "Down"), ("Left", "Right")):
        found = []
        for key in (one, other):
            hands = Controls(tip_joints=2, rotation=True)
            hands.press(key)
            found.append(hands.action(STEP))
        np.testing.assert_array_equal(found[0], -found[1])
        assert found[0].any()


def test_both_hands_move_a_single_device():
    for key, wanted in {"Up": [1, 0], "w": [1, 0], "a": [0, 1], "Left": [0, 1]}.items():
        hands = Controls(devices=1)
        hands.press(key)
        np.testing.assert_array_equal(hands.action(STEP), wanted)


def test_a_person_steers_in_the_fluoroscopy_window(monkeypatch, tmp_path):
    keys = [
        *held("w", 2, 10),
        *held("Right", 12, 18),
        (22, "KeyPress", "r"),  # the next episode
        *held("s", 26, 30),
        (34, "KeyPress", "Escape"),
    ]
    monkeypatch.setitem(sys.modules, "tkinter", Screen(keys))
    monkeypatch.setattr(window, "_REPEAT", 0.0)
    paths = play("simple1_bca", out=tmp_path, seed=4, speed=1e3)
    first, second = map(Episode.load, paths)
    assert (first.task, first.seed, second.seed) == ("simple1_bca", 4, 5)
    pushed = first.action[:, 20] == 1.0
    assert 6 <= pushed.sum() <= 10 and first.insertion[-1] > first.insertion[0] + 8e-3
    # The bend stays when the key is released.
    bend = first.action[:, 1]
    assert bend[np.flatnonzero(pushed)].max() == 0.0
    assert (np.diff(bend) >= 0).all()
    assert bend[-1] == pytest.approx(6 * STEP * BEND_RATE, rel=0.4)
    np.testing.assert_array_equal(first.action[:, 0:20:2], 0.0)
    assert first.termination == "truncated"
    assert not second.action[:, :20].any() and second.action[:, 20].min() == -1.0


def test_play_keeps_the_pace_and_does_not_catch_up(monkeypatch, shared_environment):
    """Twice as fast as the simulated time; the third picture takes half a second."""
    clock, shown = [100.0], []

    class Window:
        closed = False

        def __init__(self, task, controls):
            self._controls = controls

        def show(self, task, message="", until=0.0):
            shown.append(until - 100.0)
            clock[0] = max(clock[0], until) + 0.5 * (len(shown) == 3)
            if len(shown) == 6:
                self._controls.press("r")  # the next episode, if there is one

        def close(self):
            self.closed = True

    env = shared_environment("simple1_bca")
    monkeypatch.setattr(session.suite, "load", lambda *_: env)
    monkeypatch.setattr(session, "FluoroscopyWindow", Window)
    monotonic = types.SimpleNamespace(monotonic=lambda: clock[0])
    monkeypatch.setattr(session, "time", monotonic)
    assert play("simple1_bca", speed=2.0, episodes=1) == []
    np.testing.assert_allclose(shown, [0.02, 0.04, 0.06, 0.54, 0.56, 0.58])


def test_a_held_key_that_the_screen_repeats_stays_held(monkeypatch, shared_environment):
    clock, screen, controls = [0.0], Screen([]), Controls(10)
    monkeypatch.setitem(sys.modules, "tkinter", screen)
    monkeypatch.setattr(
        window, "time", types.SimpleNamespace(monotonic=lambda: clock[0])
    )
    shown = window.FluoroscopyWindow(shared_environment("simple1_bca").task, controls)
    event = types.SimpleNamespace(keysym="w")
    press, release = (screen.bound[f"<Key{name}>"] for name in ("Press", "Release"))

    def pushes(later):
        clock[0] += later
        shown.poll()
        return controls.action(STEP)[-1] == 1.0

    press(event)
    release(event)  # X repeats a key as release and press
    press(event)
    assert pushes(0.1)
    release(event)
    assert pushes(0.05) and not pushes(0.02)


@pytest.mark.parametrize(
    ("force", "share", "colour"),
    [(0.0, 0, "green"), (0.3, 0.2, "orange"), (1.0, 2 / 3, "red"), (9.0, 1, "red")],
)
def test_a_bar_shows_the_largest_contact(
    force, share, colour, monkeypatch, shared_environment
):
    screen = Screen([])
    monkeypatch.setitem(sys.modules, "tkinter", screen)
    env = shared_environment("simple1_bca")
    env.reset()
    shown = window.FluoroscopyWindow(env.task, Controls(10))
    monkeypatch.setattr(
        type(env.task), "wall_force",
        property(lambda _: WallForce(0.7, 0.7, 0.7, 0.7, force, force)),
    )  # fmt: skip
    shown.show(env.task)
    length, drawn = screen.bars[-1]
    assert length == pytest.approx(share * (window._PANEL - 28)) and drawn == colour


def test_the_panel_says_what_is_measured():
    force = WallForce(0.9, 0.8, 0.7, 0.6, mean_sum=0.5, mean_max=0.4)
    readings = types.SimpleNamespace(
        centreline=np.zeros((3, 3)), head=np.array([0.0, 0.03, 0.04]),
        insertion=0.012, push_force=-0.25,
    )  # fmt: skip
    task = types.SimpleNamespace(
        readings=readings, wall_force=force, devices=None, goal_position=np.zeros(3),
        scene=types.SimpleNamespace(goal=types.SimpleNamespace(name="bca")),
        config=types.SimpleNamespace(physics_timestep=2e-3),
    )  # fmt: skip
    lines = {name: text.strip() for name, text in window.lines_of(task)}
    assert lines == {
        "goal": "bca", "distance": "50.0 mm", "inserted": "12.0 mm",
        "push force": "-0.250 N", "wall force, sum": "0.500 N",
        "largest contact": "0.400 N", "peak of 2 ms steps": "0.600 N",
    }  # fmt: skip


def test_the_goal_is_a_ring_of_its_size_in_both_planes(monkeypatch, shared_environment):
    class Wide(Screen):
        rings = []

        def _canvas(self, *_, **options):
            canvas = super()._canvas(**options)
            canvas.create_oval = lambda box, **_: self.rings.append(box)
            return canvas

        def _picture(self, *, data, **_):
            assert data.startswith(b"P5 1024 512 255 ")

    monkeypatch.setitem(sys.modules, "tkinter", Wide([]))
    view = {"view": (30, 0), "biplane": (-60, 0), "size": 64}
    env = shared_environment("simple1_bca", fluoroscopy=view)
    env.reset()
    shown, goal = (
        window.FluoroscopyWindow(env.task, Controls(10)),
        env.task.goal_position,
    )
    shown.show(env.task)
    planes = shown._planes(env.task)
    for number, (ring, plane) in enumerate(zip(Wide.rings, planes, strict=True)):
        arm, radius = plane.carm, env.task.objective.goal_radius
        places = goal + radius * np.array([-arm.axes[0], -arm.axes[1], *arm.axes[:2]])
        (left, _), (_, top), (right, _), (_, bottom) = arm.project(places)[0]
        beside = 512 * number
        wanted = left + beside, top, right + beside, bottom
        np.testing.assert_allclose(ring, wanted, atol=1e-6)


def test_the_window_shows_the_vessel_and_the_view_of_the_episode(monkeypatch):
    """As the image of a policy with as many pixels."""
    shown = []
    monkeypatch.setitem(sys.modules, "tkinter", Screen([]))
    images = window.angiograph.images
    monkeypatch.setattr(
        window.angiograph, "images",
        lambda machines, *rest: shown.append(machines[0]) or images(machines, *rest),
    )  # fmt: skip
    options = {
        "anatomy": ["simple1", "simple2"], "goal": "bca", "observation": "tracking",
        "fluoroscopy": {"size": 512}, "randomisation": {"view": (-20, 20)}, "random": 0,
    }  # fmt: skip
    env = suite.load("cathsim", "navigate", options)
    screen, vessels = window.FluoroscopyWindow(env.task, Controls(10)), set()
    for _ in range(8):
        env.reset()
        screen.show(env.task)
        rollout = env.task.rollout
        (wanted,) = rollout.case().angiograph.planes(rollout.deviations[0])
        np.testing.assert_array_equal(shown[-1][0].vessel_mask, wanted.vessel_mask)
        vessels.add(rollout.case().scene.anatomy.name)
    assert len(vessels) == 2


def test_a_policy_is_watched_in_the_vessel_of_its_training(cathsim, monkeypatch):
    asked = {}
    monkeypatch.setattr(
        "cathsim_dmc.play.play", lambda task, out, **how: asked.update(how) or []
    )
    policy = "pretrained:femoral_type1_lcca_living"
    cathsim("play", "femoral_type1_lcca", "--policy", policy, "--max-steps", 5)
    assert asked["task_kwargs"]["vessel"]["wall"] is True
    assert asked["task_kwargs"]["max_steps"] == 5


@pytest.mark.parametrize("policy", ["expert", lambda many: many])
def test_a_name_or_a_function_is_no_policy_to_watch(policy):
    with pytest.raises(ValueError, match="policy is .* agents.load_policy"):
        play("simple1_bca", policy=policy)


def test_without_a_display_the_message_says_so(monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    with pytest.raises(ValueError, match="DISPLAY|tkinter"):
        play("simple1_bca")


def test_sessions_in_one_folder_take_different_numbers(tmp_path):
    """One finishes an episode while the other writes its own."""

    class Kept(types.SimpleNamespace):
        def save(self, path):
            if self.other:
                saved = session._save(self.other, tmp_path)
                assert saved.read_text() == "other"
            path.write_text(self.text)
            return path

    other = Kept(task="t", text="other", other=None)
    one = session._save(Kept(task="t", text="one", other=other), tmp_path)
    assert one.read_text() == "one"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["t_000.npz", "t_001.npz"]
    full = Kept(task="t", save=lambda path: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        session._save(full, tmp_path)
    assert len(list(tmp_path.iterdir())) == 2
