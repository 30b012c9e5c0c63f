"""Infos of environments in a batch, in the format of Gymnasium."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from cathsim_dmc import bounds


def reset_mask(options: Mapping[str, Any] | None, count: int) -> np.ndarray:
    """Mask (count,) bool of the option "reset_mask"; all true without it."""
    mask = (options or {}).get("reset_mask")
    if mask is None:
        return np.ones(count, bool)
    found = np.asarray(mask)
    if found.shape != (count,) or found.dtype != bool or not found.any():
        allowed = f"an array ({count},) of bool with a true entry"
        bounds.refuse("reset_mask", mask, allowed)
    return found


def masked(info: Mapping[str, np.ndarray], mask: np.ndarray) -> dict[str, np.ndarray]:
    """Figures (N,) where a mask (N,) is true, else zero, and "_name", the mask."""
    masked = {}
    for name, value in info.items():
        masked[name] = np.where(mask, value, np.zeros_like(value))
        masked[f"_{name}"] = mask.copy()
    return masked


def final_info(
    observation: Mapping[str, np.ndarray],
    info: Mapping[str, np.ndarray],
    mask: np.ndarray,
) -> dict[str, Any]:
    """Entries of infos for ended episodes, in Gymnasium's format."""
    last = np.full(len(mask), None, dtype=object)
    for i in np.flatnonzero(mask):
        last[i] = {name: value[i] for name, value in observation.items()}
    figures = masked(info, mask)
    return {
        "final_obs": last,
        "_final_obs": mask.copy(),
        "final_info": figures,
        "_final_info": mask.copy(),
    }
