"""Gymnasium ids of the tasks, registered when this module is imported.

```python
import gymnasium
import cathsim_dmc.gym
env = gymnasium.make("cathsim/type1_bca-v0", observation="image")
```

`gymnasium.make("cathsim_dmc.gym:cathsim/type1_bca-v0")` imports it by itself.
"""

from cathsim_dmc import suite

VERSION = 0  # the same as in simulation.gymnasium, which is imported late
IDS = tuple(f"{suite.DOMAIN}/{task}-v{VERSION}" for task in suite.SUITE)

_MODULE = "cathsim_dmc.simulation.gymnasium"


def task_of(env_id: str) -> str:
    """Name of the task of an id.

    Raises:
        ValueError: if it is none of `IDS`.
    """
    if env_id not in IDS:
        raise ValueError(f"no environment {env_id!r}; there are {', '.join(IDS)}")
    return env_id.removeprefix(f"{suite.DOMAIN}/").removesuffix(f"-v{VERSION}")


def register() -> None:
    """Registers the ids; does nothing for those that are there."""
    try:
        import gymnasium
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(
            "gymnasium is not installed; `pip install cathsim-dmc[gym]` adds it"
        ) from error
    for env_id in IDS:
        if env_id not in gymnasium.registry:
            gymnasium.register(
                env_id,
                entry_point=f"{_MODULE}:CathSimEnv",
                kwargs={"task": task_of(env_id)},
            )


register()
