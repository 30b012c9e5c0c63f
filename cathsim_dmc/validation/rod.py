"""`cathsim validate rod`: bending, buckling and twist of the device against theory."""

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import mujoco
import numpy as np
from scipy.signal import lfilter

from cathsim_dmc.entities import chain, devices
from cathsim_dmc.physics.stepper import CONTROL_TIMESTEP
from cathsim_dmc.validation import damping, helix, modes, platforms, sheath, theory
from cathsim_dmc.validation.checks import Check, Report
from cathsim_dmc.validation.rig import RESTING_TIME, Rig

CANTILEVER_BOUND = 2.0  # % of the deflection
BUCKLING_BOUND = 5.0  # % of the load
TWIST_BOUND = 2.0  # % of the angle
# Criterion of rest for the library. The softest device, the microcatheter, oscillates
# with a period of 7 s (critical damping: 2 over 1.2 rad/s), and its joints never move
# by less than 5e-6 rad, which displaces its head by 0.2 % of the deflection.
LIBRARY_REST: dict[str, Any] = {"change": 1e-5, "damping": 1.5}
END_ANGLES = (2.0, 15.0, 30.0, 45.0, 60.0)  # degrees
# Fractions of Euler's load at which the Southwell plot is taken.
SOUTHWELL_FRACTIONS = np.array([0.5, 0.6, 0.7, 0.8, 0.9])
# Columns of few links n, whose load deviates by π²/12n² (sliding), π²/3n² (fixed).
SHORT_COLUMNS = {"sliding": (4, 6, 9), "fixed": (8, 10, 12)}
_TURNING = 4.0  # s, until the lag is steady
TORSION_JOINTS = 4  # default of the tasks with rotation
TWIST = 0.35  # rad, of the whole device under the end torque; lag of the braked tip
JAM = 3.0  # N, load of a drive
HOLD_BOUND = 0.1  # mm in 10 s
SPEED_BOUND = 1.0  # % of the command
SLIP_BOUND = 2.0  # % of the stated force
_MIDDLE = 0.25  # m, middle of the stroke


class Cantilever(NamedTuple):
    """A cantilever under end load: simulation and elastica."""

    end_angle: float  # of the elastica, rad
    # (n + 1, 2), axial and transverse coordinates of joints and head from the clamp, m.
    simulated: np.ndarray
    expected: theory.Elastica
    deviation: float  # relative deviation of the displacement of the end

    def check(self, what: str = "") -> Check:
        """Check of the deviation from the elastica."""
        angle, end = np.degrees(self.end_angle), 1e3 * self.expected.position[-1, 1]
        name = f"cantilever, {what + ', ' if what else ''}end at {angle:.0f}°"
        note = f"{1e3 * self.expected.force:.3g} mN, deflection {end:.1f} mm"
        return Check.at_most(name, 100 * self.deviation, CANTILEVER_BOUND, "%", note)


def cantilevers(
    device: str | Sequence[str] = "steerable_5f",
    end_angles: Sequence[float] = END_ANGLES,
    *,
    plane: float = np.pi / 4,
    discretisation: devices.Discretisation | None = None,
    gaps: Sequence[float] | None = None,
    **rest: float,
) -> list[Cantilever]:
    """Loads the end of a straight device laterally and compares it with the elastica.

    Args:
        device: see `Rig`, as are `discretisation` and `gaps`.
        end_angles: end angles of the elastica, degrees, which determine the forces.
        plane: direction of the force about the axis, rad; π/4 bends all hinges.
        **rest: criterion of rest under each force, see `Rig.settle`.
    """
    rig = Rig(device, discretisation, straight=True, gaps=gaps)
    rig.compile()
    lengths, bending, _ = rig.sections
    across = np.array([np.cos(plane), np.sin(plane), 0.0])
    total, unloaded = float(np.sum(lengths)), rig.head_position
    results = []
    for angle in np.radians(end_angles).tolist():
        shape = theory.elastica(lengths, bending, angle)
        rig.settle(shape.force * across, **rest)
        moved = rig.head_position - unloaded
        expected = shape.position[-1] - (total, 0.0)
        # Displacement out of the plane of the load is an error too.
        axes = [0.0, 0.0, 1.0], across, np.cross([0, 0, 1], across)
        error = np.array([moved @ axis for axis in axes])
        error[:2] -= expected
        points = np.vstack([rig.joints, rig.head_position]) + (0, 0, total)
        simulated = np.stack([points[:, 2], points @ across], axis=-1)
        off = float(np.linalg.norm(error) / np.linalg.norm(expected))
        results.append(Cantilever(angle, simulated, shape, off))
    return results


class Buckling(NamedTuple):
    """Southwell plot of a column."""

    end: str  # "sliding" or "fixed", see `buckling`
    length: float  # of the column, m
    load: np.ndarray  # (n,), axial loads, N
    deflection: np.ndarray  # (n,), additional deflection under the axial load, m
    critical: float  # critical load from the plot, N
    expected: float  # Euler's load, N

    def check(self, name: str) -> Check:
        """Check of the critical load against Euler's."""
        name = f"{name}, clamped - guided, guide {self.end}"
        note = f"{1e3 * self.critical:.2f} mN, Euler {1e3 * self.expected:.2f} mN "
        note += f"over {1e3 * self.length:.0f} mm"
        found, expected = self.critical, self.expected
        return Check.deviation(name, found, expected, BUCKLING_BOUND, "N", note)


def buckling(
    end: str, joints: int | None = None, device: str | Sequence[str] = "steerable_5f"
) -> Buckling:
    """Measures the critical load of a clamped-guided chain by a Southwell plot.

    The carriage clamps link 0; a guide that cannot rotate holds another link in its
    middle. A lateral force bends the column a little. Under an axial load P the
    deflection grows by w, and w/P over w is a line of slope 1/P_cr (Southwell 1932).

    Args:
        end: "sliding" lets the guide move laterally, "fixed" holds it on the axis.
        joints: number of joints between the two links; None for the whole shaft.
        device: see `Rig`.
    """
    rig = Rig(device, straight=True)
    # Links of the tips are shorter than those of the shaft.
    last = joints or int(np.argmin(rig.lengths > rig.lengths[0] - 1e-9)) - 1
    middles = np.cumsum(rig.lengths) - rig.lengths / 2
    length, stiffness = middles[last] - middles[0], float(rig.sections[1][0])
    # Euler's load of a column with a guided end.
    expected = (4 if end == "fixed" else 1) * np.pi**2 * stiffness / length**2
    root = rig.arena.mjcf_model
    place = middles[last] - rig.lengths[last] / 2 - rig.lengths.sum()
    guide = root.worldbody.add("body", name="guide", pos=(0, 0, place))
    guide.add("inertial", pos=(0, 0, 0), mass=1e-3, diaginertia=(1e-9, 1e-9, 1e-9))
    for axis in np.eye(3)[[2, 0, 1] if end == "sliding" else [2]]:
        guide.add("joint", type="slide", axis=axis)
    solver = {"solref": (0.008, 1.0), "solimp": (0.999, 0.9999, 1e-4, 0.5, 2)}
    held = rig.catheter.links[last]
    root.equality.add("weld", body1=guide, body2=held, **solver)
    rig.compile()
    link = rig.model.body(f"{rig.name}/link_{last}").id
    middle = rig.model.body(f"{rig.name}/link_{(last + 1) // 2}").id
    pushed = middle if end == "fixed" else link
    # Small enough for linear theory at the largest load, where it grows tenfold.
    bend = 2e-4 * length * (stiffness / length**3 * (192 if end == "fixed" else 12))

    def deflection(load: float) -> float:
        rig.data.xfrc_applied[:] = 0
        rig.data.xfrc_applied[pushed, 0] = bend
        rig.data.xfrc_applied[link, 2] = -load
        rig.settle(longest=60.0)
        return rig.data.xipos[pushed, 0]

    loads = expected * SOUTHWELL_FRACTIONS
    unloaded = deflection(0.0)
    additional = np.array([deflection(load) for load in loads]) - unloaded
    slope = np.polyfit(additional, additional / loads, 1)[0]
    return Buckling(end, length, loads, additional, 1 / slope, expected)


def twist_under_torque(
    device: str = "steerable_5f", torsion_joints: int = TORSION_JOINTS
) -> tuple[float, float]:
    """Torque (N·m) for a twist of `TWIST` by theory, and simulated twist (rad)."""
    rig, compliance = _torsion_rig(device, torsion_joints)
    torque = TWIST / compliance
    # The base creeps on its speed servo, so the rig runs for a fixed time.
    rig.load_head(torque=(0, 0, torque))
    rig.run(12 * RESTING_TIME)
    return torque, _twist(rig)


class TwistLag(NamedTuple):
    """Lag of the tip behind the turning base."""

    time: np.ndarray  # (n,), s
    base: np.ndarray  # (n,), angle of the base, rad
    tip: np.ndarray  # (n,), angle of the tip, rad
    expected: np.ndarray  # (n,), lag of the tip by theory, rad

    @property
    def lags(self) -> tuple[float, float]:
        """Lag in steady rotation, simulated and expected, rad."""
        found = (self.base - self.tip)[-50:].mean()
        return float(found), float(self.expected[-50:].mean())

    @property
    def rises(self) -> tuple[float, float]:
        """Rise times (s) to 1 - 1/e of the final lag, simulated and expected."""
        curves, found = (self.base - self.tip, self.expected), []
        for lag, last in zip(curves, self.lags, strict=True):
            level = (1 - np.exp(-1)) * last
            both = np.argmax(lag >= level) - np.array([1, 0])
            found.append(float(np.interp(level, lag[both], self.time[both])))
        return found[0], found[1]


def twist_lag() -> TwistLag:
    """Turns the base at full speed against a viscous brake b on the tip.

    With K = 1/Σ(l/GJ), base speed ω and the rod's own relaxation time τ, the lag δ
    obeys (b + Kτ) δ' + K δ = b ω: it rises to bω/K with the time constant b/K + τ.
    """
    rig, compliance = _torsion_rig("steerable_5f", TORSION_JOINTS)
    brake = TWIST / compliance / chain.MAX_ROTATION_SPEED
    rig.data.actuator(f"{rig.name}/rotation").ctrl[0] = 1.0
    timestep = rig.model.opt.timestep
    # The device is straight, so the rates of its hinges add up to that of the tip.
    axial = [
        rig.model.joint(f"{rig.name}/{joint.name}").dofadr[0]
        for joint in rig.catheter.joints
        if joint.name == "rotation" or joint.name.startswith("twist_")
    ]
    rows = [(0.0, 0.0)]
    for _ in range(round(_TURNING / timestep)):
        rig.step((0, 0, 0), (0, 0, -brake * rig.data.qvel[axial].sum()))
        base = rig.qpos("rotation")
        rows.append((base, base + _twist(rig)))
    base, tip = np.array(rows).T
    decay = np.exp(-timestep / (brake * compliance + rig.device.relaxation_time))
    # The motor needs some 20 ms to its speed, so theory takes the simulated motion.
    final = brake * compliance * np.diff(base) / timestep
    lag = lfilter([1 - decay], [1, -decay], final)
    return TwistLag(timestep * np.arange(len(base)), base, tip, np.append(0.0, lag))


def _torsion_rig(device: str, torsion_joints: int) -> tuple[Rig, float]:
    """A straight device with rotation, and its compliance Σ(l/GJ), rad/(N·m)."""
    discretisation = devices.Discretisation(torsion_joints=torsion_joints)
    rig = Rig(device, discretisation, straight=True, rotation=True)
    rig.compile()
    lengths, _, torsional = rig.sections
    return rig, float((lengths / torsional).sum())


def _twist(rig: Rig) -> float:
    """Angle (rad) of the tip about the axis relative to the base."""
    # After a step, body poses are those of its start.
    mujoco.mj_kinematics(rig.model, rig.data)
    base = rig.data.body(f"{rig.name}/link_0").xmat.reshape(3, 3)
    relative = base.T @ rig.data.xmat[rig.tip_body].reshape(3, 3)
    return float(np.arctan2(relative[1, 0], relative[0, 0]))


class Driven:
    """A device on its drive, under an axial force at its base."""

    def __init__(self):
        self.rig = rig = Rig(stroke=2 * _MIDDLE)
        rig.compile()
        self._base = rig.model.body(f"{rig.name}/link_0").id
        rig.hold(_MIDDLE)
        self.drives = rig.drives

    def move(self, duration: float, command: float, force: float) -> float:
        """Moves the base for a time (s) against a force (N); returns its travel, m."""
        start = self.rig.qpos("insertion")
        for _ in range(round(duration / CONTROL_TIMESTEP)):
            self.rig.drive([command])
            self.rig.data.xfrc_applied[self._base, 2] = -force
            self.rig.run(CONTROL_TIMESTEP)
        return self.rig.qpos("insertion") - start


def slip_force() -> float:
    """Least force (N) at which the clamp of a resting base slips, to 0.5 %."""
    for force in chain.MAX_PUSH_FORCE * np.arange(0.9, 1.1, 0.005):
        driven = Driven()
        driven.move(0.4, 0.0, 0.9 * force)
        driven.move(1.0, 0.0, force)
        if driven.drives.slipped[0, 0] > 0.0:
            return float(force)
    return np.inf


def _checks(data: dict[str, Any]) -> Iterator[Check]:
    """Checks of the rod; measurements for figures are added to `data`."""
    data["cantilevers"] = cantilevers()
    yield from (one.check() for one in data["cantilevers"])
    library = [*devices.DEVICES]
    off = [cantilevers(one, (45.0,), **LIBRARY_REST)[0].deviation for one in library]
    worst = int(np.argmax(off))
    name = "cantilever, worst device of the library, end at 45°"
    note = library[worst]
    yield Check.at_most(name, 100 * off[worst], CANTILEVER_BOUND, "%", note)
    data["columns"] = [buckling("sliding"), buckling("fixed")]
    yield from (one.check("buckling load") for one in data["columns"])
    for device in ("steerable_5f", "wire_035_amplatz"):
        torque, angle = twist_under_torque(device)
        name = f"twist under end torque, {device}"
        note = f"{angle:.4f} rad under {1e6 * torque:.3g} µN·m"
        yield Check.deviation(name, angle, TWIST, TWIST_BOUND, "rad", note)
    data["lag"] = lag = twist_lag()
    name, (found, expected) = "lag of the tip behind the turning base", lag.lags
    yield Check.deviation(name, found, expected, TWIST_BOUND, "rad")
    name, (found, expected) = f"rise time of the {name}", lag.rises
    yield Check.deviation(name, found, expected, TWIST_BOUND, "s")
    driven = Driven()
    driven.move(0.4, 0.0, 0.0)
    held = 1e3 * abs(driven.move(10.0, 0.0, JAM))
    name = f"drive at rest under {JAM:g} N for 10 s: way of the base"
    yield Check.at_most(name, held, HOLD_BOUND, "mm")
    driven.move(0.4, 1.0, JAM)
    moved, name = driven.move(1.0, 1.0, JAM), f"drive, full speed against {JAM:g} N"
    yield Check.deviation(name, moved, chain.MAX_PUSH_SPEED, SPEED_BOUND, "m/s")
    name = "drive, force at which the clamp slips"
    yield Check.deviation(name, slip_force(), chain.MAX_PUSH_FORCE, SLIP_BOUND, "N")
    yield from platforms.checks()
    yield from sheath.checks()
    yield from damping.checks()
    yield from modes.checks()
    yield from helix.checks()


def validate_rod() -> Report:
    """Runs every check of the rod."""
    data: dict[str, Any] = {}
    checks = list(_checks(data))
    short = SHORT_COLUMNS.items()
    data["short"] = [buckling(end, count) for end, each in short for count in each]
    turned = {
        speed: damping.spin(speed, damping.LINK)
        for speed in (damping.SLOW, *damping.SPEEDS)
    }
    findings = {
        "lag in a half circle of links of 17.5 mm, deviation from its dampers, %": {
            f"{speed:g} rad/s": 100 * (lag / expected - 1)
            for speed, (lag, expected) in turned.items()
        },
        "deflection in three-point bending of links of 17.5 mm, deviation, %": {
            f"{1e3 * span:.0f} mm, load on a {'joint' if on_joint else 'link'}": 100
            * (damping.three_point(span, damping.LINK, on_joint) - 1)
            for span in damping.SPANS
            for on_joint in (True, False)
        },
        "buckling load of shorter columns, deviation from Euler, %": {
            f"{1e3 * one.length:.0f} mm, guide {one.end}": 100
            * (one.critical / one.expected - 1)
            for one in data["short"]
        },
        "push of a helix of links of 17.5 mm, deviation, %": helix.long_links(),
    }
    return Report("rod", checks, findings, data)
