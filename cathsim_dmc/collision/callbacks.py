"""MuJoCo's callbacks: one function for all models of a process, chained by the package.

Each compiled function calls what stood in the callback before it. Whoever sets a
callback later without calling it removes all of them, and no step says so.
"""

import ctypes
from typing import Any

import mujoco
import numpy as np

# Of each callback, in the order in which they follow each other: functions, and the
# words in which they find the address of the one before.
_chains: dict[str, list[tuple[Any, np.ndarray]]] = {}


def standing(name: str) -> int:
    """Address of the function in a callback, 0 for none.

    Raises:
        RuntimeError: if a Python function stands there.
    """
    stood = getattr(mujoco, f"get_{name}")()
    if stood is not None and not hasattr(stood, "argtypes"):
        raise RuntimeError(
            f"{name} is the Python function {stood!r}, which compiled functions cannot "
            f"call, so the effects of this package would be missing; remove it with "
            f"mujoco.set_{name}(None), then load or reset the environment"
        )
    return 0 if stood is None else ctypes.cast(stood, ctypes.c_void_p).value or 0


def follow(name: str, function: Any, before: np.ndarray) -> None:
    """Has MuJoCo call a compiled function after what stands in a callback.

    Args:
        name: "mjcb_passive" or another.
        function: Of `native.callback`.
        before: (1,) int64, gets the address of the function that stood there, which the
            function must call (`native.call_before`).

    Raises:
        RuntimeError: if a Python function stands there.
    """
    _chains.setdefault(name, [])
    _put(name, function, before)
    _chains[name].append((function, before))


def _put(name: str, function: Any, before: np.ndarray) -> None:
    before[0] = standing(name)
    getattr(mujoco, f"set_{name}")(function.ctypes)


def restore() -> None:
    """Puts back the functions of callbacks that somebody has removed.

    Raises:
        RuntimeError: if a Python function stands in a callback.
    """
    for name, chain in _chains.items():
        if chain and not standing(name):
            for function, before in chain:
                _put(name, function, before)
