"""Device and driver over local sockets: who stops when, and what is refused by name."""

import contextlib
import dataclasses
import json
import os
import signal
import socket
import struct
import sys
import threading
import time
import types
from pathlib import Path

import numpy as np
import pytest

from cathsim_dmc import bridge, suite
from cathsim_dmc.bridge import driver, fit, messages, records, serving
from cathsim_dmc.bridge.driver import Driver, connect
from cathsim_dmc.bridge.records import milliseconds
from cathsim_dmc.physics.forces import WallForce
from cathsim_dmc.tasks.navigation import Navigation

PERIOD = 0.02
WAIT = 20.0  # s, for what must happen, on a busy machine


class Robot:
    """A device of two entries, whose force is what a test makes it."""

    name, period = "robot", PERIOD
    action = [{"name": "bend", "unit": "N·m"}, {"name": "push", "unit": "m/s"}]
    observation = [
        {"key": "place", "shape": [3], "dtype": "float64"},
        {"key": "view", "shape": [2, 2, 1], "dtype": "uint8"},
    ]

    def __init__(self, steps=10, force=0.0):
        self.steps, self.force = steps, force
        self.taken, self.stops, self.seeds = [], 0, []

    def start(self, seed):
        self.seeds.append(seed)
        self.count = 0
        return self._state()

    def command(self, action):
        self.taken.append(np.array(action))

    def read(self):
        self.count += 1
        return self._state()

    def stop(self):
        self.stops += 1

    def _state(self):
        end = "success" if self.count == self.steps else None
        seen = {"place": np.full(3, 0.5 * self.count),
                "view": np.full((2, 2, 1), self.count, np.uint8)}  # fmt: skip
        force = self.force(self.count) if callable(self.force) else self.force
        return bridge.State(seen, {"push": force}, PERIOD * self.count, end)


class Served:
    """A robot that is served in a thread."""

    def __init__(self, robot, episodes=1, log=None, **options):
        self.robot, self.done, self.said = robot, None, []
        # The clock of a busy machine has hiccups.
        options = bridge.ServeOptions(**{"watchdog": 5.0, **options})
        self._listener = serving.listen("127.0.0.1", 0)
        self.address = f"127.0.0.1:{self._listener.getsockname()[1]}"

        def run():
            kept = {"log": log, "say": self.said.append}
            self.done = bridge.serve(
                robot, self._listener, options, episodes=episodes, **kept
            )

        self._thread = threading.Thread(target=run, daemon=True)
        self._thread.start()

    def joined(self):
        self._thread.join(WAIT)
        assert not self._thread.is_alive()
        self._listener.close()
        return self.done

    def raw(self):
        """A socket that has said hello, and its connection."""
        link = connect(self.address)
        link.send(1.0, "hello", protocol=messages.PROTOCOL, name="raw")
        assert link.receive(time.monotonic() + WAIT)["kind"] == "welcome"
        return link


def push(observation):
    assert observation["place"].shape == (3,) and observation["view"].dtype == np.uint8
    return np.array([observation["place"][0], 1.0])


SLOW = bridge.DriveOptions(watchdog=WAIT, warm_up=2)


@pytest.mark.parametrize("lockstep", [False, True])
def test_an_episode_is_driven_and_every_action_applied(lockstep, tmp_path):
    robot = Robot()
    with bridge.Log(tmp_path / "a" / "device.jsonl") as log:
        served = Served(robot, log=log, lockstep=lockstep, missed="hold")
        with bridge.Log(tmp_path / "driver.jsonl") as own:
            found = bridge.drive(push, served.address, seed=4, options=SLOW, log=own)
            assert (tmp_path / "driver.jsonl").read_text()  # before it is closed
        (done,) = served.joined()
    assert (found.end, done["end"], done["steps"]) == ("success", "success", 10)
    assert found.steps + found.skipped == 10 == len(robot.taken)
    assert robot.seeds == [4] and robot.stops
    if lockstep:
        wanted = [[min(0.5 * k, 1.0), 1.0] for k in range(10)]  # clipped
        np.testing.assert_array_equal(robot.taken, wanted)
        assert found.steps == 10 and done["missed"] == 0 and done["tick"] is None
    else:
        assert done["tick"]["max"] >= done["tick"]["p50"] >= 0
    assert found.compute["p50"] > 0 and done["answer"]["p99"] > 0
    lines = [
        json.loads(x) for x in (tmp_path / "driver.jsonl").read_text().splitlines()
    ]
    sent = [one for one in lines if one["event"] == "sent"]
    # On a busy machine the first state may be skipped.
    first = sent[0]["step"]
    assert len(sent) == found.steps and sent[0]["action"] == [0.5 * first, 1.0]
    assert lines[-1]["event"] == "end" and sent[0]["force"] == {"push": 0.0}
    text = (tmp_path / "a" / "device.jsonl").read_text()
    assert text.count('"applied"') == 10


def test_an_empty_host_does_not_let_all_machines_in():
    with pytest.raises(ValueError, match="host is ''; it must be"):
        serving.listen("", 0)


@pytest.mark.parametrize("host", ["::1", "[::1]", "127.0.0.1"])
def test_a_device_listens_on_either_protocol(host):
    try:
        listener = serving.listen(host, 0)
    except OSError:
        pytest.skip(f"no {host} on this machine")
    with listener:
        port = listener.getsockname()[1]
        shown = f"[{host.strip('[]')}]" if ":" in host else host
        connect(f"{shown}:{port}").close()


def test_a_log_is_never_overwritten(tmp_path):
    (tmp_path / "a.jsonl").write_text("old")
    with pytest.raises(FileExistsError, match="give a new file"):
        bridge.Log(tmp_path / "a.jsonl")


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("side", ["device", "driver"])
def test_too_much_force_stops_the_device(side, sign):
    """A pull as a push; the limit itself is allowed."""
    robot = Robot(steps=100, force=lambda n: sign * 2.0 if n == 5 else -1.5)
    limits = {"device": None, "driver": None, side: 1.5}
    served = Served(robot, force_limit=limits["device"], lockstep=True)
    own = dataclasses.replace(SLOW, force_limit=limits["driver"])
    found = bridge.drive(push, served.address, options=own)
    (done,) = served.joined()
    assert found.end == "force_limit" and len(robot.taken) == 5 and robot.stops
    assert done["end"] == ("force_limit" if side == "device" else "stopped")
    assert done["force"] == 2.0 == found.force


@pytest.mark.parametrize("dtype", ["uint8", "float64"])
def test_arrays_come_out_of_a_message_as_they_went_in(dtype):
    array = np.random.RandomState(0).randint(0, 255, (2, 3, 4)).astype(dtype)
    frame = messages.pack({"kind": "hello", "x": messages.to_json(array)})
    sent = json.loads(frame[4:])["x"]
    found = messages.to_array("x", sent, array.shape, dtype)
    np.testing.assert_array_equal(found, array, strict=True)
    with pytest.raises(bridge.BridgeError, match="wrong_shape: "):
        messages.to_array("x", sent, (3, 2, 4), dtype)
    with pytest.raises(bridge.BridgeError, match="not_finite: hello"):
        messages.pack({"kind": "hello", "x": [np.nan]})


@pytest.mark.parametrize(("factor", "same"), [(1.04, True), (1.1, False), (0.5, False)])
def test_scales_are_compared_relative_to_their_size(factor, same):
    """However small they are in their unit: 4 mm/s is not 2 mm/s."""
    entry = {"name": "push", "unit": "m/s", "scale": 4e-3, "low": -1.0, "high": 1.0}
    wanted = fit.Interface(0.04, [entry], [])
    given = {**entry, "scale": factor * 4e-3}
    found = fit.meanings(wanted, {"action": [given], "observation": []})
    assert (not found) == same
    late = {"period": factor * 0.04, "action": [entry], "observation": []}
    assert (not fit.meanings(wanted, late)) == same


def test_durations_are_told_in_milliseconds():
    found = milliseconds(np.random.RandomState(0).permutation(101) * 1e-3)
    assert found == {"p50": 50.0, "p95": 95.0, "p99": 99.0, "max": 100.0}
    assert milliseconds([]) is None


class Scripted:
    """Link to a device whose states come when they are due, and the clock of both."""

    def __init__(self, end):
        table = {"action": Robot.action, "observation": Robot.observation}
        welcome = {"protocol": 1, "name": "x", "period": PERIOD, **table}
        self.now, self.due = 0.0, [(0.0, {"kind": "welcome", **welcome})]
        robot = Robot(steps=end)
        for step in range(end + 1):
            robot.count = step
            observation, force, time_, over = robot._state()
            seen = {k: messages.to_json(v) for k, v in observation.items()}
            state = {"kind": "state", "step": step, "time": time_, "force": force}
            self.due.append((time_, {**state, "observation": seen, "end": over}))

    def monotonic(self):
        return self.now

    def send(self, *_, **__):
        pass

    def receive(self, until):
        if not self.due or self.due[0][0] > max(until, self.now) + 1e-9:
            return None
        when, message = self.due.pop(0)
        self.now = max(self.now, when)
        return message


def test_a_driver_tells_its_times_and_what_it_skips(monkeypatch, tmp_path):
    """States come every 20 ms; the policy takes 10 ms, 30 ms, and once 50 ms."""

    def driven(path, overrun):
        link, durations = Scripted(6), iter([0.01, 0.03, 0.01, 0.05, 0.01])
        for module in (driver, records):
            monkeypatch.setattr(module, "time", link)

        def choose(observation):
            link.now += next(durations)
            return push(observation)

        how = dataclasses.replace(SLOW, overrun=overrun)
        with bridge.Log(path) as log:
            return Driver(link, log).episode(choose, None, how)

    found = driven(tmp_path / "log", "latest")
    assert (found.end, found.steps, found.skipped, found.late) == ("success", 5, 1, 2)
    # States are received at 0, 20, 50, 60, 110 and 120 ms.
    assert found.compute == {"p50": 10.0, "p95": 46.0, "p99": 49.2, "max": 50.0}
    assert found.period == {"p50": 20.0, "p95": 46.0, "p99": 49.2, "max": 50.0}
    lines = map(json.loads, (tmp_path / "log").read_text().splitlines())
    told = [(x["t"], x["milliseconds"]) for x in lines if x["event"] == "sent"]
    assert told == [(0.01, 10), (0.05, 30), (0.06, 10), (0.11, 50), (0.12, 10)]
    found = driven(None, "stop")
    assert (found.end, found.steps, found.skipped, found.late) == ("overrun", 2, 0, 1)


@pytest.mark.parametrize("overrun", ["latest", "stop"])
@pytest.mark.parametrize("again", [1, 2])
def test_a_state_that_came_before_is_out_of_order(overrun, again):
    """Also if both have come when the first is read."""
    link, how = Scripted(4), dataclasses.replace(SLOW, overrun=overrun)
    link.due.insert(4, link.due[again + 1])
    with pytest.raises(bridge.BridgeError, match=f"state {again} came after state 2"):
        Driver(link).episode(push, None, how)


def test_a_driver_refuses_a_flood_of_states():
    link = Scripted(60)
    link.due = [(0.0, message) for _, message in link.due]
    with pytest.raises(bridge.BridgeError, match="flood: over 50 states at once"):
        Driver(link).episode(push, None, SLOW)


class Answering(Scripted):
    """Link to a driver that answers each state late, or not; it wakes 2 ms late."""

    def __init__(self, latencies):
        self.now, self.due, self.sent = 0.0, [], []
        self._latencies = iter(latencies)

    def send(self, within, kind, **fields):
        self.sent.append((round(self.now, 6), kind, fields))
        late, step = next(self._latencies, None), fields["step"]
        if late is not None:
            action = {"kind": "action", "step": step, "action": [0.3 - step, 2.0]}
            self.due.append((self.now + late, action))

    def receive(self, until):
        message = super().receive(until)
        if message is None:
            self.now = max(self.now, until + 2e-3)
        return message


def test_a_device_keeps_its_clock_and_tells_what_came_in_time(monkeypatch):
    """Periods of 20 ms; the third answer is missing and the fourth too late.

    Readings take no time, but the second 5 ms and the fifth 70 ms, after which the
    lost periods are not made up for.
    """
    link, robot = Answering([0.005, 0.015, None, 0.03, 0.011]), Robot(steps=7)
    monkeypatch.setattr(serving, "time", link)
    read = robot.read

    def slow():
        link.now += {1: 0.005, 4: 0.07}.get(robot.count, 0.0)
        return read()

    def far():  # the watchdog does not count the way to the start
        link.now = 0.0

    robot.read, link.now = slow, -2.0
    start = robot.start
    robot.start = lambda seed: far() or start(seed)
    options = bridge.ServeOptions(watchdog=1.0)
    nobody = types.SimpleNamespace(settimeout=lambda _: None)
    session = serving._Session(robot, link, nobody, options, bridge.Log(None))
    session._seed, session._turn_away = None, lambda: None
    found = session.episode()
    times = [0.0, 0.022, 0.047, 0.062, 0.082, 0.172, 0.174, 0.194]
    assert [when for when, *_ in link.sent] == times
    told = [(fields["step"], fields["time"]) for *_, fields in link.sent]
    assert told == [(step, PERIOD * step) for step in range(8)]
    assert (found["end"], found["steps"]) == ("success", 7)
    assert (found["missed"], found["late"]) == (4, 1)
    assert found["answer"] == {"p50": 11.0, "p95": 14.6, "p99": 14.92, "max": 15.0}
    assert found["tick"] == dict.fromkeys(("p50", "p95", "p99", "max"), 2.0)
    held = [[-0.7, 0.0]] * 2, [[-1.0, 0.0]] * 2  # the bend stays, the push does not
    wanted = [[0.3, 1.0], [-0.7, 1.0], *held[0], [-1.0, 1.0], *held[1]]
    np.testing.assert_allclose(robot.taken, wanted)


def test_a_device_stops_when_its_driver_falls_silent():
    robot = Robot(steps=10_000)
    served = Served(robot, watchdog=5 * PERIOD)
    link = served.raw()
    link.send(1.0, "start", seed=None)
    link.send(1.0, "action", step=0, action=[0.3, 1.0])
    (done,) = served.joined()
    assert done["end"] == "stopped" and done["steps"] < 100
    np.testing.assert_array_equal(robot.taken[0], [0.3, 1.0])
    # It bends as before, and does not push, until it gives up.
    for action in robot.taken[1:]:
        np.testing.assert_array_equal(action, [0.3, 0.0])
    assert done["missed"] == len(robot.taken) - 1 >= 2
    assert done["reason"].startswith("watchdog: no action for")
    told = (
        f"{done['steps']} steps, {done['missed']} periods without an action: watchdog"
    )
    assert f"stopped after {told}" in served.said[0]
    kinds = []
    with contextlib.suppress(bridge.BridgeError):
        while message := link.receive(time.monotonic() + 1.0):
            kinds.append(message)
    assert kinds[-1]["kind"] == "stop" and "watchdog" in kinds[-1]["reason"]
    link.close()


def test_a_device_goes_on_with_the_next_driver_when_one_is_killed():
    robot = Robot(steps=10_000)
    served = Served(robot, episodes=2)
    link = served.raw()
    link.send(1.0, "start", seed=1)
    assert link.receive(time.monotonic() + WAIT)["kind"] == "state"
    # As of a killed process: its end is reset, with unread states.
    link._socket.setsockopt(
        socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0)
    )
    link.close()
    robot.steps = 3
    # Until the loss is noticed, another driver hears that it is busy.
    for _ in range(100):
        try:
            found = bridge.drive(push, served.address, options=SLOW)
            break
        except bridge.BridgeError as error:
            assert error.fault == "busy"
            time.sleep(0.05)
    first, second = served.joined()
    assert first["end"] == "peer_lost" and second["end"] == "success" == found.end


def test_a_driver_stops_when_its_device_falls_silent_or_is_lost():
    listener = serving.listen("127.0.0.1", 0)
    address = f"127.0.0.1:{listener.getsockname()[1]}"
    heard = []

    def run(silent):
        sock, _ = listener.accept()
        link = bridge.Connection(sock)
        link.receive(time.monotonic() + WAIT)
        table = {"action": Robot.action, "observation": Robot.observation}
        link.send(1.0, "welcome", protocol=1, name="x", period=PERIOD, **table)
        robot = Robot()
        state = robot.start(link.receive(time.monotonic() + WAIT)["seed"])
        seen = {k: messages.to_json(v) for k, v in state.observation.items()}
        link.send(1.0, "state", step=0, time=0, observation=seen, force={}, end=None)
        heard.append(link.receive(time.monotonic() + WAIT))
        if silent:
            heard.append(link.receive(time.monotonic() + WAIT))
        link.close()

    for silent in (True, False):
        thread = threading.Thread(target=run, args=(silent,), daemon=True)
        thread.start()
        how = bridge.DriveOptions(watchdog=0.3 if silent else WAIT)
        if silent:
            assert bridge.drive(push, address, options=how).end == "watchdog"
        else:
            with pytest.raises(bridge.BridgeError, match="peer_lost"):
                bridge.drive(push, address, options=how)
        thread.join(WAIT)
    listener.close()
    assert [one["kind"] for one in heard] == ["action", "stop", "action"]


def test_the_end_counts_of_a_device_that_closes_while_the_policy_computes():
    listener = serving.listen("127.0.0.1", 0)
    computing, closed = threading.Event(), threading.Event()

    def run():
        sock, _ = listener.accept()
        link = bridge.Connection(sock)
        link.receive(time.monotonic() + WAIT)
        table = {"action": Robot.action, "observation": Robot.observation}
        link.send(1.0, "welcome", protocol=1, name="x", period=PERIOD, **table)
        state = Robot().start(link.receive(time.monotonic() + WAIT)["seed"])
        seen = {k: messages.to_json(v) for k, v in state.observation.items()}
        common = {"time": 0, "observation": seen, "force": {}}
        link.send(1.0, "state", step=0, end=None, **common)
        computing.wait(WAIT)
        link.send(1.0, "state", step=1, end="success", **common)
        off = struct.pack("ii", 1, 0)  # so that the driver's action cannot be sent
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, off)
        link.close()
        closed.set()

    def choose(observation):
        computing.set()
        closed.wait(WAIT)
        return push(observation)

    threading.Thread(target=run, daemon=True).start()
    address = f"127.0.0.1:{listener.getsockname()[1]}"
    how = bridge.DriveOptions(warm_up=0, watchdog=WAIT)
    assert bridge.drive(choose, address, options=how).end == "success"
    listener.close()


def test_missed_periods_and_late_actions_are_said(tmp_path):
    def slow(observation):
        time.sleep(4 * PERIOD)
        return push(observation)

    file = tmp_path / "log.jsonl"
    with bridge.Log(file) as log:
        served = Served(Robot(steps=20), missed="still", log=log)
        how = bridge.DriveOptions(overrun="latest", watchdog=WAIT, warm_up=0)
        bridge.drive(slow, served.address, options=how)
        (done,) = served.joined()
    missed, late = done["missed"], done["late"]
    assert missed > 5 and late > 0
    told = f", {missed} periods without an action, {late} late actions"
    assert served.said[-1].endswith(f"success after 20 steps{told}")
    end = json.loads(file.read_text().splitlines()[-1])
    assert (end["missed"], end["late"]) == (missed, late)


def test_a_driver_that_reads_nothing_is_left():
    robot = Robot(steps=10**9)
    shape = [1000, 1000, 1]
    robot.observation = [Robot.observation[0], {**Robot.observation[1], "shape": shape}]
    big = bridge.State(
        {"place": np.zeros(3), "view": np.zeros(shape, np.uint8)}, {}, 0.0
    )
    robot._state = lambda: big
    served = Served(robot, watchdog=0.5)
    link = served.raw()
    link.send(1.0, "start", seed=None)
    with pytest.raises(bridge.BridgeError):  # it is closed
        for _ in range(2000):
            link.send(1.0, "action", step=0, action=[0, 0])
            time.sleep(0.01)
    (done,) = served.joined()
    assert done["end"] == "slow_peer" and robot.stops
    link.close()


def test_a_stop_counts_at_once_and_what_was_applied_before_is_logged(tmp_path):
    robot = Robot(steps=100)
    robot.period = 10.0
    with bridge.Log(tmp_path / "device.jsonl") as log:
        served = Served(robot, log=log, watchdog=WAIT)
        link = served.raw()
        link.send(1.0, "start", seed=None)
        link.send(1.0, "action", step=0, action=[0.3, 1.0])
        link.send(1.0, "stop", reason="enough")
        began = time.monotonic()
        (done,) = served.joined()
    assert time.monotonic() - began < 5.0 and done["reason"] == "driver: enough"
    lines = [
        json.loads(x) for x in (tmp_path / "device.jsonl").read_text().split("\n")[:-1]
    ]
    assert [one["event"] for one in lines] == ["connected", "applied", "stop", "end"]
    assert lines[1]["action"] == [0.3, 1.0] == robot.taken[0].tolist()
    link.close()


def test_the_forces_of_all_states_count_on_both_sides():
    """Those of states that a slow policy skips, and of the last one."""

    def slow(observation):
        time.sleep(6 * PERIOD)
        return push(observation)

    served = Served(Robot(steps=50, force=lambda count: 2.0 * (count == 3)),
                    force_limit=None)  # fmt: skip
    how = bridge.DriveOptions(watchdog=WAIT, warm_up=0)
    found = bridge.drive(slow, served.address, options=how)
    served.joined()
    assert (found.end, found.force, found.steps) == ("force_limit", 2.0, 1)
    served = Served(Robot(steps=3, force=lambda n: np.float32(n == 3)), lockstep=True)
    found = bridge.drive(push, served.address, options=SLOW)
    assert found.force == 1.0 == served.joined()[0]["force"]


def test_an_episode_after_one_that_the_driver_has_stopped_is_its_own():
    robot = Robot(steps=20, force=lambda count: 2.0 * (len(robot.seeds) == 1))
    served = Served(robot, episodes=2, force_limit=None)
    link = connect(served.address)
    driver = Driver(link)
    assert driver.episode(push, 1, SLOW).end == "force_limit"
    assert driver.episode(push, 2, SLOW).end == "success"
    assert [one["end"] for one in served.joined()] == ["stopped", "success"]
    link.close()


@pytest.mark.parametrize(
    ("name", "value", "said"),
    [
        ("stop", None, "no class, with the methods start, command, read, stop"),
        ("name", None, "name of the device is None; it must be a text"),
        ("period", None, "period of the device is None; it must be a finite number"),
        ("period", -0.04, "period of the device is -0.04"),
        ("action", {"name": "a"}, "action of the device is .* dictionaries with name"),
        ("action", ["insertion"], "action of the device is .* dictionaries with name"),
        ("observation", [{"key": "a"}], "dictionaries with key, shape, dtype"),
    ],
)
def test_a_device_that_lacks_something_is_refused_before_it_moves(name, value, said):
    robot = Robot()
    setattr(robot, name, value)
    with pytest.raises(ValueError, match=said):
        bridge.serve(robot, None)


def test_a_class_serves_as_no_device():
    with pytest.raises(ValueError, match="an object, no class"):
        bridge.serve(Robot, None)


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_a_state_of_another_kind_is_named():
    robot = Robot()
    robot.start = lambda seed: None
    served = Served(robot)
    with pytest.raises(bridge.BridgeError, match="a state of the device is None; it"):
        bridge.drive(push, served.address)
    served.joined()


@pytest.mark.parametrize("address", [5555, None])
def test_what_is_no_address_or_policy_is_refused(address):
    with pytest.raises(ValueError, match="address is .* host:port"):
        bridge.drive(push, address)
    with pytest.raises(ValueError, match="choose is None; it must be a function"):
        bridge.drive(None, "127.0.0.1:5555")


def test_a_watchdog_that_a_period_outlasts_is_refused():
    robot, said = Robot(), "watchdog is 0.02; it must be longer than a period.*0.02 s"
    with pytest.raises(ValueError, match=said):
        bridge.serve(robot, None, bridge.ServeOptions(watchdog=PERIOD))
    served = Served(robot)
    with pytest.raises(ValueError, match=said):
        bridge.drive(push, served.address, options=bridge.DriveOptions(watchdog=PERIOD))
    bridge.drive(push, served.address, options=SLOW)
    served.joined()


@pytest.fixture
def interrupts():
    """Ctrl-C raises, also where the tests run in the background."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.parametrize(
    ("name", "error"), [("SIGTERM", SystemExit), ("SIGINT", KeyboardInterrupt)]
)
def test_a_signal_that_ends_the_program_stops_the_device(name, error, interrupts):
    number = getattr(signal, name)
    before = signal.getsignal(signal.SIGTERM)

    def killed(observation):
        os.kill(os.getpid(), number)
        time.sleep(WAIT)

    # The program of the driver.
    robot = Robot(steps=10_000)
    served = Served(robot, watchdog=WAIT)
    with pytest.raises(error) as raised:
        bridge.drive(killed, served.address, options=bridge.DriveOptions(warm_up=0))
    (done,) = served.joined()
    assert done["end"] == "stopped" and robot.stops and name[3:4] in done["reason"]
    if name == "SIGTERM":
        assert raised.value.code == 143
        assert done["reason"] == "driver: Ended: SIGTERM"
        assert served.said[0].endswith("stopped after 0 steps: driver: Ended: SIGTERM")
    # The program of the device; only the first signal is raised.
    robot, heard = Robot(steps=10_000), []
    robot.read = lambda: os.kill(os.getpid(), number)
    stop = robot.stop
    robot.stop = lambda: (os.kill(os.getpid(), signal.SIGTERM), stop())
    if name == "SIGINT":
        robot.stop = stop
    with serving.listen("127.0.0.1", 0) as listener:
        address = f"127.0.0.1:{listener.getsockname()[1]}"

        def driven():
            with pytest.raises(bridge.BridgeError) as told:
                bridge.drive(push, address, options=SLOW)
            heard.append(str(told.value))

        thread = threading.Thread(target=driven, daemon=True)
        thread.start()
        with pytest.raises(error):
            bridge.serve(robot, listener, bridge.ServeOptions(watchdog=WAIT))
        thread.join(WAIT)
    assert heard[0].startswith("peer_lost: the device's program ends: ")
    assert robot.stops and signal.getsignal(signal.SIGTERM) is before


def test_an_action_before_the_start_is_out_of_order_at_once(monkeypatch):
    served = Served(Robot(steps=2), episodes=3, lockstep=True)
    link = served.raw()
    link.send(1.0, "action", step=0, action=[0, 0])
    began = time.monotonic()
    with pytest.raises(bridge.BridgeError, match="out_of_order: action came, expected"):
        link.receive(time.monotonic() + WAIT)
    assert time.monotonic() - began < 5.0
    # After an episode those of its steps have no effect, others are refused.
    link = served.raw()
    for late in (1, 3):
        link.send(1.0, "start", seed=None)
        for step in range(3):
            assert link.receive(time.monotonic() + WAIT)["step"] == step
            link.send(1.0, "action", step=step, action=[0, 0])
        link.send(1.0, "action", step=late, action=[0, 0])
    with pytest.raises(bridge.BridgeError, match="step 3, but the episode ended at"):
        link.receive(time.monotonic() + WAIT)
    bridge.drive(push, served.address, options=SLOW)
    assert [one["end"] for one in served.joined()] == ["success"] * 3
    monkeypatch.setattr(serving, "IDLE", 0.2)
    served = Served(Robot(steps=2))
    link = served.raw()
    with pytest.raises(bridge.BridgeError, match=r"idle: no start came within 0.2 s"):
        for _ in range(100):  # a stop is no start
            link.send(1.0, "stop", reason="none")
            link.receive(time.monotonic() + 0.1)
    bridge.drive(push, served.address, options=SLOW)
    served.joined()


def test_an_end_that_is_none_is_refused_on_both_sides():
    robot = Robot()
    robot._state = lambda: bridge.State({}, {}, 0.0, "finished")
    session = serving._Session(robot, None, None, bridge.ServeOptions(), None)
    session._seed = None
    with pytest.raises(ValueError, match="end of a State is 'finished'.*success, trun"):
        session.episode()
    assert robot.stops
    with pytest.raises(bridge.BridgeError, match='end of state is "finished".*null, s'):
        messages.require_end("finished")
    for end in (None, *messages.ENDS):
        messages.require_end(end)


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (b'{"step": 0}', "kind is missing; it must be one of hello, welcome, start"),
        (b"[1, 2]", r"a frame holds \[1, 2\]; it must be an object with a kind"),
        (b'{"kind": "action", "step": "0", "action": []}', 'is "0"; .*whole number$'),
        (b'{"kind": "action", "step": 0.0, "action": []}', "is 0.0; .*whole number$"),
        (b'{"kind": "action", "step": -1, "action": []}', "is -1; it must be 0 or"),
        (b'{"kind": "action", "step": 0, "action": 0.5}', "is 0.5; it must be a list$"),
        (b'{"kind": "start", "seed": "a"}', 'is "a"; .*whole number or null$'),
        (b'{"kind": "welcome", "protocol": 1, "name": "a", "period": 0, "action": [], '
         b'"observation": []}', "period of welcome is 0; it must be above 0"),
        (b'{"kind": "state", "step": 0, "time": 1' + b"0" * 400 + b', "observation": '
         b'{}, "force": {}, "end": null}', "not_finite: time of state is 1000"),
        ('{"kind": "start", "seed": 1}'.encode("utf-16"), "no JSON in UTF-8"),
        ('{"kind": "start", "seed": 1}'.encode("utf-16-be"), "no JSON in UTF-8"),
        ('{"kind": "stop", "reason": "x"}'.encode("utf-16-le"), "no JSON in UTF-8"),
        (b"\xff\xfe", "not_json: a frame holds no JSON in UTF-8"),
        (b'{"kind": "action", "step": true, "action": []}', "is true; .*whole number$"),
        (b'{"kind": "action", "step": 0}', "action of action is missing; it must be a"),
    ],
)  # fmt: skip
def test_what_is_no_message_is_said_with_what_it_must_be(data, said):
    with pytest.raises(bridge.BridgeError, match=said):
        messages.parse(data)


@pytest.mark.parametrize(
    ("value", "said"),
    [
        (["0", 0], r'wrong_shape: action\[0\] is "0"; action must be numbers of shape'),
        ([0, None], r"action\[1\] is null"),
        ([True, 0.0], r"action\[0\] is true"),
        ([0.0, 1e400], r"not_finite: action\[1\] is inf; it must be finite"),
        ([10**400, 0.0], r"wrong_shape: action\[0\] is 10000"),
        ([[0.0], 1.0], "wrong_shape: action is .*must be numbers of shape"),
        ([0.0], r"action has shape \[1\]; it must be \[2\]"),
        ([[0.5, True]], r"wrong_shape: action\[0\]\[1\] is true"),
        ([[[0.0]]], r"action has shape \[1, 1, 1\]; it must be \[1, 2\]"),
        ([0.0, 1.0, 0.0], r"action has shape \[3\]; it must be \[2\]"),
    ],
)
def test_the_entry_that_is_no_number_is_named(value, said):
    with pytest.raises(bridge.BridgeError, match=said):
        shape = (1, 2) if isinstance(value[0], list) and len(value) == 1 else (2,)
        messages.to_array("action", value, shape, "float64")


WANTED = fit.Interface(
    0.04,
    [{"name": "bend", "unit": "N·m", "scale": 1e-3, "low": -1.0, "high": 1.0},
     {"name": "push", "unit": "m/s", "scale": 0.04, "low": -1.0, "high": 1.0}],
    [{"key": "place", "shape": [3], "dtype": "float64", "unit": "m"}],
)  # fmt: skip
PLACE = {"key": "place", "shape": [3], "dtype": "float64"}


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({}, None),
        ({"period": 0.0401}, None),
        ({"action": [{"unit": "N m"}, {"scale": 0.041, "name": None}]}, None),
        ({"action": [{}, {}], "observation": [PLACE, {**PLACE, "key": "more"}]}, None),
        ({"period": 0.1}, "period is 0.1 s, not 0.04 s"),
        ({"action": [{}, {"scale": 0.4}]}, "scale of action 1 (push) is 0.4, not 0.04"),
        ({"action": [{"name": "push"}, {}]}, "name of action 0 (bend) is push, not"),
        ({"action": [{}, {"low": 0}]}, "low of action 1 (push) is 0, not -1"),
        ({"action": [{}, {"scale": "x"}]}, "scale of action 1 (push) is x, not 0.04"),
        ({"observation": [{**PLACE, "unit": "mm"}]}, "unit of place is mm, not m"),
        ({"observation": [{**PLACE, "shape": [2]}]}, "place has shape [2], not [3]"),
        ({"observation": [{**PLACE, "dtype": "uint8"}]}, "place is uint8, not float64"),
        ({"action": [{}]}, "an action has 1 entries, not 2"),
    ],
)
def test_a_device_that_announces_something_else_does_not_fit(given, said):
    table = {"action": WANTED.action, "observation": WANTED.observation}
    welcome = {"period": 0.04, **table, **given}
    wrong = fit.sizes(WANTED, welcome) or fit.meanings(WANTED, welcome)
    assert [one[: len(said or "")] for one in wrong] == ([] if said is None else [said])


def test_a_welcome_without_tables_is_refused():
    welcome = {"action": [Robot.action[0], "push"], "observation": [PLACE]}
    with pytest.raises(bridge.BridgeError, match="action of welcome is .*list"):
        fit.sizes(WANTED, welcome)


@pytest.mark.parametrize("wrong", [{"shape": [-1]}, {"shape": [1e999]}, {"key": [1]}])
def test_a_welcome_whose_arrays_have_no_size_or_name_is_refused(wrong):
    link = types.SimpleNamespace(send=lambda *_, **__: None)
    link.receive = lambda until: {
        "kind": "welcome", "protocol": 1, "name": "x", "period": PERIOD,
        "action": Robot.action, "observation": [{**PLACE, **wrong}],
    }  # fmt: skip
    with pytest.raises(bridge.BridgeError, match="bad_message: observation of welcome"):
        Driver(link)


def test_a_driver_gets_the_arrays_that_it_reads_alone():
    served = Served(Robot(steps=3), lockstep=True)
    link = connect(served.address)
    driver = Driver(link)
    driver.read_only({"place"})
    seen = []
    choose = lambda given: seen.append(set(given)) or [0.0, 0.0]  # noqa: E731
    driver.warm_up(choose, 1)
    assert driver.episode(choose, None, SLOW).end == "success"
    assert seen == [{"place"}] * 4
    served.joined()
    link.close()


def frame(data):
    return struct.pack(">I", len(data)) + data


def action(**changed):
    values = {"kind": "action", "step": 0, "action": [0.0, 0.0], **changed}
    return frame(json.dumps(values).encode())


BAD = {
    "frame_too_long": struct.pack(">I", messages.MAX_FRAME + 1),
    "not_json": frame(b"{nothing"),
    "not_json ": frame(b"[" * 200_000),
    "bad_message": frame(b'{"kind": "dance"}'),
    "not_finite": action(action=[float("nan"), 0.0]),
    "wrong_shape": action(action=[0.0, 0.0, 0.0]),
    "wrong_shape ": frame(
        b'{"kind": "action", "step": 0, "action": ' + b"[" * 800 + b"]" * 800 + b"}"
    ),
    "out_of_order": action(step=7),
    "out_of_order ": frame(b'{"kind": "start", "seed": 3}'),
    "flood": action() * 200,  # all but the first are late
}


def test_what_is_no_action_is_refused_by_name_and_stops_the_device():
    robot = Robot(steps=10**9)
    robot.period = 1.0  # so that a flood is one
    served = Served(robot, episodes=len(BAD), lockstep=True, watchdog=WAIT)
    for name in BAD:  # to one device, which goes on with the next driver
        before, taken = robot.stops, len(robot.taken)
        link = served.raw()
        link.send(1.0, "start", seed=None)
        assert link.receive(time.monotonic() + WAIT)["kind"] == "state", name
        with contextlib.suppress(OSError):
            link._socket.sendall(BAD[name])
        with pytest.raises(bridge.BridgeError) as wrong:
            while True:
                assert link.receive(time.monotonic() + WAIT), name
        faults = name.strip(), "peer_lost" if name == "flood" else ""
        assert wrong.value.fault in faults, name
        link.close()
        assert robot.stops > before, name
        assert len(robot.taken) - taken <= (name == "flood"), name
    assert [one["end"] for one in served.joined()] == [name.strip() for name in BAD]


def test_another_version_another_program_and_a_stranger_are_refused(monkeypatch):
    monkeypatch.setattr(serving, "HANDSHAKE", 0.3)
    robot = Robot(steps=2)
    served = Served(robot, episodes=2, lockstep=True)
    stranger = socket.create_connection(served.address.split(":"), WAIT)
    assert b"idle" in stranger.recv(1000)
    stranger.close()
    link = connect(served.address)
    link.send(1.0, "hello", protocol=2, name="new")
    with pytest.raises(bridge.BridgeError, match="wrong_version.* 2, this one 1"):
        link.receive(time.monotonic() + WAIT)
    first = served.raw()
    first.send(1.0, "start", seed=None)
    for _ in range(2):  # while it waits for the first action too
        with pytest.raises(bridge.BridgeError, match="busy"):
            Driver(connect(served.address))
    first.close()
    for address in ("localhost", "a:b", ":5", "localhost:0", "localhost:65536"):
        with pytest.raises(ValueError, match="host:port"):
            connect(address)
    for _ in range(100):  # until the first one is gone
        with contextlib.suppress(bridge.BridgeError):
            assert bridge.drive(push, served.address, options=SLOW).end == "success"
            break
    assert [one["end"] for one in served.joined()] == ["peer_lost", "success"]
    with pytest.raises(OSError, match="no device answers"):
        connect(served.address)


@pytest.mark.parametrize(
    ("answer", "fault"),
    [([np.nan, 0.0], "not_finite"), ([0.0], "wrong_shape"), ("up", "wrong_shape")],
)
def test_a_policy_that_answers_with_no_action_stops_the_device(answer, fault):
    robot = Robot(steps=100)
    served = Served(robot, lockstep=True)
    how = bridge.DriveOptions(warm_up=0, watchdog=WAIT)
    with pytest.raises(bridge.BridgeError, match=fault):
        bridge.drive(lambda seen: answer, served.address, options=how)
    (done,) = served.joined()
    assert done["end"] == "stopped" and not robot.taken


@pytest.mark.parametrize("kind", [bridge.ServeOptions, bridge.DriveOptions])
def test_options_are_checked(kind):
    for name in ("watchdog", "force_limit"):
        for value in (0.0, -1.0, np.nan, "fast"):
            with pytest.raises(ValueError, match=name):
                kind(**{name: value})
    with pytest.raises(ValueError, match="missed|overrun"):
        kind(**{"missed" if kind is bridge.ServeOptions else "overrun": "faster"})


def test_what_was_driven_is_a_table_in_milliseconds(capsys):
    from cathsim_dmc.cli.bridging import _table
    from cathsim_dmc.cli.options import console

    served = Served(Robot(steps=3), lockstep=True)
    one = vars(bridge.drive(push, served.address, options=SLOW))
    served.joined()
    console().print(_table([one, {**one, "compute": None, "reason": "[/dev/tty1]"}]))
    told = capsys.readouterr().out
    assert "[/dev/tty1]" in told
    assert "state to action, ms: p50" in told and "state to state, ms: max" in told
    assert "success" in told and "{" not in told
    console().print(_table([one]))
    assert "reason" not in capsys.readouterr().out


def test_a_shipped_policy_drives_its_task_as_it_plays_it(cathsim, shared_environment):
    """Lockstep over a socket gives the episode of the suite, bit for bit."""
    from cathsim_dmc import agents
    from cathsim_dmc.cli.bridging import _choose, require_fit
    from cathsim_dmc.policies import in_environment
    from cathsim_dmc.simulation.episodes import play_alone

    options = {"observation": "tracking", "max_steps": 15}
    env = shared_environment("femoral_type1_lcca", **options)
    policy = agents.load_policy("pretrained:femoral_type1_lcca")
    env.random_state.seed(3)
    wanted = [a for a, _ in play_alone(env, in_environment(policy, env))][1:]
    device = bridge.SimulatedDevice(env, "femoral_type1_lcca")
    served = Served(device, lockstep=True, watchdog=WAIT)
    taken = []
    device.command, command = (lambda a: (taken.append(a), command(a))), device.command
    begin = lambda welcome: require_fit(policy, welcome)  # noqa: E731
    found = bridge.drive(
        _choose(policy), served.address, seed=3, options=SLOW, begin=begin
    )
    (done,) = served.joined()
    assert found.end == done["end"] == "truncated" and found.steps == 15
    np.testing.assert_array_equal(taken, wanted)
    # What does not fit is refused before the start.
    table = {"action": device.action, "observation": device.observation}
    announced = {"name": "x", "period": 0.04, **table}
    assert require_fit(policy, announced) == {one["key"] for one in device.observation}
    welcome = {**announced, "period": 0.1}
    with pytest.raises(ValueError, match="period is 0.1 s, not 0.04 s.*--unchecked"):
        require_fit(policy, welcome)
    assert require_fit(policy, welcome, unchecked=True)
    welcome["action"] = device.action[:4]
    with pytest.raises(ValueError, match="'x'.*an action has 4 entries, not 21"):
        require_fit(policy, welcome, unchecked=True)
    for name in ("type1_lcca", "navigator"):
        other = agents.load_policy(f"pretrained:{name}")
        with pytest.raises(ValueError, match="of the suite: cathsim serve"):
            require_fit(other, {"name": "x", **table})
    code, _, told = cathsim("drive", "expert", "--connect", "127.0.0.1:9")
    assert code == 2 and "reads the simulation" in told
    code, _, told = cathsim("serve", "type1_lca")
    assert code == 2 and "type1_lcca" in told


def test_the_seeds_of_episodes_that_a_command_drives_count_up(
    cathsim, monkeypatch, tmp_path
):
    from cathsim_dmc.agents.policies import FunctionPolicy
    from cathsim_dmc.cli import bridging

    def still(observation):
        return np.zeros((1, 2))

    policy = FunctionPolicy(still)
    monkeypatch.setattr(bridging.agents, "load_policy", lambda *_, **__: policy)
    robot = Robot(steps=2)
    served = Served(robot, episodes=3, lockstep=True)
    code, out, err = cathsim(
        *("drive", "mine", "--connect", served.address, "--episodes", 3, "--seed", 7),
        *("--watchdog", WAIT, "--warm-up", 1, "--json", "--log", tmp_path / "log"),
    )
    assert code == 0, err
    served.joined()
    assert robot.seeds == [7, 8, 9] and len(json.loads(out)["episodes"]) == 3
    assert (tmp_path / "log").read_text().count('"sent"') == 6


def test_a_simulated_device_measures_as_a_load_cell_does(
    shared_environment, monkeypatch
):
    """The mean over a period, by which the suite judges, not its last moment."""
    env = shared_environment("femoral_type1_lcca", observation="tracking", max_steps=15)
    force = WallForce(0.9, 0.8, 0.7, 0.6, mean_sum=0.5, mean_max=0.4)
    monkeypatch.setattr(Navigation, "wall_force", property(lambda _: force))
    device = bridge.SimulatedDevice(env, "femoral_type1_lcca")
    states = [device.start(0)]
    device.command(np.ones(21))
    states += [device.read() for _ in range(3)]
    given = [state.force for state in states]
    assert {(one["largest"], one["sum"]) for one in given} == {(0.4, 0.5)}
    assert given[-1]["push"] == env.task.readings.push_force != 0.0
    times = [state.time for state in states]
    np.testing.assert_allclose(times, 0.04 * np.arange(4), atol=1e-9)


def test_a_port_that_is_taken_is_refused_before_anything_compiles(cathsim, monkeypatch):
    monkeypatch.setattr(suite, "load", lambda *task: pytest.fail("it compiles"))
    with bridge.listen("127.0.0.1", 0) as taken:
        port = taken.getsockname()[1]
        code, _, told = cathsim("serve", "type1_lcca", "--port", port)
    assert code == 2 and f"cannot listen on 127.0.0.1:{port}" in told


def test_the_example_pushes_and_says_after_how_many_steps_a_device_stops(
    monkeypatch, capsys
):
    monkeypatch.syspath_prepend(Path(__file__).parents[1] / "examples")
    import drive_by_socket as example

    state = {"observation": {}, "force": {}, "end": None}

    def device(server):
        sock, _ = server.accept()
        with sock, sock.makefile("rb") as stream:
            example.receive(stream)
            names = "wire/insertion", "wire/rotation"
            action = [{"name": name} for name in names]
            example.send(sock, "welcome", name="d", action=action)
            for step in range(3):
                sent.append(example.receive(stream).get("action"))
                example.send(sock, "state", step=step, **state)
            example.send(sock, "stop", reason="watchdog")
            example.receive(stream)

    sent: list = []
    with socket.create_server(("127.0.0.1", 0)) as server:
        thread = threading.Thread(target=device, args=(server,))
        thread.start()
        port = str(server.getsockname()[1])
        monkeypatch.setattr(sys, "argv", ["drive_by_socket.py", "--port", port])
        example.main()
        thread.join(10.0)
    assert "watchdog after 2 steps" in capsys.readouterr().out
    assert sent == [None, [1.0, 0.0], [1.0, 0.0]]  # the start, then the push
