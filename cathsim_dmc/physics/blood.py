"""Blood at rest: its drag across the links of the device, in every physics step.

`laws.blood` has the law. docs/physics.md lists what is left out.
"""

from numpy.random import RandomState

from cathsim_dmc.entities.arena import BLOOD_DENSITY
from cathsim_dmc.laws.blood import Blood
from cathsim_dmc.physics.effects import Draw, Effect

BLOOD_VISCOSITY = 3.5e-3  # Pa·s, of whole blood at high shear rates


class StillBlood(Effect):
    """Blood at rest; the subclass `Flow` writes a velocity."""

    parameters = Blood
    acts_in, adapter = "passive", "blood"

    def restart(self, index: int, episode: Draw, random_state: RandomState) -> None:
        """Fills one simulation with blood at rest."""
        factor = 1.0 if episode.viscosity is None else episode.viscosity
        for each in self.world.parameters:
            each[index] = 0.0
        self.world.parameters.density[index] = BLOOD_DENSITY
        self.world.parameters.viscosity[index] = factor * BLOOD_VISCOSITY
