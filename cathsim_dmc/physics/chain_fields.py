"""Local properties of the chain of coaxial devices, written into a model's fields."""

from collections.abc import Sequence

import mujoco
import numpy as np

from cathsim_dmc.compiled import compiled
from cathsim_dmc.entities.coaxial import Links, Overlap
from cathsim_dmc.entities.device_stack import DeviceStack
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


class ChainFields:
    """Places in a model of what changes as the devices slide.

    Attributes:
        qpos: Places of the hinges in `qpos`, in the order of the chain.
    """

    def __init__(self, model: mujoco.MjModel, chain: DeviceStack):
        """Finds the elements of the chain in a compiled model."""
        bodies = ids(model, chain.links)
        joints = np.sort(ids(model, chain.bends))
        places = [joints, model.jnt_dofadr[joints], model.jnt_qposadr[joints]]
        # Both kinds of elements follow each other, from proximal to distal.
        if any((np.diff(each) != 1).any() for each in [bodies, *places]):
            raise ValueError(f"the links of {chain!r} do not follow each other")
        hinges = np.array([each[0] for each in places], dtype=np.intp)
        geoms = ids(model, chain.link_geoms).astype(np.intp)
        half_lengths = model.geom_size[geoms, 1].copy()
        # MuJoCo orders the axes of inertia in its own way.
        axes = model.body_inertia[bodies].argmin(axis=-1)
        self._places = hinges, int(bodies[0]), geoms, axes, half_lengths
        self._damped = chain.material_times, chain.timestep
        first = int(hinges[2])
        self.qpos = slice(first, first + 2 * (len(geoms) - 1))

    def write(
        self,
        arrays: Sequence[np.ndarray],
        row: int,
        overlap: Overlap,
        rest: np.ndarray,
        links: Links,
        factors: np.ndarray,
    ) -> None:
        """Writes the properties of the chain of one simulation.

        Args:
            arrays: live `FIELDS` of its model.
            row: number of the simulation among those of the others.
            overlap: of its devices.
            rest: (N, J, 2), angles of the free hinges about x and y, rad.
            links: properties of the links.
            factors: (2, N), of all stiffnesses, and of all loss factors.
        """
        hinges = overlap.compliance, overlap.stiffness, rest, *self._damped
        given = self._places, hinges, tuple(links), factors, tuple(arrays)
        _write(row, *given)


def write_still(
    entity: DeviceStack,
    model: mujoco.MjModel,
    gaps: np.ndarray | None = None,
    rotation: np.ndarray | None = None,
) -> None:
    """Writes into a model the properties of the chain while the devices stand still.

    Args:
        gaps: (K,), way from the end of each device to that of the chain, m; those at
            the start of an episode if None.
        rotation: (K,), of each device, not twisted, rad; 0 if None.
    """
    stack = entity.stack
    gaps = entity.start_gaps if gaps is None else np.asarray(gaps, np.float64)
    turns = np.zeros((1, len(entity.devices), len(stack.spans)))
    if rotation is not None:
        turns += np.asarray(rotation)[:, None]
    overlap = stack.overlap(gaps[None])
    rest = stack.unloaded_hinges(overlap, turns)
    links = stack.links(overlap, np.array([entity.friction]))
    arrays = [getattr(model, name) for name in FIELDS]
    ChainFields(model, entity).write(arrays, 0, overlap, rest, links, np.ones((2, 1)))


@compiled
def _write(row, places, made, links, factors, fields):
    """Writes what a chain is made of into the fields of a model.

    Args:
        row: number of the simulation.
        places: (3,) first hinge among joints, degrees of freedom and positions; number
            of the first link; (L,) geoms of the links; (L,) which of a link's axes of
            inertia lies along it; (L,) half lengths of their cylinders, m.
        made: compliance and stiffness of the overlap, rest angles; (K,) relaxation
            times of the materials, physics step, s.
        links: arrays of `coaxial.Links`.
        factors: (2, N), of stiffnesses and loss factors.
        fields: live `FIELDS`.
    """
    hinges, bodies, geoms, axes, half_lengths = places
    compliance, shares, rest, times, timestep = made
    radius, friction, mass, buoyancy, inertia = links
    jnt_stiffness, dof_damping, qpos_spring = fields[:3]
    geom_size, geom_rbound, geom_aabb, geom_friction = fields[3:7]
    body_mass, body_inertia, body_subtreemass, body_gravcomp = fields[7:]
    for j in range(compliance.shape[1]):
        stiffness = factors[0, row] / compliance[row, j]
        total, material = 0.0, 0.0
        for k in range(len(times)):
            total += shares[row, k, j]
        for k in range(len(times)):
            material += times[k] * (shares[row, k, j] / total)
        # See `chain.hinge_time`.
        damping = max(factors[1, row] * material - timestep, 0.0) * stiffness
        for axis in range(2):
            hinge = 2 * j + (axis + j) % 2  # see `posture.x_first`
            jnt_stiffness[hinges[0] + hinge] = stiffness
            dof_damping[hinges[1] + hinge] = damping
            qpos_spring[hinges[2] + hinge] = rest[row, j, axis]
    beyond = 0.0
    for link in range(len(geoms) - 1, -1, -1):
        geom, body = geoms[link], bodies + link
        thick, long = radius[row, link], radius[row, link] + half_lengths[link]
        geom_size[geom, 0] = thick
        geom_rbound[geom] = long
        geom_aabb[geom, 3] = geom_aabb[geom, 4] = thick
        geom_aabb[geom, 5] = long
        geom_friction[geom, 0] = friction[row, link]
        beyond += mass[row, link]
        body_mass[body] = mass[row, link]
        body_subtreemass[body] = beyond
        body_gravcomp[body] = buoyancy[row, link]
        for axis in range(3):
            along = 1 if axis == axes[link] else 0
            body_inertia[body, axis] = inertia[row, link, along]
