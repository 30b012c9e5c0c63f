"""Gymnasium ids of all tasks, from the import of this module on.

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
IDS: dict[str, str] = {}

_MODULE = "cathsim_dmc.simulation.gymnasium"


def _register(task: str) -> None:
    name = f"{suite.DOMAIN}/{task}-v{VERSION}"
    IDS[name] = task
    if name not in gymnasium.registry:
        gymnasium.register(
            name,
            f"{_MODULE}:CathSimEnv",
            vector_entry_point=f"{_MODULE}:CathSimVectorEnv",
            kwargs={"task": task},
        )


for _task in suite.SUITE:
    _register(_task)
suite.LISTENERS.append(_register)
