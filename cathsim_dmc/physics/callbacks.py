"""Functions of effects that are compiled and that MuJoCo calls in every physics step.

MuJoCo has one `mjcb_control` for all models of a process. Each function that is
installed becomes one more link of a chain: it calls what was there before, then acts on
the models that bear the mark of its effects in `userdata`, and on no other.
"""

import functools
from collections.abc import Callable

import mujoco

from cathsim_dmc.collision import native
from cathsim_dmc.collision.native import data_field, model_field
from cathsim_dmc.compiled import compiled
from cathsim_dmc.physics.readings import MARK, Bodies

# Links refer to each other: none is kept on disk.
_compiled = functools.partial(compiled, cache=False)


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
    made = _link(_compiled(function), mark, native.stands_in("mjcb_control"))
    _links.append(native.callback("void(int64, int64)", cache=False)(made))
    mujoco.set_mjcb_control(_links[-1].ctypes)


def _clear(parameters, time, bodies):
    bodies.xfrc_applied[:] = 0.0


def _link(apply: Callable, mark: int, before: int) -> Callable:
    """A link of the chain; with mark 0 it acts once on each model with effects.

    `before` is the address of the one before it.
    """

    def link(model, data):
        if before != 0:
            native.call_callback(before, model, data)
        count = model_field(model, "nuserdata")
        user = data_field(data, "userdata")
        if count == 0 or user[count - 1] != MARK:
            return
        nbody, time = model_field(model, "nbody"), data_field(data, "time")
        bodies = Bodies(
            data_field(data, "xipos")[:nbody],
            data_field(data, "ximat")[:nbody],
            data_field(data, "xmat")[:nbody],
            data_field(data, "cvel")[:nbody],
            data_field(data, "subtree_com")[:nbody],
            data_field(data, "xfrc_applied")[:nbody],
        )
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
