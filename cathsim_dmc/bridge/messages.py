"""Messages between a device and its driver: JSON objects over TCP, length first.

A frame is the number of bytes that follow, unsigned, 4 bytes, big-endian, and a JSON
object in UTF-8 with a "kind" (docs/robot_messages.md). Numbers are finite.
"""

import base64
import binascii
import contextlib
import json
import math
import socket
import struct
import time
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

PROTOCOL = 1
MAX_FRAME = 4 * 2**20  # bytes
_LENGTH = struct.Struct(">I")
_CHUNK = 65536  # bytes
_NUMBER, _TEXT = (int, float), (str,)
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
    """The other program cannot be talked to.

    Attributes:
        fault: Name of what is wrong: "frame_too_long", "not_json", "not_finite",
            "bad_message", "wrong_shape", "wrong_version", "out_of_order", "flood",
            "slow_peer", "peer_lost", "busy", "idle", or what the other side said.
    """

    def __init__(self, fault: str, text: str):
        super().__init__(f"{fault}: {text}")
        self.fault, self.text = fault, text


def pack(message: Mapping[str, Any]) -> bytes:
    """A message as a frame; BridgeError if it is too long or holds NaN."""
    try:
        data = json.dumps(message, allow_nan=False, separators=(",", ":")).encode()
    except ValueError as error:
        raise BridgeError("not_finite", f"{message.get('kind')}: {error}") from error
    _require_length(len(data))
    return _LENGTH.pack(len(data)) + data


def parse(data: bytes) -> dict[str, Any]:
    """The message in a frame, without its length; BridgeError if it is none."""
    try:
        message = json.loads(data, parse_constant=_no_constant)
    except (ValueError, RecursionError) as error:  # UnicodeDecodeError is a ValueError
        text = " ".join(str(error).split())[:200]
        raise BridgeError("not_json", f"a frame holds no JSON: {text}") from error
    kind = message.get("kind") if isinstance(message, dict) else None
    if not isinstance(kind, str) or kind not in KINDS:
        raise BridgeError(
            "bad_message", f"kind is {str(kind)[:80]!r}; it must be one of {[*KINDS]}"
        )
    for name, types in KINDS[kind].items():
        value = message.get(name, KINDS)
        if not isinstance(value, types) or isinstance(value, bool):
            names = " or ".join(one.__name__ for one in types)
            given = "missing" if value is KINDS else f"{str(value)[:80]!r}"
            raise BridgeError(
                "bad_message", f"{name} of {kind} is {given}; it must be {names}"
            )
        if isinstance(value, float) and not math.isfinite(value):
            raise BridgeError("not_finite", f"{name} of {kind} is {value}")
    return message


def _no_constant(text: str) -> float:
    raise BridgeError("not_finite", f"a frame holds {text}; numbers must be finite")


def _require_length(length: int) -> None:
    if length > MAX_FRAME:
        raise BridgeError(
            "frame_too_long", f"a frame of {length} bytes; at most {MAX_FRAME}"
        )


def to_json(array: Any) -> Any:
    """An array as JSON: numbers as lists, images uint8 as base64 with their shape."""
    array = np.asarray(array)
    if array.dtype != np.uint8:
        return array.tolist()
    data = base64.b64encode(array.tobytes()).decode()
    return {"dtype": "uint8", "shape": list(array.shape), "base64": data}


def to_array(name: str, value: Any, shape: Sequence[int], dtype: str) -> np.ndarray:
    """The inverse of `to_json`; BridgeError for another shape, type, or NaN."""
    try:
        if dtype == "uint8":
            data = base64.b64decode(value["base64"], validate=True)
            found = np.frombuffer(data, np.uint8).reshape(value["shape"]).copy()
        else:
            found = np.array(value)
            if found.dtype.kind not in "iuf":  # texts, switches, integers without end
                raise ValueError(found.dtype)
            found = found.astype(np.float64)
    except (ValueError, TypeError, KeyError, binascii.Error) as error:
        raise BridgeError("wrong_shape", f"{name} is no array of {dtype}") from error
    if found.shape != tuple(shape):
        raise BridgeError(
            "wrong_shape", f"{name} has shape {found.shape}; it must be {tuple(shape)}"
        )
    if not np.isfinite(found).all():
        raise BridgeError("not_finite", f"{name} holds what is not finite")
    return found


class Connection:
    """Frames over a socket, none of which is waited for longer than asked."""

    def __init__(self, sock: socket.socket):
        """Takes a connected socket over."""
        self._socket, self._held = sock, bytearray()
        with contextlib.suppress(OSError):  # a pair of local sockets has no delay
            sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def send(self, within: float, kind: str, **fields: Any) -> None:
        """Send a message; BridgeError if it is not taken within so many seconds."""
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
        """The next message, or None if none comes until a time of `time.monotonic`.

        Raises:
            BridgeError: the other side is gone, or has sent what is no message, or has
                said what is wrong ("error").
        """
        while True:
            if (message := self._next()) is not None:
                if message["kind"] == "error":
                    raise BridgeError(message["fault"], message["reason"])
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
        """Close, after saying what was wrong with the other side's messages."""
        if error is not None:
            with contextlib.suppress(BridgeError):
                self.send(0.1, "error", fault=error.fault, reason=error.text[:1000])
        self._socket.close()


def require_version(message: Mapping[str, Any]) -> None:
    """BridgeError unless a hello or welcome speaks this protocol."""
    if message["protocol"] != PROTOCOL:
        raise BridgeError(
            "wrong_version",
            f"the other side speaks {message['protocol']}, this one {PROTOCOL}",
        )


def require_kind(message: Mapping[str, Any] | None, *kinds: str) -> dict[str, Any]:
    """A message of one of these kinds; BridgeError for another one or none."""
    if message is None:
        raise BridgeError("idle", f"no {' or '.join(kinds)} came in time")
    if message["kind"] not in kinds:
        raise BridgeError(
            "out_of_order", f"{message['kind']} came, expected {' or '.join(kinds)}"
        )
    return dict(message)
