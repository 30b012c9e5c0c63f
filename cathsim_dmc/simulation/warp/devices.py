"""Where compiled laws run on Warp's arrays: kernels on a GPU, loops on the CPU.

A *thread function* is a compiled function of a thread's number and of named tuples of
arrays. `Device.launch` runs it for many threads: numba-cuda compiles the same source
for the GPU and launches it on Warp's stream, so that a captured CUDA graph has it.
"""

from __future__ import annotations

import functools
import importlib
from typing import Any, NamedTuple

import numpy as np

from cathsim_dmc import bounds, extras
from cathsim_dmc.compiled import compiled, for_cuda

_THREADS = 128  # of a block

Scratch = tuple[tuple[int, ...], tuple[int, ...], tuple[int, ...]]
NONE: Scratch = ((1,), (1,), (1,))


class Chosen(NamedTuple):
    """Threads that a test has chosen, in any order.

    Attributes:
        threads: (T,) int32, the first of which are chosen.
        found: (1,) int32, how many they are.
    """

    threads: Any
    found: Any


def warp_modules() -> tuple[Any, Any]:
    """The modules `warp` and `mujoco_warp`; ImportError says what to install."""
    extras.require("gpu", "warp", "mujoco_warp")
    found = [importlib.import_module(name) for name in ("warp", "mujoco_warp")]
    found[0].config.quiet = True
    return found[0], found[1]


class Device:
    """A device of Warp, "cpu" or "cuda:0".

    Attributes:
        name: Warp's name of it.
        is_cuda: Whether it is a GPU.
    """

    def __init__(self, name: str):
        """Finds the device; ValueError if this machine does not have it."""
        self._warp, _ = warp_modules()
        self._warp.init()
        names = [device.alias for device in self._warp.get_devices()]
        alias = "cuda:0" if name == "cuda" else name
        if alias not in names:
            bounds.refuse("device", name, f"one of this machine: {', '.join(names)}")
        self.name, self.is_cuda = alias, alias != "cpu"

    def constant(self, values: np.ndarray) -> Any:
        """A copy of an array on the device, for thread functions."""
        values = np.ascontiguousarray(values)
        if not self.is_cuda:
            return values.copy()
        return _cuda().to_device(values)

    def view(self, array: Any) -> Any:
        """Warp's array as thread functions take it, without a copy."""
        if not self.is_cuda:
            return array.numpy()
        return _cuda().as_cuda_array(array)

    def write(self, array: Any, values: np.ndarray) -> None:
        """Writes into what `constant` returned."""
        if self.is_cuda:
            array.copy_to_device(np.ascontiguousarray(values, array.dtype))
        else:
            array[...] = values

    def host(self, array: Any) -> np.ndarray:
        """What `constant` returned, on the host, a copy."""
        return array.copy_to_host() if self.is_cuda else array.copy()

    def launch(
        self, function: Any, count: int | Chosen, scratch: Scratch, given: Any
    ) -> None:
        """Runs `function(thread, scratch, given)` in many threads.

        Args:
            function: Compiled thread function.
            count: Number of threads, or those of `select`.
            scratch: Shapes of arrays of float64 that each thread has for itself.
            given: Named tuple of arrays, numbers and named tuples.
        """
        picked = isinstance(count, Chosen)
        if self.is_cuda:
            total = len(count.threads) if picked else count
            self._run(_kernel(function, scratch, picked), total, (count, given))
        else:
            _loop(function, picked)(count, tuple(map(np.zeros, scratch)), given)

    def select(self, test: Any, chosen: Chosen, given: Any) -> Chosen:
        """Chooses the threads in which `test(thread, given)` is true."""
        if self.is_cuda:
            self.launch(_forget, 1, NONE, chosen)
            self._run(_test_kernel(test), len(chosen.threads), (chosen, given))
        else:
            _test_loop(test)(chosen, given)
        return chosen

    def _run(self, kernel: Any, count: int, arguments: tuple[Any, Any]) -> None:
        stream = _cuda().external_stream(self._warp.get_stream(self.name).cuda_stream)
        blocks = (count + _THREADS - 1) // _THREADS
        kernel[blocks, _THREADS, stream](arguments[0], arguments[1])


def _cuda() -> Any:
    extras.require("gpu", "numba_cuda")
    from numba import cuda

    return cuda


# Loops and kernels refer to the function: none is kept on disk.


@compiled
def _every(count, n):
    """The number of a thread, -1 for none."""
    return n if n < count else -1


@compiled
def _picked(chosen, n):
    """The number of a chosen thread, -1 for none."""
    return chosen.threads[n] if n < chosen.found[0] else -1


@compiled
def _forget(thread, scratch, chosen):
    """Chooses no thread."""
    chosen.found[thread] = 0


@functools.cache
def _loop(function: Any, picked: bool) -> Any:
    """A compiled loop over the threads of a thread function, or the chosen ones."""
    number = _picked if picked else _every

    def loop(threads, scratch, given):
        n, thread = 0, number(threads, 0)
        while thread >= 0:
            function(thread, scratch, given)
            n += 1
            thread = number(threads, n)

    return compiled(loop, cache=False)


@functools.cache
def _test_loop(test: Any) -> Any:
    """A compiled loop that chooses threads."""

    def loop(chosen, given):
        found = 0
        for thread in range(len(chosen.threads)):
            if test(thread, given):
                chosen.threads[found] = thread
                found += 1
        chosen.found[0] = found

    return compiled(loop, cache=False)


@functools.cache
def _kernel(function: Any, scratch: Scratch, picked: bool) -> Any:
    """A kernel of a thread function, of all threads or the chosen ones."""
    cuda, inner = _cuda(), for_cuda(function)
    number = for_cuda(_picked if picked else _every)
    one, two, three = scratch

    @cuda.jit
    def kernel(threads, given):
        thread = number(threads, cuda.grid(1))
        if thread >= 0:
            own = (
                cuda.local.array(one, np.float64),
                cuda.local.array(two, np.float64),
                cuda.local.array(three, np.float64),
            )
            inner(thread, own, given)

    return kernel


@functools.cache
def _test_kernel(test: Any) -> Any:
    """A kernel that chooses threads."""
    cuda, inner = _cuda(), for_cuda(test)

    @cuda.jit
    def kernel(chosen, given):
        thread = cuda.grid(1)
        if thread < len(chosen.threads) and inner(thread, given):
            chosen.threads[cuda.atomic.add(chosen.found, 0, 1)] = thread

    return kernel
