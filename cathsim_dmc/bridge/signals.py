"""Signals that end a program, as exceptions: what moves is told to stop before."""

import contextlib
import signal
import threading
from collections.abc import Iterator
from types import FrameType

# Of systemd, docker and timeout, and of a terminal that is closed.
_ENDING = ("SIGTERM", "SIGHUP")


class Ended(SystemExit):
    """The program is ended by a signal; its exit code is 128 and the signal's number.

    Attributes:
        name: Name of the signal.
    """

    def __init__(self, number: int):
        """Takes the number of the signal."""
        super().__init__(128 + number)
        self.name = signal.Signals(number).name

    def __str__(self) -> str:
        """The name of the signal."""
        return self.name


@contextlib.contextmanager
def raised() -> Iterator[None]:
    """SIGTERM and SIGHUP end what runs in it as Ctrl-C does, by an exception.

    So in the main thread, and where the program neither ignores nor handles them
    itself. Only the first is raised: a second one must not end the stop of a device.
    """
    before = {}
    if threading.current_thread() is threading.main_thread():
        numbers = [getattr(signal, one) for one in _ENDING if hasattr(signal, one)]
        before = {n: signal.getsignal(n) for n in numbers}
        before = {n: old for n, old in before.items() if old is signal.SIG_DFL}

    def end(number: int, _frame: FrameType | None) -> None:
        for one in before:
            signal.signal(one, signal.SIG_IGN)
        raise Ended(number)

    try:
        for number in before:
            signal.signal(number, end)
        yield
    finally:
        for number, old in before.items():
            signal.signal(number, old)
