"""Interrupts (Ctrl-C) that get lost.

Code that is called from C, as imports of extension modules do, may drop the exception
of an interrupt or make another one of it. So it is raised again as long as nobody
handles it.
"""

import signal
import sys
from types import FrameType

_AGAIN = 1.0  # s between two attempts


class Interrupts:
    """Raises KeyboardInterrupt in the main thread until it is handled.

    Attributes:
        came: Whether there has been an interrupt.
    """

    def __init__(self) -> None:
        """Listens, unless interrupts are ignored or somebody else listens."""
        self.came = False
        if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
            signal.signal(signal.SIGINT, self._interrupt)

    def _interrupt(self, _number: int, _frame: FrameType | None) -> None:
        self.came = True
        if hasattr(signal, "setitimer"):  # not on Windows
            signal.signal(signal.SIGALRM, self._again)
            signal.setitimer(signal.ITIMER_REAL, _AGAIN, _AGAIN)
        raise KeyboardInterrupt

    def _again(self, _number: int, _frame: FrameType | None) -> None:
        error: BaseException | None = sys.exc_info()[1]
        while error is not None:  # what is being handled, as in a `finally`
            if isinstance(error, KeyboardInterrupt):
                return
            error = error.__context__
        raise KeyboardInterrupt

    def handled(self) -> None:
        """Ends the attempts."""
        if self.came and hasattr(signal, "setitimer"):
            signal.setitimer(signal.ITIMER_REAL, 0.0)
