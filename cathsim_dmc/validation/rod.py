"""`cathsim validate rod`: bending, buckling and twist of the device against theory."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import NamedTuple

import mujoco
import numpy as np

from cathsim_dmc.entities import devices
from cathsim_dmc.entities.chain import MAX_ROTATION_SPEED
from cathsim_dmc.validation import damping, drive, theory
from cathsim_dmc.validation.checks import Check, Checks, Report
from cathsim_dmc.validation.rig import REST, RESTING_TIME, Rest, Rig

CANTILEVER_BOUND = 2.0  # % of the deflection
BUCKLING_BOUND = 5.0  # % of the load
TWIST_BOUND = 2.0  # % of the angle
# How every device of the library settles. The softest, the microcatheter, swings with a
# period of 7 s, which this damping stops (critical: 2 over 1.2 rad/s), and its joints
# never move by less than 5e-6 rad: its head wanders by 0.2 % of the deflection.
LIBRARY_REST = Rest(change=1e-5, damping=1.5)
END_ANGLES = (2.0, 15.0, 30.0, 45.0, 60.0)  # degrees
# Fractions of the load of Euler at which the Southwell plot is taken.
SOUTHWELL_FRACTIONS = (0.5, 0.6, 0.7, 0.8, 0.9)
# Columns of fewer links, whose load is off by π²/12n² (sliding), π²/3n² (fixed).
SHORT_COLUMNS = (
    *(("sliding", count) for count in (4, 6, 9)),
    *(("fixed", count) for count in (8, 10, 12)),
)
_TURNING = 4.0  # s, until the lag is steady
TORSION_JOINTS = 4  # default of the tasks with rotation
TWIST = 0.35  # rad, of the whole device under the end torque; lag of the braked tip


class Cantilever(NamedTuple):
    """A cantilever under end load, simulated and as elastica."""

    end_angle: float  # of the elastica, rad
    force: float  # N
    # (n + 1, 2), axial and transverse places of joints and head from the clamp on, m.
    simulated: np.ndarray
    expected: theory.Elastica
    deviation: float  # of the displacement of the end, per displacement of the end


def straight(device: str | devices.Device) -> devices.Device:
    """The device without its pre-shaped tip."""
    return dataclasses.replace(devices.get(device), tip_shape=())


def cantilevers(
    device: str | devices.Device = "steerable_5f",
    end_angles=END_ANGLES,
    *,
    plane: float = np.pi / 4,
    discretisation: devices.Discretisation | None = None,
    rest: Rest = REST,
) -> list[Cantilever]:
    """Loads the end of a straight device across and compares it with the elastica.

    Args:
        device: its shape at rest is taken as straight.
        end_angles: of the elastica's end, degrees; they set the forces.
        plane: direction of the force about the axis, rad. π/4 bends both hinges of
            every joint.
        discretisation: default of the tasks if None.
        rest: how it settles under each force.
    """
    rig = Rig(straight(device), discretisation)
    rig.compile()
    lengths, bending, _ = rig.sections
    return bent(rig, lengths, bending, end_angles, plane, rest)


def bent(
    rig: Rig,
    lengths: np.ndarray,
    bending: np.ndarray,
    end_angles: Sequence[float],
    plane: float = np.pi / 4,
    rest: Rest = REST,
) -> list[Cantilever]:
    """Loads the end of a straight chain across and compares it with the elastica.

    Args:
        rig: compiled, at rest.
        lengths: (S,) of the sections of the rod it stands for, from the clamp on, m.
        bending: (S,) their EI, N·m².
        end_angles: of the elastica's end, degrees; they set the forces.
        plane: direction of the force about the axis, rad.
        rest: how it settles under each force.
    """
    across = np.array([np.cos(plane), np.sin(plane), 0.0])
    total = float(np.sum(lengths))
    clamp = np.array([0.0, 0.0, -total])
    unloaded = rig.head_position
    results = []
    for degrees in end_angles:
        shape = theory.elastica(lengths, bending, np.radians(degrees))
        rig.settle(shape.force * across, rest=rest)
        moved = rig.head_position - unloaded
        expected = shape.position[-1] - (total, 0.0)
        simulated = np.array([moved[2], moved @ across])
        # What leaves the plane of the load is an error too.
        error = np.append(simulated - expected, moved @ np.cross([0, 0, 1], across))
        points = np.concatenate([rig.joints, rig.head_position[None]]) - clamp
        results.append(
            Cantilever(
                np.radians(degrees),
                shape.force,
                np.stack([points[:, 2], points @ across], axis=-1),
                shape,
                float(np.linalg.norm(error) / np.linalg.norm(expected)),
            )
        )
    return results


class Buckling(NamedTuple):
    """Southwell plot of a column."""

    end: str  # "sliding" or "fixed", see `theory.buckling_load`
    length: float  # of the column, m
    load: np.ndarray  # (n,), axial loads, N
    deflection: np.ndarray  # (n,), additional deflection under the axial load, m
    critical: float  # load from the plot, N
    expected: float  # load of Euler, N


def buckling(end: str, joints: int | None = None) -> Buckling:
    """Measures the critical load of a clamped-guided length by a Southwell plot.

    The carriage clamps link 0; a guide that cannot turn holds another link by its
    middle and pushes back along the axis. Between them lies a length `joints` links
    long. A sideways force bends the column a little; under an axial load P the
    deflection grows by w, and w/P over w is a line of slope 1/P_cr (Southwell 1932).

    Args:
        end: "sliding" lets the guide move sideways, "fixed" holds it on the axis.
        joints: links from clamp to guide; None for the whole shaft.
    """
    rig = Rig(straight("steerable_5f"))
    shaft = len(rig.lengths) - rig.device.tip_links
    last = shaft - 1 if joints is None else joints
    if not 2 <= last < shaft:
        raise ValueError(f"joints is {joints}; allowed are 2 to {shaft - 1}")
    return column(rig, end, last, rig.device.shaft.bending_stiffness)


def column(
    rig: Rig,
    end: str,
    last: int,
    stiffness: float,
    prepare: Callable[[Rig], None] = lambda rig: None,
) -> Buckling:
    """Measures the critical load of a chain between its clamp and a guide.

    Args:
        rig: not compiled yet.
        end: as in `buckling`.
        last: link that the guide holds.
        stiffness: EI of the rod up to there, N·m².
        prepare: called when the rig has been compiled.
    """
    middles = np.cumsum(rig.lengths) - rig.lengths / 2
    length = middles[last] - middles[0]
    expected = theory.buckling_load(length, stiffness, end)
    _add_guide(rig, last, end)
    rig.compile()
    prepare(rig)
    link = rig.model.body(f"{rig.name}/link_{last}").id
    middle = rig.model.body(f"{rig.name}/link_{(last + 1) // 2}").id
    pushed = middle if end == "fixed" else link
    # Small enough for linear theory at the largest load, where it grows tenfold.
    stiffness_across = stiffness / length**3 * (192 if end == "fixed" else 12)
    bend = 2e-4 * length * stiffness_across

    def deflection(load):
        rig.data.xfrc_applied[:] = 0
        rig.data.xfrc_applied[pushed, 0] = bend
        rig.data.xfrc_applied[link, 2] = -load
        rig.settle(longest=60.0)
        return rig.data.xipos[pushed, 0]

    loads = expected * np.array(SOUTHWELL_FRACTIONS)
    unloaded = deflection(0.0)
    additional = np.array([deflection(load) for load in loads]) - unloaded
    slope = np.polyfit(additional, additional / loads, 1)[0]
    return Buckling(end, length, loads, additional, 1 / slope, expected)


def cantilever_check(what: str, one: Cantilever) -> Check:
    """Its deviation from the elastica."""
    angle, end = np.degrees(one.end_angle), 1e3 * one.expected.position[-1, 1]
    name = f"cantilever, {what + ', ' if what else ''}end at {angle:.0f}°"
    note = f"{1e3 * one.force:.3g} mN, deflection {end:.1f} mm"
    return Check.at_most(name, 100 * one.deviation, CANTILEVER_BOUND, "%", note)


def buckling_check(name: str, column: Buckling) -> Check:
    """Its critical load against Euler's."""
    return Check.deviation(
        f"{name}, clamped - guided, guide {column.end}",
        column.critical,
        column.expected,
        BUCKLING_BOUND,
        "N",
        f"{1e3 * column.critical:.2f} mN, Euler {1e3 * column.expected:.2f} mN "
        f"over {1e3 * column.length:.0f} mm",
    )


def _add_guide(rig: Rig, index: int, end: str) -> None:
    origin = float(np.sum(rig.lengths[:index]) - rig.lengths.sum())
    guide = rig.arena.mjcf_model.worldbody.add("body", name="guide", pos=(0, 0, origin))
    guide.add("inertial", pos=(0, 0, 0), mass=1e-3, diaginertia=(1e-9, 1e-9, 1e-9))
    axes = {"z": (0, 0, 1)}
    if end == "sliding":
        axes |= {"x": (1, 0, 0), "y": (0, 1, 0)}
    for name, axis in axes.items():
        guide.add("joint", name=f"guide_{name}", type="slide", axis=axis)
    rig.arena.mjcf_model.equality.add(
        "weld",
        body1=guide,
        body2=rig.catheter.links[index],
        solref=(0.008, 1.0),
        solimp=(0.999, 0.9999, 1e-4, 0.5, 2),
    )


def twist_under_torque(
    device: str | devices.Device = "steerable_5f",
    torsion_joints: int = TORSION_JOINTS,
) -> tuple[float, float]:
    """Torque (N·m) on the end of the straight device that GJ turns by `TWIST`.

    Returns:
        The torque, and the angle of the end that it gives, rad.
    """
    rig = _torsion_rig(device, torsion_joints)
    lengths, _, torsional = rig.sections
    torque = TWIST / theory.twist(1.0, lengths, torsional)
    # The motor of the base is a speed servo: the base creeps, so wait for a time.
    rig.load_head(torque=(0, 0, torque))
    rig.run(12 * RESTING_TIME)
    return torque, _twist(rig)


class TwistLag(NamedTuple):
    """Lag of the tip behind the turning base."""

    time: np.ndarray  # (n,), s
    base: np.ndarray  # (n,), angle of the base, rad
    tip: np.ndarray  # (n,), angle of the tip, rad
    expected: np.ndarray  # (n,), angle of the tip by theory, for that of the base, rad
    lag: float  # of the tip in steady rotation, rad
    expected_lag: float  # rad
    rise_time: float  # in which the lag reaches 1 - 1/e of its final value, s
    expected_rise_time: float  # s, for the measured motion of the base


def twist_lag() -> TwistLag:
    """Turns the base at full speed against a viscous brake b on the tip.

    With K = 1/Σ(l/GJ), base speed ω and the rod's own relaxation time τ, the lag δ
    obeys (b + Kτ) δ' + K δ = b ω: it rises to bω/K with the time constant b/K + τ.
    """
    rig = _torsion_rig("steerable_5f", TORSION_JOINTS)
    lengths, _, torsional = rig.sections
    stiffness = 1 / theory.twist(1.0, lengths, torsional)
    brake = TWIST * stiffness / MAX_ROTATION_SPEED
    rig.data.actuator(f"{rig.name}/rotation").ctrl[0] = 1.0
    timestep = rig.model.opt.timestep
    # The device is straight, so the rates of its hinges add up to that of the tip.
    axial = [
        rig.model.joint(f"{rig.name}/{joint.name}").dofadr[0]
        for joint in rig.catheter.joints
        if joint.name == "rotation" or joint.name.startswith("twist_")
    ]
    base, tip = [0.0], [0.0]
    for _ in range(round(_TURNING / timestep)):
        rig.step((0, 0, 0), (0, 0, -brake * rig.data.qvel[axial].sum()))
        base.append(rig.qpos("rotation"))
        tip.append(base[-1] - _twist(rig, wrapped=True))
    base, tip = np.array(base), np.array(tip)
    time = timestep * np.arange(len(base))
    constant = brake / stiffness + rig.device.relaxation_time
    # The motor takes some 20 ms to its speed; the lag is driven by what it does.
    lag, speed = np.zeros(len(base)), np.diff(base) / timestep
    for index, omega in enumerate(speed):
        final = brake * omega / stiffness
        lag[index + 1] = final + (lag[index] - final) * np.exp(-timestep / constant)
    return TwistLag(
        time=time,
        base=base,
        tip=tip,
        expected=base - lag,
        lag=float((base - tip)[-50:].mean()),
        expected_lag=float(brake * speed[-50:].mean() / stiffness),
        rise_time=_rise_time(time, base - tip),
        expected_rise_time=_rise_time(time, lag),
    )


def _rise_time(time: np.ndarray, curve: np.ndarray) -> float:
    """Time (s) at which a rising curve first meets 1 - 1/e of its end."""
    level = (1 - np.exp(-1)) * curve[-50:].mean()
    index = int(np.argmax(curve >= level))
    return float(
        np.interp(level, curve[index - 1 : index + 1], time[index - 1 : index + 1])
    )


def _torsion_rig(device, torsion_joints) -> Rig:
    rig = Rig(
        straight(device),
        devices.Discretisation(torsion_joints=torsion_joints),
        rotation=True,
    )
    rig.compile()
    return rig


def _twist(rig: Rig, wrapped: bool = False) -> float:
    """Angle of the tip about the axis against the base, rad; base ahead if wrapped."""
    # A step leaves the poses of its start.
    mujoco.mj_kinematics(rig.model, rig.data)
    base = rig.data.body(f"{rig.name}/link_0").xmat.reshape(3, 3)
    relative = base.T @ rig.data.xmat[rig.tip_body].reshape(3, 3)
    angle = float(np.arctan2(relative[1, 0], relative[0, 0]))
    return -angle if wrapped else angle


def validate_rod() -> Report:
    """Runs every check of the rod."""
    loaded, checks = cantilevers(), Checks()
    checks += [cantilever_check("", one) for one in loaded]
    worst, name = max(
        (cantilevers(name, (45.0,), rest=LIBRARY_REST)[0].deviation, name)
        for name in devices.DEVICES
    )
    label = "cantilever, worst device of the library, end at 45°"
    checks.at_most(label, 100 * worst, CANTILEVER_BOUND, "%", name)
    columns = [buckling("sliding"), buckling("fixed")]
    for column in columns:
        checks.append(buckling_check("buckling load", column))
    for name in ("steerable_5f", "wire_035_amplatz"):
        torque, angle = twist_under_torque(name)
        note = f"{angle:.4f} rad under {1e6 * torque:.3g} µN·m"
        label = f"twist under end torque, {name}"
        checks.deviation(label, angle, TWIST, TWIST_BOUND, "rad", note)
    lag = twist_lag()
    label = "lag of the tip behind the turning base"
    checks.deviation(label, lag.lag, lag.expected_lag, TWIST_BOUND, "rad")
    found = lag.rise_time, lag.expected_rise_time
    checks.deviation("rise time of that lag", *found, TWIST_BOUND, "s")
    checks += drive.checks() + damping.checks()
    short = [buckling(end, count) for end, count in SHORT_COLUMNS]
    coarse = {
        f"{1e3 * span:.0f} mm, load on a {'joint' if on_joint else 'link'}": 100
        * (damping.three_point(span, damping.LINK, on_joint) - 1)
        for span in damping.SPANS
        for on_joint in (True, False)
    }
    findings = {
        "deflection in three-point bending of links of 17.5 mm, deviation, %": coarse,
        "buckling load of shorter columns, deviation from Euler, %": {
            f"{1e3 * one.length:.0f} mm, guide {one.end}": 100
            * (one.critical / one.expected - 1)
            for one in short
        },
    }
    data = {"cantilevers": loaded, "columns": columns, "short": short, "lag": lag}
    return Report("rod", checks, findings, data)
