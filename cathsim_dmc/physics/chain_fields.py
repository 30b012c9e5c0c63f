"""Local properties of the chain of coaxial devices, written into a model's fields."""

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from cathsim_dmc.compiled import compiled
from cathsim_dmc.entities import coaxial_loops
from cathsim_dmc.entities.device_stack import DeviceStack
from cathsim_dmc.laws.hinges import unloaded_hinges
from cathsim_dmc.physics.readings import ids

# Fields of the model that change as the devices slide. The constants that MuJoCo
# derives from masses (`body_invweight0`, ...) stay those of the start: the armature of
# the hinges outweighs the links in them a thousand times.
FIELDS = (
    "jnt_stiffness",
    "dof_damping",
    "qpos_spring",
    "geom_size",
    "geom_rbound",
    "geom_aabb",
    "geom_friction",
    "body_mass",
    "body_inertia",
    "body_subtreemass",
    "body_gravcomp",
)


def places_of(model: mujoco.MjModel, chain: DeviceStack) -> tuple:
    """Places of the elements of a chain in a compiled model, which `write` takes.

    Returns:
        (3,) first hinge among joints, degrees of freedom and positions; number of the
        first link; (L,) geoms of the links; (L,) which of a link's axes of inertia lies
        along it; (L,) half lengths of their cylinders, m; (K,) relaxation times of the
        materials, physics step, s.
    """
    bodies, joints = ids(model, chain.links), np.sort(ids(model, chain.bends))
    places = [joints, model.jnt_dofadr[joints], model.jnt_qposadr[joints]]
    # Both kinds of elements follow each other, from proximal to distal.
    if any((np.diff(each) != 1).any() for each in [bodies, *places]):
        raise ValueError(f"the links of {chain!r} do not follow each other")
    hinges = np.array([each[0] for each in places], dtype=np.intp)
    geoms = ids(model, chain.link_geoms).astype(np.intp)
    half_lengths = model.geom_size[geoms, 1].copy()
    # MuJoCo orders the axes of inertia in its own way.
    axes = model.body_inertia[bodies].argmin(axis=-1)
    material = chain.rods.times, chain.timestep
    return hinges, int(bodies[0]), geoms, axes, half_lengths, *material


def write_still(
    entity: DeviceStack,
    model: mujoco.MjModel,
    gaps: ArrayLike | None = None,
    rotation: ArrayLike | None = None,
) -> None:
    """Writes into a model the properties of the chain while the devices stand still.

    Args:
        gaps: (K,), way from the end of each device to that of the chain, m; those at
            the start of an episode if None.
        rotation: (K,), of each device, not twisted, rad; 0 if None.
    """
    stack = entity.stack
    turns = np.zeros((len(entity.devices), len(stack.spans)))
    if rotation is not None:
        turns += np.asarray(rotation)[:, None]
    overlap = stack.overlap(entity.start_gaps if gaps is None else gaps)
    rest = np.empty((len(stack.spans), 2))
    unloaded_hinges(coaxial_loops.rest_angles(overlap.rest, turns), rest)
    links = stack.links(overlap, entity.friction)
    fields = tuple(getattr(model, name) for name in FIELDS)
    write(fields, places_of(model, entity), overlap, rest, links, np.ones(2))


@compiled
def write(fields, places, overlap, rest, links, factors):
    """Writes the properties of a chain into the fields of a model.

    Args:
        fields: live `FIELDS`.
        places: of `places_of`.
        overlap: of the devices.
        rest: (J, 2), angles of the free hinges about x and y, rad.
        links: properties of the links.
        factors: (2,), of all stiffnesses, and of all loss factors.
    """
    hinges, bodies, geoms, axes, half_lengths, times, timestep = places
    jnt_stiffness, dof_damping, qpos_spring = fields[:3]
    geom_size, geom_rbound, geom_aabb, geom_friction = fields[3:7]
    body_mass, body_inertia, body_subtreemass, body_gravcomp = fields[7:]
    for j in range(len(rest)):
        stiffness = factors[0] / overlap.compliance[j]
        total, material = 0.0, 0.0
        for k in range(len(times)):
            total += overlap.stiffness[k, j]
        for k in range(len(times)):
            material += times[k] * (overlap.stiffness[k, j] / total)
        # See `chain.hinge_time`.
        damping = max(factors[1] * material - timestep, 0.0) * stiffness
        for axis in range(2):
            hinge = 2 * j + (axis + j) % 2  # see `posture.x_first`
            jnt_stiffness[hinges[0] + hinge] = stiffness
            dof_damping[hinges[1] + hinge] = damping
            qpos_spring[hinges[2] + hinge] = rest[j, axis]
    beyond = 0.0
    for link in range(len(geoms) - 1, -1, -1):
        geom, body = geoms[link], bodies + link
        thick, long = links.radius[link], links.radius[link] + half_lengths[link]
        geom_size[geom, 0] = thick
        geom_rbound[geom] = long
        geom_aabb[geom, 3] = geom_aabb[geom, 4] = thick
        geom_aabb[geom, 5] = long
        geom_friction[geom, 0] = links.friction[link]
        beyond += links.mass[link]
        body_mass[body] = links.mass[link]
        body_subtreemass[body] = beyond
        body_gravcomp[body] = links.buoyancy[link]
        for axis in range(3):
            along = 1 if axis == axes[link] else 0
            body_inertia[body, axis] = links.inertia[link, along]
