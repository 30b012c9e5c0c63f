"""Actions as an agent gives them."""

import numpy as np

from cathsim_dmc import bounds


def check_action(given: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Returns the action as float64, clipped to [-1, 1] as the drives would.

    Args:
        given: action of one simulation (A,), or of many (N, A).
        shape: that it must have.

    Raises:
        ValueError: if its shape is another or it is not finite.
    """
    try:
        action = np.asarray(given)
    except ValueError:  # rows of different lengths
        action = np.array(None)
    if action.dtype.kind not in "fiu":
        raise ValueError(
            f"the action is {bounds.shown(given)}; give an array {shape} of numbers in "
            "[-1, 1]"
        )
    action = action.astype(np.float64)
    if action.shape != shape:
        many = f"for {shape[0]} simulations, " if shape[1:] else ""
        raise ValueError(
            f"the action has shape {action.shape}, but it must have {shape}: {many}"
            f"{shape[-1]} entries in [-1, 1]: tip motors from proximal to distal (x "
            "before y), translation, and rotation if the task has it"
        )
    finite = np.isfinite(action)
    if np.count_nonzero(finite) < finite.size:  # a third of the time of `all`
        raise ValueError(
            f"the action holds {np.count_nonzero(~finite)} NaN or infinite entries; "
            "all must be numbers in [-1, 1]"
        )
    return np.minimum(np.maximum(action, -1.0), 1.0)
