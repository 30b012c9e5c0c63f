"""The device as observations show it, whatever length of it is simulated.

A task simulates what can leave the sheath. Observations show a device of
`COMMON_LENGTH`, so they have one shape: behind the simulated links the device is
straight and moves with its base.
"""

import numpy as np

from cathsim_dmc.entities.chain import Chain
from cathsim_dmc.entities.devices import Discretisation
from cathsim_dmc.physics.readings import Readings
from cathsim_dmc.tasks.placement import COMMON_LENGTH

# Distances of the tracked points from the head, m. They are joints of the steerable
# device, whose links are 7 mm long in the tip and 16.9 mm in the shaft.
TRACKED_PLACES = np.array([120.625, 86.875, 63.0, 49.0, 42.0, 28.0, 14.0, 0.0]) * 1e-3


class CommonChain:
    """Joints, links and tracked points of a device of `COMMON_LENGTH`.

    A longer chain is cut: the observation then shows its distal links.

    Attributes:
        num_links: L, number of links that observations show.
        num_joints: J, number of joints that they show.
    """

    def __init__(self, chain: Chain, shaft_link: float):
        """Finds the places of the simulated joints and links."""
        tip = max(device.tip_length for device in chain.devices)
        whole = Discretisation(max(COMMON_LENGTH, 2 * tip), shaft_link)
        self.num_links = len(whole.link_lengths(*chain.devices))
        lengths = chain.link_lengths
        self._behind = max(self.num_links - len(lengths), 0)

        names = [joint.full_identifier for joint in chain.joints]
        bends = [names.index(joint.full_identifier) for joint in chain.bends]
        others = [place for place in range(len(names)) if place not in bends]
        shown = 2 * (self.num_links - 1)
        missing = max(shown - len(bends), 0)
        # Places in the simulated joints, any for those that are missing.
        self._joints = np.array([*others, *[0] * missing, *bends[-shown:]])
        self._missing = slice(len(others), len(others) + missing)
        self.num_joints = len(self._joints)

        nodes = np.append(np.cumsum(lengths[::-1])[::-1], 0.0)
        # The link that each place lies on; the first one continues behind the base.
        after = np.sum(nodes[1:-1, None] > TRACKED_PLACES + 1e-9, axis=0)
        share = (nodes[after] - TRACKED_PLACES) / (nodes[after] - nodes[after + 1])
        self._after = after
        self._share = np.round(share, 9)[:, None]  # without rounding errors at joints

    def joints(self, values: np.ndarray) -> np.ndarray:
        """Values (..., J) of the joints shown, 0 for those that are not simulated."""
        taken = values.take(self._joints, axis=-1)
        taken[..., self._missing] = 0.0
        return taken

    def links(self, state: Readings) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Inertia (N, L, 10), velocity and force (N, L, 6) of the links shown.

        They are MuJoCo's `cinert`, `cvel` and `cfrc_ext`, about the centre of mass of
        the whole device. Links behind the simulated ones continue the first of these;
        nothing touches them.

        Args:
            state: readings of N simulations.
        """
        arrays = state.com_inertia, state.com_velocity, state.external_force
        if not self._behind:
            inertia, velocity, force = (a[:, -self.num_links :] for a in arrays)
            return inertia, velocity, force
        from cathsim_dmc.tasks import common_chain_loops  # late, as it takes long

        return common_chain_loops.continued(*arrays, state.centreline, self._behind)

    def tracked(self, line: np.ndarray) -> np.ndarray:
        """Tracked points (..., K, 3) of a centreline (..., l + 1, 3), the head last."""
        start, stop = line[..., self._after, :], line[..., self._after + 1, :]
        return start + self._share * (stop - start)
