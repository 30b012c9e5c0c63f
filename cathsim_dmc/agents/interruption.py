"""Interrupts of a training, which ends after the current batch."""

import contextlib
import signal
import sys
import threading
from collections.abc import Iterator

from tqdm import tqdm

_SAID = "ends after this batch, with a checkpoint; once more ends it at once"


@contextlib.contextmanager
def noted_interruption(say: bool) -> Iterator[threading.Event]:
    """Yield an event that the first SIGINT or SIGTERM of the main thread sets.

    Args:
        say: Whether to announce the end of the training on standard error.
    """
    requested = threading.Event()
    with contextlib.ExitStack() as handlers:

        def note(number: int, frame: object) -> None:
            requested.set()
            handlers.close()
            if say:
                tqdm.write(_SAID, file=sys.stderr)

        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, signal.SIGTERM):
                handlers.callback(signal.signal, number, signal.signal(number, note))
        yield requested
