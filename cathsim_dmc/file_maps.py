"""Files mapped into memory: pages are read at the first access and can be dropped.

`mmap.mmap` and `numpy.memmap` keep a file descriptor open for each map, and a process
is often limited to 1,024; these maps keep none.
"""

import ctypes
import mmap
import os
import weakref
from typing import BinaryIO

import numpy as np

if os.name == "posix":
    _library = ctypes.CDLL(None, use_errno=True)
    _library.mmap.restype = ctypes.c_void_p


def mapped(stream: BinaryIO) -> np.ndarray:
    """Maps a complete file into memory; returns its bytes (n,) uint8.

    Writes to the array do not reach the file. On systems other than POSIX the file is
    read instead.

    Raises:
        OSError: if the file is empty or cannot be mapped.
    """
    size = os.fstat(stream.fileno()).st_size
    if os.name != "posix":
        stream.seek(0)
        return np.frombuffer(bytearray(stream.read()), np.uint8)
    access, length = mmap.PROT_READ | mmap.PROT_WRITE, ctypes.c_size_t(size)
    file, offset = stream.fileno(), ctypes.c_long(0)
    start = _library.mmap(None, length, access, mmap.MAP_PRIVATE, file, offset)
    if start == ctypes.c_void_p(-1).value:
        raise OSError(ctypes.get_errno(), "cannot be mapped into memory")
    block = (ctypes.c_uint8 * size).from_address(start)
    # Not at exit: other threads may still read it.
    place = ctypes.c_void_p(start)
    weakref.finalize(block, _library.munmap, place, length).atexit = False
    return np.frombuffer(memoryview(block), np.uint8)


def release(pages: np.ndarray) -> None:
    """Drops the pages of an array of `mapped`; the next access reads the file again.

    Values written to the array are lost.
    """
    if os.name == "posix":
        place, size = ctypes.c_void_p(pages.ctypes.data), ctypes.c_size_t(pages.size)
        _library.madvise(place, size, mmap.MADV_DONTNEED)
