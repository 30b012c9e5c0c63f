"""The thread of a process in which MuJoCo's cameras render.

A thread has one current OpenGL context. `physics.render` of dm_control assumes that the
context that it has last made current still is, so cameras that rendered in the same
thread would draw into its images, and it into theirs. With a thread of their own,
environments may also be stepped by any thread, and no destructor that runs within a
rendering changes the context.
"""

import atexit
import os
import queue
import threading
from collections.abc import Callable
from concurrent.futures import Future
from typing import TypeVar

import mujoco

# Annotations name `mujoco.Renderer` in quotes: without OpenGL modules there is none.
_T = TypeVar("_T")
_TIME_TO_CLOSE = 5.0  # s at the exit of the process


class RenderThread:
    """Opens renderers of MuJoCo, and runs functions that use them.

    Attributes:
        process: Number of the process that started the thread; a fork has none.
    """

    def __init__(self):
        """Starts the thread."""
        self.process = os.getpid()
        self._renderers: set[mujoco.Renderer] = set()
        self._closes_at_exit = False
        # Its `put` may be called by a destructor in the middle of another `put`.
        self._jobs: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        work = threading.Thread(target=self._work, name="cathsim cameras", daemon=True)
        work.start()

    def _work(self) -> None:
        while True:
            self._jobs.get()()  # no name, which would keep it until the next one

    def run(self, function: Callable[[], _T]) -> _T:
        """Returns what a function returns in this thread, or raises its error."""
        future: Future[_T] = Future()

        def job() -> None:
            try:
                future.set_result(function())
            except BaseException as error:  # noqa: BLE001 - raised by the caller
                future.set_exception(error)

        self._jobs.put(job)
        return future.result()

    def open(self, model: mujoco.MjModel, size: tuple[int, int]) -> "mujoco.Renderer":
        """Opens a renderer of images (rows, columns); called in this thread."""
        rows, columns = size
        renderer = mujoco.Renderer(model, rows, columns)
        self._renderers.add(renderer)
        if not self._closes_at_exit:
            # MuJoCo has registered the end of EGL, which is to come after this.
            atexit.register(self._close_all)
            self._closes_at_exit = True
        return renderer

    def upload(
        self, renderer: "mujoco.Renderer", model: mujoco.MjModel, mesh: int
    ) -> None:
        """Uploads a mesh of a model that has changed; called in this thread."""
        renderer._gl_context.make_current()  # noqa: SLF001
        mujoco.mjr_uploadMesh(model, renderer._mjr_context, mesh)  # noqa: SLF001

    def close(self, renderer: "mujoco.Renderer") -> None:
        """Closes a renderer, at once or after the present job; does not wait."""
        self._jobs.put(lambda: self._close(renderer))

    def _close(self, renderer: "mujoco.Renderer") -> None:
        if renderer in self._renderers:
            self._renderers.remove(renderer)
            # MuJoCo frees objects of the current context, which may be another one.
            renderer._gl_context.make_current()  # noqa: SLF001
            renderer.close()

    def _close_all(self) -> None:
        if self.process != os.getpid():
            return
        done = threading.Event()
        for renderer in tuple(self._renderers):
            self.close(renderer)
        self._jobs.put(done.set)
        done.wait(_TIME_TO_CLOSE)


_LOCK = threading.Lock()
_threads: list[RenderThread] = []  # of this process, once it is started


def render_thread() -> RenderThread:
    """Returns the thread of this process; starts it at the first call.

    Raises:
        RuntimeError: if the process has been forked from one that had started it.
    """
    with _LOCK:
        if not _threads:
            _threads.append(RenderThread())
    (thread,) = _threads
    if thread.process != os.getpid():
        raise RuntimeError(
            "the observations rgb and depth: this process was forked from one that had "
            "rendered already, and OpenGL hangs in such a fork; start processes by "
            'spawn (context="spawn" in Gymnasium), or fork before the first reset of '
            "an environment that observes them"
        )
    return thread
