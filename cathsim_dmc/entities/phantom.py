"""The phantom: the wall of an anatomy as a field, with goals and sensors."""

import numpy as np
from dm_control import composer, mjcf

from cathsim_dmc.anatomy import Anatomy
from cathsim_dmc.collision import fields
from cathsim_dmc.entities.contact import FRICTION, wall_contact

# Of a geom of the device with the wall, at most; the wall's sensor has room for all.
MOST_CONTACTS = 4
CONTACT_FIELDS = ("found", "force", "dist", "pos", "normal", "tangent")

_LUMEN_COLOUR = (0.8, 0.25, 0.25, 0.25)
_UNSEEN = 1e-4  # m
_GOAL_COLOUR = (0.1, 0.7, 0.3, 0.5)


class Phantom(composer.Entity):
    """A rigid wall around the lumen of an anatomy, on a load cell."""

    def _build(
        self,
        anatomy: Anatomy,
        friction: float = FRICTION,
        goal_radius: float = 8e-3,
        drawn: bool = True,
        name: str = "phantom",
    ):
        """Builds the wall.

        Args:
            goal_radius: radius of the goal sites, m.
            drawn: whether its surface is there to be seen; a point stands for it if
                not, so that the models have as many geoms.
        """
        if not 0 <= friction <= 2:
            raise ValueError(f"friction is {friction}; it must be between 0 and 2")
        self._anatomy = anatomy
        self._mjcf_root = mjcf.RootElement(model=name)
        self._body = self._mjcf_root.worldbody.add("body", name="wall")
        self._friction = friction
        self._add_surface(drawn)
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

    def _add_surface(self, drawn: bool):
        shape = {"type": "sphere", "size": [_UNSEEN]}
        if drawn:
            surface = self._anatomy.surface
            self._mjcf_root.asset.add(
                "mesh",
                name="lumen",
                file=mesh_file(surface.vertices, surface.faces),
                inertia="shell",
            )
            shape = {"type": "mesh", "mesh": "lumen"}
        self._surface = self._body.add(
            "geom",
            name="lumen",
            **shape,
            contype=0,
            conaffinity=0,
            mass=0,
            group=2,
            rgba=_LUMEN_COLOUR if drawn else (0, 0, 0, 0),
        )

    def add_wall(self, device_body, hole: float = np.inf, moving: bool = False) -> None:
        """Adds the carrier of the wall and the sensors of its contacts with a device.

        Args:
            device_body: root body of the device, an element of the same model tree.
            hole: radius of the hole in the cap over the inlet, m; open if larger.
            moving: whether heart and breathing may move it.
        """
        root = self._mjcf_root.root_model
        lumen = self._anatomy.lumen.with_hole(hole)
        motion = self._anatomy.motion.lattice if moving else None
        root.worldbody.add(
            "geom",
            name="wall",
            **fields.carrier(lumen, motion),
            **wall_contact(self._friction),
            mass=0,
            group=5,
            rgba=(0, 0, 0, 0),
        )
        root.sensor.add(
            "contact",
            name="wall_contacts",
            body1="world",
            subtree2=device_body,
            num=MOST_CONTACTS * len(device_body.find_all("geom")),
            data=" ".join(CONTACT_FIELDS),
            reduce="none",
        )
        # A load cell under the phantom carries the sum of the contacts.
        root.sensor.add(
            "contact",
            name="load_cell",
            body1="world",
            subtree2=device_body,
            data="force",
            reduce="netforce",
        )

    @property
    def mjcf_model(self) -> mjcf.RootElement:
        """The MJCF model of the phantom."""
        return self._mjcf_root

    @property
    def anatomy(self) -> Anatomy:
        """Lumen and goals."""
        return self._anatomy

    @property
    def body(self):
        """The static body of the drawn surface and the goals."""
        return self._body

    @property
    def surface(self):
        """The geom of the drawn surface."""
        return self._surface

    @property
    def goals(self) -> dict:
        """Goal sites by name."""
        return self._goals


def mesh_file(vertices: np.ndarray, faces: np.ndarray | None = None) -> mjcf.Asset:
    """A mesh in MuJoCo's own binary format (MSH).

    Args:
        vertices: (n, 3), m.
        faces: (m, 3) indices of vertices; None for the convex hull.
    """
    faces = np.empty((0, 3)) if faces is None else faces
    counts = np.array([len(vertices), 0, 0, len(faces)], dtype="<i4")
    parts = (counts, vertices.astype("<f4"), faces.astype("<i4"))
    return mjcf.Asset(b"".join(part.tobytes() for part in parts), ".msh")


def read_mesh_file(data: bytes) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (n, 3) float32, m, and faces (m, 3) of a mesh of a `Phantom`."""
    vertices, _, _, faces = np.frombuffer(data, "<i4", 4)
    points = np.frombuffer(data, "<f4", 3 * vertices, 16)
    numbers = np.frombuffer(data, "<i4", 3 * faces, 16 + 12 * vertices)
    return points.reshape(-1, 3), numbers.reshape(-1, 3)
