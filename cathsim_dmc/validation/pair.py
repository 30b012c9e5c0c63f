"""`cathsim validate pair`: coaxial devices against theory, at rest and on the move."""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from cathsim_dmc.entities.device_stack import DeviceStack
from cathsim_dmc.tasks.config import CONTROL_TIMESTEP
from cathsim_dmc.validation import pressed, rod, shapes, sliding, theory, two_rods
from cathsim_dmc.validation.checks import Check, Report
from cathsim_dmc.validation.rig import Rig

PAIR = ("wire_035_glide", "berenstein_5f")
PROTRUSIONS = (0.0, 0.02, 0.05, 0.10)  # m, of the wire out of the catheter
END_ANGLES = (15.0, 45.0)  # degrees
# Largest step of the free end as one device slides in the other, in that of the curve:
# a chain whose hinges jumped one after the other would make several at once.
STEP_BOUND = 1.1


def straightened(names: Sequence[str]) -> DeviceStack:
    """The devices without their pre-shaped tips."""
    return DeviceStack([rod.straight(name) for name in names])


def sections(entity: DeviceStack, gaps: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Lengths and EI of the uniform sections of the free rod, from the clamp on.

    The carriage holds link 0 by its middle, as in `Rig.sections`.
    """
    length = float(entity.link_lengths.sum() - entity.link_lengths[0] / 2)
    tips = [device.tip_length for device in entity.devices]
    places = np.unique(np.minimum([0.0, length, *gaps, *(gaps + tips)], length))
    middles = (places[1:] + places[:-1]) / 2
    bending = sum(
        theory.profile(device, middles - gap)[0]
        for device, gap in zip(entity.devices, gaps, strict=True)
    )
    return np.diff(places)[::-1], np.asarray(bending)[::-1]


def cantilevers(protrusion: float) -> list[rod.Cantilever]:
    """The pair, straightened, with the wire out by so much (m), loaded at its end."""
    gaps, entity = np.array([0.0, protrusion]), straightened(PAIR)
    rig = Rig(stack=entity, gaps=gaps)
    rig.compile()
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
    curve = [shapes.free_curve(entity.devices, gap, length) for gap in gaps]
    return np.stack([x, 0 * x, z], axis=-1), np.array(curve)


def smoothness() -> Check:
    """Steps of the free end as the wire slides at 10 mm/s, against the curve's."""
    leads = np.arange(-0.06, 0.06, sliding.SPEED * CONTROL_TIMESTEP)
    ends = free_ends(sliding.SLIDING_PAIR, leads)
    chain, curve = (np.linalg.norm(np.diff(e, axis=0), axis=-1).max() for e in ends)
    name = "free end while the wire slides at 10 mm/s: largest step over the curve's"
    note = f"{1e3 * chain:.2f} mm in 40 ms, the curve's {1e3 * curve:.2f} mm, over "
    note += f"{len(leads)} steps"
    return Check.at_most(name, chain / curve, STEP_BOUND, "", note)


def buckling(end: str) -> rod.Buckling:
    """Critical load of the shafts of the pair, one in the other."""
    entity = straightened(PAIR)
    # Up to the last of the long links: beyond lie the tips.
    last = int(np.argmin(entity.link_lengths >= entity.link_lengths[0])) - 1
    stiffness = sum(device.shaft.bending_stiffness for device in entity.devices)
    return rod.column(Rig(stack=entity), end, last, stiffness)


def _checks(data: dict[str, Any], findings: dict[str, Any]) -> Iterator[Check]:
    for protrusion in PROTRUSIONS:
        what = f"wire out by {1e3 * protrusion:.0f} mm" if protrusion else "pair"
        yield from (one.check(what) for one in cantilevers(protrusion))
    yield from shapes.checks()
    yield from two_rods.checks()
    for end in ("sliding", "fixed"):
        yield buckling(end).check("buckling load of the pair")
    yield smoothness()
    yield from pressed.checks(PAIR)
    yield from sliding.checks(data, findings)


def validate_pair() -> Report:
    """Runs every check of coaxial devices."""
    data: dict[str, Any] = {}
    findings: dict[str, Any] = {}
    return Report("pair", list(_checks(data, findings)), findings, data)
