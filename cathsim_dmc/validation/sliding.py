"""Coaxial devices on the move: sliding through each other, and turned in a tube."""

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from cathsim_dmc import suite
from cathsim_dmc.entities.chain import MAX_PUSH_SPEED, MAX_ROTATION_SPEED
from cathsim_dmc.entities.devices import get
from cathsim_dmc.tasks.config import CONTROL_TIMESTEP
from cathsim_dmc.validation.checks import Check
from cathsim_dmc.validation.rig import in_tube

SLIDING_PAIR = ("wire_035_amplatz", "diagnostic_5f_simmons")
SLIDING_TASK = "femoral_type1_lcca"
SPEED = 0.01  # m/s, of one device through the other
# mm, of the end of the chain in a control step: 0.1 m/s, as it snaps from one wall of
# the vessel to the other. What the sliding itself adds, `pair` compares in free space.
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

TURNED = "berenstein_5f"  # alone in a tube
TUBE_RADIUS = 4e-3  # m
BEND_RADIUS = 0.04  # m, of half a circle
# m: length of a straight tube, and that before and after a bend.
STRAIGHT_TUBE, BENT_TUBE = 0.275, 0.1
TURN_RATE = 0.5  # rad/s, of the base
TURNS = 2.0
STRAIGHT_LAG = 45.0  # °, of the end in a straight tube
WHIP = 3.0  # least rate of turning of the end in a bend, in that of the base


def slide() -> Iterator[Check]:
    """Slides two devices through each other in a vessel."""
    options = {"devices": SLIDING_PAIR, "random": 0, "observation": "tracking"}
    environment = suite.load(suite.DOMAIN, SLIDING_TASK, options)
    environment.reset()
    play, warnings = environment.task, 0
    for name, wire, catheter, turn, duration in SCRIPT:
        action = np.array([wire, 0.0, catheter, 0.0]) / MAX_PUSH_SPEED
        action[3] = turn / MAX_ROTATION_SPEED
        heads, peak = [play.readings.head], 0.0
        for _ in range(round(duration / CONTROL_TIMESTEP)):
            if environment.step(action).last():
                break
            heads.append(play.readings.head)
            peak = max(peak, float(play.wall_force.peak_max))
        warnings = int(environment.physics.data.ptr.warning.number.sum())
        if name == SCRIPT[0][0]:
            continue
        steps = np.linalg.norm(np.diff(heads, axis=0), axis=-1)
        name = f"sliding, {name}: largest step of the end in 40 ms"
        note = f"moves by {1e3 * np.linalg.norm(heads[-1] - heads[0]):.1f} mm, largest "
        note += f"contact {peak:.3f} N, {warnings} warnings"
        largest = 1e3 * steps.max(initial=0.0)
        yield Check.at_most(name, largest, LARGEST_STEP, "mm", note)
    yield Check.at_most("sliding, warnings", warnings, 0, "", "of MuJoCo")
    environment.close()


class Torque(NamedTuple):
    """Rotation of a device's end against that of its base.

    Attributes:
        name: of the tube.
        base: (T,), rad.
        tip: (T,), rad.
        ratio: A/K, rad, of the torque A by which the shape resists at most, EI κ α, 0
            in a straight tube, and the torsional stiffness K of the whole device.
            Without friction the end follows a base that turns on until, at a ratio
            above 1, it whips round.
    """

    name: str
    base: np.ndarray
    tip: np.ndarray
    ratio: float

    @property
    def lag(self) -> float:
        """Largest of the end behind the base, rad."""
        return float(np.abs(self.base - self.tip).max())

    @property
    def whips(self) -> float:
        """Largest rate of turning of the end over that of the base."""
        return float(np.abs(np.diff(self.tip)).max() / np.diff(self.base).mean())


def turn(bent: bool) -> Torque:
    """Advances a pre-shaped catheter through a tube and turns its base slowly."""
    size = (STRAIGHT_TUBE, TUBE_RADIUS), (BENT_TUBE / 2, TUBE_RADIUS, BEND_RADIUS)
    environment = in_tube(size[bent], devices=(TURNED,), observation="tracking")
    play, device = environment.task, get(TURNED)
    # Until its bend lies at the far end of the half circle.
    ahead = 0.05 + np.pi * BEND_RADIUS - play.scene.placement.start_depth
    for _ in range(round(ahead / (0.5 * MAX_PUSH_SPEED * CONTROL_TIMESTEP))):
        environment.step(np.array([0.5, 0.0]))
    compliance = float((1 / play.scene.catheter.rods.stiffness[0]).sum())
    rows = []
    for _ in range(round(2 * np.pi * TURNS / (TURN_RATE * CONTROL_TIMESTEP))):
        environment.step(np.array([0.0, TURN_RATE / MAX_ROTATION_SPEED]))
        state = play.rollout.devices
        rows.append((state.rotation[0, 0], state.tip_rotation[0, 0]))
    environment.close()
    angle = abs(sum(arc.angle for arc in device.tip_shape))
    shape = device.tip.bending_stiffness * angle / BEND_RADIUS if bent else 0.0
    name = "half circle" if bent else "straight tube"
    return Torque(name, *np.array(rows).T, ratio=shape * compliance)


def checks(data: dict[str, Any]) -> Iterator[Check]:
    """Runs the devices; puts the turned ones into `data`."""
    yield from slide()
    straight, bent = data["turned"] = [turn(False), turn(True)]
    name = "torque in a straight tube, lag of the end"
    note = "friction alone holds it back"
    yield Check.at_most(name, np.degrees(straight.lag), STRAIGHT_LAG, "°", note)
    name = "torque in a half circle, fastest turning of the end over the base's"
    note = f"A/K = {bent.ratio:.1f}: above 1 it whips"
    yield Check.at_least(name, bent.whips, WHIP, "", note)
