"""Test rigs: devices with the settings of the tasks under known loads."""

import dataclasses
import types
from collections.abc import Callable, Sequence
from typing import Any, cast

import mujoco
import numpy as np
from dm_control import mjcf

from cathsim_dmc import suite
from cathsim_dmc.anatomy.anatomy import Anatomy
from cathsim_dmc.anatomy.builder import VesselPlace
from cathsim_dmc.anatomy.centreline import Centreline, Vessel, VesselTree
from cathsim_dmc.anatomy.field import Field
from cathsim_dmc.collision import fields
from cathsim_dmc.entities import devices
from cathsim_dmc.entities.arena import AngiographyArena
from cathsim_dmc.entities.catheter import Catheter
from cathsim_dmc.entities.contact import FRICTION
from cathsim_dmc.entities.device_stack import DeviceStack
from cathsim_dmc.entities.phantom import Phantom
from cathsim_dmc.physics import chain_fields
from cathsim_dmc.physics.blood import StillBlood
from cathsim_dmc.physics.drives import hold
from cathsim_dmc.physics.effects import Draw, Layout, World, userdata_size
from cathsim_dmc.physics.readings import ids
from cathsim_dmc.tasks.config import PHYSICS_TIMESTEP
from cathsim_dmc.validation import theory

RESTING_TIME = 0.4  # s, over which motion at rest is measured
STRICT = 1e-8  # solver tolerance with which devices at rest do not move


def uniform(link: float) -> devices.Device:
    """A device with the shaft of steerable_5f to its end, in links of a length, m."""
    one = devices.STEERABLE_5F
    links = round(one.tip_length / link)
    return dataclasses.replace(one, tip=one.shaft, tip_links=links, steering_angle=0.0)


def half_circle(radius: float, start: float, pieces: int) -> np.ndarray:
    """Half circle (pieces + 1, 3), m, from +z towards +x, from z = `start`, m, on."""
    angle = np.linspace(0.0, np.pi, pieces + 1)
    arc = np.stack([1 - np.cos(angle), 0 * angle, np.sin(angle)], axis=-1)
    return radius * arc + (0, 0, start)


def tube(length: float, radius: float, bend: float = 0.0) -> Anatomy:
    """A vessel "tube" from the origin along +z, closed at its end, with a goal "end".

    Args:
        length: length of a straight tube, or of the parts before and after a bend, m.
        radius: radius of the lumen, m.
        bend: radius of a half circle towards +x, m; 0 for none.
    """
    z = np.linspace(0.0, length, max(3, round(length / 5e-3) + 1))
    points = np.stack([0 * z, 0 * z, z], axis=-1)
    if bend:
        arc = half_circle(bend, length, 60)[1:]
        points = np.vstack([points, arc, arc[-1] - points[1:]])
    line = Centreline(points, np.full(len(points), radius))
    end = VesselPlace("tube", arc_length=line.length - 1e-3)
    tree = VesselTree({"tube": Vessel("tube", line)})
    return Anatomy.from_tree(tree, "tube", goals={"end": end})


def in_tube(size: tuple[float, ...], **options: Any):
    """A composer environment in a `tube(*size)`, after a reset."""
    place = {"anatomy": tube(*size), "goal": "end", "goal_radius": 1e-6, "random": 0}
    environment = suite.load(suite.DOMAIN, "navigate", place | options)
    environment.reset()
    return environment


def bare(lumen: Any = None, lattice: np.ndarray | None = None, **wall: Any):
    """MuJoCo spec without a device, with the options of the tasks but no gravity.

    The field `lumen`, if given, is geom 0 with attributes `wall`; `lattice` moves it.
    """
    spec = mujoco.MjSpec()
    spec.nuser_geom = 4
    option = spec.option
    option.integrator = mujoco.mjtIntegrator.mjINT_DISCRETE
    option.timestep, option.gravity = PHYSICS_TIMESTEP, (0, 0, 0)
    option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    if lumen is not None:
        made = fields.carrier(lumen, lattice)
        wall |= {"pos": made["pos"], "size": made["size"], "userdata": made["user"]}
        spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, **wall)
    return spec


def slider(spec: mujoco.MjSpec, axes: Any, pos: Any = (0, 0, 0), **geom: Any):
    """Adds a body with slide joints along axes (n, 3); returns its geom."""
    body = spec.worldbody.add_body(pos=pos)
    for axis in np.atleast_2d(axes):
        body.add_joint(type=mujoco.mjtJoint.mjJNT_SLIDE, axis=axis)
    return body.add_geom(**geom)


class Rig:
    """A device, or coaxial devices, in the arena of the tasks, with their settings.

    The device lies along +z with its base at insertion 0. Gravity is off.

    Attributes:
        arena: arena, to which a test adds its fixtures before `compile`.
        catheter: entity of the device, with `origin` at the middle of link 0.
        gaps: (K,) m, from the ends of the devices to that of the chain, at rest.
        drives: Drives of the base, from `hold` on.
    """

    def __init__(
        self,
        device: str | devices.Device | Sequence[str | devices.Device] = "steerable_5f",
        discretisation: devices.Discretisation | None = None,
        *,
        straight: bool = False,
        gaps: Sequence[float] | None = None,
        **options: Any,
    ):
        """Makes the device.

        Args:
            device: Name or device, or a sequence of coaxial ones.
            discretisation: Default of the tasks if None.
            straight: Whether devices lack their pre-shaped tips.
            gaps: (K,) m; 0 if None.
            **options: Options of the entity; default: stroke 0.1 m and `FRICTION`.
        """
        single = isinstance(device, str | devices.Device)
        chosen = [devices.get(one) for one in ([device] if single else device)]
        if straight:
            chosen = [dataclasses.replace(one, tip_shape=()) for one in chosen]
        kind, made = (Catheter, chosen[0]) if single else (DeviceStack, chosen)
        options = {"stroke": 0.1, "friction": FRICTION} | options
        self.catheter = kind(made, discretisation, **options)
        self.gaps = np.zeros(len(chosen)) if gaps is None else np.array(gaps)
        self.device = self.catheter.device
        self.arena = AngiographyArena(self.catheter.density)
        self.arena.mjcf_model.option.timestep = self.catheter.timestep
        self.arena.mjcf_model.option.gravity = (0, 0, 0)
        self.lengths = self.catheter.link_lengths
        self.arena.attach(self.catheter)

    @property
    def sections(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Lengths (m), EI and GJ (N·m²), (S,), of uniform sections from the clamp.

        The clamp is the middle of link 0: the first joint represents the rod from there
        to the middle of link 1.
        """
        length = float(self.lengths.sum() - self.lengths[0] / 2)
        tips = [device.tip_length for device in self.catheter.devices]
        places = np.unique(
            np.minimum([0, length, *self.gaps, *self.gaps + tips], length)
        )
        middles = (places[1:] + places[:-1]) / 2
        found = theory.profile(self.catheter.devices, self.gaps, middles).sum(axis=1)
        return np.diff(places)[::-1], found[0, ::-1], found[1, ::-1]

    def add_wall(self, measure: Callable, low, high, friction: float = FRICTION):
        """Adds a wall with contact sensors.

        Args:
            measure: Depth function of the lumen, see `Field.sampled`.
            low: (3,) m, lower corner of a box around the lumen.
            high: (3,) m, upper corner.
            friction: Coulomb coefficient.
        """
        anatomy = tube(0.04, 1.5e-3)  # only its lumen is used
        vars(anatomy)["lumen"] = Field.sampled(measure, np.array(low), np.array(high))
        wall = Phantom(anatomy, friction=friction)
        self.arena.attach(wall)
        wall.add_wall(self.catheter.links[0])

    def add_plate(self, height: float) -> None:
        """Adds a plate at y = `height`, m."""

        def measure(blocks: np.ndarray, points: np.ndarray) -> np.ndarray:
            return height - blocks[:, None, 1] - points[:, 1]

        self.add_wall(measure, (-0.05, -0.05, -0.5), (0.05, height, 0.5))

    def compile(self, blood: StillBlood | None = None) -> None:
        """Compiles the model with its fixtures, in blood or in vacuum."""
        if blood is not None:
            size = self.arena.mjcf_model.size
            size.nuserdata = userdata_size([blood], self.catheter)
        physics = mjcf.Physics.from_mjcf_model(self.arena.mjcf_model)
        self._physics = physics  # owns model and data
        self.model, self.data = physics.model.ptr, physics.data.ptr
        self.name = self.catheter.mjcf_model.model
        self.head = self.model.site(f"{self.name}/head").id
        self.tip_body = self.model.body(f"{self.name}/link_{len(self.lengths) - 1}").id
        if isinstance(self.catheter, DeviceStack):
            chain_fields.write_still(self.catheter, self.model, self.gaps)
        if blood is not None:
            self._fill(blood)
        mujoco.mj_forward(self.model, self.data)

    def _fill(self, blood: StillBlood) -> None:
        from cathsim_dmc.physics.dispatcher import Places

        chain, nothing = self.catheter, cast(Any, None)
        places = Places(
            int(ids(self.model, chain.links)[0]), ids(self.model, chain.link_geoms)
        )
        world = World(
            self.model,
            chain,
            index=nothing,
            start_depth=np.zeros(1),
            stroke=np.full(1, chain.stroke),
            arrays=types.SimpleNamespace(qpos=self.data.qpos[None]),
            field=nothing,
            parameters=self.data.userdata[None],
        )
        Layout([blood], world, places).begin(np.arange(1))
        blood.restart(0, Draw(np.zeros(3)), np.random.RandomState(0))

    def qpos(self, joint: str) -> float:
        """Position (m or rad) of a joint of the catheter, by its name in the entity."""
        return float(self.data.joint(f"{self.name}/{joint}").qpos[0])

    def sensor(self, name: str) -> np.ndarray:
        """Reading of a sensor, by its full name."""
        return self.data.sensor(name).data.copy()

    @property
    def joints(self) -> np.ndarray:
        """Positions (n, 3), m, of the proximal ends of the links."""
        last = self.tip_body + 1
        return self.data.xpos[last - len(self.lengths) : last].copy()

    @property
    def head_position(self) -> np.ndarray:
        """Position (3,), m, of the distal end."""
        return self.data.site_xpos[self.head].copy()

    def load_head(self, force=(0.0, 0.0, 0.0), torque=(0.0, 0.0, 0.0)) -> None:
        """Sets the dead load on the distal end, world frame, N and N·m."""
        # Force sensors include a force on the body, unlike one on the joints.
        lever = self.head_position - self.data.xipos[self.tip_body]
        load = self.data.xfrc_applied[self.tip_body]
        load[:3] = force
        load[3:] = np.asarray(torque) + np.cross(lever, force)

    def step(self, force=None, torque=(0.0, 0.0, 0.0)) -> None:
        """Does a physics step, under a dead load on the distal end if one is given."""
        if force is not None:
            self.load_head(force, torque)
        mujoco.mj_step(self.model, self.data)

    def run(self, duration: float, force=None) -> None:
        """Steps for a time (s), under a dead load if one is given."""
        for _ in range(round(duration / self.model.opt.timestep)):
            self.step(force)

    def hold(self, insertion: float) -> None:
        """Places the base at an insertion, m, and holds it by its drives."""
        self.data.joint(f"{self.name}/insertion").qpos = insertion
        self.drives = hold(self.model, self.data)

    def drive(self, command: Sequence[float]) -> None:
        """Commands the D drives, (D,) in [-1, 1], for the control step to come."""
        self.drives.follow(np.array([command]))
        self.data.ctrl[-len(command) :] = command

    def bend(self, angles: np.ndarray) -> None:
        """Sets the hinges to angles (n - 1, 2), rad, about x and y."""
        for joint, bends in enumerate(angles.tolist(), start=1):
            for axis, angle in zip("xy", bends, strict=True):
                self.data.joint(f"{self.name}/bend_{axis}_{joint}").qpos = angle
        mujoco.mj_forward(self.model, self.data)

    def settle(
        self,
        force=None,
        *,
        change: float = 1e-6,
        damping: float = RESTING_TIME,
        longest: float = 20.0,
    ) -> None:
        """Steps with strong damping until the device is at rest.

        Args:
            force: (3,) dead load on the distal end, N; None leaves what is applied.
            change: Largest motion of a joint over `RESTING_TIME` at rest, rad or m.
            damping: Least relaxation time of the hinges while they settle, s. With the
                damping of its material alone a device oscillates for minutes.
            longest: Time limit, s.

        Raises:
            RuntimeError: if the time limit is reached, or the simulation diverges.
        """
        end, moved = self.data.time + longest, np.inf
        model, before = self.model, self.model.dof_damping.copy()
        hinges = model.jnt_type == mujoco.mjtJoint.mjJNT_HINGE
        chosen, least = model.jnt_dofadr[hinges], damping * model.jnt_stiffness[hinges]
        model.dof_damping[chosen] = np.maximum(before[chosen], least)
        while moved > change:
            start = self.data.qpos.copy()
            self.run(RESTING_TIME, force)
            moved = np.abs(self.data.qpos - start).max()
            if self.data.time > end:
                raise RuntimeError(
                    f"after {longest} s a joint still moves by {moved:.2g} in "
                    f"{RESTING_TIME} s, more than {change:g}; the load is too large "
                    "or the time too short"
                )
        model.dof_damping[:] = before
        if self.data.warning.number.any():
            raise RuntimeError("MuJoCo warned while the device settled")
        mujoco.mj_forward(self.model, self.data)
