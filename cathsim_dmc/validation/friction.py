"""Friction of devices on a wall: sliding, sticking, and the capstan."""

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from cathsim_dmc.anatomy.field import EDGE
from cathsim_dmc.entities import devices
from cathsim_dmc.entities.chain import MAX_PUSH_SPEED
from cathsim_dmc.entities.contact import FRICTION
from cathsim_dmc.validation.checks import Check
from cathsim_dmc.validation.pair import PAIR
from cathsim_dmc.validation.rig import Rig

LOADS = (0.02, 0.2, 2.0)  # N
SPEEDS = (0.001, 0.01, 0.04)  # m/s
ACTING_BOUND = 5.0  # % of the coefficient of friction
RIPPLE_BOUND = 5.0  # % of the pull, its standard deviation
CREEP_LOAD = 0.2  # N
CREEP_BOUND = 0.001  # mm/s, under a lateral pull of half the friction limit
_PRESSED = 0.07  # m, loaded length at the end of the device
_DROP = 1e-3  # m, from the base to the plate: unloaded links do not touch it
_SETTLED = 2.0  # s
_SLID = 0.02  # m, travel after which the whole device slides
_WATCHED = 0.02  # m, travel that is evaluated
# Findings: clearances of a device in a round lumen, m; load, N; speed, m/s; number of
# places of the lumen in the lattice of its field.
NARROW = (3e-3, 1.5e-3, 1e-3, 0.67e-3, 0.37e-3)
_NARROW_LOAD, _NARROW_SPEED, _PLACES = 0.2, 0.01, 6

CAPSTAN_BOUND = 3.0  # % of the coefficient of friction
CAPSTAN_RIPPLE = 3.0  # % of the mean pull, its standard deviation in 5 mm of travel
DRUM_RADIUS = 0.05  # m
# Coefficient of friction and wrap angle, rad: the default friction, and about the
# limits of the range from lubricated silicone to bare steel.
QUARTER, HALF = 0.5 * np.pi, np.pi
CAPSTANS = ((0.05, QUARTER), (FRICTION, HALF), (0.05, HALF), (0.2, HALF))
CAPSTANS += ((0.05, 3 * QUARTER), (0.2, QUARTER), (0.2, 3 * QUARTER))
# Dead load on the distal end, N: far above EI/R² = 0.02 N. Under 0.5 N a free end of 45
# to 65 mm oscillates at a physics step of 4 ms, but not at 2 ms.
TENSION = 0.4
PULL_SPEED = 0.02  # m/s, without load
_AXIS = DRUM_RADIUS + devices.STEERABLE_5F.outer_radius  # m, radius of the rod's axis
# Friction acts on the surface of the drum, tension in the axis of the rod.
_LEVER = DRUM_RADIUS / _AXIS
# Bending energy per length over the tension at the end, EI κ² / 2 T: the relative drop
# of the tension from the straight part to the part on the drum.
_BENT = devices.STEERABLE_5F.shaft.bending_stiffness / (2 * _AXIS**2 * TENSION)
# Radius, m, of a tube that is bent around the drum into an arch.
ARCH_RADIUS = 9e-3
ARCH_RIPPLE = 2.0  # % of the force at the base, its standard deviation
_SETTLING = 0.5  # s, before the pull
_LEAD = 0.02  # m of rod between clamp and drum; the first part of the pull is ignored
_PULL = 0.1  # m, travel of the base
_PART = 5e-3  # m, travel over which the ripple is taken


class Lumen(NamedTuple):
    """A round lumen around a straight device."""

    clearance: float  # of the centred device, m
    place: tuple[float, float] = (0.0, 0.0)  # in the lattice of its field, m


def _on_wall(device: Any, load: float, lumen: Lumen | None) -> tuple[Rig, np.ndarray]:
    """A straight device at rest under a load (N) in a lumen, or on a plate if None.

    Returns:
        Rig, and loads (nbody,), N.
    """
    rig = Rig(device, straight=True)
    if lumen is None:
        rig.add_plate(rig.device.outer_radius + _DROP)
    else:
        radius = rig.device.outer_radius + lumen.clearance

        def depth(blocks: np.ndarray, points: np.ndarray) -> np.ndarray:
            x, y, _ = np.moveaxis(blocks[:, None, :] + points, -1, 0)
            return radius - np.hypot(x, y)

        low, high = np.array([-radius, -radius, -0.5]), (radius, radius, 0.5)
        rig.add_wall(depth, low - (*lumen.place, 0.0), high)
    rig.compile()
    rig.hold(0.09)
    beyond = np.cumsum(rig.lengths[::-1])[::-1] - rig.lengths
    pressed = np.where(beyond < _PRESSED - 1e-9, rig.lengths, 0.0)
    loads, last = np.zeros(rig.model.nbody), rig.tip_body + 1
    loads[last - len(pressed) : last] = load * pressed / pressed.sum()
    rig.data.xfrc_applied[:, 1] = loads
    rig.run(_SETTLED)
    return rig, loads


def slid(
    device: Any, load: float, speed: float, lumen: Lumen | None = None
) -> tuple[float, float]:
    """Pulls a device (see `Rig`) over a wall under a load, N, with a speed, m/s.

    The wall is a plate if there is no lumen.

    Returns:
        Acting coefficient of friction, pull over load; standard deviation of the pull
        over its mean.
    """
    rig, _ = _on_wall(device, load, lumen)
    rig.data.actuator(f"{rig.name}/insertion").ctrl[0] = -speed / MAX_PUSH_SPEED
    rig.run(_SLID / speed)
    pull = []
    for _ in range(round(_WATCHED / speed / rig.model.opt.timestep)):
        rig.step()
        pull.append(-rig.sensor(f"{rig.name}/push_force")[2])
    mean, deviation = float(np.mean(pull)), float(np.std(pull))
    return mean / load, deviation / abs(mean)


def creep(device: Any) -> float:
    """Creep speed (m/s) of a sticking device under a lateral pull of half the limit."""
    rig, loads = _on_wall(device, CREEP_LOAD, None)
    rig.data.xfrc_applied[:, 0] = 0.5 * FRICTION * loads
    rig.run(0.5 * _SETTLED)
    before = rig.head_position
    rig.run(_SETTLED)
    return float(np.linalg.norm(rig.head_position - before)) / _SETTLED


def narrow_lumens() -> dict[str, dict[str, float]]:
    """Excess (%) of the friction that acts in round lumens, by clearance.

    The normals of the planes of a contact are tilted, so the magnitudes of their forces
    sum to more than the load; the sum of the wall force has the same excess. It depends
    on the place of the lumen in the lattice of its field.

    Returns:
        Lowest and highest excess of `_PLACES` places.
    """
    random, found = np.random.RandomState(0), {}
    for clearance in NARROW:
        lumens = [
            Lumen(clearance, tuple(place))
            for place in random.uniform(0.0, EDGE, (_PLACES, 2))
        ]
        acting = [
            slid("steerable_5f", _NARROW_LOAD, _NARROW_SPEED, lumen)[0]
            for lumen in lumens
        ]
        excess = 100 * (np.array(acting) / FRICTION - 1)
        found[f"{1e3 * clearance:g} mm"] = {
            "lowest": float(excess.min()),
            "highest": float(excess.max()),
        }
    return found


class Capstan(NamedTuple):
    """Measurement of a rod that is pulled round a drum."""

    friction: float  # Coulomb coefficient
    angle: float  # between the forces at both ends of the drum, rad
    mean: float = np.nan  # ratio of the tensions at base and end in steady sliding
    free: float = 1.0  # the same without friction: bending dissipates a little
    travel: np.ndarray = np.zeros(1)  # (n,), travel of the base, m
    ratio: np.ndarray = np.zeros(1)  # (n,), ratio of the tensions
    bent: np.ndarray = np.ones(1)  # (n,), the same without friction, at that travel

    @property
    def expected(self) -> float:
        """Ratio of the tensions by the capstan equation with bending."""
        return float(_BENT + (1 - _BENT) * np.exp(self.friction * self.angle * _LEVER))

    @property
    def acting(self) -> float:
        """Acting coefficient of friction, from the measured exponent."""
        ratio = (self.mean - (self.free - 1) - _BENT) / (1 - _BENT)
        return float(np.log(ratio) / (self.angle * _LEVER))

    @property
    def ripple(self) -> float:
        """Largest standard deviation of the ratio over its mean, in 5 mm of travel."""
        part = (self.travel // _PART).astype(int)
        sliding = range(round(_LEAD / _PART), part.max() + 1)
        deviations = [self.ratio[part == each].std() for each in sliding]
        return float(np.max(deviations)) / self.mean

    def checks(self) -> Iterator[Check]:
        """Checks of the coefficient and the ripple.

        A ratio of tensions near 1 would hide errors of a small coefficient.
        """
        angle = np.degrees(self.angle)
        name = f"capstan, friction {self.friction:g} over {angle:.0f}°"
        note = f"friction {self.acting:.4f} acts, ratio {self.mean:.4f}, "
        note += f"{self.free:.4f} without friction, expected {self.expected:.4f}"
        expected, bound = self.friction, CAPSTAN_BOUND
        yield Check.deviation(name, self.acting, expected, bound, "", note)
        name += ": ripple of the pull"
        yield Check.at_most(name, 100 * self.ripple, CAPSTAN_RIPPLE, "%")


def capstan(friction: float, wrap: float = np.pi) -> Capstan:
    """Pulls the rod over a drum, by `wrap` rad, with and without friction.

    The distal end carries a dead load; the base retracts. Both forces and the angle
    between them are measured, because a rod with bending stiffness leaves the drum
    earlier than a string. Above half a turn the rod passes through itself.

    Raises:
        RuntimeError: if the rod sticks to the drum.
    """
    (angle, travel, ratio), (_, way, free) = _pulled(friction, wrap), _pulled(0.0, wrap)
    mean, without = float(ratio[travel > _LEAD].mean()), float(free[way > _LEAD].mean())
    bent = np.interp(travel, way, free)
    return Capstan(friction, angle, mean, without, travel, ratio, bent)


def _pulled(
    friction: float, wrap: float, tube: float | None = None
) -> tuple[float, np.ndarray, np.ndarray]:
    """Angle (rad) of a rod round a drum or in a tube; travel (m) and ratio (n,)."""
    length = 2 * _LEAD + _PULL + wrap * _AXIS
    fine = devices.Discretisation(working_length=length)
    rig = Rig("steerable_5f", fine, straight=True, stroke=_PULL, friction=friction)
    middle = np.array([_AXIS, 0, _PULL - rig.lengths.sum() + _LEAD])
    half = np.array([length, 0.02, length])  # around the whole rod

    def clearance(blocks: np.ndarray, points: np.ndarray) -> np.ndarray:
        across, y, along = np.moveaxis(blocks[:, None, :] + points - middle, -1, 0)
        if tube is None:
            return np.hypot(across, along) - DRUM_RADIUS
        reach = np.hypot(across, np.maximum(along, 0.0))
        return tube - np.hypot(reach - DRUM_RADIUS - tube, y)

    rig.add_wall(clearance, middle - half, middle + half, friction)
    rig.compile()
    middles = np.cumsum(rig.lengths) - rig.lengths / 2
    heading = np.clip((middles - _LEAD) / _AXIS, 0.0, wrap)
    rig.hold(_PULL)
    rig.bend(np.stack([0 * heading[1:], np.diff(heading)], axis=-1))
    load = TENSION * np.array([np.sin(wrap), 0.0, np.cos(wrap)])
    rig.run(_SETTLING, load)
    rig.data.actuator(f"{rig.name}/insertion").ctrl[0] = -PULL_SPEED / MAX_PUSH_SPEED
    travel, force = [0.0], []
    while travel[-1] < _PULL - 0.02:
        rig.step(load)
        travel.append(_PULL - rig.qpos("insertion"))
        force.append(rig.sensor(f"{rig.name}/push_force"))
        if len(force) > 10_000:
            moved = 1e3 * travel[-1]
            raise RuntimeError(f"the rod stuck on the drum after {moved:.1f} mm")
    way, force = np.array(travel[1:]), np.array(force)
    # Link 0 does not rotate, so its frame is the world frame. Both forces point away
    # from the drum; that of the base is opposite to its heading, which is about 0.
    heading = np.arctan2(-force[:, 0], -force[:, 2])[way > _LEAD]
    tension = np.linalg.norm(force, axis=1)
    return float(wrap - heading.mean()), way, tension / TENSION


def arch_ripple() -> float:
    """Standard deviation over mean of the force that pulls a device round an arch."""
    _, travel, ratio = _pulled(FRICTION, np.pi, ARCH_RADIUS)
    sliding = ratio[travel > _LEAD]
    return float(sliding.std() / sliding.mean())


def checks(pulled: list[Capstan]) -> Iterator[Check]:
    """Checks of sliding and sticking friction; capstans are appended to `pulled`."""
    for what, device in (("steerable_5f", "steerable_5f"), ("pair", PAIR)):
        for load in LOADS:
            found = [slid(device, load, speed) for speed in SPEEDS]
            acting, ripples = np.transpose(found)
            worst = acting[np.abs(acting - FRICTION).argmax()]
            name = f"{what} sliding under {load:g} N"
            each = zip(acting, SPEEDS, strict=True)
            note = ", ".join(f"{one:.4f} at {1e3 * v:g} mm/s" for one, v in each)
            acts = f"{name}: friction that acts"
            yield Check.deviation(acts, worst, FRICTION, ACTING_BOUND, "", note)
            name += ": ripple of the pull"
            yield Check.at_most(name, 100 * ripples.max(), RIPPLE_BOUND, "%")
        name = f"{what} under {CREEP_LOAD:g} N, pulled sideways at half the limit: "
        yield Check.at_most(f"{name}creep", 1e3 * creep(device), CREEP_BOUND, "mm/s")
    name = f"device drawn round an arch under {TENSION:g} N: ripple of the force"
    yield Check.at_most(name, 100 * arch_ripple(), ARCH_RIPPLE, "%")
    pulled.extend(capstan(friction, wrap) for friction, wrap in CAPSTANS)
    for one in pulled:
        yield from one.checks()
