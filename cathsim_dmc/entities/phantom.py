"""The phantom: the wall of an anatomy as a field, with goals and sensors."""

from collections.abc import Mapping

import numpy as np
from dm_control import composer, mjcf

from cathsim_dmc import bounds
from cathsim_dmc.anatomy import Anatomy, Goal
from cathsim_dmc.collision import fields
from cathsim_dmc.entities.contact import DRAWN, FRICTION, wall_contact

# Largest number of contacts of a device's geom with the wall, for the wall's sensor.
MOST_CONTACTS = 4
CONTACT_FIELDS = ("found", "force", "dist", "pos", "normal", "tangent")

_LUMEN_COLOUR = (0.8, 0.25, 0.25, 0.25)
_UNSEEN = 1e-4  # m, radius of the point in place of a surface that is not drawn
_GOAL_COLOUR = (0.1, 0.7, 0.3, 0.5)


class Phantom(composer.ModelWrapperEntity):
    """A rigid wall around the lumen of an anatomy, on a load cell.

    Attributes:
        anatomy: Lumen and goals.
        body: The static body of the drawn surface and the goals.
        surface: The geom of the drawn surface.
        goals: Goal sites by name.
    """

    def _build(
        self,
        anatomy: Anatomy,
        friction: float = FRICTION,
        goal_radius: float = 8e-3,
        drawn: bool = True,
        marked: Mapping[str, Goal] | None = None,
    ):
        """Builds the wall.

        Args:
            anatomy: lumen and goals.
            friction: Coulomb coefficient of the wall.
            goal_radius: radius of the goal sites, m.
            drawn: whether the surface is drawn; otherwise a point replaces it, so that
                all models have the same number of geoms.
            marked: goals that get a site, by the name of the site; None for all.
        """
        bounds.instance("anatomy", anatomy, Anatomy)
        bounds.number("goal_radius", goal_radius, 0.0, 1.0, "m", positive=True)
        self.anatomy, self._friction = anatomy, friction
        root = mjcf.RootElement(model="phantom")
        super()._build(root)
        self.body = root.worldbody.add("body", name="wall")
        shape = {"type": "sphere", "size": [_UNSEEN]}
        if drawn:
            file = mesh_file(anatomy.surface.vertices, anatomy.surface.faces)
            root.asset.add("mesh", name="lumen", file=file, inertia="shell")
            shape = {"type": "mesh", "mesh": "lumen"}
        colour = _LUMEN_COLOUR if drawn else (0, 0, 0, 0)
        self.surface = self.body.add(
            "geom", name="lumen", **shape, **DRAWN, rgba=colour
        )
        self.goals = {
            name: self.body.add(
                "site",
                name=f"goal_{name}",
                pos=goal.position,
                size=[goal_radius],
                rgba=_GOAL_COLOUR,
                group=4,
            )
            for name, goal in (anatomy.goals if marked is None else marked).items()
        }

    def add_wall(self, device_body, hole: float = np.inf, moving: bool = False) -> None:
        """Adds the carrier of the wall and the sensors of its contacts with a device.

        Args:
            device_body: root body of the device, an element of the same model tree.
            hole: radius of the hole in the cap over the inlet, m; no cap if the hole is
                as wide as the lumen.
            moving: whether heart and breathing may move the wall.

        Raises:
            ValueError: if phantom and device are not attached to the same arena.
        """
        root = self.mjcf_model.root_model
        if device_body.root.root_model is not root:
            raise ValueError(
                f"device_body {device_body.full_identifier!r} is not in the model of "
                "the phantom; attach both to one arena, then add the wall"
            )
        lumen = self.anatomy.lumen.with_hole(hole)
        motion = self.anatomy.motion.lattice if moving else None
        root.worldbody.add(
            "geom",
            name="wall",
            **fields.carrier(lumen, motion),
            **wall_contact(self._friction),
        )
        between = {"body1": "world", "subtree2": device_body}
        root.sensor.add(
            "contact",
            name="wall_contacts",
            **between,
            num=MOST_CONTACTS * len(device_body.find_all("geom")),
            data=" ".join(CONTACT_FIELDS),
            reduce="none",
        )
        # A load cell under the phantom carries the sum of the contacts.
        cell = {"name": "load_cell", "data": "force", "reduce": "netforce"}
        root.sensor.add("contact", **cell, **between)


def mesh_file(vertices: np.ndarray, faces: np.ndarray) -> mjcf.Asset:
    """Mesh of vertices (n, 3) m and triangles (m, 3) in MuJoCo's own format (MSH)."""
    counts = np.array([len(vertices), 0, 0, len(faces)], dtype="<i4")
    parts = (counts, vertices.astype("<f4"), faces.astype("<i4"))
    return mjcf.Asset(b"".join(part.tobytes() for part in parts), ".msh")
