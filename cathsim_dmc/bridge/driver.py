"""The driver's side: a loop from states to actions that stops at any fault."""

import contextlib
import dataclasses
import math
import socket
import time
from collections.abc import Callable, Collection, Mapping
from typing import Any

import numpy as np

from cathsim_dmc import __version__, bounds
from cathsim_dmc.bridge import messages, signals
from cathsim_dmc.bridge.device import (
    FORCE_LIMIT,
    HANDSHAKE,
    LIMITED,
    MOST_FRAMES,
    require_watchdog,
)
from cathsim_dmc.bridge.messages import BridgeError, Connection
from cathsim_dmc.bridge.records import Log, milliseconds

# Longest time in which a device reaches its start, s.
START = 60.0
# Function from the observation, arrays by key, to the action (A,).
Choose = Callable[[Mapping[str, np.ndarray]], np.ndarray]


@dataclasses.dataclass(frozen=True)
class DriveOptions:
    """How a device is driven.

    Attributes:
        warm_up: Number of actions that are computed from zeros before the start: the
            first ones of a network take longer.
        overrun: What to do when an action takes longer than a period: "latest", answer
            the newest state and skip the others, or "stop".
        watchdog: Time without a message of the device after which the driver stops, s.
        force_limit: Largest contact or push above which the driver stops, N; None for
            none.
    """

    warm_up: int = 20
    overrun: str = "latest"
    watchdog: float = 0.2
    force_limit: float | None = FORCE_LIMIT

    def __post_init__(self) -> None:
        bounds.whole("warm_up", self.warm_up, 0, 10_000)
        bounds.choice("overrun", self.overrun, ("latest", "stop"))
        bounds.number("watchdog", self.watchdog, 0.0, 3600.0, "s", positive=True)
        if self.force_limit is not None:
            bounds.number("force_limit", self.force_limit, unit="N", positive=True)


@dataclasses.dataclass(frozen=True)
class Driven:
    """Outcome of a driven episode.

    Attributes:
        end: Why it ended: what the device reported ("success", "truncated", …), or
            "stopped", "watchdog", "force_limit", "overrun".
        reason: Why the device stopped, as it reported; None if it did not stop.
        steps: Number of states that were answered.
        skipped: Number of states that were skipped for newer ones.
        late: Number of answers that took longer than a period.
        force: Largest force that the device reported, N.
        compute: Percentiles of the time from a state to its action, ms.
        period: Percentiles of the time between two states, ms.
    """

    end: str
    reason: str | None
    steps: int
    skipped: int
    late: int
    force: float
    compute: dict[str, float] | None
    period: dict[str, float] | None


def connect(address: str) -> Connection:
    """Connect to "host:port"; ValueError for another text, OSError if none answers."""
    host, colon, port = str(address).rpartition(":")
    if not colon or not host or not port.isdecimal() or not 0 < int(port) < 65536:
        bounds.refuse("address", address, "host:port, such as 127.0.0.1:5555")
    try:
        sock = socket.create_connection((host.strip("[]"), int(port)), HANDSHAKE)
        return Connection(sock)
    except OSError as error:
        raise OSError(
            f"no device answers at {address}: {error}; start it first, in another "
            "terminal, such as with `cathsim serve TASK`"
        ) from error


@dataclasses.dataclass
class _Run:
    """Counts of an episode."""

    answered: int = -1
    skipped: int = 0
    late: int = 0
    force: float = 0.0
    before: float = math.nan
    times: list[float] = dataclasses.field(default_factory=list)
    gaps: list[float] = dataclasses.field(default_factory=list)

    def arrived(self, message: Mapping[str, Any], now: float) -> None:
        """Count a state; BridgeError if it is not newer than the last one."""
        _require_newer(message["step"], self.answered)
        self.answered = message["step"]
        if math.isfinite(self.before):
            self.gaps.append(now - self.before)
        self.before, self.force = now, max(self.force, _largest(message["force"]))


class Driver:
    """A connection to a device after the handshake.

    Attributes:
        welcome: The device's description of itself: "name", "period", "action",
            "observation".
    """

    def __init__(self, link: Connection, log: Log | None = None):
        """Do the handshake; BridgeError if the device is busy or of another version."""
        self._link, self._log = link, log or Log(None)
        hello = {"protocol": messages.PROTOCOL, "name": f"cathsim_dmc {__version__}"}
        link.send(HANDSHAKE, "hello", **hello)
        found = link.receive(time.monotonic() + HANDSHAKE)
        self.welcome = messages.require_kind(found, "welcome")
        messages.require_version(self.welcome)
        table = self.welcome["observation"]
        try:
            self._table = {
                bounds.text("key", one["key"]): (
                    tuple(bounds.whole("shape", n, 0) for n in one["shape"]),
                    str(one["dtype"]),
                )
                for one in table
            }
        except (TypeError, KeyError, ValueError) as error:
            text = "observation of welcome must list key, shape and dtype"
            raise BridgeError("bad_message", text) from error
        self._size = len(self.welcome["action"])
        self._log.write("welcome", **{k: self.welcome[k] for k in ("name", "period")})

    def read_only(self, keys: Collection[str]) -> None:
        """Restrict the observation of the policy to the arrays with these keys."""
        self._table = {key: self._table[key] for key in self._table if key in keys}

    def warm_up(self, choose: Choose, count: int) -> dict[str, float] | None:
        """Compute actions from zeros; return percentiles of their durations, ms."""
        zeros = {
            key: np.zeros(shape, np.uint8 if dtype == "uint8" else float)
            for key, (shape, dtype) in self._table.items()
        }
        times = []
        for _ in range(count):
            began = time.monotonic()
            self._checked(choose(zeros))
            times.append(time.monotonic() - began)
        return milliseconds(times)

    def episode(
        self,
        choose: Choose,
        seed: int | None = None,
        options: DriveOptions | None = None,
    ) -> Driven:
        """Drive an episode.

        If the driver ends it, also by an error, SIGTERM, SIGHUP or Ctrl-C, it sends the
        device a stop.

        Raises:
            BridgeError: the connection is lost, the device sends no valid state, or the
                action is not finite or of another size.
            ValueError: if the watchdog is not longer than a period of the device.
        """
        options = options or DriveOptions()
        if not self.welcome.get("lockstep"):
            require_watchdog(options.watchdog, self.welcome["period"])
        self._link.send(HANDSHAKE, "start", seed=seed)
        self._log.write("start", seed=seed)
        try:
            with signals.raised():
                found = self._loop(choose, options)
        except BaseException as error:
            self._stop(f"{type(error).__name__}: {error}"[:200].removesuffix(": "))
            raise
        self._log.write("end", reason=found.end, steps=found.steps)
        return found

    def _loop(self, choose: Choose, options: DriveOptions) -> Driven:
        run, wait = _Run(), START
        while True:
            message = self._link.receive(time.monotonic() + wait)
            arrived, wait = time.monotonic(), options.watchdog
            if message is None:
                return self._ended(run, "watchdog")
            if options.overrun == "latest":
                message = self._newest(message, run)
            message = messages.require_kind(message, "state", "stop")
            if message["kind"] == "stop":
                self._log.write("stopped", reason=message["reason"])
                reason = message["reason"][:200]
                return self._ended(run, "stopped", told=True, reason=reason)
            messages.require_end(message["end"])
            run.arrived(message, arrived)
            if message["end"] is not None:
                return self._ended(run, message["end"], told=True)
            # The forces of states that are skipped count too.
            if options.force_limit is not None and run.force > options.force_limit:
                return self._ended(run, "force_limit")
            action = self._checked(choose(self._observation(message["observation"])))
            values, step = action.tolist(), message["step"]
            try:
                self._link.send(options.watchdog, "action", step=step, action=values)
            except BridgeError as error:
                if error.fault != "peer_lost":
                    raise
                continue  # the device may have sent the reason in a last state
            run.times.append(time.monotonic() - arrived)
            self._log.write(
                "sent", step=step, action=values, force=message["force"],
                milliseconds=round(1e3 * run.times[-1], 3),
            )  # fmt: skip
            if run.times[-1] > float(self.welcome["period"]):
                run.late += 1
                if options.overrun == "stop":
                    return self._ended(run, "overrun")

    def _newest(self, message: dict[str, Any], run: _Run) -> dict[str, Any]:
        """Return the newest message received, or the one that ends the episode."""
        for _ in range(MOST_FRAMES):
            final = message["kind"] != "state" or message["end"] is not None
            newer = None if final else self._link.receive(0.0)
            if newer is None:
                return message
            if newer["kind"] == "state":
                _require_newer(newer["step"], message["step"])
            run.force = max(run.force, _largest(message["force"]))
            message, run.skipped = newer, run.skipped + 1
        raise BridgeError("flood", f"over {MOST_FRAMES} states at once")

    def _ended(
        self, run: _Run, end: str, told: bool = False, reason: str | None = None
    ) -> Driven:
        if not told:
            self._stop(end)
        return Driven(
            end,
            reason,
            steps=len(run.times),
            skipped=run.skipped,
            late=run.late,
            force=run.force,
            compute=milliseconds(run.times),
            period=milliseconds(run.gaps),
        )

    def _observation(self, given: Mapping[str, Any]) -> dict[str, np.ndarray]:
        if missing := sorted(self._table.keys() - given.keys()):
            text = f"a state lacks {', '.join(missing)}, which the welcome names; "
            raise BridgeError("wrong_shape", f"{text}it has {', '.join(sorted(given))}")
        return {
            key: messages.to_array(key, given[key], *kind)
            for key, kind in self._table.items()
        }

    def _checked(self, action: Any) -> np.ndarray:
        return messages.to_array(
            "the policy's action", action, (self._size,), "float64"
        )

    def _stop(self, reason: str) -> None:
        self._log.write("stop", reason=reason)
        with contextlib.suppress(BridgeError):  # it may be gone
            self._link.send(0.2, "stop", reason=reason)
            # Discard states sent before the stop: they are not of the next episode.
            until = time.monotonic() + 0.2
            while (left := self._link.receive(until)) and left["kind"] == "state":
                if left["end"] is not None:
                    break


def _require_newer(step: int, before: int) -> None:
    if step <= before:
        text = f"state {step} came after state {before}"
        raise BridgeError("out_of_order", text)


def _largest(force: Mapping[str, Any]) -> float:
    values = [force[key] for key in LIMITED if key in force]
    if not all(bounds.is_number(one) for one in values):
        raise BridgeError("bad_message", f"force is {str(dict(force))[:200]}")
    return max(map(abs, values), default=0.0)


def drive(
    choose: Choose,
    address: str,
    *,
    seed: int | None = None,
    options: DriveOptions | None = None,
    log: Log | None = None,
    begin: Callable[[Mapping[str, Any]], None] = lambda welcome: None,
) -> Driven:
    """Drive one episode of the device at an address.

    Args:
        choose: Function from the observation, arrays by key, to the action (A,).
        address: "host:port".
        seed: Seed of the episode; None leaves it to the device.
        log: Log of the messages sent; None keeps none.
        begin: Function that is called with the device's `welcome` before the warm-up;
            it may raise to refuse the device.

    Returns:
        Outcome of the episode.

    Raises:
        ValueError: if `choose` is no function, the address is invalid, or the watchdog
            is not longer than a period of the device.
        OSError: if no device answers there.
        BridgeError: see `Driver.episode`.
    """
    if not callable(choose):
        bounds.refuse("choose", choose, "a function from observation to action")
    options, link = options or DriveOptions(), connect(address)
    try:
        driver = Driver(link, log)
        begin(driver.welcome)
        driver.warm_up(choose, options.warm_up)
        return driver.episode(choose, seed, options)
    finally:
        link.close()
