"""Compiled loop over the velocities of links; see `stepper`."""

import math

import numpy as np

from cathsim_dmc.compiled import compiled


@compiled
def fastest(velocity, motions, places, poles, parents, bodies, last, roots, reach):
    """Largest velocity (N,) m/s of any place of the links of N devices.

    Along itself, only the last link counts: the others follow a way that is free.

    Args:
        velocity: (N, nv), `qvel`.
        motions: (N, nv, 6), `cdof`.
        places: (N, nbody, 3), `xpos`.
        poles: (N, nbody, 3), `subtree_com`.
        parents: (nv,), `dof_parentid`.
        bodies: (n,), of the links, from the proximal end.
        last: (n,), degree of freedom by which each is moved.
        roots: (n,), body of the tree of each.
        reach: (n,), m, of a link from its body's origin.
    """
    found = np.zeros(len(velocity))
    total = np.empty((len(parents), 6))
    for i in range(len(velocity)):
        for dof in range(len(parents)):
            for k in range(6):
                total[dof, k] = motions[i, dof, k] * velocity[i, dof]
                if parents[dof] >= 0:
                    total[dof, k] += total[parents[dof], k]
        for n in range(len(bodies)):
            place, pole = places[i, bodies[n]], poles[i, roots[n]]
            a, b, c, u, v, w = total[last[n]]
            x, y, z = place[0] - pole[0], place[1] - pole[1], place[2] - pole[2]
            u, v, w = u + b * z - c * y, v + c * x - a * z, w + a * y - b * x
            along = 0.0
            if n + 1 < len(bodies):
                ahead = places[i, bodies[n + 1]]
                x, y, z = ahead[0] - place[0], ahead[1] - place[1], ahead[2] - place[2]
                along = (u * x + v * y + w * z) / (x * x + y * y + z * z)
            u, v, w = u - along * x, v - along * y, w - along * z
            speed = math.sqrt(u * u + v * v + w * w)
            speed += reach[n] * math.sqrt(a * a + b * b + c * c)
            found[i] = max(found[i], speed)
    return found
