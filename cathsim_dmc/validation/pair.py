"""`cathsim validate pair`: coaxial devices against theory, at rest and in motion."""

from collections.abc import Iterator, Sequence
from typing import Any

import mujoco
import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from cathsim_dmc import suite
from cathsim_dmc.entities import devices, posture
from cathsim_dmc.entities.chain import MAX_PUSH_SPEED, MAX_ROTATION_SPEED
from cathsim_dmc.entities.device import Device
from cathsim_dmc.entities.device_stack import DeviceStack
from cathsim_dmc.laws import hinges
from cathsim_dmc.physics import chain_fields
from cathsim_dmc.tasks.config import CONTROL_TIMESTEP
from cathsim_dmc.validation import pressed, rod, theory, two_rods
from cathsim_dmc.validation.checks import Check, Report
from cathsim_dmc.validation.rig import Rig, half_circle, in_tube

PAIR = ("wire_035_glide", "berenstein_5f")
PROTRUSIONS = (0.0, 0.02, 0.05, 0.10)  # m, of the wire out of the catheter
END_ANGLES = (15.0, 45.0)  # degrees
# Largest step of the free end as one device slides in the other, relative to that of
# the continuous curve: hinges that jump one after the other take several at once.
STEP_BOUND = 1.1

# Unloaded shapes rotated about the axis, and twist of the chain in a bend.
_FINE = 0.05e-3  # m, step of the integration of the curve
TURNS = np.radians(np.arange(0, 360, 15))
SLIDING_PAIR = ("wire_035_amplatz", "diagnostic_5f_simmons")
# Distances (m) of the ends of wire and catheter from the end of the chain.
GAPS = ((0.0, 0.02), (0.012, 0.0), (0.0, 0.005))
SHAPE_BOUND = 1.0  # % of the displacement of the end from a straight device
DIRECTION_BOUND = 1.5  # °, of the last link
BEND_RADIUS = 0.04  # m, of half a circle
TWIST_BOUND = 1.0  # °, of the last frame in this bend

SLIDING_TASK = "femoral_type1_lcca"
SPEED = 0.01  # m/s, of one device in the other
# Largest movement of the end of the chain in a control step, mm: 0.1 m/s, as it snaps
# from one wall of the vessel to the other. `smoothness` checks the sliding itself.
LARGEST_STEP = 4.0
# Steps of the script: name, speeds of wire and catheter in m/s, rotation of the
# catheter in rad/s, duration in s.
SCRIPT = (
    ("both advance", 0.04, 0.04, 0.0, 3.0),
    ("catheter over the wire", 0.0, SPEED, 0.0, 6.0),
    ("wire withdrawn", -SPEED, 0.0, 0.0, 6.0),
    ("wire advanced", SPEED, 0.0, 0.0, 6.0),
    ("catheter turned", 0.0, 0.0, np.pi / 2, 4.0),
)

TURNED = "berenstein_5f"  # single device in a tube
TUBE_RADIUS = 4e-3  # m
# m: length of a straight tube, and length before and after a bend.
STRAIGHT_TUBE, BENT_TUBE = 0.275, 0.05
TURN_RATE, TURNED_BY = 0.5, 4 * np.pi  # rad/s and rad, of the base
STRAIGHT_LAG = 45.0  # °, largest lag of the end in a straight tube
WHIP = 3.0  # least ratio of the angular velocities of end and base in a bend


def free_curve(chosen: Sequence[Device], gaps: ArrayLike, length: float) -> np.ndarray:
    """End (3,), m, of the unloaded curve of K devices, over a length (m).

    Its curvature is the EI-weighted mean of the devices. `gaps` (K,), m, are the
    distances from their ends to that of the curve. Devices are not rotated, so the
    curve lies in the plane of x and z.
    """
    arc = np.arange(0.0, length, _FINE)
    steps = np.diff(np.append(arc, length))
    middle = length - (arc + steps / 2)  # from the end
    bending, _, own = theory.profile(chosen, gaps, middle)
    # There is no curvature without a device.
    stiffness = np.maximum(bending.sum(axis=0), 1e-12)
    turning = (bending * own).sum(axis=0) / stiffness * steps
    heading = np.cumsum(turning) - turning / 2
    return np.array([np.sin(heading) @ steps, 0.0, np.cos(heading) @ steps])


def turned(names: Sequence[str], gaps: Sequence[float]) -> tuple[float, float, float]:
    """Largest deviations of the unloaded end of K rotated devices with gaps (K,), m.

    Returns:
        Deviation from the rotated shape of 0° and from the curve of `free_curve`, as
        fractions of the displacement of the end; deviation of the last link's direction
        from that of 0°, rad.
    """
    rig = Rig(names)
    rig.compile()
    rows = []
    for turn in TURNS:
        rotation = np.full(len(names), turn)
        chain_fields.write_still(rig.catheter, rig.model, np.asarray(gaps), rotation)
        rig.data.qpos[:] = rig.model.qpos_spring
        mujoco.mj_kinematics(rig.model, rig.data)
        axis = rig.data.xmat[rig.tip_body].reshape(3, 3)[:, 2].copy()
        rows.append((rig.head_position - rig.joints[0], axis))
    back = Rotation.from_euler("z", -TURNS[:, None])
    ends, axes = (back.apply(each) for each in np.moveaxis(np.array(rows), 1, 0))
    length = float(rig.lengths.sum())
    curve = free_curve(rig.catheter.devices, gaps, length)
    moved = float(np.linalg.norm(curve - (0.0, 0.0, length)))
    angle = np.linalg.norm(np.cross(axes, axes[0]), axis=-1).max()
    away = [np.linalg.norm(ends - one, axis=-1).max() for one in (ends[0], curve)]
    return float(away[0] / moved), float(away[1] / moved), float(np.arcsin(angle))


def twists(link_lengths: np.ndarray, start: float, plane: float) -> tuple[float, float]:
    """Twist at the last joint of links (L,), m, in a half circle of 40 mm.

    The half circle begins after `start`, m, in a plane at `plane`, rad, about the axis.

    Returns:
        Angles, rad, of the command of the last motor, and of the unloaded shape at the
        last joint, relative to a twist-free frame.
    """
    end = [[2 * BEND_RADIUS, 0, -1.0]]
    line = np.vstack([[[0, 0, 0]], half_circle(BEND_RADIUS, start, 399), end])
    line = Rotation.from_euler("z", plane).apply(line)
    angles = posture.joints_along(link_lengths, line)
    frame = still = Rotation.identity()
    for joint, (x, y) in enumerate(angles[:-1], start=1):
        first = posture.x_first(joint)
        turn = Rotation.from_euler("XY" if first else "YX", [x, y] if first else [y, x])
        frame = frame * turn
        across = np.cross(still.apply([0, 0, 1]), frame.apply([0, 0, 1]))
        sine = np.linalg.norm(across)
        across *= np.arcsin(sine) / sine if sine else 1.0
        still = Rotation.from_rotvec(across) * still
    twist = (still.inv() * frame).as_rotvec()[2]
    ordered = angles.copy()  # in the order of the hinges
    ordered[1::2] = angles[1::2, ::-1]
    bends = hinges.Bends(np.empty(len(ordered), complex), np.empty(len(ordered)))
    command, turned = np.array([[1.0, 0.0]]), np.empty((1, 2))
    hinges.steered(command, ordered.reshape(1, -1), bends, turned)
    ((x, y),) = turned
    return float(twist + np.arctan2(y, x)), float(twist - bends.twists[-1])


def smoothness() -> Check:
    """Check of the steps of the unloaded end as the wire slides at 10 mm/s."""
    # Lead of the wire over the catheter, m; negative if it is behind.
    leads = np.arange(-0.06, 0.06, SPEED * CONTROL_TIMESTEP)
    entity = DeviceStack(SLIDING_PAIR)
    stack, length = entity.stack, float(entity.link_lengths.sum())
    gaps = np.stack([np.maximum(-leads, 0.0), np.maximum(leads, 0.0)], axis=-1)
    # All shapes lie in one plane.
    angles = np.array([stack.overlap(gap).rest.sum(axis=0) for gap in gaps])
    heading = np.cumsum(np.pad(angles, ((0, 0), (1, 0))), axis=-1)
    links = stack.link_lengths * np.stack([np.sin(heading), np.cos(heading)])
    curve = [free_curve(entity.devices, gap, length)[::2] for gap in gaps]
    chain, curve = (
        np.linalg.norm(np.diff(ends, axis=0), axis=-1).max()
        for ends in (links.sum(axis=-1).T, curve)
    )
    name = "free end while the wire slides at 10 mm/s: largest step over that of theory"
    note = f"{1e3 * chain:.2f} mm in 40 ms, the curve's {1e3 * curve:.2f} mm, over "
    note += f"{len(leads)} steps"
    return Check.at_most(name, chain / curve, STEP_BOUND, "", note)


def slide() -> Iterator[Check]:
    """Checks of two devices that slide in each other in a vessel."""
    options = {"devices": SLIDING_PAIR, "random": 0, "observation": "tracking"}
    environment = suite.load(suite.DOMAIN, SLIDING_TASK, options)
    environment.reset()
    play, warnings = environment.task, 0
    for name, wire, catheter, turn, duration in SCRIPT:
        action = np.array([wire, 0.0, catheter, 0.0]) / MAX_PUSH_SPEED
        action[3] = turn / MAX_ROTATION_SPEED
        heads, peak = [play.readings.head], 0.0
        for _ in range(round(duration / CONTROL_TIMESTEP)):
            ended = environment.step(action).last()
            heads.append(play.readings.head)
            peak = max(peak, float(play.wall_force.peak_max))
            if ended:
                break
        warnings = int(environment.physics.data.ptr.warning.number.sum())
        if ended:  # one more step would begin another episode
            early = f"sliding, {name}: early ends"
            yield Check.at_most(early, 1, 0, "", str(play.termination))
            break
        if name == SCRIPT[0][0]:
            continue
        steps = np.linalg.norm(np.diff(heads, axis=0), axis=-1)
        name = f"sliding, {name}: largest step of the end in 40 ms"
        note = f"moves by {1e3 * np.linalg.norm(heads[-1] - heads[0]):.1f} mm, largest "
        note += f"contact {peak:.3f} N, {warnings} warnings"
        largest = 1e3 * steps.max(initial=0.0)
        yield Check.at_most(name, largest, LARGEST_STEP, "mm", note)
    yield Check.at_most("sliding, warnings of MuJoCo", warnings, 0, "", "of MuJoCo")
    environment.close()


def turn(bent: bool) -> tuple[np.ndarray, np.ndarray, float]:
    """Advances a pre-shaped catheter through a tube and turns its base slowly.

    Returns:
        Rotations (T,) of base and end, rad; and A/K, rad. A is the largest torque of
        the bent shape, EI κ α, 0 in a straight tube; K is the torsional stiffness of
        the device. Without friction the end follows the base for A/K below 1, and whips
        above.
    """
    size = (STRAIGHT_TUBE, TUBE_RADIUS), (BENT_TUBE, TUBE_RADIUS, BEND_RADIUS)
    environment = in_tube(size[bent], devices=(TURNED,), observation="tracking")
    play, device = environment.task, devices.get(TURNED)
    # The catheter advances until its bend is at the far end of the half circle.
    ahead = 0.05 + np.pi * BEND_RADIUS - play.scene.placement.start_depth
    for _ in range(round(ahead / (0.5 * MAX_PUSH_SPEED * CONTROL_TIMESTEP))):
        environment.step(np.array([0.5, 0.0]))
    compliance = float((1 / play.scene.catheter.rods.stiffness[0]).sum())
    rows = []
    for _ in range(round(TURNED_BY / (TURN_RATE * CONTROL_TIMESTEP))):
        environment.step(np.array([0.0, TURN_RATE / MAX_ROTATION_SPEED]))
        state = play.rollout.devices
        rows.append((state.rotation[0, 0], state.tip_rotation[0, 0]))
    environment.close()
    angle = abs(sum(arc.angle for arc in device.tip_shape))
    shape = device.tip.bending_stiffness * angle / BEND_RADIUS if bent else 0.0
    base, tip = np.array(rows).T
    return base, tip, shape * compliance


def _shape_checks() -> Iterator[Check]:
    """Checks of rotated shapes of devices and pairs, and of twist in a half circle."""
    alone = [
        ((name,), (0.0,)) for name, one in devices.DEVICES.items() if one.tip_shape
    ]
    pairs = [(pair, gaps) for pair in (PAIR, SLIDING_PAIR) for gaps in GAPS]
    parts = (
        ("end against that at 0°", SHAPE_BOUND, 100.0, "%"),
        ("end against the curve", SHAPE_BOUND, 100.0, "%"),
        ("direction against that at 0°", DIRECTION_BOUND, 57.29578, "°"),
    )
    for label, cases in (("single", alone), ("pairs", pairs)):
        found = [(turned(n, g), f"{' in '.join(n)} {g}") for n, g in cases]
        for part, (what, bound, scale, unit) in enumerate(parts):
            worst, note = found[np.argmax([one[part] for one, _ in found])]
            name = f"unloaded shapes turned by 0 to 345°, {label}, {what}"
            yield Check.at_most(name, scale * worst[part], bound, unit, note)
    lengths = devices.Discretisation().link_lengths(devices.get("steerable_5f"))
    starts = np.arange(0.02, 0.2, 0.0175 / 2)
    bent = [twists(lengths, start, plane) for start in starts for plane in TURNS[:7]]
    worst = np.degrees(np.abs(bent).max(axis=0))
    for what, value in zip(("motors", "shapes"), worst, strict=True):
        name = f"twist of the last link in a half circle of 40 mm, bent by {what}"
        yield Check.at_most(name, value, TWIST_BOUND, "°")


def _checks(data: dict[str, Any]) -> Iterator[Check]:
    for protrusion in PROTRUSIONS:
        what = f"wire out by {1e3 * protrusion:.0f} mm" if protrusion else "pair"
        bent = rod.cantilevers(PAIR, END_ANGLES, gaps=(0.0, protrusion))
        yield from (one.check(what) for one in bent)
    yield from _shape_checks()
    yield from two_rods.checks()
    for end in ("sliding", "fixed"):
        yield rod.buckling(end, device=PAIR).check("buckling load of the pair")
    yield smoothness()
    yield from pressed.checks(PAIR)
    yield from slide()
    base, tip, _ = turn(False)
    data["turned"] = {"straight tube": (base, tip)}
    name = "torque in a straight tube, lag of the end"
    note, lag = "friction alone holds it back", np.degrees(np.abs(base - tip).max())
    yield Check.at_most(name, lag, STRAIGHT_LAG, "°", note)
    base, tip, ratio = turn(True)
    data["turned"]["half circle"] = base, tip
    name = "torque in a half circle, fastest turning of the end over the base's"
    note = f"A/K = {ratio:.1f}: above 1 it whips"
    whips = np.abs(np.diff(tip)).max() / np.diff(base).mean()
    yield Check.at_least(name, whips, WHIP, "", note)


def validate_pair() -> Report:
    """Runs every check of coaxial devices."""
    data: dict[str, Any] = {}
    return Report("pair", list(_checks(data)), data=data)
