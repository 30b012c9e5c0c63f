"""Compiled loop over the links of a device that is continued behind its base."""

import numpy as np

from cathsim_dmc.compiled import compiled


@compiled
def continued(inertia, velocity, force, line, behind):
    """Inertia (N, L, 10), velocity and force (N, L, 6) of all links, see `CommonChain`.

    Args:
        inertia: (N, l, 10), of the simulated links about their centre of mass.
        velocity: (N, l, 6).
        force: (N, l, 6).
        line: (N, l + 1, 3), proximal ends of the simulated links and the head, m.
        behind: number of links that continue the first one; L = l + behind.
    """
    count, simulated = inertia.shape[:2]
    inertias = np.zeros((count, simulated + behind, 10))
    velocities = np.zeros((count, simulated + behind, 6))
    forces = np.zeros((count, simulated + behind, 6))
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
    return inertias, velocities, forces
