"""Drives a device over TCP by the standard library alone (docs/robot_messages.md).

    cathsim serve type1_lcca --observation tracking   # in one terminal
    python examples/drive_by_socket.py                # in another

Pushes until the wall force exceeds a limit, then withdraws a little and continues. A
program in any language can do the same with sockets and JSON.
"""

import argparse
import json
import socket
import struct

LIMIT = 0.05  # N, of the largest contact
WITHDRAWAL = 10  # periods


def send(sock: socket.socket, kind: str, **fields) -> None:
    """Sends a frame: its length in four bytes, big-endian, and a JSON object."""
    data = json.dumps({"kind": kind, **fields}).encode()
    sock.sendall(struct.pack(">I", len(data)) + data)


def receive(stream) -> dict:
    """The next message; ends the program on an error or a closed connection."""
    head = stream.read(4)
    if len(head) < 4:
        raise SystemExit("the device is gone")
    message = json.loads(stream.read(*struct.unpack(">I", head)))
    if message["kind"] == "error":
        raise SystemExit(f"{message['fault']}: {message['reason']}")
    return message


def main() -> None:
    """Drives one episode."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--host", default="127.0.0.1")
    parser.add_argument("--port", type=int, default=5555)
    parser.add_argument("--seed", type=int, default=3)
    options = parser.parse_args()
    with socket.create_connection((options.host, options.port), 10.0) as sock:
        stream = sock.makefile("rb")
        send(sock, "hello", protocol=1, name="drive_by_socket")
        welcome = receive(stream)
        names = [one["name"] for one in welcome["action"]]
        pushes = [float(name.endswith("insertion")) for name in names]
        print(f"{welcome['name']}: {len(names)} actions, {sum(pushes):g} of them push")
        send(sock, "start", seed=options.seed)
        back, step = 0, 0
        while (state := receive(stream))["kind"] == "state":
            step = state["step"]
            if state["end"] is not None:
                break
            if state["force"].get("largest", 0.0) > LIMIT:  # if it is measured
                back = WITHDRAWAL
            action = [-push if back else push for push in pushes]
            back = max(0, back - 1)
            send(sock, "action", step=step, action=action)
        print(state.get("end") or state["reason"], "after", step, "steps")


if __name__ == "__main__":
    main()
