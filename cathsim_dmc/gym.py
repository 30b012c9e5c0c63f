"""Gymnasium ids of the tasks, registered when this module is imported.

`gymnasium.make("cathsim_dmc.gym:cathsim/type1_bca-v0")` imports it by itself, and
`gymnasium.make_vec` with the same id makes many simulations in one batch.
"""

from cathsim_dmc import extras, suite

try:
    import gymnasium
except ModuleNotFoundError as error:
    raise ModuleNotFoundError(
        f"gymnasium is not installed; {extras.adding('gym')}"
    ) from error

VERSION = 0  # the same as in simulation.gymnasium, which is imported late
# Names of the tasks by Gymnasium id.
IDS = {f"{suite.DOMAIN}/{task}-v{VERSION}": task for task in suite.SUITE}

_MODULE = "cathsim_dmc.simulation.gymnasium"

for _id, _task in IDS.items():
    if _id not in gymnasium.registry:
        gymnasium.register(
            _id,
            f"{_MODULE}:CathSimEnv",
            vector_entry_point=f"{_MODULE}:CathSimVectorEnv",
            kwargs={"task": _task},
        )
