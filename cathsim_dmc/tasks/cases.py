"""Cases of a task: anatomies that take turns in one compiled model.

All anatomies are compiled once. Wherever their models differ, in the pieces of the wall
and in where device and sheath stand, the fields are kept and written into a model that
has room for any of them: nothing is compiled when an episode gets another anatomy, and
everything that was bound to the model stays bound.
"""

import functools
from collections.abc import Mapping, Sequence

import mujoco
import numpy as np
from dm_control import mjcf

from cathsim_dmc.entities.contact import wall_contact
from cathsim_dmc.entities.phantom import piece_name
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
_ROOMY = ("mesh_", "bvh_")
_FILLER_SIZE = 1e-3  # m
# How often the filler mesh may turn out too small; it grows by half each time.
_ATTEMPTS = 6
# Entries that a vertex of a filler mesh adds at least, or about.
_PER_VERTEX = {
    "nmeshvert": 1,
    "nmeshnormal": 1,
    "nmeshface": 2,
    "nmeshgraph": 5,
    "nmeshpoly": 1,
    "nmeshpolyvert": 4,
    "nmeshpolymap": 4,
    "nbvh": 4,
}

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

    The first scene gets fillers: geoms until it has as many as any other, one of them
    with a mesh that makes room for the meshes of the others.

    Args:
        scenes: Scenes of one device, not compiled yet.
        objectives: Success and reward in each of them.
        fluoroscopy: Set-up of the angiography machines, None for none.
        start_along_route: As in `NavigationConfig`.

    Raises:
        ValueError: if the scenes differ in more than wall and places.
    """
    _share_pairs([scene.arena.mjcf_model for scene in scenes])
    pieces = 1 + max(len(scene.anatomy.wall) for scene in scenes)
    models = [_filled(scene, pieces) for scene in scenes]
    host = _make_room(scenes[0], pieces, models)
    fields = _differences(host, models, [scene.anatomy.name for scene in scenes])
    return tuple(
        Case(scene, objective, model, fluoroscopy, own, start_along_route)
        for scene, objective, model, own in zip(
            scenes, objectives, models, fields, strict=True
        )
    )


def _share_pairs(roots: Sequence[mjcf.RootElement]) -> None:
    """Lists in every scene the pairs of links and rods that are listed in any.

    How far the device starts in the vessel decides which links can meet the sheath. A
    pair that cannot meet costs a test and nothing else.
    """
    pairs = {pair.name: pair for root in roots for pair in root.contact.pair}
    for root in roots:
        listed = {pair.name for pair in root.contact.pair}
        for name in sorted(set(pairs) - listed):
            attributes = dict(pairs[name].get_attributes())
            for key in ("geom1", "geom2"):
                attributes[key] = root.find("geom", attributes[key].full_identifier)
            root.contact.add("pair", **attributes)


def _spec(scene: Scene) -> mujoco.MjSpec:
    root = scene.arena.mjcf_model
    return mujoco.MjSpec.from_string(root.to_xml_string(), assets=root.get_assets())


def _corner(scene: Scene) -> np.ndarray:
    """A place (3,) that no device comes to, m."""
    return scene.anatomy.surface.vertices.min(0)


def _filled(scene: Scene, pieces: int) -> mujoco.MjModel:
    """The compiled scene with geoms that touch nothing, up to a number of pieces."""
    spec = _spec(scene)
    for index in range(len(scene.anatomy.wall), pieces):
        spec.worldbody.add_geom(
            name=piece_name(index),
            type=mujoco.mjtGeom.mjGEOM_SPHERE,
            size=[_FILLER_SIZE, 0, 0],
            pos=_corner(scene),
            contype=0,
            conaffinity=0,
            mass=0,
            group=3,
        )
    return spec.compile()


def _make_room(
    scene: Scene, pieces: int, models: Sequence[mujoco.MjModel]
) -> mujoco.MjModel:
    """Adds fillers to a scene until its model has room for all; returns the model."""
    root, first = scene.arena.mjcf_model, len(scene.anatomy.wall)
    needed = {name: max(getattr(m, name) for m in models) for name in _PER_VERTEX}
    least = max(
        (size - getattr(models[0], name)) / _PER_VERTEX[name]
        for name, size in needed.items()
    )
    # A filler mesh of its own for each piece that the scene has too few, so that there
    # are as many meshes, and the room is shared among them.
    count = max(model.nmesh for model in models) - models[0].nmesh + 1
    vertices = max(16, int(1.3 * least / count) + 1)
    meshes = [
        root.asset.add(
            "mesh", name=piece_name(first + index), inertia="shell", vertex=[0] * 12
        )
        for index in range(count)
    ]
    for index in range(first, pieces):
        mesh = meshes[min(index - first, count - 1)]
        root.worldbody.add(
            "geom",
            name=piece_name(index),
            type="mesh",
            mesh=mesh,
            pos=_corner(scene),
            # Its hull is computed only if it can touch something.
            **wall_contact(0.0),
            mass=0,
            group=3,
        )
    for _ in range(_ATTEMPTS):
        for mesh in meshes:
            mesh.vertex = _ball(vertices).ravel()
        host = _spec(scene).compile()
        if all(getattr(host, name) >= size for name, size in needed.items()):
            return host
        vertices += vertices // 2
    raise RuntimeError(f"a model with {needed} cannot be filled up from {scene}")


def _ball(count: int) -> np.ndarray:
    """Points (count, 3) spread over a sphere, m."""
    number = np.arange(count) + 0.5
    height = 1 - 2 * number / count
    angle = np.pi * (1 + np.sqrt(5)) * number
    ring = np.sqrt(1 - height**2)
    points = np.stack([ring * np.cos(angle), ring * np.sin(angle), height], axis=-1)
    return _FILLER_SIZE * points


def _differences(
    host: mujoco.MjModel, models: Sequence[mujoco.MjModel], names: Sequence[str]
) -> list[Fields]:
    """What to write into the host for each model; the same fields for all."""
    differing = []
    for name in _array_names(host):
        room = getattr(host, name)
        values = [getattr(model, name) for model in models]
        for value, anatomy in zip(values, names, strict=True):
            fits = value.shape == room.shape or (
                name.startswith(_ROOMY)
                and value.shape[1:] == room.shape[1:]
                and len(value) <= len(room)
            )
            if not fits:
                raise ValueError(
                    f"{anatomy!r} cannot take turns with {names[0]!r}: {name} has the "
                    f"shape {value.shape}, and {room.shape} there; give anatomies with "
                    "as many goals, and one device of one length"
                )
        if not all(np.array_equal(room[: len(v)], v) for v in values):
            differing.append(name)
    for model, anatomy in zip(models, names, strict=True):
        _check_names(host, model, anatomy)
    return [
        {name: getattr(model, name).copy() for name in differing}
        | {name: np.copy(getattr(model.stat, name)) for name in _STATISTICS}
        for model in models
    ]


def _array_names(model: mujoco.MjModel) -> list[str]:
    """Names of the arrays of a model that are no text."""
    return [
        name
        for name in dir(model)
        if not name.startswith(("_", "name", "path", "text", "mesh_path"))
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
