"""Local properties of the chain of coaxial devices, written into a model's fields."""

from collections.abc import Sequence
from typing import NamedTuple

import mujoco
import numpy as np

from cathsim_dmc.entities.chain import hinge_time
from cathsim_dmc.entities.coaxial import Links, Overlap
from cathsim_dmc.entities.device_stack import DeviceStack
from cathsim_dmc.physics import sliding_loops
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
        first = int(hinges[2])
        self.qpos = slice(first, first + 2 * (len(geoms) - 1))

    def write(
        self, arrays: Sequence[np.ndarray], made: "ChainProperties", row: int
    ) -> None:
        """Writes the properties of the chain of one simulation.

        Args:
            arrays: live `FIELDS` of its model.
            made: of some simulations.
            row: which of them.
        """
        chain = made.stiffness, made.damping, made.rest, *made.links
        sliding_loops.write(row, self._places, chain, tuple(arrays))


class ChainProperties(NamedTuple):
    """Properties of chains, arrays with the leading axis N.

    Attributes:
        stiffness: (N, J), of the hinges, N·m/rad.
        damping: (N, J), of the hinges, N·m·s/rad.
        rest: (N, J, 2), angles of the free hinges about x and y, rad.
        links: arrays (N, L).
    """

    stiffness: np.ndarray
    damping: np.ndarray
    rest: np.ndarray
    links: Links


def chain_properties(
    entity: DeviceStack,
    overlap: Overlap,
    turns: np.ndarray,
    friction: np.ndarray,
    factor: np.ndarray,
    loss: np.ndarray,
    angles: np.ndarray | None = None,
) -> ChainProperties:
    """Properties of chains at an overlap of their devices.

    Args:
        turns: (N, K, J), rotation of each device at each joint, rad.
        friction: (N,), Coulomb coefficient of an uncoated device on the wall.
        factor: (N,), of all stiffnesses.
        loss: (N,), factor of all loss factors.
        angles: (N, 2 J), of the hinges as they stand, in the order of the chain, rad;
            None for the unloaded chain at rest.
    """
    stack = entity.stack
    if angles is None:
        rest = stack.unloaded_hinges(overlap, turns)
    else:
        rest = stack.free_hinges(overlap, turns, angles)
    stiffness = factor[:, None] / overlap.compliance
    shares = overlap.stiffness / overlap.stiffness.sum(axis=1, keepdims=True)
    material = loss[:, None] * (entity.material_times[:, None] * shares).sum(axis=1)
    return ChainProperties(
        stiffness=stiffness,
        damping=hinge_time(material, entity.timestep) * stiffness,
        rest=rest,
        links=stack.links(overlap, friction),
    )


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
    gaps = entity.start_gaps if gaps is None else np.asarray(gaps, np.float64)
    turns = np.zeros((1, len(entity.devices), len(entity.stack.spans)))
    if rotation is not None:
        turns += np.asarray(rotation)[:, None]
    overlap = entity.stack.overlap(gaps[None])
    made = chain_properties(
        entity, overlap, turns, np.array([entity.friction]), np.ones(1), np.ones(1)
    )
    arrays = [getattr(model, name) for name in FIELDS]
    ChainFields(model, entity).write(arrays, made, 0)
