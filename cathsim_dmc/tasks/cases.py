"""Cases of a task: anatomies that share one compiled model.

Each anatomy is compiled once. A case keeps the fields in which its model differs from
that of the first anatomy, and writes them into that model, so all bindings stay valid.
"""

import dataclasses
import functools
from collections.abc import Iterable, Sequence
from typing import cast

import mujoco
import numpy as np

from cathsim_dmc import bounds
from cathsim_dmc.entities.device_stack import DeviceStack
from cathsim_dmc.imaging import views
from cathsim_dmc.imaging.angiograph import Angiograph
from cathsim_dmc.imaging.options import FluoroscopyOptions
from cathsim_dmc.physics.chain_fields import write_still
from cathsim_dmc.physics.randomisation import Randomisation
from cathsim_dmc.physics.readings import ModelIndex
from cathsim_dmc.tasks.config import NavigationConfig
from cathsim_dmc.tasks.judging import Groups
from cathsim_dmc.tasks.objectives import Cannulation, Objective, Shiftable
from cathsim_dmc.tasks.scene import Scene
from cathsim_dmc.tasks.start import StartPosture

# Fields of mjStatistic; the mean inertia scales the tolerance of the solver.
_STATISTICS = ("meaninertia", "meanmass", "meansize", "extent", "center")
# Prefixes of fields that are not compared: texts, and meshes, since only the first
# anatomy has that of the surface; and of bounding volume trees, in which those of
# meshes come last.
_APART, _TREES = ("_", "name", "path", "text", "mesh_"), "bvh_"
# Kinds of geoms whose data are a mesh.
_WITH_MESH = mujoco.mjtGeom.mjGEOM_MESH, mujoco.mjtGeom.mjGEOM_SDF

Fields = dict[str, np.ndarray]


class Case:
    """One anatomy of a task, with objective, start posture and model fields."""

    def __init__(
        self,
        scene: Scene,
        objective: Objective,
        model: mujoco.MjModel,
        config: NavigationConfig,
        fields: Fields | None = None,
    ):
        """Settles the device; `fields` are the model fields that `write` copies."""
        self.scene, self.objective = scene, objective
        index = ModelIndex(model, scene.catheter, scene.robot)
        if isinstance(scene.catheter, DeviceStack):
            write_still(scene.catheter, model)
        self.start = StartPosture(scene, model, index, config)
        self._fluoroscopy = config.fluoroscopy
        self.fields = fields or {}
        self._statistics = {n: np.copy(getattr(model.stat, n)) for n in _STATISTICS}

    def write(self, model: mujoco.MjModel) -> None:
        """Writes the anatomy into a model of the task; replaces the present one."""
        self.write_statistics(model)
        for name, value in self.fields.items():
            getattr(model, name)[: len(value)] = value

    def write_statistics(self, model: mujoco.MjModel) -> None:
        """Writes MuJoCo's statistics of this anatomy into a model of the task."""
        for name, value in self._statistics.items():
            setattr(model.stat, name, value)

    @functools.cached_property
    def fluoroscopy(self) -> FluoroscopyOptions:
        """Options of the machine; angles replace "best"."""
        return views.settled(self.scene.anatomy.surface, self._fluoroscopy)

    @functools.cached_property
    def angiograph(self) -> Angiograph:
        """Angiography machine that images this anatomy."""
        return Angiograph(self.scene.anatomy.surface, self.fluoroscopy)


def objectives_of(
    cases: Sequence[Case], drawn: np.ndarray, shift: np.ndarray | None = None
) -> tuple[Groups, np.ndarray]:
    """Returns the objectives of N simulations, and their goals.

    Args:
        drawn: (N,) int, number of each simulation's case.
        shift: (N,), shifts of the goals along their branches, m; None for none.

    Returns:
        objectives: Each with the rows of its simulations.
        goals: (N, 3) m, in the vessel at rest, world frame.
    """
    found: list[tuple[Objective, np.ndarray | slice]] = []
    goals = np.empty((len(drawn), 3))
    numbers = np.unique(drawn)
    for number in numbers:
        objective, rows = cases[number].objective, slice(None)
        if len(numbers) > 1:
            rows = np.flatnonzero(drawn == number)
        if shift is not None:
            # `check_shift` has found that it can be shifted.
            objective = cast(Shiftable, objective).shifted(shift[rows])
        found.append((objective, rows))
        goals[rows] = objective.goal
    return found, goals


def check_parts(objective: Objective) -> None:
    """Raises ValueError if an objective lacks an attribute, or its goal is no place."""
    name = type(objective).__name__
    parts = "goal", "goal_radius", "terms", "outcome", "path_distance"
    if lacking := [part for part in parts if not hasattr(objective, part)]:
        raise ValueError(
            f"the objective {name} lacks {', '.join(lacking)}; an objective has "
            f"{', '.join(parts)}, see tasks.objectives.Objective"
        )
    shape = (3,) if np.shape(objective.goal) == (3,) else (-1, 3)
    bounds.array(f"the goal of {name}", objective.goal, shape=shape)


def check_objective(objective: Objective, scene: Scene) -> None:
    """Raises ValueError if an objective lacks a part, or is that of another scene."""
    check_parts(objective)
    if not isinstance(objective, Cannulation):
        return
    anatomy, goal, kind = scene.anatomy, scene.goal, type(objective).__name__
    line, own = objective.branch, anatomy.tree.vessel(goal.vessel).centreline
    depths = anatomy.lumen(np.reshape(objective.goal, (-1, 3)))
    if not np.array_equal(line.points, own.points) or not (depths > 0.0).all():
        raise ValueError(
            f"the objective is a {kind} with the goal "
            f"{np.round(objective.goal, 4).tolist()} m, but the scene has the goal "
            f"{goal.name!r} of {anatomy.name!r}; give {kind}.to(scene.anatomy, "
            "scene.goal)"
        )


def check_shift(objective: Objective, ranges: Randomisation) -> None:
    """Raise ValueError if an objective does not support the shifts of its goal."""
    if ranges.goal_shift and not isinstance(objective, Shiftable):
        raise ValueError(
            f"randomisation shifts the goal, but {type(objective).__name__} has no "
            "shifted(shift): derive it from tasks.objectives.Shiftable, or leave "
            "goal_shift out"
        )
    own = isinstance(objective, Cannulation) and objective.goal_arc_length is None
    if ranges.farthest_shift and own:
        raise ValueError(
            "randomisation shifts the goal away from the ostium, but the route of "
            f"{type(objective).__name__} ends at the goal: give the function of the "
            "task's objective a keyword farthest_shift and hand it on to "
            "Cannulation.to, or leave goal_shift out"
        )


def compile_together(
    scenes: Iterable[tuple[Scene, Objective]], config: NavigationConfig
) -> tuple[Case, ...]:
    """Compiles scenes so that any of them can be written into a model of the first.

    Args:
        scenes: Scenes of one device, not compiled yet, with their objectives; only the
            first one has the mesh of the lumen's surface, see `Scene.build`.
        config: Options of the task.

    Raises:
        ValueError: if the scenes differ in more than wall and places, or were built
            with other options, or an objective is that of another scene.
    """
    found: list[Case] = []
    sizes: dict[str, int] = {}  # lengths of the fields that differ in any case
    first, host = None, None
    for scene, objective in scenes:
        scene.check(config)
        check_objective(objective, scene)
        root = scene.arena.mjcf_model
        root.option.timestep = config.physics_timestep
        spec = mujoco.MjSpec.from_string(root.to_xml_string(), assets=root.get_assets())
        model, fields = spec.compile(), {}
        if first is None or host is None:
            first, host = scene, model
        else:
            fields = _differences(host, model, scene, first)
            sizes |= {name: len(value) for name, value in fields.items()}
        case = Case(scene, objective, model, config, fields)
        # The case shares the entities of the first scene, to which the model belongs.
        own = {"anatomy": scene.anatomy, "goal": scene.goal}
        case.scene = dataclasses.replace(first, placement=scene.placement, **own)
        scene.anatomy.lumen.release()
        found.append(case)
    for case in found:
        for name, size in sizes.items():
            case.fields.setdefault(name, getattr(host, name)[:size].copy())
    return tuple(found)


def _differences(
    host: mujoco.MjModel, model: mujoco.MjModel, scene: Scene, first: Scene
) -> Fields:
    """Returns copies of the model's fields that differ from those of the host."""
    names = f"{scene.anatomy.name!r} cannot share a model with {first.anatomy.name!r}"
    fields: Fields = {}
    numbers, trees = _mesh_numbers(host, model, names), model.body_bvhnum.sum()
    for name in dir(host):
        room, value = getattr(host, name), getattr(model, name)
        if name.startswith(_APART) or not isinstance(room, np.ndarray):
            continue
        if name.startswith(_TREES):
            room, value = room[:trees], value[:trees]
        elif name == "geom_dataid":
            value = numbers
        if value.shape != room.shape:
            raise ValueError(
                f"{names}: {name} has the shape {value.shape}, and {room.shape} "
                "there; give anatomies with as many goals, one device of one length, "
                "scenes after the first that are not drawn, and all scenes the same "
                "bodies of your own"
            )
        if not np.array_equal(room, value):
            fields[name] = value.copy()
    ours, theirs = (
        [one.site(index).name for index in range(one.nsite)] for one in (host, model)
    )
    if ours != theirs:
        raise ValueError(f"{names}: {theirs} are not {ours}; give the same goals")
    return fields


def _mesh_numbers(
    host: mujoco.MjModel, model: mujoco.MjModel, names: str
) -> np.ndarray:
    """Returns the numbers (G,) in the host of the meshes of a model's geoms.

    ValueError for a mesh that the host lacks or has with another shape.
    """
    there = {host.mesh(number).name: number for number in range(host.nmesh)}
    found = model.geom_dataid.copy()
    for number in range(model.nmesh):
        name = model.mesh(number).name
        if name not in there or not all(
            map(np.array_equal, _mesh(model, number), _mesh(host, there[name]))
        ):
            raise ValueError(
                f"{names}: there is no such mesh {name!r} there; give all scenes the "
                "same meshes of your own, of which a geom may show another in each"
            )
        shown = np.isin(model.geom_type, _WITH_MESH) & (model.geom_dataid == number)
        found[shown] = there[name]
    return found


def _mesh(model: mujoco.MjModel, number: int) -> tuple[np.ndarray, np.ndarray]:
    """Returns the vertices (V, 3), m, and triangles (F, 3) of a mesh."""
    first, count = model.mesh_vertadr[number], model.mesh_vertnum[number]
    start, size = model.mesh_faceadr[number], model.mesh_facenum[number]
    return model.mesh_vert[first:][:count], model.mesh_face[start:][:size]
