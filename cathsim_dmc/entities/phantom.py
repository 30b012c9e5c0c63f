"""The phantom: the wall of an anatomy as convex pieces, its goals and its sensors."""

import numpy as np
from dm_control import composer, mjcf

from cathsim_dmc.anatomy import Anatomy
from cathsim_dmc.entities.contact import FRICTION, wall_contact

# Contacts that the wall sensor can report. A device jammed in a narrow tube has about
# a hundred; `Contacts.found` tells when there are more.
MAX_CONTACTS = 192
CONTACT_FIELDS = ("found", "force", "dist", "pos", "normal", "tangent")

_LUMEN_COLOUR = (0.8, 0.25, 0.25, 0.25)
_GOAL_COLOUR = (0.1, 0.7, 0.3, 0.5)


class Phantom(composer.Entity):
    """A rigid wall around the lumen of an anatomy, on a load cell."""

    def _build(
        self,
        anatomy: Anatomy,
        friction: float = FRICTION,
        goal_radius: float = 8e-3,
        name: str = "phantom",
    ):
        """Builds the wall.

        Args:
          anatomy: lumen, wall pieces and goals.
          friction: Coulomb coefficient of device on wall.
          goal_radius: of the goal sites, m.
          name: of the entity.
        """
        if not 0 <= friction <= 2:
            raise ValueError(f"friction is {friction}; it must be between 0 and 2")
        self._anatomy = anatomy
        self._mjcf_root = mjcf.RootElement(model=name)
        self._body = self._mjcf_root.worldbody.add("body", name="wall")
        self._add_wall(friction)
        self._add_looks()
        self._goals = {
            goal.name: self._body.add(
                "site",
                name=f"goal_{goal.name}",
                pos=goal.position,
                size=[goal_radius],
                rgba=_GOAL_COLOUR,
                group=4,
            )
            for goal in anatomy.goals.values()
        }
        cell = self._body.add("site", name="load_cell", size=[1e-3], group=4)
        self._load_cell = self._mjcf_root.sensor.add(
            "force", name="load_cell", site=cell
        )

    def _add_wall(self, friction: float):
        for index, piece in enumerate(self._anatomy.wall):
            name = f"wall_{index:03d}"
            self._mjcf_root.asset.add(
                "mesh", name=name, vertex=np.ravel(piece), inertia="shell"
            )
            self._body.add(
                "geom",
                name=name,
                type="mesh",
                mesh=name,
                **wall_contact(friction),
                mass=0,
                group=3,
            )

    def _add_looks(self):
        surface = self._anatomy.surface
        self._mjcf_root.asset.add(
            "mesh",
            name="lumen",
            vertex=surface.vertices.ravel(),
            face=surface.faces.ravel(),
            inertia="shell",
        )
        self._body.add(
            "geom",
            name="lumen",
            type="mesh",
            mesh="lumen",
            contype=0,
            conaffinity=0,
            mass=0,
            group=2,
            rgba=_LUMEN_COLOUR,
        )

    def add_wall_sensor(self, device_body) -> None:
        """Adds the sensor of the contacts of a device with the wall.

        Args:
          device_body: root body of the device, an element of the same model tree.
        """
        self._body.root.root_model.sensor.add(
            "contact",
            name="wall_contacts",
            body1=self._body,
            subtree2=device_body,
            num=MAX_CONTACTS,
            data=" ".join(CONTACT_FIELDS),
            reduce="none",
        )

    @property
    def mjcf_model(self) -> mjcf.RootElement:
        """The MJCF model of the phantom."""
        return self._mjcf_root

    @property
    def anatomy(self) -> Anatomy:
        """Lumen, wall pieces and goals."""
        return self._anatomy

    @property
    def body(self):
        """The one static body that carries the wall."""
        return self._body

    @property
    def goals(self) -> dict:
        """Goal sites by name."""
        return self._goals

    @property
    def load_cell(self):
        """Force sensor under the phantom, world frame, force of the support on it."""
        return self._load_cell
