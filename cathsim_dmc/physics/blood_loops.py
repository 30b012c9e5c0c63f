"""Drag of blood, compiled; MuJoCo calls it in every physics step. See `blood`."""

import functools
import math

from cathsim_dmc.anatomy.circulation import BEAT
from cathsim_dmc.collision import callbacks, native
from cathsim_dmc.collision.native import (
    address_of,
    call_before,
    data_field,
    model_field,
)
from cathsim_dmc.collision.own import parameters_of
from cathsim_dmc.compiled import compiled

# Parameters before those of the links: the mark of blood, its density and viscosity,
# the first link's number among the bodies; and of the factor b beat(r t + p) of all
# velocities the peak b, 0 for a steady flow, the rate r in 1/s and the phase p.
HEADER, MARK = 7, 1843.0
# Parameters of a link: velocity of the blood there, m/s at a factor of 1, its delay, s,
# the friction along the link's axis per length and velocity, N·s/m², and the velocity
# of the vessel's space, m/s.
OF_LINK = 8
_SYMBOL = "cathsim_blood"
_before = native.symbol(_SYMBOL, 1)


@compiled
def beat(phase):
    """Inflow of the aorta over that at its peak, at a phase in beats."""
    place = (phase - math.floor(phase)) * (len(BEAT) - 1)
    first = min(int(place), len(BEAT) - 2)
    share = place - first
    return (1.0 - share) * BEAT[first] + share * BEAT[first + 1]


@native.callback("void(int64, int64)")
def _drag(model, data):
    """Adds the drag on each link to the passive forces of a model with blood."""
    call_before(address_of(_SYMBOL), model, data)
    start = parameters_of(model, data, MARK)
    if start == 0:
        return
    user = data_field(data, "userdata")
    links, user = (int(user[start - 1]) - HEADER) // OF_LINK, user[start:]
    density, viscosity, first = user[1], user[2], int(user[3])
    if viscosity == 0.0:
        return
    geoms, sizes = model_field(model, "body_geomadr"), model_field(model, "geom_size")
    dofs, counts = model_field(model, "body_dofadr"), model_field(model, "body_dofnum")
    xipos, xmat = data_field(data, "xipos"), data_field(data, "xmat")
    cvel, pole = data_field(data, "cvel"), data_field(data, "subtree_com")[first]
    cdof, passive = data_field(data, "cdof"), data_field(data, "qfrc_passive")
    peak, rate, factor = user[4], user[5], 1.0
    phase = rate * data_field(data, "time") + user[6]
    # Force of all links from here to the end, and its torque about the pole.
    fx = fy = fz = tx = ty = tz = 0.0
    for link in range(links - 1, -1, -1):
        body, flow = first + link, user[HEADER + OF_LINK * link :]
        radius, half = sizes[geoms[body], 0], sizes[geoms[body], 1]
        spin, axes, place = cvel[body], xmat[body], xipos[body]
        x, y, z = place[0] - pole[0], place[1] - pole[1], place[2] - pole[2]
        if peak != 0.0:
            factor = peak * beat(phase - rate * flow[3])
        u = factor * flow[0] + flow[5] - spin[3] - spin[1] * z + spin[2] * y
        v = factor * flow[1] + flow[6] - spin[4] - spin[2] * x + spin[0] * z
        w = factor * flow[2] + flow[7] - spin[5] - spin[0] * y + spin[1] * x
        along = u * axes[2] + v * axes[5] + w * axes[8]
        u, v, w = u - along * axes[2], v - along * axes[5], w - along * axes[8]
        speed = math.sqrt(u * u + v * v + w * w)
        reynolds = density * speed * 2 * radius / viscosity
        # ½ Re C_d, which is 0 at rest.
        drag = (0.59 - 2e-4 * reynolds / (1 + 3.64e-7 * reynolds**2)) * reynolds
        drag += 3.4 * reynolds**0.11 + 0.98 * math.sqrt(reynolds)
        drag *= viscosity * 2 * half
        u, v, w = drag * u, drag * v, drag * w
        along *= flow[4] * 2 * half
        u, v, w = u + along * axes[2], v + along * axes[5], w + along * axes[8]
        fx, fy, fz = fx + u, fy + v, fz + w
        tx, ty, tz = tx + y * w - z * v, ty + z * u - x * w, tz + x * v - y * u
        for dof in range(dofs[body], dofs[body] + counts[body]):
            way = cdof[dof]
            passive[dof] += way[0] * tx + way[1] * ty + way[2] * tz
            passive[dof] += way[3] * fx + way[4] * fy + way[5] * fz


@functools.cache
def install() -> None:
    """Has MuJoCo add the drag where there is blood; RuntimeError as `follow`."""
    callbacks.follow("mjcb_passive", _drag, _before)
