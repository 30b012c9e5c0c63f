"""Places in vessels that move, of simulations of one anatomy; compiled loops.

`own` (n,) are the indices of the simulations in arrays (N, ...). `given` are
`laws.motion.MotionParameters` of arrays (N,) and times (N,), s.
"""

import numpy as np

from cathsim_dmc.compiled import compiled
from cathsim_dmc.laws.motion import (
    VALUES,
    WARP,
    first_past,
    nth_course,
    to_rest,
    to_space,
)


@compiled
def to_rest_of(lattice, own, given, inlets, places):
    """Maps places past the inlet from space to the vessel at rest, in place.

    Args:
        lattice: Lattice of `anatomy.motion.Motion`.
        own: (n,) int64.
        given: See the module.
        inlets: (N, 2, 3), position (m) and direction of the inlets.
        places: (N, P, 3) m, in space; overwritten with the places at rest.
    """
    parameters, times = given
    scratch = np.empty((VALUES + WARP // 4, 4))
    for n in own:
        course = nth_course(parameters, n, times[n])
        moved = places[n, first_past(inlets[n], places[n]) :]
        to_rest(lattice, course, moved, scratch, moved)


@compiled
def to_space_of(lattice, own, given, places):
    """Maps places (N, 3) m of the vessel at rest into space, in place."""
    parameters, times = given
    scratch, growth = np.empty((VALUES + WARP // 4, 4)), np.empty(1)
    for n in own:
        course, one = nth_course(parameters, n, times[n]), places[n : n + 1]
        to_space(lattice, course, one, scratch, one, growth)
