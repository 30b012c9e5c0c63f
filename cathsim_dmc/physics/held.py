"""Links in the sheath, held along its axis by the stiffness of their hinges.

`laws.sheath` has the law.
"""

import contextlib
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import mujoco
import numpy as np
from numpy.random import RandomState

from cathsim_dmc.compiled import interpreted
from cathsim_dmc.entities.chain import Chain
from cathsim_dmc.laws import sheath
from cathsim_dmc.physics.effects import Draw, Effect, World
from cathsim_dmc.physics.readings import ids

FIELDS = ("jnt_stiffness", "dof_damping", "qpos_spring")


class Held:
    """The hinges of a chain in a sheath.

    Attributes:
        joints: `laws.sheath.Joints`.
        ends: (J,), distance of each joint from the end of the chain, negative, m.
        nominal: (3, J, 2), stiffness, damping and rest angles without a sheath.
        out: (J,), fraction of the compliance of each joint that was out of the sheath
            when last written.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        chain: Chain,
        bends_qpos: np.ndarray,
    ):
        """Finds the hinges in a model with the values of hinges without a sheath.

        Args:
            model: Model with the values without a sheath.
            chain: The entity.
            bends_qpos: (J, 2), see `readings.ModelIndex`.
        """
        lengths = chain.link_lengths
        self.ends = np.cumsum(lengths)[:-1] - np.sum(lengths)
        joint = np.searchsorted(model.jnt_qposadr, bends_qpos)
        self.joints = sheath.Joints(
            joint=joint,
            dof=model.jnt_dofadr[joint].astype(np.int64),
            qpos=bends_qpos.astype(np.int64),
            behind=lengths[:-1] / 2,
            ahead=lengths[1:] / 2,
            distal=chain.distal_shares,
        )
        self.nominal = self.read(fields_of(lambda name: getattr(model, name)))
        self.out = np.ones(len(self.ends))

    def read(self, fields: sheath.Hinges) -> np.ndarray:
        """Values (3, J, 2) of the hinges in the fields of a model."""
        pairs = zip(fields, self.joints[:3], strict=True)
        return np.array([field[places] for field, places in pairs])

    def hold(self, model: mujoco.MjModel, start_depth: float, insertion: float) -> None:
        """Holds the links in a model at an insertion, m.

        The chain's end is `start_depth`, m, past the mouth at insertion 0.
        """
        fields = fields_of(lambda name: getattr(model, name))
        free, places = sheath.Hinges._make(self.nominal), self.ends + start_depth
        interpreted(sheath.hold)(
            self.joints, places, float(insertion), free, fields, self.out
        )

    @contextlib.contextmanager
    def at(
        self, model: mujoco.MjModel, start_depth: float, insertion: float
    ) -> Iterator[None]:
        """Holds the links, see `hold`, within a `with` block."""
        fields = fields_of(lambda name: getattr(model, name))
        before = [field.copy() for field in fields]
        self.hold(model, start_depth, insertion)
        try:
            yield
        finally:
            for field, values in zip(fields, before, strict=True):
                field[:] = values


class Released(Effect):
    """Resets the hinges to their values without a sheath as an episode begins.

    Other effects may then change them. The device restarts last and stiffens the hinges
    in the sheath from the values that it finds.
    """

    model_fields = FIELDS

    def bind(self, world: World) -> None:
        """Finds the hinges of the device in the model."""
        super().bind(world)
        model, joints = world.model, ids(world.model, world.chain.hinges)
        places = joints, model.jnt_dofadr[joints], model.jnt_qposadr[joints]
        self._nominal = [
            (name, where, getattr(model, name)[where])
            for name, where in zip(FIELDS, places, strict=True)
        ]

    def restart(self, index: int, episode: Draw, random_state: RandomState) -> None:
        """Writes the unchanged values into the model of one simulation."""
        for name, where, values in self._nominal:
            self.world.field(index, name)[where] = values


class Sheathed(NamedTuple):
    """Hinges of N simulations in a sheath.

    Attributes:
        joints: `laws.sheath.Joints`.
        depths: (N, J), distance of each joint past the mouth at insertion 0, m.
        insertion: (N,), m.
        free: (N, 3, J, 2), stiffness, damping and rest angles without a sheath.
        places: (N, 3) int64, see `addresses`; 0 before the first episode.
        out: (N, J), fraction of each joint's compliance that is out of the sheath.
    """

    joints: Any
    depths: Any
    insertion: Any
    free: Any
    places: Any
    out: Any

    def of(self, rows: slice) -> "Sheathed":
        """Returns the hinges of some of the simulations."""
        return Sheathed._make((self.joints, *(each[rows] for each in self[1:])))


def addresses(fields: Sequence[np.ndarray]) -> list[int]:
    """Addresses of fields of a model, which are contiguous arrays of float64."""
    assert all(each.dtype == float and each.flags.c_contiguous for each in fields)
    return [each.ctypes.data for each in fields]


def fields_of(field: Callable[[str], np.ndarray]) -> sheath.Hinges:
    """Live fields of a model, from a function that returns a field by its name."""
    return sheath.Hinges._make(map(field, FIELDS))
