"""Interrupts (Ctrl-C) that do not get lost.

Code that is called from C, as in the import of extension modules, may drop a
KeyboardInterrupt or turn it into another exception. It is therefore raised again until
it is handled.
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
        """Installs the handler, unless SIGINT is ignored or handled elsewhere."""
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
        while error is not None:  # exceptions being handled, as in a `finally`
            if isinstance(error, KeyboardInterrupt):
                return
            error = error.__context__
        raise KeyboardInterrupt

    def handled(self) -> None:
        """Stops raising the interrupt again."""
        if self.came and hasattr(signal, "setitimer"):
            signal.setitimer(signal.ITIMER_REAL, 0.0)
