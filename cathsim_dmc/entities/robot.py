"""Follower of a CathBot-like catheter robot: geometry and joints, no forces.

A main rail carries four platforms on prismatic joints. From the patient
backwards: front clamps, catheter rotary unit, rear clamps, guidewire rotary
unit. The two pairs of clamps grip one device in turn while it advances, or one of two
devices each; the rotary units turn the devices and let them slide between rollers.

**Frame.** ``+z`` runs along the device towards the patient, the origin is the
proximal mouth of the introducer sheath and the device lies on the ``z`` axis.
``+y`` is down: posterior in the LPS frame of a supine patient, so a robot attached
without rotation lies on the table below the device. ``+x`` is then the patient's
left.

**Motion** is perfect, as in the published system: the joints of the device are driven,
and the robot is posed accordingly. :func:`follower_posture` gives every robot joint as
a function of insertion and rotation; the task writes the joints into the simulation.
They are slides and hinges without load (gravity compensated, no actuator, no contact,
no limit in the solver), so they do not move between two poses.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from dm_control import composer, mjcf
from numpy.typing import ArrayLike, NDArray

# --- The clamp-advance-release cycle, in metres of insertion. ---
# The stroke fits a rail of 0.35 m, and the clamps change about once a second at the
# fastest push (40 mm/s).
STROKE = 0.040  # m, insertion over which a pair of clamps stays closed
OVERLAP = 0.002  # m, both pairs are closed at each change
JAW_TRAVEL = 0.004  # m, insertion during which the jaws open, or close
CYCLE = 2 * (STROKE - OVERLAP)  # m, the two pairs work half a cycle apart
RETURN = CYCLE - STROKE - 2 * JAW_TRAVEL  # m, insertion while a platform returns
JAW_OPENING = 0.005  # m, each jaw, fully open

# --- Dimensions (own design; metres, robot frame). ---
DEVICE_RADIUS = 0.835e-3  # m, 5 French
FRONT_HOME, CATHETER_HOME = -0.080, -0.154  # m, z of the platforms at mid-stroke
REAR_HOME, GUIDEWIRE_HOME = -0.228, -0.286
CLAMP_HALF_LENGTH, ROTARY_HALF_LENGTH = 0.022, 0.026  # m, platforms along z
RAIL_END = -0.360  # m, z of the proximal end of the rail
ROLLER_RADIUS = 0.005  # m
RING_TEETH, PINION_TEETH = 16, 8
GEAR_MODULE = 0.002  # m of pitch diameter per tooth
PINION_ANGLE = np.deg2rad(25.0)  # about z from +x: beside the ring, a little below
PLATFORM_RANGE = 0.026  # m, either side of home; the cycle itself needs 0.0249

# No force accelerates the robot. Real masses would only raise the mean inertia of the
# model, which scales the solver's tolerance for the catheter, so the masses are small.
# Damping limits the motion under a viewer's mouse.
GEOM_MASS = 2e-5  # kg
SLIDE_DAMPING = 1.0  # N s/m
HINGE_DAMPING = 1e-4  # N m s/rad
VISUAL_GROUP = 2  # geom group of geoms that are drawn only

#: name, RGBA, specular, shininess
MATERIALS = (
    ("aluminium", (0.72, 0.74, 0.77, 1.0), 0.6, 0.5),
    ("steel", (0.86, 0.87, 0.89, 1.0), 0.9, 0.8),
    ("graphite", (0.22, 0.24, 0.27, 1.0), 0.4, 0.4),
    ("brass", (0.80, 0.65, 0.32, 1.0), 0.7, 0.6),
    ("rubber", (0.10, 0.10, 0.11, 1.0), 0.1, 0.1),
    ("clamp", (0.86, 0.24, 0.16, 1.0), 0.4, 0.4),
    ("catheter", (0.10, 0.45, 0.78, 1.0), 0.4, 0.4),
    ("guidewire", (0.95, 0.62, 0.10, 1.0), 0.4, 0.4),
)
ACCENTS = ("clamp", "catheter", "clamp", "guidewire")  # by platform, front to back
SIDES = ((1, "left"), (-1, "right"))  # sign of x, word: +x is the patient's left


@dataclass(frozen=True)
class RobotJoint:
    """One joint of the follower: name, kind, and its range in m or rad.

    ``range`` is ``None`` for wheels, which turn without end.
    """

    name: str
    kind: Literal["slide", "hinge"]
    range: tuple[float, float] | None


def _platform_joint(name: str) -> RobotJoint:
    return RobotJoint(f"{name}_platform", "slide", (-PLATFORM_RANGE, PLATFORM_RANGE))


def _jaw_joints(name: str) -> tuple[RobotJoint, ...]:
    return tuple(
        RobotJoint(f"{name}_jaw_{side}", "slide", (0.0, JAW_OPENING))
        for side in ("left", "right")
    )


def _wheel_joints(name: str) -> tuple[RobotJoint, ...]:
    wheels = ("ring", "pinion", "roller_left", "roller_right")
    return tuple(RobotJoint(f"{name}_{wheel}", "hinge", None) for wheel in wheels)


#: Order of the joints in a posture, and in ``Robot.joints``.
JOINTS: tuple[RobotJoint, ...] = (
    *map(_platform_joint, ("front", "catheter", "rear", "guidewire")),
    *_jaw_joints("front"),
    *_jaw_joints("rear"),
    *_wheel_joints("catheter"),
    *_wheel_joints("guidewire"),
)


# Insertion 0 lies in the middle of an overlap: both pairs are closed at the start.
_PHASES = (OVERLAP / 2, OVERLAP / 2 + CYCLE / 2)
_CYCLE = (CYCLE, STROKE, JAW_TRAVEL, RETURN, JAW_OPENING)


def follower_posture(
    insertion: ArrayLike,
    rotation: ArrayLike = 0.0,
    *,
    guidewire_insertion: ArrayLike | None = None,
    guidewire_rotation: ArrayLike | None = None,
) -> NDArray[np.float64]:
    """Joint positions of the follower for an insertion and a rotation.

    Args:
        insertion: (...,) metres from the start, positive into the patient.
        rotation: (...,) radians about +z from the start.
        guidewire_insertion: (...,) metres; the catheter's if omitted, so that both
            pairs of clamps and both rotary units hold one device. Otherwise the front
            clamps hold the catheter and the rear clamps the guidewire.
        guidewire_rotation: (...,) radians; the catheter's if omitted.

    Returns:
        (..., len(JOINTS)) float64 in the order of ``JOINTS``; metres for slides,
        radians for hinges, continuous in every argument (angles do not wrap).

    Raises:
        ValueError: an argument is not finite, or the shapes do not broadcast.
    """
    given = (
        insertion,
        rotation,
        insertion if guidewire_insertion is None else guidewire_insertion,
        rotation if guidewire_rotation is None else guidewire_rotation,
    )
    table = np.empty((len(given), *np.broadcast(*given).shape))
    for row, each in enumerate(given):
        table[row] = each
    posture = postures(table.reshape(len(given), -1))
    return posture.reshape(*table.shape[1:], len(JOINTS))


def postures(given: NDArray[np.float64]) -> NDArray[np.float64]:
    """Joint positions (N, len(JOINTS)) of N followers; see `follower_posture`.

    Args:
        given: (4, N), insertion and rotation of the catheter and of the guidewire.

    Raises:
        ValueError: a number is not finite.
    """
    from cathsim_dmc.entities import robot_loops  # late, as numba takes long

    if not math.isfinite(given.sum()):
        raise ValueError(
            "insertion, rotation, guidewire insertion and guidewire rotation must be "
            f"finite, got {given}: check for a diverged simulation"
        )
    teeth = RING_TEETH / PINION_TEETH
    return robot_loops.postures(given, _PHASES, _CYCLE, ROLLER_RADIUS, teeth)


class Robot(composer.Entity):
    """The follower; attach it to the arena at the mouth of the introducer sheath."""

    def _build(self, device_radius: float = DEVICE_RADIUS, name: str = "robot"):
        """Builds the model.

        Args:
            device_radius: radius of the device between jaws and rollers, m.
            name: name of the model, the prefix of its elements once attached.
        """
        if not 1e-4 <= device_radius <= 4e-3:
            raise ValueError(
                f"device_radius is {device_radius} m; allowed are 1e-4 to 4e-3 m "
                "(devices up to 24 French); did you mean millimetres?"
            )
        self._device_radius = device_radius
        self._kinds = {joint.name: joint for joint in JOINTS}
        self._mjcf_root = mjcf.RootElement(model=name)
        self._build_defaults()
        self._build_rail()
        self._build_clamps("front", FRONT_HOME)
        self._build_rotary("catheter", CATHETER_HOME)
        self._build_clamps("rear", REAR_HOME)
        self._build_rotary("guidewire", GUIDEWIRE_HOME)
        self._joints = tuple(
            self._mjcf_root.find("joint", joint.name) for joint in JOINTS
        )

    @property
    def mjcf_model(self) -> mjcf.RootElement:
        """The PyMJCF model."""
        return self._mjcf_root

    @property
    def joints(self) -> tuple[mjcf.Element, ...]:
        """The MJCF joints in the order of ``JOINTS``."""
        return self._joints

    # ------------------------------------------------------------- construction

    def _build_defaults(self) -> None:
        root = self._mjcf_root
        geom = root.default.geom
        geom.contype = geom.conaffinity = 0
        geom.group, geom.mass = VISUAL_GROUP, GEOM_MASS
        root.default.joint.limited = "false"
        for name, rgba, specular, shininess in MATERIALS:
            root.asset.add(
                "material", name=name, rgba=rgba, specular=specular, shininess=shininess
            )

    def _build_rail(self) -> None:
        rail = self._mjcf_root.worldbody.add("body", name="rail")
        middle, half = RAIL_END / 2, -RAIL_END / 2
        _box(rail, "bed", (0, 0.057, middle), (0.034, 0.006, half), "aluminium")
        for side, word in reversed(SIDES):
            start, end = (side * 0.022, 0.043, -0.004), (side * 0.022, 0.043, RAIL_END)
            _rod(rail, f"rod_{word}", start, end, 0.005, "steel")
        _rod(rail, "screw", (0, 0.045, -0.004), (0, 0.045, RAIL_END), 0.003, "brass")
        for end, z, guide in (
            ("front", -0.010, 0.010),
            ("rear", RAIL_END + 0.006, 0.014),
        ):
            plate, post = (0.038, 0.022, 0.006), (0.008, 0.010, 0.006)
            _box(rail, f"{end}_plate", (0, 0.041, z), plate, "aluminium")
            _box(rail, f"{end}_post", (0, 0.010, z), post, "aluminium")
            start, stop = (0, 0, z - guide), (0, 0, z + guide)
            _rod(rail, f"{end}_guide", start, stop, 0.006, "steel")
        # Valve manifold at the far end, with one air line per platform.
        at, half_sizes = (0, 0.043, RAIL_END - 0.020), (0.036, 0.018, 0.020)
        _box(rail, "manifold", at, half_sizes, "graphite")
        for index, material in enumerate(ACCENTS):
            x = -0.024 + 0.016 * index
            start, end = (x, 0.043, RAIL_END - 0.038), (x, 0.055, RAIL_END - 0.090)
            _rod(rail, f"air_line_{index}", start, end, 0.003, material, "capsule")

    def _build_platform(
        self, name: str, home: float, half_length: float, accent: str
    ) -> mjcf.Element:
        body = self._add_body(
            self._mjcf_root.worldbody, f"{name}_platform", (0, 0, home), (0, 0, 1)
        )
        _box(body, "plate", (0, 0.030, 0), (0.042, 0.004, half_length), "graphite")
        _box(body, "block", (0, 0.040, 0), (0.032, 0.006, 0.017), "steel")
        half_sizes = (0.0427, 0.0022, half_length - 0.003)
        _box(body, "stripe", (0, 0.030, 0), half_sizes, accent)
        return body

    def _build_clamps(self, name: str, home: float) -> None:
        accent = "clamp"
        platform = self._build_platform(name, home, CLAMP_HALF_LENGTH, accent)
        _box(platform, "bridge", (0, 0.022, 0), (0.040, 0.004, 0.008), "aluminium")
        r, y = self._device_radius, 0.0135
        for side, word in SIDES:
            start, end = (side * 0.028, y, 0), (side * 0.041, y, 0)
            _rod(platform, f"cylinder_{word}", start, end, 0.006, "steel")
            jaw = self._add_body(
                platform, f"{name}_jaw_{word}", (side * r, 0, 0), (side, 0, 0)
            )
            _box(jaw, "pad", (side * 0.001, 0, 0), (0.001, 0.004, 0.012), "rubber")
            at, half_sizes = (side * 0.0055, 0.002, 0), (0.0035, 0.008, 0.010)
            _box(jaw, "holder", at, half_sizes, accent)
            at, half_sizes = (side * 0.0105, y, 0), (0.0085, 0.0045, 0.010)
            _box(jaw, "arm", at, half_sizes, accent)
            start, end = (side * 0.018, y, 0), (side * 0.030, y, 0)
            _rod(jaw, "piston", start, end, 0.0022, "brass")

    def _build_rotary(self, name: str, home: float) -> None:
        accent = name
        platform = self._build_platform(name, home, ROTARY_HALF_LENGTH, accent)
        _rod(platform, "motor", (0, 0, -0.018), (0, 0, -0.006), 0.019, "graphite")
        _box(platform, "foot", (0, 0.014, -0.012), (0.019, 0.012, 0.006), "graphite")
        _rod(platform, "hub", (0, 0, -0.023), (0, 0, -0.0055), 0.011, "steel")
        distance = GEAR_MODULE * (RING_TEETH + PINION_TEETH) / 2
        x, y = distance * np.cos(PINION_ANGLE), distance * np.sin(PINION_ANGLE)
        _rod(platform, "drive", (x, y, -0.026), (x, y, -0.003), 0.0085, "aluminium")

        ring = self._add_body(platform, f"{name}_ring", (0, 0, 0.002), (0, 0, 1))
        _gear(ring, RING_TEETH, PINION_ANGLE, accent)
        for side, word in ((-1, "top"), (1, "bottom")):
            at, half_sizes = (0, side * 0.0063, 0.010), (0.010, 0.0012, 0.007)
            _box(ring, f"fork_{word}", at, half_sizes, "steel")
        for side, word in SIDES:
            at = (side * (ROLLER_RADIUS + self._device_radius), 0, 0.015)
            roller = self._add_body(ring, f"{name}_roller_{word}", at, (0, 1, 0))
            start, end = (0, -0.005, 0), (0, 0.005, 0)
            _rod(roller, "tyre", start, end, ROLLER_RADIUS, "rubber")
            # A stripe makes the rotation of the cylinder visible.
            _box(roller, "stripe", (0, 0, 0), (0.0052, 0.0044, 0.001), accent)

        pinion = self._add_body(platform, f"{name}_pinion", (x, y, 0.002), (0, 0, 1))
        # A gap of the pinion faces a tooth of the ring.
        gap = PINION_ANGLE + np.pi + np.pi / PINION_TEETH
        _gear(pinion, PINION_TEETH, gap, "brass")

    def _add_body(self, parent, name: str, pos, axis) -> mjcf.Element:
        """Adds a body with compensated gravity and one joint of the same name."""
        body = parent.add("body", name=name, pos=pos, gravcomp=1)
        joint = self._kinds[name]
        slides = joint.kind == "slide"
        element = body.add("joint", name=name, type=joint.kind, axis=axis)
        element.damping = SLIDE_DAMPING if slides else HINGE_DAMPING
        if joint.range is not None:
            element.range = joint.range
        return body


def _box(body, part: str, centre, half_sizes, material: str, quat=(1, 0, 0, 0)) -> None:
    body.add(
        "geom",
        name=f"{body.name}_{part}",
        type="box",
        pos=centre,
        size=half_sizes,
        quat=quat,
        material=material,
    )


def _rod(
    body, part: str, start, end, radius, material: str, shape: str = "cylinder"
) -> None:
    body.add(
        "geom",
        name=f"{body.name}_{part}",
        type=shape,
        fromto=(*start, *end),
        size=(radius,),
        material=material,
    )


def _gear(body, teeth: int, angle: float, material: str) -> None:
    """A spur gear about z with one tooth at ``angle`` (rad from +x)."""
    pitch = GEAR_MODULE * teeth / 2
    root_radius = pitch - 0.8 * GEAR_MODULE
    _rod(body, "blank", (0, 0, -0.004), (0, 0, 0.004), root_radius, material)
    half_sizes = (pitch + 0.75 * GEAR_MODULE, 0.9 * GEAR_MODULE, 0.0038)
    for i in range(teeth // 2):  # a box makes two opposite teeth
        half_turn = (angle + 2 * np.pi * i / teeth) / 2
        quat = (np.cos(half_turn), 0, 0, np.sin(half_turn))
        _box(body, f"teeth_{i}", (0, 0, 0), half_sizes, material, quat)
