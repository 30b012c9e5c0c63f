"""The device's side: it keeps the clock, and stops if its driver falls silent."""

import contextlib
import dataclasses
import socket
import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from cathsim_dmc import bounds
from cathsim_dmc.bridge import messages, signals
from cathsim_dmc.bridge.device import (
    FORCE_LIMIT,
    HANDSHAKE,
    LIMITED,
    MOST_FRAMES,
    Device,
    State,
    require_device,
    require_watchdog,
)
from cathsim_dmc.bridge.messages import BridgeError, Connection
from cathsim_dmc.bridge.records import Log, milliseconds

IDLE = 60.0  # s, for which a driver may wait between episodes
_SLICE = 0.2  # s, longest wait on a socket before other drivers are looked for


@dataclasses.dataclass(frozen=True)
class ServeOptions:
    """How a device is served.

    Attributes:
        lockstep: Whether each period waits for its action, at any speed; otherwise the
            clock does not wait.
        missed: What the device does in a period whose action has not come in time:
            "still", no translation and no rotation, or "hold", repeat the last action.
        watchdog: Time without a message of the driver after which the device stops, s.
        force_limit: Largest contact or push above which the device stops, N; None for
            none.
    """

    lockstep: bool = False
    missed: str = "still"
    watchdog: float = 0.2
    force_limit: float | None = FORCE_LIMIT

    def __post_init__(self) -> None:
        bounds.switch("lockstep", self.lockstep)
        bounds.choice("missed", self.missed, ("still", "hold"))
        bounds.number("watchdog", self.watchdog, 0.0, 3600.0, "s", positive=True)
        if self.force_limit is not None:
            bounds.number("force_limit", self.force_limit, unit="N", positive=True)


@signals.raised()
def serve(
    device: Device,
    listener: socket.socket,
    options: ServeOptions | None = None,
    *,
    episodes: int | None = None,
    log: Log | None = None,
    say: Callable[[str], None] = lambda text: None,
) -> list[dict[str, Any]]:
    """Serve one driver after the other.

    SIGTERM, SIGHUP and Ctrl-C stop the device before they end the function.

    Args:
        listener: A listening socket, see `listen`.
        episodes: Number of episodes after which it returns; None for no limit.
        log: Log of connections, of applied actions and of the ends of episodes.
        say: Function that is called with each line of progress.

    Returns:
        For each episode "end", "reason" (why it was stopped, else None), "steps",
        "missed", "late", "force" (largest, N), and percentiles of "answer" (time from a
        state to its action) and "tick" (delay of the start of a period), ms.

    Raises:
        ValueError: if an attribute or method of the device is missing, it returns no
            `State`, or the watchdog is not longer than a period of the device.
    """
    require_device(device)
    done: list[dict[str, Any]] = []
    log, options = log or Log(None), options or ServeOptions()
    if not options.lockstep:
        require_watchdog(options.watchdog, device.period)
    while episodes is None or len(done) < episodes:
        listener.settimeout(_SLICE)
        try:
            sock, (peer, port, *_) = listener.accept()
        except TimeoutError:
            continue
        link, wrong = Connection(sock), None
        log.write("connected", peer=f"{peer}:{port}")
        session = _Session(device, link, listener, options, log)
        try:
            session.greet()
            while (episodes is None or len(done) < episodes) and session.begins():
                done.append(session.episode())
                say(f"{peer}:{port}: {_told(done[-1])}")
        except BridgeError as error:
            wrong = error
            say(f"{peer}:{port}: {error}")
            log.write("refused", fault=error.fault, reason=error.text)
            if session.running:
                done.append(session.summary(error.fault, error.text))
        except BaseException as error:  # of the device, or a signal
            text = f"the device's program ends: {type(error).__name__}: {error}"
            wrong = BridgeError("peer_lost", text.removesuffix(": "))
            raise
        finally:
            device.stop()
            link.close(wrong)
    return done


def _told(episode: Mapping[str, Any]) -> str:
    """Return the outcome of an episode as text."""
    reason = "" if episode["reason"] is None else f": {episode['reason']}"
    counts = {"missed": "periods without an action", "late": "late actions"}
    told = [f", {episode[key]} {text}" for key, text in counts.items() if episode[key]]
    return f"{episode['end']} after {episode['steps']} steps{''.join(told)}{reason}"


def listen(host: str, port: int) -> socket.socket:
    """Return a listening socket; port 0 takes a free one.

    A host with colons, in brackets or not, is an IPv6 address.

    Raises:
        ValueError: the port is invalid, or the host is empty, which would admit all.
        OSError: the address cannot be used, as when the port is taken.
    """
    bounds.text("host", host)
    bounds.whole("port", port, 0, 65535)
    try:
        host = host.strip("[]")
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        return socket.create_server((host, port), family=family, backlog=8)
    except OSError as error:
        text = f"cannot listen on {host}:{port}; choose another --port or --host"
        raise OSError(f"{text}: {error}") from error


@dataclasses.dataclass
class _Running:
    """Counts of an episode."""

    step: int = 0
    missed: int = 0
    late: int = 0
    force: float = 0.0
    answers: list[float] = dataclasses.field(default_factory=list)
    ticks: list[float] = dataclasses.field(default_factory=list)


class _Session:
    """Session with one driver."""

    running = False  # an episode
    played: int | None = None  # steps of the last episode

    def __init__(
        self,
        device: Device,
        link: Connection,
        listener: socket.socket,
        options: ServeOptions,
        log: Log,
    ):
        self._device, self._link, self._listener = device, link, listener
        self._options, self._log = options, log
        speeds = ["/s" in str(one["unit"]) for one in device.action]
        self._speeds = np.array(speeds, dtype=bool)
        self._run = _Running()

    def greet(self) -> None:
        hello = self._wait(HANDSHAKE, "hello")
        messages.require_version(hello)
        device = self._device
        self._link.send(
            HANDSHAKE, "welcome", protocol=messages.PROTOCOL, name=device.name,
            period=device.period, action=list(device.action),
            observation=list(device.observation), watchdog=self._options.watchdog,
            force_limit=self._options.force_limit, lockstep=self._options.lockstep,
        )  # fmt: skip

    def begins(self) -> bool:
        """Wait for the start of an episode; False if the driver has left."""
        try:
            message = self._wait(IDLE, "start", "action", "stop")
        except BridgeError as error:
            if error.fault == "peer_lost":
                return False
            raise
        if message["seed"] is not None:
            try:
                bounds.seed("seed", message["seed"])
            except ValueError as error:
                raise BridgeError("bad_message", str(error)) from error
        self._seed = message["seed"]
        return True

    def _require_past(self, step: int) -> None:
        """Raise BridgeError for an action that answers no state of the last episode."""
        if self.played is None:
            raise BridgeError("out_of_order", "action came, expected start")
        if step > self.played:
            text = f"action of step {step}, but the episode ended at step {self.played}"
            raise BridgeError("out_of_order", text)

    def episode(self) -> dict[str, Any]:
        """Run one episode and return its summary; stop the device in any case."""
        device, options = self._device, self._options
        self.running, self._run = True, _Running()
        run = self._run
        self._heard = due = time.monotonic()
        last, reason = np.zeros(len(self._speeds)), None
        try:
            state = device.start(self._seed)
            self._heard = due = time.monotonic()
            while True:
                bounds.instance("a state of the device", state, State)
                if state.end is not None:
                    bounds.choice("end of a State", state.end, messages.ENDS)
                over = self._too_much(state.force)
                end = state.end or over
                self._send(run.step, state, end)
                if end is not None:
                    break
                due = max(due, time.monotonic() - device.period) + device.period
                action, reason = self._action(due, state)
                if reason is not None:
                    end = "stopped"
                    self._log.write("stop", step=run.step, reason=reason)
                    with contextlib.suppress(BridgeError):  # it may have left
                        self._link.send(device.period, "stop", reason=reason)
                    break
                if action is None:
                    run.missed += 1
                    hold = options.missed == "hold"
                    action = last if hold else np.where(self._speeds, 0.0, last)
                    self._apply(action, state)
                if not options.lockstep:
                    run.ticks.append(time.monotonic() - due)
                last = action
                run.step += 1
                state = device.read()
        finally:
            device.stop()
        counts = {"missed": run.missed, "late": run.late}
        self._log.write("end", step=run.step, reason=end, **counts)
        found = self.summary(end, reason)
        self.running, self.played = False, run.step
        return found

    def summary(self, end: str, reason: str | None) -> dict[str, Any]:
        run = self._run
        return {
            "end": end, "reason": reason, "steps": run.step, "missed": run.missed,
            "late": run.late, "force": run.force, "answer": milliseconds(run.answers),
            "tick": milliseconds(run.ticks),
        }  # fmt: skip

    def _too_much(self, force: Mapping[str, float]) -> str | None:
        run, limit = self._run, self._options.force_limit
        largest = max((abs(force[k]) for k in LIMITED if k in force), default=0.0)
        run.force = max(run.force, largest)
        return "force_limit" if limit is not None and largest > limit else None

    def _send(self, step: int, state: State, end: str | None) -> None:
        observation = {k: messages.to_json(v) for k, v in state.observation.items()}
        self._sent = time.monotonic()
        self._link.send(
            self._options.watchdog, "state", step=step, time=state.time,
            observation=observation, force=dict(state.force), end=end,
        )  # fmt: skip

    def _apply(self, action: np.ndarray, state: State) -> None:
        """Give the device an action; log it with the forces of the last state."""
        self._device.command(action)
        step, force = self._run.step, dict(state.force)
        self._log.write("applied", step=step, action=action.tolist(), force=force)

    def _action(self, due: float, state: State) -> tuple[np.ndarray | None, str | None]:
        """Return the action of the present period and the reason to stop, each or None.

        The action is applied when it arrives. Messages are received for the rest of the
        period too, so that a stop or the loss of the driver takes effect at once.
        """
        run, options = self._run, self._options
        action, frames = None, 0
        while True:
            now, until = time.monotonic(), self._heard + options.watchdog
            if now > until:
                return action, f"watchdog: no action for {now - self._heard:.3f} s"
            until = min(until, now + _SLICE) if options.lockstep else min(due, until)
            message = self._link.receive(until)
            self._turn_away()
            if message is None:
                if options.lockstep or time.monotonic() < due:
                    continue
                return action, None
            frames += 1
            if frames > MOST_FRAMES:
                raise BridgeError("flood", f"over {MOST_FRAMES} frames in a period")
            message = messages.require_kind(message, "action", "stop")
            if message["kind"] == "stop":
                return action, f"driver: {message['reason'][:200]}"
            self._heard = time.monotonic()
            size = (len(self._speeds),)
            given = messages.to_array("action", message["action"], size, "float64")
            if message["step"] > run.step:
                text = f"action of step {message['step']}, but step {run.step} runs"
                raise BridgeError("out_of_order", text)
            if message["step"] < run.step or action is not None:
                run.late += 1  # for an earlier state, or one already answered
                continue
            run.answers.append(self._heard - self._sent)
            action = np.clip(given, -1.0, 1.0)
            self._apply(action, state)
            if options.lockstep:
                return action, None

    def _wait(self, seconds: float, *kinds: str) -> dict[str, Any]:
        """Return the first message of `kinds[0]`; skip those of the other kinds."""
        until = time.monotonic() + seconds
        while (left := until - time.monotonic()) > 0:
            message = self._link.receive(time.monotonic() + min(left, _SLICE))
            self._turn_away()
            if message is None:
                continue
            message = messages.require_kind(message, *kinds)
            if message["kind"] == kinds[0]:
                return message
            # Messages in transit when the last episode ended have no effect.
            if message["kind"] == "action":
                self._require_past(message["step"])
        raise BridgeError("idle", f"no {kinds[0]} came within {seconds:g} s")

    def _turn_away(self) -> None:
        """Refuse another driver that connects meanwhile."""
        self._listener.settimeout(0.0)
        with contextlib.suppress(OSError):
            sock, _ = self._listener.accept()
            Connection(sock).close(BridgeError("busy", "another program drives it"))
