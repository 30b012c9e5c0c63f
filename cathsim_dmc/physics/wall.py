"""Compliant wall: contacts are springs with the local stiffness of the vessel.

`laws.compliance` has the law. The contact parameters of each link are set once per
control step. They obey the rule of `entities.contact`, α(1 + m) < 2. Where the vessel
is stiffer than the contact with the rigid wall, the law of the rigid wall applies.
"""

import dataclasses
from typing import Any

import numpy as np
from numpy.random import RandomState

from cathsim_dmc import rows
from cathsim_dmc.entities.chain import Chain
from cathsim_dmc.entities.contact import CONTACT_SOLIMP, CONTACT_SOLREF
from cathsim_dmc.laws.compliance import (
    Law,
    Links,
    Sharing,
)
from cathsim_dmc.physics import held
from cathsim_dmc.physics.effects import Draw, Effect, World
from cathsim_dmc.physics.flow import Flow
from cathsim_dmc.physics.randomisation import Drawn, check_drawn, drawn
from cathsim_dmc.physics.readings import Readings

STIFFENING = 3e-3  # m, indentation from which the stiffness is largest
SOLIMP = (0.7, 0.95, STIFFENING, 0.5, 4)
RELAXATION = 8e-3  # s, as that of the rigid wall
RIGID = Law(np.array(CONTACT_SOLREF), np.array(CONTACT_SOLIMP, float), 0.0)
COMPLIANT = Law(np.zeros(2), np.array(SOLIMP), RELAXATION)
# Load, N, at which the secant stiffness of the rigid wall is taken.
_LOAD = 0.1

_LIMITS = {
    "modulus": (1e4, 1e9, "Pa"),
    "thickness": (1e-4, 5e-3, "m"),
    "support": (0.0, 1.0, ""),
}


@dataclasses.dataclass(frozen=True)
class WallOptions:
    """Material of the wall; a range (low, high) is drawn from in each episode.

    Attributes:
        modulus: Young's modulus, Pa, 1e4 to 1e9: 0.45e6 of an aorta, 0.52e6 of
            silicone.
        thickness: m, 1e-4 to 5e-3; None for that of an artery, a tenth of the radius of
            the lumen and at least 0.6 mm.
        support: 0 to 1: 1 for a vessel that its surroundings keep round, 0 for one that
            may become oval.
    """

    modulus: Drawn = 0.45e6
    thickness: Drawn | None = None
    support: Drawn = 1.0

    def __post_init__(self):
        check_drawn(self, _LIMITS)


def rigid_stiffness(weight: np.ndarray) -> np.ndarray:
    """Secant stiffness (n,) N/m of the rigid wall for inverse weights (n,), 1/kg."""
    depth = np.geomspace(1e-7, 2e-4, 400)
    first, last, width, middle, power = CONTACT_SOLIMP
    share = depth / width
    below = share**power / middle ** (power - 1)
    above = 1 - (1 - share) ** power / (1 - middle) ** (power - 1)
    impedance = first + (last - first) * np.where(share <= middle, below, above)
    force = -CONTACT_SOLREF[0] / last**2 * impedance**2 * depth / (1 - impedance)
    return np.array([_LOAD / np.interp(_LOAD * each, force, depth) for each in weight])


class Wall(Effect):
    """Sets the contact parameters of each link from the vessel around it."""

    acts_in, adapter, parameters = "contact", "compliance", Sharing
    model_fields = step_fields = ("geom_solref", "geom_solimp")
    state = ("_radius", "_material")

    def __init__(self, options: WallOptions, blood: Flow):
        """Takes the options of the task, and the blood, which has the radii."""
        self._options, self._blood = options, blood

    def bind(self, world: World) -> None:
        """Finds the links in the model."""
        super().bind(world)
        model, links, count = world.model, world.index.geoms, world.num_simulations
        weight = model.body_invweight0[model.geom_bodyid[links], 0]
        self._links = Links(links, weight, rigid_stiffness(weight))
        # Radius of the last lumen around each link, 0 before it has been in one.
        self._radius = np.zeros((count, len(links)))
        self._material = np.ones((count, len(_LIMITS)))
        # Addresses of the fields of each simulation, 0 before its first episode.
        self._fields: list[Any] = [None] * count
        self._places = np.zeros((count, len(self.model_fields)), np.int64)

    def restart(self, index: int, episode: Draw, random_state: RandomState) -> None:
        """Draws the material of the wall."""
        self._radius[index] = 0.0
        given = [getattr(self._options, name) for name in _LIMITS]
        self._material[index] = [
            np.nan if value is None else drawn(value, random_state) for value in given
        ]
        fields = [self.world.field(index, name) for name in self.model_fields]
        self._fields[index], self._places[index] = fields, held.addresses(fields)
        self._write(slice(index, index + 1))

    def conditions(self, index: int) -> dict[str, float]:
        """Material of one simulation, in the units of `WallOptions`."""
        found = zip(_LIMITS, self._material[index].tolist(), strict=True)
        return {f"wall.{name}": x for name, x in found if not np.isnan(x)}

    def _write(self, own: slice) -> None:
        from cathsim_dmc.physics import adapters  # late, as numba takes long

        radius, material = self._radius[own], self._material[own]
        laws = RIGID, COMPLIANT
        adapters.press(self._places[own], radius, material, self._links, laws)

    def act(self, action: np.ndarray, state: Readings) -> np.ndarray:
        """Writes the contacts for the radius of the vessel around each link."""
        radius = self._blood.radius
        np.copyto(self._radius, radius, where=radius > 0.0)
        rows.each(len(radius), self._write)
        return action


def soften(chain: Chain) -> None:
    """Gives the contact parameters of a chain's links priority over the wall's."""
    for geom in chain.link_geoms:
        geom.priority = 1
