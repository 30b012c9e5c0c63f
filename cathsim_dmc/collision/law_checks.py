"""Compiled checks of a user's law: what it returns, and what it writes."""

import math

from numba.core import errors, types
from numba.extending import overload

from cathsim_dmc.compiled import compiled

# What a law writes, by where it acts.
WRITTEN = {
    "control": lambda state: state.xfrc_applied,
    "passive": lambda state: state.qfrc_passive,
    "contact": lambda state: state.solref,
}


@compiled
def finite(array):
    """Whether all numbers of an array are finite."""
    for x in array.flat:  # noqa: SIM110  numba has no `all` of a generator
        if not math.isfinite(x):
            return False
    return True


def nothing(returned):
    """Refuses at compilation that a law returns a value."""


@overload(nothing)
def _nothing(returned):
    if not isinstance(returned, types.NoneType):
        raise errors.TypingError(
            f"the law returns a value ({returned}), which has no effect; it adds to "
            "what it acts on, and returns nothing"
        )
    return lambda returned: None
