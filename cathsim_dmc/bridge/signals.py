"""Signals that end a program as exceptions, so that a moving device is stopped."""

import contextlib
import signal
import threading
from collections.abc import Iterator
from types import FrameType

# Sent by systemd, docker and timeout, and by a terminal that is closed.
_ENDING = ("SIGTERM", "SIGHUP")


class Ended(SystemExit):
    """A signal ends the program; the exit code is 128 plus its number.

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
    """Make SIGTERM and SIGHUP raise `Ended` in the block.

    This holds in the main thread, for signals that the program neither ignores nor
    handles itself. Only the first one is raised: a second one must not interrupt the
    stop of a device.
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
