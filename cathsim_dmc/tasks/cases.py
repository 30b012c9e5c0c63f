"""Cases of a task: anatomies that take turns in one compiled model.

All anatomies are compiled once. Wherever their models differ, in the key of the wall's
field and in where device and sheath stand, the fields are kept and written into the
model of the first: nothing is compiled when an episode gets another anatomy, and
everything that was bound to the model stays bound.
"""

import functools
from collections.abc import Mapping, Sequence

import mujoco
import numpy as np

from cathsim_dmc.imaging.angiograph import Angiograph
from cathsim_dmc.imaging.options import FluoroscopyOptions
from cathsim_dmc.physics.readings import ModelIndex
from cathsim_dmc.physics.sliding import devices_of
from cathsim_dmc.tasks.objectives import Objective
from cathsim_dmc.tasks.scene import Scene
from cathsim_dmc.tasks.start import StartPosture

# Of mjStatistic; the mean inertia scales the tolerance of the solver.
_STATISTICS = ("meaninertia", "meanmass", "meansize", "extent", "center")
# Arrays over meshes: a model may have more of them than it uses.
# Arrays of the mesh of the surface, which stays that of the first anatomy, and of the
# tree of its triangles, which follows those of the bodies.
_OF_MESH, _TREES = "mesh_", "bvh_"
_UNSEEN = 1e-4  # m, size of what stands for the surface of any other


Fields = Mapping[str, np.ndarray]


class Case:
    """One anatomy of a task, as an episode needs it."""

    def __init__(
        self,
        scene: Scene,
        objective: Objective,
        model: mujoco.MjModel,
        fluoroscopy: FluoroscopyOptions | None = None,
        fields: Fields | None = None,
        start_along_route: Sequence[float] | None = None,
    ):
        """Lets the device settle in the anatomy.

        Args:
            scene: Entities and where they stand.
            objective: Success and reward.
            model: The compiled scene.
            fluoroscopy: Set-up of the angiography machine, None for no machine.
            fields: What `write` writes, by name in MuJoCo's model.
            start_along_route: As in `NavigationConfig`.
        """
        self.scene = scene
        self.objective = objective
        index = model_index(scene, model)
        devices_of(scene.catheter).settle(model)
        self.start = StartPosture(scene, model, index, start_along_route)
        self._fluoroscopy = fluoroscopy
        self._fields = fields or {}

    def write(self, model: mujoco.MjModel) -> None:
        """Puts the anatomy into a model of the task, in place of the one in it."""
        for name, value in self._fields.items():
            if name in _STATISTICS:
                setattr(model.stat, name, value)
            else:
                getattr(model, name)[: len(value)] = value

    @functools.cached_property
    def angiograph(self) -> Angiograph | None:
        """The angiography machine before this anatomy; None where there is none."""
        if self._fluoroscopy is None:
            return None
        surface = self.scene.anatomy.surface
        return Angiograph(surface.vertices, surface.faces, self._fluoroscopy)

    @property
    def nbytes(self) -> int:
        """Memory of the fields that `write` writes, bytes."""
        return sum(np.asarray(value).nbytes for value in self._fields.values())


def model_index(scene: Scene, model: mujoco.MjModel) -> ModelIndex:
    """Places of a task's quantities in a compiled scene."""
    return ModelIndex(model, scene.catheter, scene.robot)


def compile_together(
    scenes: Sequence[Scene],
    objectives: Sequence[Objective],
    fluoroscopy: FluoroscopyOptions | None = None,
    start_along_route: Sequence[float] | None = None,
) -> tuple[Case, ...]:
    """Compiles scenes so that any of them can be written into a model of the first.

    The first scene alone is drawn with its surface: a model holds one mesh of it.

    Args:
        scenes: Scenes of one device, not compiled yet.
        objectives: Success and reward in each of them.
        fluoroscopy: Set-up of the angiography machines, None for none.
        start_along_route: As in `NavigationConfig`.

    Raises:
        ValueError: if the scenes differ in more than wall and places.
    """
    host, *models = (_compiled(scene, scene is scenes[0]) for scene in scenes)
    fields = _differences(host, models, [scene.anatomy.name for scene in scenes])
    return tuple(
        Case(scene, objective, model, fluoroscopy, own, start_along_route)
        for scene, objective, model, own in zip(
            scenes, objectives, (host, *models), fields, strict=True
        )
    )


def _compiled(scene: Scene, drawn: bool) -> mujoco.MjModel:
    """The model of a scene, with the mesh of its surface or with nothing there."""
    root = scene.arena.mjcf_model
    spec = mujoco.MjSpec.from_string(root.to_xml_string(), assets=root.get_assets())
    if not drawn:
        geom = spec.geom(scene.phantom.surface.full_identifier)
        mesh = spec.mesh(geom.meshname)
        geom.meshname, geom.type = "", mujoco.mjtGeom.mjGEOM_SPHERE
        geom.size, geom.rgba = [_UNSEEN, 0, 0], [0, 0, 0, 0]
        spec.delete(mesh)
    return spec.compile()


def _differences(
    host: mujoco.MjModel, models: Sequence[mujoco.MjModel], names: Sequence[str]
) -> list[Fields]:
    """What to write into the host for itself and each model; the same for all."""
    differing = {}
    for name in _array_names(host):
        room = getattr(host, name)
        values = [getattr(model, name) for model in models]
        size = len(values[0]) if name.startswith(_TREES) else len(room)
        for value, anatomy in zip(values, names[1:], strict=True):
            if value.shape != (size, *room.shape[1:]):
                raise ValueError(
                    f"{anatomy!r} cannot take turns with {names[0]!r}: {name} has the "
                    f"shape {value.shape}, and {room.shape} there; give anatomies with "
                    "as many goals, and one device of one length"
                )
        if not all(np.array_equal(room[:size], value) for value in values):
            differing[name] = size
    for model, anatomy in zip(models, names[1:], strict=True):
        _check_names(host, model, anatomy)
    return [
        {name: getattr(model, name)[:size].copy() for name, size in differing.items()}
        | {name: np.copy(getattr(model.stat, name)) for name in _STATISTICS}
        for model in (host, *models)
    ]


def _array_names(model: mujoco.MjModel) -> list[str]:
    """Names of the arrays of a model that are no text."""
    return [
        name
        for name in dir(model)
        if not name.startswith(("_", "name", "path", "text", _OF_MESH))
        and isinstance(getattr(model, name), np.ndarray)
    ]


def _check_names(host: mujoco.MjModel, model: mujoco.MjModel, anatomy: str) -> None:
    """Raises if what has a number in one model has another one in the other."""
    for kind, count in (
        ("body", model.nbody),
        ("joint", model.njnt),
        ("geom", model.ngeom),
        ("site", model.nsite),
        ("actuator", model.nu),
        ("sensor", model.nsensor),
    ):
        for index in range(count):
            theirs = getattr(model, kind)(index).name
            ours = getattr(host, kind)(index).name
            if theirs != ours:
                raise ValueError(
                    f"{anatomy!r} cannot take turns with the first anatomy: {kind} "
                    f"{index} is {theirs!r}, and {ours!r} there; give anatomies with "
                    "the same goals"
                )
