"""Which models of the process are built by this package, for compiled functions.

MuJoCo calls its callbacks for every model of a process. The last number of `userdata`
of a simulation with effects is `OWN`; nothing else of a model is read before that is.
"""

import numpy as np

from cathsim_dmc.collision.native import data_field, model_field
from cathsim_dmc.compiled import compiled

OWN = 0.7389056098930650


@compiled
def owned(model, data):
    """Whether a simulation is one of this package's that has begun an episode."""
    count = model_field(model, "nuserdata")
    return count > 0 and data_field(data, "userdata")[count - 1] == OWN


@compiled
def parameters_of(model, data, mark):
    """Place in `userdata` of the parameters of the effect with a mark; 0 for none."""
    if not owned(model, data):
        return np.int64(0)
    last = np.int64(model_field(model, "nuserdata")) - 1
    user, start = data_field(data, "userdata"), np.int64(0)
    while start + 2 < last:
        size = user[start + 1]
        if not 0.0 < size <= last - start - 2:
            return np.int64(0)
        if user[start + 2] == mark:
            return start + 2
        start += 2 + np.int64(size)
    return np.int64(0)
