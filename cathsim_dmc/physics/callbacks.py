"""Functions of effects that are compiled and that MuJoCo calls in every physics step.

MuJoCo has one `mjcb_control` for all models of a process. Each function that is
installed becomes one more link of a chain: it calls what was there before, then acts on
the models that bear the mark of its effects in `userdata`, and on no other.
"""

from collections.abc import Callable

import numpy as np

from cathsim_dmc.collision import callbacks, native
from cathsim_dmc.collision.native import call_before, data_field, model_field
from cathsim_dmc.collision.own import owned
from cathsim_dmc.compiled import compiled
from cathsim_dmc.physics.readings import Bodies

# Mark of each function, and what the links refer to by address, which must stay alive.
_marks: dict[Callable, int] = {}
_kept: list = []
# The mark of a function that has raised an error since this was read last.
_fault = np.zeros(1)


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
        _append(_nothing, 0)
    if function not in _marks:
        _append(function, len(_marks) + 1)
        _marks[function] = len(_marks) + 1
    return _marks[function]


def raise_fault() -> None:
    """Raises RuntimeError if a function has raised an error since the last call."""
    mark, _fault[0] = int(_fault[0]), 0
    if mark:
        names = {found: function for function, found in _marks.items()}
        raise RuntimeError(
            f"{names[mark].__qualname__} has raised an error in a physics step, most "
            "likely an index beyond an array of its parameters or bodies; compare its "
            "indices with the arrays' lengths"
        )


def _append(function: Callable, mark: int) -> None:
    before = np.full(1, callbacks.standing("mjcb_control"))
    # Links refer to each other: none is kept on disk.
    law = compiled(function, cache=False, checked=True)
    places = before.ctypes.data, _fault.ctypes.data
    link = native.callback("void(int64, int64)", cache=False)(_link(law, mark, *places))
    _kept.append(before)
    callbacks.follow("mjcb_control", link, before)


def _nothing(parameters, time, bodies):
    """What the link that clears the forces does beside that."""


def _link(apply: Callable, mark: int, before: int, fault: int) -> Callable:
    """A link of the chain; with mark 0 it clears the forces, before all others.

    `before` is the place of the address of the one before it, `fault` that of `_fault`.
    """

    def link(model, data):
        call_before(before, model, data)
        if not owned(model, data):
            return
        count = np.int64(model_field(model, "nuserdata")) - 1
        user = data_field(data, "userdata")[:count]
        nbody, time = model_field(model, "nbody"), data_field(data, "time")
        bodies = Bodies(
            data_field(data, "xipos")[:nbody],
            data_field(data, "ximat")[:nbody],
            data_field(data, "xmat")[:nbody],
            data_field(data, "cvel")[:nbody],
            data_field(data, "subtree_com")[:nbody],
            data_field(data, "xfrc_applied")[:nbody],
        )
        start = np.int64(0)
        while start + 2 < count:
            size = user[start + 1]
            if not 0.0 < size <= count - start - 2:
                return
            own = start + 2 + np.int64(size)
            if mark == 0 and user[start] != 0.0:
                bodies.xfrc_applied[:] = 0.0
                return
            if mark != 0 and user[start] == mark:
                try:
                    apply(user[start + 2 : own], time, bodies)
                except Exception:  # noqa: BLE001  C cannot be told
                    native.numbers(fault)[0] = mark
            start = own

    return link
