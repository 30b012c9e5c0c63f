"""Small arrays for the thread functions of MuJoCo Warp: three worlds, two links."""

import mujoco
import numpy as np

from cathsim_dmc.simulation.warp import contact_kernels as kernels
from cathsim_dmc.simulation.warp import contacts
from cathsim_dmc.simulation.warp.contact_arrays import (
    ROW,
    Contacts,
    Fields,
    Found,
    Motion,
    Walls,
)

SCENE = """
<mujoco>
  <option timestep="0.004"/>
  <worldbody>
    <geom name="a" type="box" size="1 1 1" condim="3" solmix="3"
      friction="0.3 2e-3 4e-6" solref="-90 -7" solimp="0.5 0.8 0.01 0.4 3"
      contype="1" conaffinity="0"/>
    <geom name="b" type="box" size="1 1 1" condim="1" priority="2"
      friction="0.2 0.1 0.1" solref="0.03 0.9" contype="1" conaffinity="0"/>
    <geom name="d" type="box" size="1 1 1" condim="6" solref="0.03 1.2" contype="1"
      conaffinity="0"/>
    <body pos="5 0 0">
      <joint type="slide"/>
      <geom size="0.1" contype="0" conaffinity="0"/>
    </body>
    <body pos="0.1 0 1.05">
      <freejoint/>
      <body>
        <joint/>
        <geom size="0.1" contype="0" conaffinity="0"/>
      </body>
      <geom name="c" type="capsule" size="0.1 0.2" contype="0" conaffinity="1"
        condim="4" friction="0.6 1e-3 5e-4" solref="-50 -9" solmix="0.5"/>
      <body pos="0 0.5 -0.2">
        <joint axis="1 0 0"/>
        <joint axis="0 1 0"/>
        <geom name="e" type="capsule" size="0.1 0.4" contype="0" conaffinity="1"
          priority="1" pos="0 0 0.4" solimp="0.6 0.7 0.02 0.3 2"/>
      </body>
    </body>
  </worldbody>
</mujoco>"""
WORLDS = 3


def scene():
    """Model, and data of the worlds in other postures and motions."""
    model = mujoco.MjModel.from_xml_string(SCENE)
    random, worlds = np.random.RandomState(0), []
    for _ in range(WORLDS):
        data = mujoco.MjData(model)
        data.qpos[1:4] += random.uniform(-0.02, 0.02, 3)
        data.qpos[8:] = random.uniform(-0.3, 0.3, 3)
        data.qvel[:] = random.uniform(-1, 1, model.nv)
        mujoco.mj_forward(model, data)
        worlds.append(data)
    return model, worlds


def fields_of(model, factors=(1.0, 1.0, 1.0)):
    def each(value):
        return np.array([value * factor for factor in factors])

    return Fields(
        geom_size=np.array([model.geom_size * (factor, 1, 1) for factor in factors]),
        geom_friction=each(model.geom_friction),
        geom_solref=each(model.geom_solref),
        geom_solimp=model.geom_solimp[None],
        timestep=np.array([model.opt.timestep]),
    )


def links_of(model):
    return contacts._links(model, np.arange(3))


def written(links, fields, number, rows, room=32):
    """`Written` of all worlds, with arrays that are full of nonsense."""
    out = Contacts(
        dist=np.full(room, 9.0),
        pos=np.full((room, 3), 9.0),
        frame=np.full((room, 3, 3), 9.0),
        friction=np.full((room, 5), 9.0),
        solref=np.full((room, 2), 9.0),
        solimp=np.full((room, 5), 9.0),
        dim=np.full(room, 9),
        geom=np.full((room, 2), 9),
        efc_address=np.full((room, 4), 9),
        worldid=np.full(room, 9),
        geomcollisionid=np.full(room, 9),
        nacon=np.zeros(1, int),
    )
    shared = [np.zeros(WORLDS, int) for _ in range(3)]
    return kernels.Written(links, fields, Found(number, rows), out, *shared)


def motion_of(worlds):
    def each(name, shape):
        return np.array([getattr(data, name).reshape(shape) for data in worlds])

    return Motion(
        geom_xpos=each("geom_xpos", (-1, 3)),
        geom_xmat=each("geom_xmat", (-1, 3, 3)),
        xpos=each("xpos", (-1, 3)),
        cdof=each("cdof", (-1, 6)),
        qvel=each("qvel", -1),
        subtree_com=each("subtree_com", (-1, 3)),
    )


def walls_of(lattice=()):
    """Two bores; the second world has the second one; each has its place and axes."""
    lines = [
        np.array([2.0, 0, 0, 0, 0.5, 0, 0, 4.0, 0.5]),
        np.array([2.0, 0, 0, 0, 0.6, 0, 0, 5.0, 0.6]),
    ]
    none, turned = np.zeros(0), np.eye(3)[[2, 0, 1]]
    starts = np.zeros((2, 6, 2), int)
    starts[:, 4] = [[0, 9], [9, 18]]
    starts[1, 5] = [0, len(lattice)]
    return Walls(
        head=none,
        coarse=none.astype(np.int16),
        bricks=none.astype(np.int32),
        samples=none.astype(np.int16),
        line=np.concatenate(lines),
        lattice=np.asarray(lattice, float),
        starts=starts,
        is_bore=np.array([True, True]),
        middle=np.array([[0, 0, 2.0], [0, 0, 2.5]]),
        of_world=np.array([[0], [1], [0]], np.int32),
        places=np.array([[[0.2, 0.1, 1.2]], [[0.5, -0.1, 1.3]], [[0.1, 0.3, 1.4]]]),
        turns=np.array([[np.eye(3)], [turned], [turned.T]]),
    )


def scene_of(model, worlds):
    links = contacts._links(model, np.arange(3))
    links = links._replace(
        carriers=links.carriers[:1],
        dims=links.dims[:, :1],
        priorities=links.priorities[:, :1],
        mix=links.mix[:, :1],
    )
    found = Found(np.full(6, 9), np.full((6, 4, ROW), np.nan))
    fields = fields_of(model, (1.0, 1.1, 1.2))
    moves = motion_of(worlds)
    return kernels.Scene(links, walls_of(), fields, moves, found)
