"""A guidewire in a measured phantom: held at the entry, pushed or let go."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from cathsim_dmc.anatomy.field import Field
from cathsim_dmc.anatomy.parts import Surface
from cathsim_dmc.collision import fields
from cathsim_dmc.entities.arena import BLOOD_DENSITY, GRAVITY
from cathsim_dmc.entities.chain import MAX_PUSH_SPEED, MAX_ROTATION_SPEED
from cathsim_dmc.entities.contact import FRICTION, wall_contact
from cathsim_dmc.entities.device import Device
from cathsim_dmc.entities.devices import Discretisation
from cathsim_dmc.entities.phantom import mesh_file
from cathsim_dmc.entities.posture import bends_of
from cathsim_dmc.entities.sheath import Sheath, straight
from cathsim_dmc.recording.geometry import along
from cathsim_dmc.validation.bench_data import Wire
from cathsim_dmc.validation.rig import Rig

_LINK = 7e-3  # m, longest of the shaft
# Rest: no node moves by more than _REST, m, in _WHILE, s. Limit of the wait, s.
_REST, _WHILE, _LONGEST = 0.1e-3, 0.4, 20.0
_SPEEDS = {"insertion": MAX_PUSH_SPEED, "rotation": MAX_ROTATION_SPEED}
# Steering: the operator looks after each advance, m. If the tip is astray, it pulls
# back, m, and turns by the golden angle, rad, up to so many times.
_LOOK, _BACK, _TURN, _ATTEMPTS = 5e-3, 30e-3, np.pi * (3.0 - 5.0**0.5), 12


class Held:
    """A wire clamped at the entry, in the middle of its first link.

    At full insertion the middle of link 0 is at the entry, so no link outside affects
    the shape. The device is upright at the origin; the wall is rotated instead.
    """

    def __init__(
        self,
        wall: Field | Surface,
        wire: Wire,
        device: Device,
        down: np.ndarray,
        turn: float = 0.0,
        *,
        friction: float = FRICTION,
        overshoot: float = 0.0,
    ):
        """Builds the scene; vectors are in the frame of the mesh.

        Args:
            wall: lumen; a surface acts as its convex hull.
            wire: measured wire, which gives entry and length.
            device: model of the wire.
            down: (3,) unit direction of gravity; 0 for none.
            turn: rotation of the device about its axis, rad.
            friction: Coulomb coefficient.
            overshoot: by which the wire is pushed too far and pulled back, m.

        Raises:
            ValueError: if less of the wire is inserted than its tip and one link.
        """
        # The shape at rest does not depend on damping; strong damping saves time.
        device = replace(device, loss_factor=2.0)
        self.length, self._entry = wire.length, wire.points[0]
        self._reach = reach = wire.length + overshoot
        shaft = reach - device.tip_length
        if shaft < _LINK:
            raise ValueError(
                f"{wire.name} is inserted by {1e3 * wire.length:.0f} mm; at least "
                f"{1e3 * (device.tip_length + _LINK):.0f} mm are needed"
            )
        # The inserted shaft has n - 1/2 links.
        first = shaft / (np.ceil(shaft / _LINK) - 0.5)
        fine = Discretisation(reach + first / 2, shaft_link=first * (1 + 1e-6))
        stroke = reach + 1e-3
        rig = Rig(device, fine, stroke=stroke, friction=friction, rotation=True)
        self.rig = rig
        axis = wire.direction
        across = np.cross(np.eye(3)[np.abs(axis).argmin()], axis)
        across /= np.linalg.norm(across)
        frame = np.stack([across, np.cross(axis, across), axis], axis=1)
        self._frame = frame @ Rotation.from_euler("z", turn).as_matrix()
        root = rig.arena.mjcf_model
        buoyancy = BLOOD_DENSITY / rig.catheter.density
        root.option.gravity = GRAVITY * (1.0 - buoyancy) * down @ self._frame
        bore = straight(float(rig.lengths.sum()))
        rig.arena.attach(Sheath(bore, device.outer_radius))
        quat = Rotation.from_matrix(self._frame.T).as_quat(scalar_first=True)
        body = root.worldbody.add("body", pos=-self._entry @ self._frame, quat=quat)
        if isinstance(wall, Field):
            shape = fields.carrier(wall)
        else:
            file = mesh_file(wall.vertices, wall.faces)
            root.asset.add("mesh", name="hull", file=file, inertia="shell")
            shape = {"type": "mesh", "mesh": "hull", "mass": 0}
        body.add("geom", name="wall", **shape, **wall_contact(friction))
        rig.compile()

    def push(self) -> np.ndarray:
        """Pushes the wire in; returns its shape (n, 3), m, at rest, 1 mm apart.

        Raises:
            RuntimeError: if the simulation diverges.
        """
        self.rig.data.qpos[:] = 0.0
        return self._to_rest()

    def steer(self, astray: Callable[[np.ndarray], bool]) -> np.ndarray:
        """Pushes the wire in like an operator who sees its tip; see `push`.

        If the tip is astray, the wire is pulled back and turned before the next push.

        Args:
            astray: Whether a position (3,) of the tip, m, is in a wrong vessel.
        """
        self.rig.data.qpos[:] = 0.0
        place, attempts = 0.0, 0
        while place < self._reach:
            place = min(place + _LOOK, self._reach)
            self._go("insertion", place)
            if attempts < _ATTEMPTS and astray(self._nodes()[-1]):
                attempts, place = attempts + 1, max(place - _BACK, 0.0)
                self._go("insertion", place)
                self._go("rotation", attempts * _TURN)
        return self._to_rest()

    def release(self, points: np.ndarray) -> np.ndarray:
        """Releases the wire from the shape of a line; see `push`.

        Args:
            points: (n, 3) m; shifted to the entry and, if too short, extended.
        """
        rig = self.rig
        end = points[-1] - points[-2]
        longer = points[-1] + 2.0 * self.length * end / np.linalg.norm(end)
        local = (np.vstack([points, longer]) - points[0]) @ self._frame
        first = rig.lengths[0] / 2
        nodes = along(local, first + np.cumsum(rig.lengths[1:]))
        steps = np.diff(np.vstack([[0.0, 0.0, first], nodes]), axis=0)
        steps /= np.linalg.norm(steps, axis=1)[:, None]
        rig.data.qpos[:] = 0.0
        rig.data.joint(f"{rig.name}/insertion").qpos = self.length
        rig.data.act[self._servo("insertion")] = self.length / MAX_PUSH_SPEED
        rig.bend(bends_of(np.vstack([[0.0, 0.0, 1.0], steps])))
        return self._to_rest()

    def _to_rest(self) -> np.ndarray:
        """Moves the carriage to the inserted length; returns the shape of `push`."""
        rig = self.rig
        for goal in (self._reach, self.length):
            self._go("insertion", goal)
        mujoco.mj_forward(rig.model, rig.data)
        before, nodes = np.inf, self._nodes()
        end = rig.data.time + _LONGEST
        while np.abs(nodes - before).max() > _REST and rig.data.time < end:
            rig.run(_WHILE)
            before, nodes = nodes, self._nodes()
        if rig.data.warning.number.any():
            raise RuntimeError("the wire in the phantom diverges")
        total = float(rig.lengths.sum())
        arcs = np.append(np.arange(total - self.length, total, 1e-3), total)
        return along(nodes, arcs)

    def _go(self, motion: str, goal: float) -> None:
        """Moves the base at full speed to `goal`, m or rad."""
        servo, speed = self._servo(motion), _SPEEDS[motion]
        data, step = self.rig.data, speed * self.rig.model.opt.timestep
        place = data.act[servo] * speed
        while place != goal:
            place += np.clip(goal - place, -step, step)
            data.act[servo] = place / speed
            self.rig.step()

    def _servo(self, motion: str) -> int:
        rig = self.rig
        return rig.model.actuator_actadr[rig.model.actuator(f"{rig.name}/{motion}").id]

    def _nodes(self) -> np.ndarray:
        """Joints and head (n, 3) in the frame of the mesh, m."""
        nodes = np.vstack([self.rig.joints, self.rig.head_position])
        return self._entry + nodes @ self._frame.T
