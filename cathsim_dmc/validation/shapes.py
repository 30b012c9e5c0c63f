"""Unloaded shapes turned about the axis, and twist of the chain in a bend."""

from collections.abc import Sequence

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from cathsim_dmc.entities import devices, posture
from cathsim_dmc.entities.coaxial import Stack
from cathsim_dmc.entities.device import Device
from cathsim_dmc.entities.device_stack import DeviceStack
from cathsim_dmc.physics import chain_fields
from cathsim_dmc.validation import theory
from cathsim_dmc.validation.checks import Check
from cathsim_dmc.validation.rig import Rig

_FINE = 0.05e-3  # m, of the curve that is integrated
TURNS = np.radians(np.arange(0, 360, 15))
# Distances (m) of the ends of wire and catheter from the end of the chain.
GAPS = ((0.0, 0.02), (0.012, 0.0), (0.0, 0.005))
PAIRS = (
    ("wire_035_glide", "berenstein_5f"),
    ("wire_035_amplatz", "diagnostic_5f_simmons"),
)
END_BOUND = 1.0  # % of the displacement of the end from the straight line
DIRECTION_BOUND = 1.5  # °, of the last link
CURVE_BOUND = 1.0  # % likewise
BEND_RADIUS = 0.04  # m, of half a circle
TWIST_BOUND = 1.0  # °, of the last frame there
# °, of a single device, whose shape does not take the twist out: that of one link.
SINGLE_TWIST_BOUND = 2.0


def free_ends(
    rig: Rig, gaps: Sequence[float], turns: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Ends (T, 3), m, from the base, and directions (T, 3) of the last link at rest.

    Args:
        rig: compiled, with coaxial devices.
        gaps: (K,) from the end of each device to that of the chain, m.
        turns: (T,), rotations of all devices, rad.
    """
    entity = rig.catheter
    assert isinstance(entity, DeviceStack)
    ends = []
    for turn in turns:
        rotation = np.full(len(entity.devices), turn)
        chain_fields.write_still(entity, rig.model, np.asarray(gaps), rotation)
        rig.data.qpos[:] = rig.model.qpos_spring
        mujoco.mj_kinematics(rig.model, rig.data)
        axis = rig.data.xmat[rig.tip_body].reshape(3, 3)[:, 2]
        ends.append((rig.head_position - rig.joints[0], axis.copy()))
    return np.array([end for end, _ in ends]), np.array([axis for _, axis in ends])


def weighted_curvature(
    chosen: Sequence[Device],
    gaps: np.ndarray,
    rotation: np.ndarray,
    length: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pieces (n,) of 0.05 mm: arc length of their beginning, length, curvature x + iy.

    The curvature leads towards x and y; where no device is, there is none.
    """
    arc = np.arange(0.0, length, _FINE)
    steps = np.diff(np.append(arc, length))
    middle = length - (arc + steps / 2)  # from the end
    rows = [
        theory.profile(device, middle - gap)
        for device, gap in zip(chosen, gaps, strict=True)
    ]
    bending, _, own = (np.array(each) for each in zip(*rows, strict=True))
    moment = (bending * own * np.exp(1j * rotation)[:, None]).sum(axis=0)
    stiffness = bending.sum(axis=0)
    curvature = np.divide(
        moment, stiffness, out=np.zeros_like(moment), where=stiffness > 0
    )
    return arc, steps, curvature


def turned(names: Sequence[str], gaps: Sequence[float]) -> tuple[float, float, float]:
    """Largest deviations of the unloaded end, turned by `TURNS`.

    Returns:
        Deviation from the turned shape of 0° and from the continuous curve of the
        EI-weighted curvature, as fractions of the displacement of the end; deviation of
        the last link's direction from that of 0°, rad.
    """
    rig = Rig(catheter=DeviceStack(names))
    rig.compile()
    ends, axes = free_ends(rig, gaps, TURNS)
    back = Rotation.from_euler("z", -TURNS[:, None])
    ends, axes = back.apply(ends), back.apply(axes)
    length, still = float(rig.lengths.sum()), np.zeros(len(names))
    _, steps, curvature = weighted_curvature(
        rig.catheter.devices, np.asarray(gaps), still, length
    )
    turning = np.real(curvature) * steps
    heading = np.cumsum(turning) - turning / 2
    curve = np.array([np.sin(heading) @ steps, 0.0, np.cos(heading) @ steps])
    moved = float(np.linalg.norm(curve - (0.0, 0.0, length)))
    angle = np.linalg.norm(np.cross(axes, axes[0]), axis=-1).max()
    return (
        float(np.linalg.norm(ends - ends[0], axis=-1).max()) / moved,
        float(np.linalg.norm(ends - curve, axis=-1).max()) / moved,
        float(np.arcsin(angle)),
    )


def twists(link_lengths: np.ndarray, start: float, plane: float) -> tuple[float, float]:
    """Twist of the last frame of a chain laid along half a circle of 40 mm.

    Args:
        link_lengths: (L,), m.
        start: length of the straight piece before the half circle, m.
        plane: of the half circle about the axis, rad.

    Returns:
        Twist of the last link, and of the link before it less the twist that coaxial
        devices take out (`Stack.bent`), against frames that do not twist, rad.
    """
    angle = np.linspace(0.0, np.pi, 400)
    arc = np.stack([1 - np.cos(angle), 0 * angle, np.sin(angle)], axis=-1)
    line = np.vstack([[[0, 0, 0]], BEND_RADIUS * arc + (0, 0, start)])
    line = np.vstack([line, [[2 * BEND_RADIUS, 0, -1.0]]])
    line = Rotation.from_euler("z", plane).apply(line)
    angles = posture.joints_along(link_lengths, line)
    frame = still = Rotation.identity()
    found = []
    for joint, (x, y) in enumerate(angles, start=1):
        first = posture.x_first(joint)
        turn = Rotation.from_euler("XY" if first else "YX", [x, y] if first else [y, x])
        frame = frame * turn
        across = np.cross(still.apply([0, 0, 1]), frame.apply([0, 0, 1]))
        sine = np.linalg.norm(across)
        across *= np.arcsin(sine) / sine if sine else 1.0
        still = Rotation.from_rotvec(across) * still
        found.append((still.inv() * frame).as_rotvec()[2])
    stack = Stack([devices.get("berenstein_5f")], link_lengths)
    order = [posture.x_first(joint) for joint in range(1, len(link_lengths))]
    hinges = np.where(np.array(order)[:, None], angles, angles[:, ::-1])
    _, taken = stack.bent(hinges.reshape(1, -1))
    return float(found[-1]), float(found[-2] - taken[0, -1])


def checks() -> list[Check]:
    """Turned shapes of all devices and pairs, and twist in half a circle."""
    alone = [
        ((name,), (0.0,)) for name, one in devices.DEVICES.items() if one.tip_shape
    ]
    pairs = [(pair, gaps) for pair in PAIRS for gaps in GAPS]
    made = []
    for label, cases in (("single", alone), ("pairs", pairs)):
        found = {f"{' in '.join(n)} {g}": turned(n, g) for n, g in cases}
        for part, (what, bound, scale, unit) in enumerate(
            (
                ("end against that at 0°", END_BOUND, 100.0, "%"),
                ("end against the curve", CURVE_BOUND, 100.0, "%"),
                ("direction against that at 0°", DIRECTION_BOUND, 57.29578, "°"),
            )
        ):
            worst = max(found, key=lambda name, part=part: found[name][part])
            name = f"unloaded shapes turned by 0 to 345°, {label}, {what}"
            value = scale * found[worst][part]
            made.append(Check.at_most(name, value, bound, unit, worst))
    lengths = devices.Discretisation().link_lengths(devices.get("steerable_5f"))
    bent = [
        twists(lengths, start, plane)
        for start in np.arange(0.02, 0.2, 0.0175 / 2)
        for plane in TURNS[:7]
    ]
    for part, (what, bound) in enumerate(
        (("single", SINGLE_TWIST_BOUND), ("coaxial", TWIST_BOUND))
    ):
        value = np.degrees(max(abs(each[part]) for each in bent))
        name = f"twist of the last frame in half a circle of 40 mm, {what} devices"
        made.append(Check.at_most(name, value, bound, "°"))
    return made
