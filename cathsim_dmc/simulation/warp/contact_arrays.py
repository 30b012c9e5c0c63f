"""Arrays of many worlds that the kernels of contacts read and write."""

from __future__ import annotations

from typing import Any, NamedTuple


class Links(NamedTuple):
    """The links and the carriers of the compiled model.

    Attributes:
        geoms: (L,) geoms of the links.
        joints: (L,) bodies whose origin is the joint of a link; -1 for none.
        carriers: (C,) geoms that carry a wall.
        last_dof: (L,) last degree of freedom that moves a link; -1 for none.
        roots: (L,) bodies at the roots of the links' trees.
        parents: (nv,) degree of freedom before each one; -1 for none.
        dims: (L, C) dimensions of a contact.
        priorities: (L, C) 1 where the carrier's parameters hold, -1 where the link's
            do, 0 where they are mixed.
        mix: (L, C) weight of the link's `solref` and `solimp` where they are mixed.
    """

    geoms: Any
    joints: Any
    carriers: Any
    last_dof: Any
    roots: Any
    parents: Any
    dims: Any
    priorities: Any
    mix: Any


class Walls(NamedTuple):
    """Walls of all anatomies, concatenated, and the walls of each world.

    Attributes:
        head, coarse, bricks, samples: As `laws.field.FieldArrays`, of all lumens.
        line: As `laws.wall.Wall`, of all bores.
        lattice: Lattices of the motions of all walls, see `laws.motion`.
        starts: (F, 6, 2) start and stop index of wall f in each of these arrays.
        is_bore: (F,) whether a wall is a bore.
        middle: (F, 3) m, place of the carrier's middle in the frame of the wall.
        of_world: (N, C) wall of a carrier in each world.
        places: (N, C, 3) m, position of a carrier in each world. They are kept here
            because Warp has one position of a static geom for all worlds.
        turns: (N, C, 3, 3), the axes of a carrier in columns.
    """

    head: Any
    coarse: Any
    bricks: Any
    samples: Any
    line: Any
    lattice: Any
    starts: Any
    is_bore: Any
    middle: Any
    of_world: Any
    places: Any
    turns: Any


class Fields(NamedTuple):
    """Fields of Warp's model, (1 or N, ...)."""

    geom_size: Any
    geom_friction: Any
    geom_solref: Any
    geom_solimp: Any
    timestep: Any


class Motion(NamedTuple):
    """Arrays of Warp's data (N, ...) that a contact depends on."""

    geom_xpos: Any
    geom_xmat: Any
    xpos: Any
    cdof: Any
    qvel: Any
    subtree_com: Any


# Numbers of a contact in `Found`.
ROW = 8


class Found(NamedTuple):
    """Contacts of all threads, before they are counted.

    Attributes:
        number: (T,) contacts of a thread.
        rows: (T, MOST, ROW) of each contact the distance m, the place (3) m, the
            direction (3) from the link into the wall, and 1 if it shares its spring,
            else 0.
    """

    number: Any
    rows: Any


class Contacts(NamedTuple):
    """Arrays of mujoco_warp's `Contact` that differ between contacts, and `nacon`."""

    dist: Any
    pos: Any
    frame: Any
    friction: Any
    solref: Any
    solimp: Any
    dim: Any
    geom: Any
    efc_address: Any
    worldid: Any
    geomcollisionid: Any
    nacon: Any
