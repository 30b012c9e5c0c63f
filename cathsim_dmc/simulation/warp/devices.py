"""Devices on which compiled laws run on Warp's arrays: as GPU kernels or CPU loops.

A *thread function* is a compiled function of a thread's number, of scratch arrays that
are private to it, and of a named tuple of arrays. `Device.launch` runs it for many
threads: numba-cuda compiles the same source for the GPU and launches it on Warp's
stream, so that a captured CUDA graph includes it.
"""

from __future__ import annotations

import contextlib
import functools
import gc
import importlib
from collections.abc import Iterator
from typing import Any

import numpy as np

from cathsim_dmc import bounds, extras
from cathsim_dmc.compiled import compiled, for_cuda
from cathsim_dmc.compiled_parts import uncollected

# Threads of a block where there are more than `_MANY` threads in all.
_THREADS, _MANY = 64, 32_768

Scratch = tuple[tuple[int, ...], tuple[int, ...], tuple[int, ...]]
NONE: Scratch = ((1,), (1,), (1,))


def warp_modules() -> tuple[Any, Any]:
    """Imports `warp` and `mujoco_warp`; ImportError names the extra to install."""
    extras.require("gpu", "warp", "mujoco_warp")
    found = [importlib.import_module(name) for name in ("warp", "mujoco_warp")]
    found[0].config.quiet = True
    return found[0], found[1]


class Device:
    """A device of Warp, "cpu" or "cuda:0".

    Attributes:
        name: Warp's name of the device.
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

    def active(self) -> Any:
        """A context in which this is the active device of Warp and numba-cuda."""
        return self._warp.ScopedDevice(self.name)

    @contextlib.contextmanager
    def captured(self) -> Iterator[Any]:
        """Captures the launches in this context as a CUDA graph, `graph` of its value.

        Garbage collection is off meanwhile: CUDA ends a capture if memory is freed.
        """
        gc.collect()
        with uncollected(), self.active(), _cuda().defer_cleanup():
            with self._warp.ScopedCapture() as capture:
                yield capture

    def constant(self, values: Any) -> Any:
        """A copy on the device of an array, or of a named tuple of arrays."""
        if isinstance(values, tuple):
            kind: Any = type(values)
            return kind._make(map(self.constant, values))
        values = np.ascontiguousarray(values)
        if not self.is_cuda:
            return values.copy()
        with self.active():
            return _cuda().to_device(values)

    def view(self, array: Any) -> Any:
        """A view of Warp's array for thread functions, without a copy."""
        if not self.is_cuda:
            return array.numpy()
        with self.active():
            return _cuda().as_cuda_array(array)

    def views(self, kind: Any, source: Any, **others: Any) -> Any:
        """A named tuple of views of the arrays of the same names in `source`.

        Args:
            kind: Class of the named tuple.
            source: Part of Warp's model or data.
            others: Fields that `source` does not have.
        """
        names = [name for name in kind._fields if name not in others]
        return kind(**{n: self.view(getattr(source, n)) for n in names}, **others)

    def zeros(self, size: int) -> Any:
        """Makes a Warp array (size,) of int, all 0."""
        return self._warp.zeros(size, dtype=int, device=self.name)

    def sum_before(self, numbers: Any, sums: Any) -> None:
        """Writes the exclusive prefix sums of numbers; both are arrays of `zeros`."""
        self._warp.utils.array_scan(numbers, sums, inclusive=False)

    def write(self, array: Any, values: Any) -> None:
        """Writes values into what `constant` has made."""
        if isinstance(array, tuple):
            for own, given in zip(array, values, strict=True):
                self.write(own, given)
        elif self.is_cuda:
            with self.active():
                array.copy_to_device(np.ascontiguousarray(values, array.dtype))
        else:
            array[...] = values

    def host(self, array: Any) -> np.ndarray:
        """Returns a copy on the host of an array made by `constant`."""
        if not self.is_cuda:
            return array.copy()
        with self.active():
            return array.copy_to_host()

    def launch(self, function: Any, count: int, scratch: Scratch, given: Any) -> None:
        """Runs `function(thread, scratch, given)` in many threads.

        Args:
            function: Compiled thread function.
            count: Number of threads.
            scratch: Shapes of the float64 arrays that are private to each thread.
            given: Named tuple of arrays, numbers and named tuples.
        """
        if not self.is_cuda:
            _loop(function)(count, tuple(map(np.zeros, scratch)), given)
            return
        stream = _cuda().external_stream(self._warp.get_stream(self.name).cuda_stream)
        # Small blocks spread few threads over all multiprocessors of the GPU.
        block = _THREADS if count > _MANY else 32
        blocks = (count + block - 1) // block
        with self.active():
            _kernel(function, scratch)[blocks, block, stream](count, given)


def _cuda() -> Any:
    extras.require("gpu", "numba_cuda")
    from numba import cuda

    return cuda


# Loops and kernels refer to a function object, so they are not cached on disk.


@functools.cache
def _loop(function: Any) -> Any:
    """A compiled loop over the threads of a thread function."""

    def loop(count, scratch, given):
        for thread in range(count):
            function(thread, scratch, given)

    return compiled(loop, cache=False)


@functools.cache
def _kernel(function: Any, scratch: Scratch) -> Any:
    """A kernel of a thread function."""
    cuda, inner = _cuda(), for_cuda(function)
    one, two, three = scratch

    @cuda.jit
    def kernel(count, given):
        thread = cuda.grid(1)
        if thread < count:
            own = (
                cuda.local.array(one, np.float64),
                cuda.local.array(two, np.float64),
                cuda.local.array(three, np.float64),
            )
            inner(thread, own, given)

    return kernel
