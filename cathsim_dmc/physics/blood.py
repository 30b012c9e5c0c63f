"""Drag of still blood across the links of the device, in every physics step.

On a length l and a diameter d, at a velocity u across the axis and Re = ρ|u|d/µ, it is
-½ ρ d l C_d |u| u, C_d = 1.18 + 6.8 / Re^0.89 + 1.96 / √Re - 0.0004 Re / (1 + 3.64e-7
Re²) (Sucker and Brauer 1975, Wärme- und Stoffübertragung 8, 149; Re from 1e-4 to 2e5).
docs/physics.md says what is left out.
"""

from numpy.random import RandomState

from cathsim_dmc.entities.arena import BLOOD_DENSITY
from cathsim_dmc.entities.chain import Chain
from cathsim_dmc.physics.effects import Effect, Episode, World

BLOOD_VISCOSITY = 3.5e-3  # Pa·s, of whole blood at high shear rates


class StillBlood(Effect):
    """Blood at rest, the first of a task's effects; a flow writes its velocity."""

    def num_parameters(self, chain: Chain) -> int:
        """A header, and the velocity of the blood at each link."""
        from cathsim_dmc.physics import blood_loops  # late, as numba takes long

        self._loops = blood_loops
        return blood_loops.HEADER + blood_loops.OF_LINK * len(chain.links)

    def bind(self, world: World) -> None:
        """Has MuJoCo call the drag, and finds its parameters."""
        super().bind(world)
        self._loops.install()
        self._header = world.parameters[:, : self._loops.HEADER]
        links = world.parameters[:, self._loops.HEADER :].reshape(
            world.num_simulations, -1, self._loops.OF_LINK
        )
        # See `blood_loops.OF_LINK`; the first are the blood's velocity, world frame.
        self.velocity, self._links = links[..., :3], links

    def restart(self, index: int, episode: Episode, random_state: RandomState) -> None:
        """Fills one simulation with blood at rest."""
        factor = 1.0 if episode.viscosity is None else episode.viscosity
        viscosity, first = factor * BLOOD_VISCOSITY, self.world.index.links.start
        self._header[index] = 0.0
        self._header[index, :4] = self._loops.MARK, BLOOD_DENSITY, viscosity, first
        self._links[index] = 0.0
