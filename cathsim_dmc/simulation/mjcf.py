"""A task as files: the scene as MJCF, and what another program needs to run it.

MuJoCo's viewer, its WebAssembly build (as on the page in the browser) and other engines
read the scene.
"""

import itertools
import json
import os
from collections.abc import Iterator, Mapping
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
from dm_control import mjcf
from lxml import etree

from cathsim_dmc import bounds, suite
from cathsim_dmc.anatomy.export import check_wall, wall_pieces
from cathsim_dmc.entities.sheath import CLEARANCE, Sheath
from cathsim_dmc.files import as_path, atomic_directory, require_place
from cathsim_dmc.physics.forces import CONTACT_SIZE
from cathsim_dmc.tasks.navigation import Navigation
from cathsim_dmc.tasks.objectives import Cannulation
from cathsim_dmc.tasks.scene import Scene, chosen_devices

FORMAT = 2
SCENE, TASK = "scene.xml", "task.json"
# Methods of a cannulation that decide what success is.
_RULE = "outcome", "success", "failure", "distance", "in_branch"
_SIDE = 8e-3  # m, thickness of the boxes around the bore of the sheath


def write_mjcf(
    task: str,
    directory: str | os.PathLike[str],
    *,
    seed: int = 0,
    wall: str = "merged",
    task_kwargs: Mapping[str, Any] | None = None,
) -> Path:
    """Write the scene of a task and the start of one of its episodes.

    `scene.xml` is a file of plain MuJoCo, beside files with meshes of your own bodies:
    convex pieces replace the wall, and boxes the bore of the sheath, whose fields only
    this package can read. With the same actions it moves nearly as a task with the same
    `sheath_clearance` does, by default that of `entities.sheath.CLEARANCE`. The
    keyframe "start" is the start of the episode. `task.json` has the rest, see
    `describe`.

    Coaxial devices are one chain whose model fields change in every control step; the
    file has the fields at the start. A compliant or moving wall is rigid and at rest in
    the file, and its blood does not flow; delays of the action and a user's own effects
    are left out.

    Args:
        directory: Directory to write, which must not exist.
        wall: How the wall is divided, see `anatomy.export.wall_pieces`.

    Returns:
        The directory.

    Raises:
        ValueError: the task or an option does not exist, or the task has no single
            scene because each episode draws its anatomy.
        FileExistsError: the directory exists.
        ModuleNotFoundError: CoACD is selected and not installed.
    """
    directory = as_path("directory", directory)
    if directory.exists():
        raise FileExistsError(f"{directory} exists; give a directory that does not")
    require_place(directory.parent)
    bounds.choice("task", task, suite.SUITE)
    check_wall(wall)
    options = bounds.options("task_kwargs", task_kwargs)
    options["random"] = bounds.seed("seed", seed)
    if options.get("sheath_clearance") is None:
        # A bare `mj_step` does not update the hinges that hold a device in the sheath.
        options["sheath_clearance"] = CLEARANCE
    env = suite.load(suite.DOMAIN, task, options)
    if env.task.num_anatomies > 1:
        raise ValueError(
            f"{task} draws from {env.task.num_anatomies} anatomies; give one anatomy, "
            "or pool=1 of random arches, for the scene of one"
        )
    env.reset()
    values = {"name": task, "seed": options["random"], **describe(env)}
    directory.parent.mkdir(parents=True, exist_ok=True)
    with atomic_directory(directory) as folder:
        mjcf.export_with_assets(env.task.root_entity.mjcf_model, folder, SCENE)
        drawn = env.physics.model.ptr.geom("wall").friction
        _in_one_file(folder / SCENE, env.task.scene, wall, drawn)
        chain = env.task.scene.catheter.mjcf_model.model
        _at_its_start(folder / SCENE, env.physics, f"{chain}/")
        (folder / TASK).write_text(json.dumps(values, indent=1) + "\n")
    return directory


def describe(env: Any) -> dict[str, Any]:
    """Describes a task for a program that runs it as the suite does, in SI units.

    Args:
        env: Environment of `suite.load`, at the start of an episode.

    Returns:
        "qpos" (the start, at rest), "control_timestep" and "substeps" (`mj_step` with
        the same control, after `physics.drives.Drives.follow`), "actuators" (order of
        the action, which is the control),
        "links" (bodies from base to tip), "head" (site), "insertion" (joint),
        "sensors" (name by quantity, and "contact_size", the numbers a contact takes in
        the sensor of the wall: found, force, dist, pos, normal, tangent), "goal" and
        "branch" (success: the head is within the goal's radius, nearer to the branch's
        centreline than its radius there, and past its ostium; "branch" is None for an
        objective of your own with another success or a failure), "max_steps",
        "device_radius", "devices" (from the innermost outwards; of several the
        actuators move their combined chain) and "versions".
    """
    task: Navigation = env.task
    scene, data, objective = task.scene, env.physics.data, task.objective
    catheter = scene.catheter
    return {
        "format": FORMAT,
        "qpos": data.qpos.tolist(),
        "control_timestep": task.control_timestep,
        "substeps": task.substeps,
        "max_steps": task.config.max_steps,
        "actuators": [each.full_identifier for each in catheter.actuators],
        "tip_joints": len(catheter.tip_motors) // 2,
        "rotation": catheter.rotation is not None,
        "links": [each.full_identifier for each in catheter.links],
        "head": catheter.head.full_identifier,
        "insertion": catheter.insertion.full_identifier,
        "device_radius": scene.catheter.device.outer_radius,
        "devices": [one.name for one in chosen_devices(task.config)],
        "sensors": {
            "wall_contacts": "wall_contacts",
            "load_cell": "load_cell",
            "push_force": f"{catheter.mjcf_model.model}/push_force",
        },
        "contact_size": CONTACT_SIZE,
        "goal": {
            "name": scene.goal.name,
            "position": task.goal_position.tolist(),
            "radius": float(objective.goal_radius),
        },
        "branch": _branch(objective),
        "versions": {
            name: metadata.version(name) for name in ("cathsim-dmc", "mujoco")
        },
    }


def _at_its_start(path: Path, physics: Any, chain: str) -> None:
    """Writes the present model fields of a chain, and the state as a keyframe.

    Args:
        chain: Prefix of the names of its elements.
    """
    tree, model, data = etree.parse(str(path)), physics.model.ptr, physics.data
    named: dict[str, list[Any]] = {kind: [] for kind in ("body", "joint", "geom")}
    for one in tree.find("worldbody").iter(*named):
        if (one.get("name") or "").startswith(chain):
            named[one.tag].append(one)
    for one in named["joint"]:
        joint = model.joint(one.get("name"))
        dof, place = joint.dofadr[0], joint.qposadr[0]
        one.set("stiffness", _text(joint.stiffness, 17))
        one.set("damping", _text(model.dof_damping[dof], 17))
        one.set("springref", _text(model.qpos_spring[place], 17))
    for one in named["geom"]:
        geom = model.geom(one.get("name"))
        own = one.get("size", "").split()
        one.set("size", " ".join([_text(geom.size[:1], 17), *own[1:]]))
        one.set("friction", _text(geom.friction, 17))
    for one in tree.find("actuator"):
        if one.get("name").startswith(chain):  # their torques scale with the stiffness
            gain = model.actuator(one.get("name")).gainprm
            one.set("gainprm", _text(gain, 17))
    for one in named["body"]:
        body = model.body(one.get("name"))
        one.set("gravcomp", _text(model.body_gravcomp[body.id], 17))
        if body.mass[0]:
            for old in one.findall("inertial"):
                one.remove(old)
            numbers = {"pos": body.ipos, "quat": body.iquat, "mass": body.mass}
            numbers["diaginertia"] = body.inertia
            values = {name: _text(value, 17) for name, value in numbers.items()}
            one.insert(0, etree.Element("inertial", values))
    fields = {"qpos": data.qpos, "qvel": data.qvel, "act": data.act, "ctrl": data.ctrl}
    fields |= {"mpos": data.mocap_pos, "mquat": data.mocap_quat}
    state = {name: _text(value, 17) for name, value in fields.items() if value.size}
    keyframe = etree.SubElement(tree.getroot(), "keyframe")
    etree.SubElement(keyframe, "key", {"name": "start", **state})
    tree.write(str(path))


def _in_one_file(path: Path, scene: Scene, wall: str, friction: np.ndarray) -> None:
    """Writes surface and convex wall into the scene; drops classes of textures.

    MuJoCo up to 3.14 refuses a defaults class of textures. PyMJCF names a class in
    every element but defines none for textures, so nothing is lost.

    Args:
        wall: How the wall is divided.
        friction: (3,) coefficients of the wall in the present episode.
    """
    tree = etree.parse(str(path))
    for texture in tree.iter("texture"):
        texture.attrib.pop("class", None)
    surface = scene.anatomy.surface
    # Meshes of bodies that a user has added keep their files.
    lumen = scene.phantom.mjcf_model.find("mesh", "lumen")
    mesh = tree.find(f"asset/mesh[@name='{lumen.full_identifier}']")
    (path.parent / mesh.attrib.pop("file")).unlink()
    mesh.set("vertex", _text(surface.vertices.astype(np.float32)))
    mesh.set("face", " ".join(map(str, surface.faces.ravel().tolist())))
    carrier = tree.find(".//geom[@name='wall']")
    for number, piece in enumerate(wall_pieces(scene.anatomy, wall)):
        name = f"wall_{number:03d}"
        etree.SubElement(
            tree.find("asset"), "mesh", name=name, vertex=_text(piece), inertia="shell"
        )
        geom = etree.SubElement(carrier.getparent(), "geom", dict(carrier.attrib))
        geom.attrib.update({"name": name, "type": "mesh", "mesh": name, "group": "3"})
        geom.set("friction", _text(friction, 17))
        for attribute in ("pos", "size", "user"):
            del geom.attrib[attribute]
    carrier.getparent().remove(carrier)
    carrier = tree.find(f".//geom[@name='{scene.sheath.bore.full_identifier}']")
    for number, side in enumerate(_sides(scene.sheath)):
        geom = etree.SubElement(carrier.getparent(), "geom", dict(carrier.attrib))
        name = f"{carrier.get('name')}_{number}"
        geom.attrib.update({"name": name, "group": "3", **side})
        del geom.attrib["user"]
    carrier.getparent().remove(carrier)
    tree.write(str(path))


def _text(values: np.ndarray, digits: int = 9) -> str:
    """Numbers as text; nine digits are exact for float32, 17 for float64."""
    return " ".join(f"{x:.{digits}g}" for x in np.ravel(values).tolist())


def _sides(sheath: Sheath) -> Iterator[dict[str, str]]:
    """Attributes of boxes around the straight pieces of a sheath's bore."""
    for start, stop in itertools.pairwise(sheath.vertices):
        along = (stop - start) / np.linalg.norm(stop - start)
        first = np.cross(along, np.eye(3)[np.argmin(np.abs(along))])
        first /= np.linalg.norm(first)
        half = (
            _SIDE / 2,
            sheath.bore_radius + _SIDE,
            float(np.linalg.norm(stop - start)) / 2,
        )
        for turn in range(4):
            angle = turn * np.pi / 2
            out = np.cos(angle) * first + np.sin(angle) * np.cross(along, first)
            middle = (start + stop) / 2 + (sheath.bore_radius + _SIDE / 2) * out
            yield {
                "type": "box",
                "pos": _text(middle),
                "xyaxes": _text(np.concatenate([out, np.cross(along, out)])),
                "size": _text(np.array(half)),
            }


def _branch(objective: Any) -> dict[str, Any] | None:
    """Centreline of the target branch; None for objectives with another success."""
    same = (getattr(type(objective), n, None) is getattr(Cannulation, n) for n in _RULE)
    if not all(same):
        return None
    line = objective.branch
    return {
        "points": line.points.tolist(),
        "radii": line.radii.tolist(),
        "ostium": float(objective.ostium),
    }
