"""Meshes of several anatomies, or of vessels that move, for MuJoCo's cameras.

The simulated model has the mesh of the first anatomy alone, at rest: a mesh is drawn
and never touched. Cameras draw in a model of their own, which has all meshes, so that
nothing changes in the simulations.
"""

from collections.abc import Sequence

import mujoco
import numpy as np

from cathsim_dmc.anatomy import Surface
from cathsim_dmc.entities.phantom import mesh_file
from cathsim_dmc.tasks.cases import Case
from cathsim_dmc.tasks.placement import matrix_of
from cathsim_dmc.tasks.scene import VIEWS, camera_position

# Largest difference between normals of a `Surface` and of MuJoCo, which treats sharp
# edges, as those of the caps, in a way of its own.
_ALIKE = 1e-3
# Fields that differ between models with other meshes.
_OWN = ("_", "name", "path", "text", "mesh_", "bvh_")


class CaseMeshes:
    """Shows one of several cases in a model that cameras draw."""

    def __init__(self, cases: Sequence[Case]):
        """Takes the cases; the first one's scene is that of the simulated model."""
        self._cases = cases
        self._smooth: dict[int, np.ndarray] = {}  # vertices (n,) bool of each case

    def compiled(self, simulated: mujoco.MjModel) -> mujoco.MjModel:
        """Returns a copy of the simulated model with the meshes of all cases."""
        first = self._cases[0].scene
        root = first.arena.mjcf_model
        assets, names = dict(root.get_assets()), []
        for number, case in enumerate(self._cases[1:], 1):
            surface = case.scene.anatomy.surface
            names.append(f"case_{number}")
            file = mesh_file(surface.vertices, surface.faces)
            assets[f"{names[-1]}.msh"] = file.contents
        spec = mujoco.MjSpec.from_string(root.to_xml_string(), assets=assets)
        for name in names:
            shell = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
            spec.add_mesh(name=name, file=f"{name}.msh", inertia=shell)
        model = spec.compile()
        geom = model.geom(first.phantom.surface.full_identifier).id
        self._geom, mesh = geom, int(model.geom_dataid[geom])
        self._meshes = [mesh, *(model.mesh(name).id for name in names)]
        # Taken first: the simulated model may be in another case by now.
        self._row = {
            name: np.copy(getattr(model, name)[geom])
            for name in dir(model)
            if name.startswith("geom_")
        }
        for name in dir(model):
            own, value = getattr(model, name), getattr(simulated, name, None)
            if isinstance(own, np.ndarray) and not name.startswith(_OWN):
                own[:] = value
        return model

    def enter(self, model: mujoco.MjModel, number: int) -> None:
        """Writes the places of a case, and the cameras that look at it."""
        case = self._cases[number]
        case.write(model)
        vertices = case.scene.anatomy.surface.vertices
        low, high = vertices.min(0), vertices.max(0)
        for name in VIEWS:
            model.cam_pos[model.camera(name).id] = camera_position(name, low, high)

    def draw(self, model: mujoco.MjModel, number: int) -> None:
        """Gives the surface the mesh of a case; after all else that is written."""
        mesh = self._meshes[number]
        for name, row in self._row.items():
            getattr(model, name)[self._geom] = row
        model.geom_dataid[self._geom] = mesh
        model.geom_pos[self._geom] = model.mesh_pos[mesh]
        model.geom_quat[self._geom] = model.mesh_quat[mesh]
        model.geom_sameframe[self._geom] = mujoco.mjtSameFrame.mjSAMEFRAME_NONE

    def reshape(self, model: mujoco.MjModel, number: int, surface: Surface) -> int:
        """Gives the mesh of a case its vertices as moved; returns the mesh's number.

        The mesh must then be uploaded to the context that draws it.
        """
        mesh = self._meshes[number]
        start, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
        own = slice(start, start + count)
        frame = matrix_of(model.mesh_quat[mesh])
        start = model.mesh_normaladr[mesh]
        there = slice(start, start + model.mesh_normalnum[mesh])
        if number not in self._smooth:
            rest = self._cases[number].scene.anatomy.surface.normals @ frame
            away = np.abs(rest - model.mesh_normal[there]).max(axis=1)
            self._smooth[number] = away < _ALIKE
        smooth = self._smooth[number]
        model.mesh_vert[own] = (surface.vertices - model.mesh_pos[mesh]) @ frame
        turned = surface.normals @ frame
        model.mesh_normal[there][smooth] = turned[smooth]
        return mesh
