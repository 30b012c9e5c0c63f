"""`cathsim validate pair`: coaxial devices against theory, at rest and on the move."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from cathsim_dmc.entities import devices
from cathsim_dmc.entities.device import Device
from cathsim_dmc.entities.device_stack import DeviceStack
from cathsim_dmc.physics import chain_fields
from cathsim_dmc.tasks.config import CONTROL_TIMESTEP
from cathsim_dmc.validation import pressed, rod, shapes, sliding, theory, two_rods
from cathsim_dmc.validation.checks import Check, Checks, Report
from cathsim_dmc.validation.rig import Rig

PAIR = ("wire_035_glide", "berenstein_5f")
PROTRUSIONS = (0.0, 0.02, 0.05, 0.10)  # m, of the wire out of the catheter
END_ANGLES = (15.0, 45.0)  # degrees
# Largest step of the free end as one device slides in the other, in that of the curve:
# a chain whose hinges jumped one after the other would make several at once.
STEP_BOUND = 1.1


def straightened(names: Sequence[str]) -> tuple[Device, ...]:
    """The devices without their pre-shaped tips."""
    return tuple(dataclasses.replace(devices.get(name), tip_shape=()) for name in names)


def sections(entity: DeviceStack, gaps: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Lengths and EI of the uniform sections of the free rod, from the clamp on.

    The carriage holds link 0 by its middle, as in `Rig.sections`.
    """
    length = float(entity.link_lengths.sum() - entity.link_lengths[0] / 2)
    edges = {0.0, length}
    for device, gap in zip(entity.devices, gaps, strict=True):
        edges |= {min(gap, length), min(gap + device.tip_length, length)}
    places = np.array(sorted(edges))
    middles = (places[1:] + places[:-1]) / 2
    bending = sum(
        theory.profile(device, middles - gap)[0]
        for device, gap in zip(entity.devices, gaps, strict=True)
    )
    return np.diff(places)[::-1], np.asarray(bending)[::-1]


def cantilevers(protrusion: float) -> list[rod.Cantilever]:
    """The pair, straightened, with the wire out by so much (m), loaded at its end."""
    gaps = np.array([0.0, protrusion])
    entity = DeviceStack(straightened(PAIR))
    rig = Rig(catheter=entity)
    rig.compile()
    chain_fields.write_still(entity, rig.model, gaps)
    return rod.bent(rig, *sections(entity, gaps), END_ANGLES)


def free_ends(names: Sequence[str], leads: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Ends (n, 3) of the unloaded chain and of the curve, as the wire slides, m.

    Args:
        names: of wire and catheter.
        leads: (n,), by how much the wire is ahead of the catheter, m; negative where it
            is behind.
    """
    entity = DeviceStack(names)
    stack, length = entity.stack, float(entity.link_lengths.sum())
    gaps = np.stack([np.maximum(-leads, 0.0), np.maximum(leads, 0.0)], axis=-1)
    turns = np.zeros((len(leads), 2, len(stack.spans)))
    angles = np.real(stack.rest_angles(stack.overlap(gaps), turns))
    # All shapes lie in one plane here.
    heading = np.concatenate([np.zeros((len(leads), 1)), np.cumsum(angles, -1)], -1)
    x = (np.sin(heading) * stack.link_lengths).sum(-1)
    z = (np.cos(heading) * stack.link_lengths).sum(-1)
    chain = np.stack([x, 0 * x, z], axis=-1)
    curve = []
    for gap in gaps:
        _, steps, curvature = shapes.weighted_curvature(
            entity.devices, gap, np.zeros(2), length
        )
        turning = np.real(curvature) * steps
        heading = np.cumsum(turning) - turning / 2
        end = (np.sin(heading) @ steps, 0.0, np.cos(heading) @ steps)
        curve.append(end)
    return chain, np.array(curve)


def _smoothness() -> Check:
    """Steps of the free end as the wire slides at 10 mm/s, against the curve's."""
    leads = np.arange(-0.06, 0.06, sliding.SPEED * CONTROL_TIMESTEP)
    chain, curve = free_ends(sliding.SLIDING_PAIR, leads)
    steps = [np.linalg.norm(np.diff(ends, axis=0), axis=-1) for ends in (chain, curve)]
    return Check.at_most(
        "free end while the wire slides at 10 mm/s: largest step over the curve's",
        steps[0].max() / steps[1].max(),
        STEP_BOUND,
        "",
        f"{1e3 * steps[0].max():.2f} mm in 40 ms, the curve's "
        f"{1e3 * steps[1].max():.2f} mm, over {len(leads)} steps",
    )


def buckling(end: str) -> rod.Buckling:
    """Critical load of the shafts of the pair, one in the other."""
    entity = DeviceStack(straightened(PAIR))
    gaps = np.zeros(2)
    # Up to the last of the long links: beyond lie the tips.
    last = int(np.argmin(entity.link_lengths >= entity.link_lengths[0])) - 1
    tips = max(device.tip_length for device in entity.devices)
    assert entity.stack.nodes[last + 1] > tips - 1e-9
    stiffness = sum(device.shaft.bending_stiffness for device in entity.devices)
    return rod.column(
        Rig(catheter=entity),
        end,
        last,
        stiffness,
        lambda rig: chain_fields.write_still(entity, rig.model, gaps),
    )


def validate_pair() -> Report:
    """Runs every check of coaxial devices."""
    checks = Checks()
    for protrusion in PROTRUSIONS:
        what = f"wire out by {1e3 * protrusion:.0f} mm" if protrusion else "pair"
        for one in cantilevers(protrusion):
            checks.append(rod.cantilever_check(what, one))
    checks += shapes.checks() + two_rods.checks()
    for end in ("sliding", "fixed"):
        checks.append(rod.buckling_check("buckling load of the pair", buckling(end)))
    checks.append(_smoothness())
    checks += pressed.checks(PAIR)
    moving, findings, turned = sliding.checks()
    return Report("pair", [*checks, *moving], findings, {"turned": turned})
