"""Messages between a device and its driver: JSON objects over TCP, length first.

A frame is the length of the rest in bytes (unsigned, 4 bytes, big-endian) and a JSON
object in UTF-8 with a "kind" (docs/robot_messages.md). Numbers are finite.
"""

import base64
import binascii
import contextlib
import json
import socket
import struct
import time
from collections.abc import Mapping, Sequence
from typing import Any, NoReturn

import numpy as np

from cathsim_dmc import bounds

PROTOCOL = 1
MAX_FRAME = 4 * 2**20  # bytes
_LENGTH = struct.Struct(">I")
_CHUNK = 65536  # bytes
_SHOWN = 80  # characters of a value in an error
_NUMBER, _TEXT = (int, float), (str,)
_NAMES: Mapping[type, str] = {
    int: "a whole number", float: "a number", str: "a text", list: "a list",
    dict: "an object", type(None): "null",
}  # fmt: skip
# Ends of an episode that a state may report.
ENDS = ("success", "truncated", "physics_error", "force_limit")
# Fields that a message must have, and their types.
KINDS: Mapping[str, Mapping[str, tuple[type, ...]]] = {
    "hello": {"protocol": (int,), "name": _TEXT},
    "welcome": {
        "protocol": (int,), "name": _TEXT, "period": _NUMBER, "action": (list,),
        "observation": (list,),
    },
    "start": {"seed": (int, type(None))},
    "state": {
        "step": (int,), "time": _NUMBER, "observation": (dict,), "force": (dict,),
        "end": (str, type(None)),
    },
    "action": {"step": (int,), "action": (list,)},
    "stop": {"reason": _TEXT},
    "error": {"fault": _TEXT, "reason": _TEXT},
}  # fmt: skip


class BridgeError(RuntimeError):
    """Communication with the other program fails.

    Attributes:
        fault: Name of the fault: "frame_too_long", "not_json", "not_finite",
            "bad_message", "wrong_shape", "wrong_version", "out_of_order", "flood",
            "slow_peer", "peer_lost", "busy", "idle", or what the other side reports.
    """

    def __init__(self, fault: str, text: str):
        super().__init__(f"{fault}: {text}")
        self.fault, self.text = fault, text


def pack(message: Mapping[str, Any]) -> bytes:
    """Return a message as a frame; BridgeError if it is too long or not finite."""
    try:
        text = json.dumps(
            message, allow_nan=False, separators=(",", ":"), default=np.generic.item
        )
    except ValueError as error:
        raise BridgeError("not_finite", f"{message.get('kind')}: {error}") from error
    data = text.encode()
    _require_length(len(data))
    return _LENGTH.pack(len(data)) + data


def parse(data: bytes) -> dict[str, Any]:
    """Return the message in a frame without its length; BridgeError if invalid."""
    try:
        # From bytes, json.loads would take UTF-16 and UTF-32 as well.
        message = json.loads(data.decode(), parse_constant=_no_constant)
    except (ValueError, RecursionError) as error:  # UnicodeDecodeError is a ValueError
        text = " ".join(str(error).split())[:200]
        text = f"a frame holds no JSON in UTF-8: {text}"
        raise BridgeError("not_json", text) from error
    if not isinstance(message, dict):
        text = f"a frame holds {_shown(message)}; it must be an object with a kind"
        raise BridgeError("bad_message", text)
    kind = message.get("kind", KINDS)
    if not isinstance(kind, str) or kind not in KINDS:
        _refuse("kind", kind, f"one of {', '.join(KINDS)}")
    for name, types in KINDS[kind].items():
        value = message.get(name, KINDS)
        if not isinstance(value, types) or isinstance(value, bool):
            names = " or ".join(_NAMES[one] for one in types if one is not float)
            names = names.replace("whole ", "") if float in types else names
            _refuse(f"{name} of {kind}", value, names)
        if float in types and not bounds.is_number(value):
            text = f"{name} of {kind} is {_shown(value)}; it must be finite"
            raise BridgeError("not_finite", text)
    if "step" in KINDS[kind] and message["step"] < 0:
        _refuse(f"step of {kind}", message["step"], "0 or more")
    if "period" in KINDS[kind] and message["period"] <= 0:
        _refuse(f"period of {kind}", message["period"], "above 0")
    return message


def require_end(end: Any) -> None:
    """Raise BridgeError unless an end is one of `ENDS` or None."""
    if end is not None and end not in ENDS:
        _refuse("end of state", end, f"null, {', '.join(ENDS)}")


def _refuse(name: str, value: Any, allowed: str) -> NoReturn:
    given = "missing" if value is KINDS else _shown(value)
    raise BridgeError("bad_message", f"{name} is {given}; it must be {allowed}")


def _shown(value: Any) -> str:
    """Return a value as JSON text of at most 80 characters."""
    try:
        text = json.dumps(value, ensure_ascii=False)
    except (TypeError, ValueError):  # an object of this program
        return bounds.shown(value)
    return text if len(text) <= _SHOWN else f"{text[: _SHOWN - 3]}..."


def _no_constant(text: str) -> float:
    raise BridgeError("not_finite", f"a frame holds {text}; numbers must be finite")


def _require_length(length: int) -> None:
    if length > MAX_FRAME:
        raise BridgeError(
            "frame_too_long", f"a frame of {length} bytes; at most {MAX_FRAME}"
        )


def to_json(array: Any) -> Any:
    """Return an array as JSON values: lists, or for uint8 base64 with the shape."""
    array = np.asarray(array)
    if array.dtype != np.uint8:
        return array.tolist()
    data = base64.b64encode(array.tobytes()).decode()
    return {"dtype": "uint8", "shape": list(array.shape), "base64": data}


def to_array(name: str, value: Any, shape: Sequence[int], dtype: str) -> np.ndarray:
    """Invert `to_json`; BridgeError for another shape or type, or NaN or infinity."""
    if dtype == "uint8":
        return _image(name, value, tuple(shape))
    try:
        found = np.array(value)
        if found.dtype.kind not in "iuf" or _has_switch(value):
            raise ValueError(found.dtype)  # texts, integers beyond 64 bits
        found = found.astype(np.float64)
    except (ValueError, TypeError) as error:
        odd, given = _odd(name, value, len(shape)) or (name, value)
        text = f"{odd} is {_shown(given)}; {name} must be numbers of shape {[*shape]}"
        raise BridgeError("wrong_shape", text) from error
    _require_shape(name, found, tuple(shape))
    if not np.isfinite(found).all():
        odd, given = _odd(name, found.tolist(), len(shape)) or (name, found)
        raise BridgeError("not_finite", f"{odd} is {given}; it must be finite")
    return found


def _image(name: str, value: Any, shape: tuple[int, ...]) -> np.ndarray:
    try:
        data = base64.b64decode(value["base64"], validate=True)
        found = np.frombuffer(data, np.uint8).reshape(value["shape"]).copy()
    except (ValueError, TypeError, KeyError, binascii.Error) as error:
        text = f"{name} is {_shown(value)}; it must be an image: an object with "
        text += f'"shape": {[*shape]} and as many bytes in "base64"'
        raise BridgeError("wrong_shape", text) from error
    _require_shape(name, found, shape)
    return found


def _require_shape(name: str, found: np.ndarray, shape: tuple[int, ...]) -> None:
    if found.shape != shape:
        text = f"{name} has shape {[*found.shape]}; it must be {[*shape]}"
        raise BridgeError("wrong_shape", text)


def _has_switch(value: Any) -> bool:
    """Whether nested lists hold booleans, which numpy would count as 1 and 0."""
    return type(value) is bool or (
        isinstance(value, list) and any(map(_has_switch, value))
    )


def _odd(name: str, value: Any, depth: int) -> tuple[str, Any] | None:
    """Return name and value of the first entry that is not a finite number, or None.

    Lists nested deeper than `depth` are not searched: a message may nest hundreds.
    """
    if not isinstance(value, list):
        return None if bounds.is_number(value) else (name, value)
    inner = value if depth else []
    each = (_odd(f"{name}[{n}]", one, depth - 1) for n, one in enumerate(inner))
    return next(filter(None, each), None)


class Connection:
    """Frames over a socket, each with a time limit."""

    def __init__(self, sock: socket.socket):
        """Takes a connected socket, which `close` closes."""
        self._socket, self._held = sock, bytearray()
        with contextlib.suppress(OSError):  # local socket pairs lack this option
            sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def send(self, within: float, kind: str, **fields: Any) -> None:
        """Send a message; BridgeError if that takes longer than `within` s."""
        data = pack({"kind": kind, **fields})
        self._socket.settimeout(within)
        try:
            self._socket.sendall(data)
        except TimeoutError as error:
            text = f"{kind} was not taken within {within:g} s"
            raise BridgeError("slow_peer", text) from error
        except OSError as error:
            raise BridgeError("peer_lost", f"{kind} cannot be sent: {error}") from error

    def receive(self, until: float) -> dict[str, Any] | None:
        """Return the next message; None if none comes until `until`.

        Args:
            until: Time of `time.monotonic`, s.

        Raises:
            BridgeError: the connection is lost, the message is invalid, or it is an
                "error" of the other side.
        """
        while True:
            if (message := self._next()) is not None:
                if message["kind"] == "error":
                    raise BridgeError(message["fault"][:80], message["reason"][:1000])
                return message
            left = until - time.monotonic()
            self._socket.settimeout(max(left, 0.0))
            try:
                chunk = self._socket.recv(_CHUNK)
            except (TimeoutError, BlockingIOError):
                return None
            except OSError as error:
                raise BridgeError("peer_lost", str(error)) from error
            if not chunk:
                raise BridgeError("peer_lost", "the other side has closed")
            self._held += chunk

    def _next(self) -> dict[str, Any] | None:
        if len(self._held) < _LENGTH.size:
            return None
        (length,) = _LENGTH.unpack_from(self._held)
        _require_length(length)
        end = _LENGTH.size + length
        if len(self._held) < end:
            return None
        data = bytes(self._held[_LENGTH.size : end])
        del self._held[:end]
        return parse(data)

    def close(self, error: BridgeError | None = None) -> None:
        """Close the socket, after reporting an error to the other side if given."""
        if error is not None:
            with contextlib.suppress(BridgeError):
                self.send(0.1, "error", fault=error.fault, reason=error.text[:1000])
        self._socket.close()


def require_version(message: Mapping[str, Any]) -> None:
    """Raise BridgeError unless a hello or welcome has this protocol version."""
    if message["protocol"] != PROTOCOL:
        raise BridgeError(
            "wrong_version",
            f"the other side has protocol {message['protocol']}, this one {PROTOCOL}",
        )


def require_kind(message: Mapping[str, Any] | None, *kinds: str) -> dict[str, Any]:
    """Return a message of one of some kinds; BridgeError for another one or None."""
    if message is None:
        raise BridgeError("idle", f"no {' or '.join(kinds)} came in time")
    if message["kind"] not in kinds:
        raise BridgeError(
            "out_of_order", f"{message['kind']} came, expected {' or '.join(kinds)}"
        )
    return dict(message)
