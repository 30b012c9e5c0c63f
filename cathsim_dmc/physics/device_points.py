"""Points of coaxial devices on the line of their chain."""

import numpy as np

from cathsim_dmc.laws import sliding

# Length of straight device behind the base that fluoroscopy shows, m.
BEHIND = 0.3
# Distances of the tracked points of a device from its end, m.
DEVICE_PLACES = np.arange(7, -1, -1) * 15e-3


def device_points(line: np.ndarray, gaps: np.ndarray, nodes: np.ndarray) -> np.ndarray:
    """Points (N, K, n, 3) of devices that end at gaps (N, K) from the end of a line, m.

    Nodes (L + 1,) are the distances of the line's points (N, L + 1, 3) from its end.
    """
    # A device has one point more than the chain: behind, its own nodes, its end.
    beyond = (nodes < gaps[..., None]).sum(axis=-1, keepdims=True)
    own = np.arange(len(nodes)) - np.maximum(beyond - 1, 0)
    places = np.maximum(nodes[np.maximum(own, 0)], gaps[..., None])
    behind = np.full((*places.shape[:2], 1), nodes[0] + BEHIND)
    places = np.concatenate([behind, places], axis=-1)
    return points_at(line, places, nodes)


def points_at(line: np.ndarray, places: np.ndarray, nodes: np.ndarray) -> np.ndarray:
    """Points (N, K, n, 3) at places (N, K, n) from the end of a line, m."""
    found = np.empty((*places.shape, 3))
    sliding.points(line, places, nodes, found)
    return found


def gaps_of(insertion: np.ndarray) -> np.ndarray:
    """Distances (N, K), m, of the ends of devices behind the one that leads."""
    return insertion.max(axis=1, keepdims=True) - insertion
