"""Gymnasium ids of the tasks, registered when this module is imported.

`gymnasium.make("cathsim_dmc.gym:cathsim/type1_bca-v0")` imports it by itself.
"""

from cathsim_dmc import extras, suite

try:
    import gymnasium
except ModuleNotFoundError as error:
    raise ModuleNotFoundError(
        f"gymnasium is not installed; {extras.adding('gym')}"
    ) from error

VERSION = 0  # the same as in simulation.gymnasium, which is imported late
# Ids with the names of their tasks.
IDS = {f"{suite.DOMAIN}/{task}-v{VERSION}": task for task in suite.SUITE}

_ENTRY = "cathsim_dmc.simulation.gymnasium:CathSimEnv"

for _id, _task in IDS.items():
    if _id not in gymnasium.registry:
        gymnasium.register(_id, _ENTRY, kwargs={"task": _task})
