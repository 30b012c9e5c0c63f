"""Functions of effects that are compiled and that MuJoCo calls in every physics step.

MuJoCo has one `mjcb_control` for all models of a process. Each function that is
installed becomes one more link of a chain: it calls what was there before, then acts on
the models that bear the mark of its effects in `userdata`, and on no other.
"""

import ctypes
import functools
from collections.abc import Callable

import mujoco

from cathsim_dmc.collision import native
from cathsim_dmc.compiled import compiled
from cathsim_dmc.physics.readings import MARK, Bodies

# Links refer to each other: none is kept on disk.
_compiled = functools.partial(compiled, cache=False)

_NUSERDATA, _NBODY = native.offsets("mjModel", ("nuserdata", "nbody")).tolist()
_USERDATA, _TIME, *_ARRAYS = native.offsets(
    "mjData", ("userdata", "time", *Bodies._fields)
).tolist()
_XIPOS, _XIMAT, _XMAT, _CVEL, _COM, _FORCE = _ARRAYS
_C_FUNCTION = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_void_p)

# Mark of each function, and the links of the chain, which must stay alive.
_marks: dict[Callable, int] = {}
_links: list = []


def install(function: Callable) -> int:
    """Has MuJoCo call a function in every physics step of the models with its mark.

    Args:
        function: See `effects.Effect.forces`.

    Returns:
        Its mark.

    Raises:
        RuntimeError: if a Python function stands in `mjcb_control`.
    """
    if not _marks:
        _append(_clear, 0)
    if function not in _marks:
        _marks[function] = len(_marks) + 1
        _append(function, _marks[function])
    return _marks[function]


def _append(function: Callable, mark: int) -> None:
    before = mujoco.get_mjcb_control()
    if before is not None and not hasattr(before, "argtypes"):
        raise RuntimeError(
            f"mjcb_control is the Python function {before!r}, which compiled effects "
            "cannot call; remove it with mujoco.set_mjcb_control(None)"
        )
    link = native.callback("void(int64, int64)", cache=False)(
        _link(_compiled(function), mark, _called(before))
    )
    _links.append(link)
    mujoco.set_mjcb_control(link.ctypes)


def _called(before) -> Callable:
    if before is None:

        @_compiled
        def call(model, data):
            pass

        return call
    function = ctypes.cast(before, _C_FUNCTION)

    @_compiled
    def call(model, data):
        function(native.pointer(model), native.pointer(data))

    return call


def _clear(parameters, time, bodies):
    bodies.xfrc_applied[:] = 0.0


def _link(apply: Callable, mark: int, before: Callable) -> Callable:
    """A link of the chain; with mark 0 it acts once on each model with effects."""

    def link(model, data):
        before(model, data)
        count = native.word(model + _NUSERDATA)
        if count == 0:
            return
        user = native.numbers(native.word(data + _USERDATA), count)
        if user[count - 1] != MARK:
            return
        nbody = native.word(model + _NBODY)
        bodies = Bodies(
            _rows(data + _XIPOS, nbody, 3),
            _rows(data + _XIMAT, nbody, 9),
            _rows(data + _XMAT, nbody, 9),
            _rows(data + _CVEL, nbody, 6),
            _rows(data + _COM, nbody, 3),
            _rows(data + _FORCE, nbody, 6),
        )
        time = native.numbers(data + _TIME, 1)[0]
        if mark == 0:
            apply(user[:0], time, bodies)
            return
        start = 0
        while start < count - 1:
            own = start + 2 + int(user[start + 1])
            if user[start] == mark:
                apply(user[start + 2 : own], time, bodies)
            start = own

    return link


@_compiled
def _rows(place, count, width):
    return native.numbers(native.word(place), count * width).reshape(count, width)
