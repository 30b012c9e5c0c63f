"""The device as observations show it, independent of the simulated length.

A task simulates only what can leave the sheath. Observations show a device of
`COMMON_LENGTH`, so their shape is the same in all tasks: proximal to the simulated
links, the device is straight and moves with its base.
"""

from typing import NamedTuple

import numpy as np

from cathsim_dmc import rows
from cathsim_dmc.compiled import compiled
from cathsim_dmc.entities.chain import Chain
from cathsim_dmc.entities.devices import Discretisation
from cathsim_dmc.physics.readings import Readings, part
from cathsim_dmc.tasks.placement import COMMON_LENGTH

# Distances of the tracked points from the head, m. They are joints of the steerable
# device, whose links are 7 mm long in the tip and 16.9 mm in the shaft.
TRACKED_PLACES = np.array([120.625, 86.875, 63.0, 49.0, 42.0, 28.0, 14.0, 0.0]) * 1e-3


class LinkState(NamedTuple):
    """Inertia (N, L, 10), velocity and force (N, L, 6) of links."""

    inertia: np.ndarray
    velocity: np.ndarray
    force: np.ndarray


class CommonChain:
    """Joints, links and tracked points of a device of `COMMON_LENGTH`.

    A longer chain is cut: the observation then shows its distal links.

    Attributes:
        num_links: L, number of links that observations show.
        num_joints: J, number of joints that observations show.
    """

    def __init__(self, chain: Chain, shaft_link: float):
        """Finds the joints and links shown; `shaft_link` is the shaft's longest, m."""
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
        # Indices of the simulated joints; arbitrary for missing ones, which read 0.
        self._joints = np.array([*others, *[0] * missing, *bends[-shown:]])
        self._missing = slice(len(others), len(others) + missing)
        self.num_joints = len(self._joints)

        nodes = np.append(np.cumsum(lengths[::-1])[::-1], 0.0)
        # The link of each tracked point; the first link extends behind the base.
        after = np.sum(nodes[1:-1, None] > TRACKED_PLACES + 1e-9, axis=0)
        share = (nodes[after] - TRACKED_PLACES) / (nodes[after] - nodes[after + 1])
        self._after = after
        self._share = np.round(share, 9)[:, None]  # without rounding errors at joints

    def joints(self, values: np.ndarray) -> np.ndarray:
        """Maps values (..., j) of the chain's joints to those (..., J) of joints shown.

        Base and torsion come first, then the bending hinges; hinges that are not
        simulated read 0.
        """
        taken = values.take(self._joints, axis=-1)
        taken[..., self._missing] = 0.0
        return taken

    def links(self, state: Readings) -> LinkState:
        """Inertia (N, L, 10), velocity and force (N, L, 6) of the links shown.

        They are MuJoCo's `cinert`, `cvel` and `cfrc_ext`, about the centre of mass of
        the whole device. Links proximal to the simulated ones extend the first of these
        and have no contacts.

        Args:
            state: readings of N simulations.
        """
        arrays = LinkState(state.com_inertia, state.com_velocity, state.external_force)
        if not self._behind:
            return LinkState._make(a[:, -self.num_links :] for a in arrays)
        shape = len(state.com_inertia), self.num_links
        inertia, velocity, force = (np.zeros((*shape, width)) for width in (10, 6, 6))
        found = LinkState(inertia, velocity, force)

        def extend(own: slice) -> None:
            line, out = state.centreline[own], part(found, own)
            _continued(part(arrays, own), line, self._behind, out)

        if len(force) < rows.MANY:  # slices of all arrays take longer than the work
            _continued(arrays, state.centreline, self._behind, found)
        else:
            rows.each(len(force), extend)
        return found

    def tracked(self, line: np.ndarray) -> np.ndarray:
        """Tracked points (..., K, 3) of a centreline (..., l + 1, 3), the head last."""
        start, stop = line[..., self._after, :], line[..., self._after + 1, :]
        return start + self._share * (stop - start)


@compiled
def _continued(simulated_links, line, behind, out):
    """Writes the state of all links, see `CommonChain.links`."""
    inertia, velocity, force = simulated_links
    inertias, velocities, forces = out
    count, simulated = inertia.shape[:2]
    back, shift = np.zeros(3), np.zeros(3)
    for i in range(count):
        first, mass = inertia[i, 0, 9], behind * inertia[i, 0, 9]
        for link in range(simulated):
            mass += inertia[i, link, 9]
        if mass == 0.0:  # before the first episode
            continue
        # From the centre of mass of the simulated links to that of all links.
        for k in range(3):
            back[k] = line[i, 0, k] - line[i, 1, k]
            shift[k] = inertia[i, 0, 6 + k] + 0.5 * first * (behind + 1) * back[k]
            shift[k] *= behind / mass
        for row in range(simulated + behind):
            link, steps = max(row - behind, 0), max(behind - row, 0)
            own, new = inertia[i, link], inertias[i, row]
            m, x, y, z = own[9], own[6], own[7], own[8]
            a = x + m * (steps * back[0] - shift[0])
            b = y + m * (steps * back[1] - shift[1])
            c = z + m * (steps * back[2] - shift[2])
            # Theorem of parallel axes.
            new[0] = own[0] + (b * b + c * c - y * y - z * z) / m
            new[1] = own[1] + (a * a + c * c - x * x - z * z) / m
            new[2] = own[2] + (a * a + b * b - x * x - y * y) / m
            new[3] = own[3] - (a * b - x * y) / m
            new[4] = own[4] - (a * c - x * z) / m
            new[5] = own[5] - (b * c - y * z) / m
            new[6], new[7], new[8], new[9] = a, b, c, m
            for k in range(3):
                p, q = (k + 1) % 3, (k + 2) % 3
                turn, push = velocity[i, link], force[i, link]
                velocities[i, row, k] = turn[k]
                across = turn[p] * shift[q] - turn[q] * shift[p]
                velocities[i, row, 3 + k] = turn[3 + k] + across
                if not steps:
                    across = push[3 + p] * shift[q] - push[3 + q] * shift[p]
                    forces[i, row, k] = push[k] + across
                    forces[i, row, 3 + k] = push[3 + k]
