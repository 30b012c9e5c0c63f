"""Files mapped into memory: pages are read when they are touched, and may be dropped.

`mmap.mmap` and `numpy.memmap` keep a descriptor open for each file, of which a process
often has 1,024; these maps keep none.
"""

import ctypes
import functools
import mmap
import os
import weakref
from typing import BinaryIO

import numpy as np

_SIZE, _PLACE, _FAILED = ctypes.c_size_t, ctypes.c_void_p, ctypes.c_void_p(-1).value


def mapped(stream: BinaryIO) -> np.ndarray:
    """The bytes (n,) uint8 of a file that nobody writes any more.

    What is written into them stays in this process. Where the system has no `mmap`
    they are read.

    Raises:
        OSError: if the file is empty or cannot be mapped.
    """
    size = os.fstat(stream.fileno()).st_size
    if os.name != "posix":
        stream.seek(0)
        return np.frombuffer(bytearray(stream.read()), np.uint8)
    access = mmap.PROT_READ | mmap.PROT_WRITE
    start = _library().mmap(None, size, access, mmap.MAP_PRIVATE, stream.fileno(), 0)
    if start == _FAILED:
        raise OSError(ctypes.get_errno(), "cannot be mapped into memory")
    block = (ctypes.c_uint8 * size).from_address(start)
    # Not at exit: other threads may still look at it.
    weakref.finalize(block, _library().munmap, start, size).atexit = False
    return np.frombuffer(memoryview(block), np.uint8)


def release(pages: np.ndarray) -> None:
    """Drops the pages of what `mapped` returned; they are read again when touched.

    What has been written into them is lost.
    """
    if os.name == "posix":
        _library().madvise(pages.ctypes.data, pages.size, mmap.MADV_DONTNEED)


@functools.cache
def _library() -> ctypes.CDLL:
    library = ctypes.CDLL(None, use_errno=True)
    number = ctypes.c_int
    library.mmap.restype = _PLACE
    library.mmap.argtypes = [_PLACE, _SIZE, number, number, number, ctypes.c_long]
    library.munmap.argtypes = [_PLACE, _SIZE]
    library.madvise.argtypes = [_PLACE, _SIZE, number]
    return library
