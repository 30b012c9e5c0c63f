"""Local properties of the chain of coaxial devices, written into a model's fields."""

from collections.abc import Callable
from typing import Any, NamedTuple

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from cathsim_dmc.compiled import compiled, interpreted
from cathsim_dmc.entities import stack_memory
from cathsim_dmc.entities.device_stack import DeviceStack
from cathsim_dmc.laws import coaxial
from cathsim_dmc.laws.hinges import unloaded_hinges
from cathsim_dmc.physics.readings import ids


class Fields(NamedTuple):
    """Fields of the model that change as the devices slide, with MuJoCo's names.

    Constants that MuJoCo derives from masses (`body_invweight0`, ...) are not updated:
    the armature of the hinges outweighs the links in them many times.
    """

    jnt_stiffness: np.ndarray
    dof_damping: np.ndarray
    qpos_spring: np.ndarray
    geom_size: np.ndarray
    geom_rbound: np.ndarray
    geom_aabb: np.ndarray
    geom_friction: np.ndarray
    body_mass: np.ndarray
    body_inertia: np.ndarray
    body_subtreemass: np.ndarray
    body_gravcomp: np.ndarray


FIELDS = Fields._fields


class Places(NamedTuple):
    """Indices of the elements of a chain in a compiled model, and its constants.

    Attributes:
        joint: Joint of the first hinge.
        dof: Degree of freedom of the first hinge.
        qpos: Index in `qpos` of the first hinge.
        body: Body of the first link.
        geoms: (L,), geoms of the links.
        axes: (L,), index of the axis of inertia that lies along each link.
        half_lengths: (L,), of the cylinders of the links, m.
        times: (K,), relaxation times of the materials, s.
        timestep: Physics step, s.
    """

    joint: int
    dof: int
    qpos: int
    body: int
    geoms: np.ndarray
    axes: np.ndarray
    half_lengths: np.ndarray
    times: np.ndarray
    timestep: float


class Live(NamedTuple):
    """The chains of N simulations, for compiled functions.

    Attributes:
        devices: `laws.sliding.Devices`.
        scratch: `laws.sliding.Scratch`.
        chain: `laws.sliding.Chain`, written for one simulation after the other.
        places: `Places`.
        fields: (N, 11) int64, addresses of the `Fields`; 0 before the first episode.
        sizes: (5,), numbers of joints, of degrees of freedom, of positions, of geoms
            and of bodies of the model.
        sheathed: `held.Sheathed`; None where a bore holds the links.
    """

    devices: Any
    scratch: Any
    chain: Any
    places: Places
    fields: np.ndarray
    sizes: np.ndarray
    sheathed: Any


def places_of(model: mujoco.MjModel, chain: DeviceStack) -> Places:
    """`Places` of a chain in a model; ValueError if its links are not contiguous."""
    bodies, joints = ids(model, chain.links), np.sort(ids(model, chain.bends))
    places = [joints, model.jnt_dofadr[joints], model.jnt_qposadr[joints]]
    # Links and hinges are contiguous, from proximal to distal.
    if any((np.diff(each) != 1).any() for each in [bodies, *places]):
        raise ValueError(f"the links of {chain!r} do not follow each other")
    geoms = ids(model, chain.link_geoms).astype(np.intp)
    return Places(
        joint=int(joints[0]),
        dof=int(places[1][0]),
        qpos=int(places[2][0]),
        body=int(bodies[0]),
        geoms=geoms,
        # MuJoCo orders the axes of inertia in its own way.
        axes=model.body_inertia[bodies].argmin(axis=-1),
        half_lengths=model.geom_size[geoms, 1].copy(),
        times=chain.rods.times,
        timestep=chain.timestep,
    )


def fields_of(field: Callable[[str], np.ndarray]) -> Fields:
    """Live fields of a model, from a function that returns a field by its name."""
    return Fields._make(map(field, FIELDS))


def write_still(
    entity: DeviceStack,
    model: mujoco.MjModel,
    gaps: ArrayLike | None = None,
    rotation: ArrayLike | None = None,
) -> None:
    """Writes the properties of a chain whose devices stand still into a model.

    Args:
        gaps: (K,), distance from the end of each device to that of the chain, m; those
            at the start of an episode if None.
        rotation: (K,), rotation of each untwisted device, rad; 0 if None.
    """
    stack = entity.stack
    turns = np.zeros((len(entity.devices), len(stack.spans)))
    if rotation is not None:
        turns += np.asarray(rotation)[:, None]
    overlap = stack.overlap(entity.start_gaps if gaps is None else gaps)
    shape, chain = np.empty(len(stack.spans), complex), stack_memory.chain(stack.tables)
    interpreted(coaxial.rest_angles)(overlap.rest, turns, shape)
    interpreted(unloaded_hinges)(shape, chain.rest)
    links = stack.links(overlap, entity.friction)
    chain = chain._replace(overlap=overlap, links=links)
    fields = fields_of(lambda name: getattr(model, name))
    interpreted(write)(fields, places_of(model, entity), chain, 1.0, 1.0)


@compiled
def write(fields, places, chain, stiffness_factor, loss_factor):
    """Writes the properties of a chain into the fields of a model.

    Args:
        fields: live `Fields`.
        places: `Places`.
        chain: `laws.sliding.Chain`.
        stiffness_factor: factor of all stiffnesses.
        loss_factor: factor of all loss factors.
    """
    overlap, rest, links, times = chain.overlap, chain.rest, chain.links, places.times
    for j in range(len(rest)):
        stiffness = stiffness_factor / overlap.compliance[j]
        total, material = 0.0, 0.0
        for k in range(len(times)):
            total += overlap.stiffness[k, j]
        for k in range(len(times)):
            material += times[k] * (overlap.stiffness[k, j] / total)
        # See `chain.hinge_time`.
        damping = max(loss_factor * material - places.timestep, 0.0) * stiffness
        for axis in range(2):
            hinge = 2 * j + (axis + j) % 2  # see `posture.x_first`
            fields.jnt_stiffness[places.joint + hinge] = stiffness
            fields.dof_damping[places.dof + hinge] = damping
            fields.qpos_spring[places.qpos + hinge] = rest[j, axis]
    beyond = 0.0
    for link in range(len(places.geoms) - 1, -1, -1):
        geom, body = places.geoms[link], places.body + link
        thick = links.radius[link]
        long = links.radius[link] + places.half_lengths[link]
        fields.geom_size[geom, 0] = thick
        fields.geom_rbound[geom] = long
        fields.geom_aabb[geom, 3] = fields.geom_aabb[geom, 4] = thick
        fields.geom_aabb[geom, 5] = long
        fields.geom_friction[geom, 0] = links.friction[link]
        beyond += links.mass[link]
        fields.body_mass[body] = links.mass[link]
        fields.body_subtreemass[body] = beyond
        fields.body_gravcomp[body] = links.buoyancy[link]
        for axis in range(3):
            along = 1 if axis == places.axes[link] else 0
            fields.body_inertia[body, axis] = links.inertia[link, along]
