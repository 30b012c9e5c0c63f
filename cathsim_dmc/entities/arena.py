"""The angiography suite: world settings of the physics, light and cameras."""

import numpy as np
from dm_control import composer

from cathsim_dmc import bounds
from cathsim_dmc.entities.contact import FRICTION_STIFFNESS

BLOOD_DENSITY = 1060.0  # kg/m^3
GRAVITY = 9.81  # m/s^2

# Forces on the wall are within 0.02 % of those of the exact solution on average. At
# rest, the residuals of the steps can add up to a vibration (docs/validation.md).
SOLVER_TOLERANCE = 1e-6


class AngiographyArena(composer.Arena):
    """World in the patient frame LPS (+x left, +y posterior, +z superior), metres.

    The patient lies on the back: gravity points to +y.
    """

    def _build(
        self, device_density: float = 1100.0, tolerance: float = SOLVER_TOLERANCE
    ):
        """Sets the physics.

        Args:
            device_density: mean density of the device, kg/m³; gravity is reduced by
                its buoyancy in blood.
            tolerance: tolerance of the contact solver.
        """
        bounds.number("device_density", device_density, positive=True)
        bounds.number("tolerance", tolerance, positive=True)
        super()._build(name="arena")
        root = self._mjcf_root
        # composer.Arena bounds masses and inertias from below and sets no-slip
        # iterations; a catheter's links are lighter than these bounds.
        root.compiler.boundmass = 0
        root.compiler.boundinertia = 0
        root.option.noslip_iterations = 0
        # Springs and damping enter the implicit metric, so a stiff light chain is
        # stable at steps of milliseconds.
        root.option.integrator = "discrete"
        root.option.tolerance = tolerance
        # Pyramidal cones diverge under full-amplitude steps of the tip.
        root.option.cone = "elliptic"
        root.option.impratio = FRICTION_STIFFNESS
        root.option.density = 0
        root.option.viscosity = 0
        buoyancy = max(0.0, 1 - BLOOD_DENSITY / device_density)
        root.option.gravity = (0, GRAVITY * buoyancy, 0)
        root.size.memory = "16M"
        root.visual.map.znear = 0.01
        root.visual.map.zfar = 50
        root.visual.headlight.ambient = (0.35, 0.35, 0.35)
        root.visual.headlight.diffuse = (0.5, 0.5, 0.5)
        root.visual.scale.forcewidth = 0.02
        bright, dark = (0.96, 0.97, 0.98), (0.75, 0.8, 0.86)
        sky = {"type": "skybox", "builtin": "gradient", "rgb1": bright, "rgb2": dark}
        root.asset.add("texture", name="backdrop", **sky, width=64, height=64)
        light = root.worldbody.add("light", name="ceiling", castshadow=False)
        light.pos, light.dir, light.diffuse = (0, -1.5, 0.3), (0, 1, 0), [0.45] * 3

    def add_camera(self, name: str, target, distance: float, xyaxes) -> None:
        """Adds a camera that looks at a point.

        Args:
            target: point (3,) on the optical axis, m.
            distance: distance from the point, m.
            xyaxes: right and up directions (6,) of the image.
        """
        position = target + distance * np.cross(xyaxes[:3], xyaxes[3:])
        place = {"pos": position, "xyaxes": xyaxes, "fovy": 30.0}
        self._mjcf_root.worldbody.add("camera", name=name, **place)
