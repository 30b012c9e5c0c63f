"""The task suite `cathsim`, a domain of `dm_control.suite`.

```python
from cathsim_dmc import suite
env = suite.load("cathsim", "type1_lcca")
```

Importing this module registers the domain, so that `dm_control.suite.load` and
TorchRL's `DMControlEnv` know it too.
"""

import dataclasses
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from dm_control import composer
from dm_control import suite as dm_suite
from dm_control.utils import containers

from cathsim_dmc.anatomy import Anatomy, Goal
from cathsim_dmc.tasks import navigation

DOMAIN = "cathsim"
SUITE = containers.TaggedTasks()

# Constants of dm_control.suite that are computed from its domains at import.
_TAGGED = {"BENCHMARKING": "benchmarking", "EASY": "easy", "HARD": "hard"}


@SUITE.add("benchmarking", "easy")
def type1_bca(random=None, environment_kwargs=None, **options):
    """Type-I arch: cannulate the brachiocephalic artery from the ascending aorta."""
    return _arch_environment("type1", "bca", random, environment_kwargs, options)


@SUITE.add("benchmarking", "hard")
def type1_lcca(random=None, environment_kwargs=None, **options):
    """Type-I arch: cannulate the left common carotid from the ascending aorta."""
    return _arch_environment("type1", "lcca", random, environment_kwargs, options)


@SUITE.add("benchmarking", "easy")
def type2_bca(random=None, environment_kwargs=None, **options):
    """Type-II arch: cannulate the brachiocephalic artery from the ascending aorta."""
    return _arch_environment("type2", "bca", random, environment_kwargs, options)


@SUITE.add("benchmarking", "hard")
def type2_lcca(random=None, environment_kwargs=None, **options):
    """Type-II arch: cannulate the left common carotid from the ascending aorta."""
    return _arch_environment("type2", "lcca", random, environment_kwargs, options)


@SUITE.add()
def navigate(
    phantom: "str | Path | Anatomy" = "type1",
    goal: "str | Goal" = "bca",
    random=None,
    environment_kwargs=None,
    **options,
):
    """Any anatomy, such as an imported scan: reach a goal of it.

    Args:
      phantom: directory written by `cathsim phantom`, name of an arch, or anatomy.
      goal: name of a goal of the anatomy, or a goal.
      random: seed.
      environment_kwargs: of `composer.Environment`.
      **options: fields of `tasks.navigation.NavigationConfig`.
    """
    return _environment(
        load_anatomy(phantom), goal, random, environment_kwargs or {}, options
    )


def load(
    domain_name: str,
    task_name: str,
    task_kwargs: Mapping[str, Any] | None = None,
    environment_kwargs: Mapping[str, Any] | None = None,
    visualize_reward: bool = False,
) -> composer.Environment:
    """Returns an environment, as `dm_control.suite.load` does.

    Args:
      domain_name: "cathsim", or any other domain of dm_control.suite.
      task_name: a task of the domain, see `SUITE`.
      task_kwargs: `random` (a seed), and fields of
        `tasks.navigation.NavigationConfig` such as `observation`.
      environment_kwargs: of `composer.Environment`.
      visualize_reward: accepted as dm_control does; there is nothing to colour.

    Raises:
      ValueError: if domain, task or an option does not exist; lists those that do.
    """
    if domain_name == DOMAIN and task_name not in SUITE:
        raise ValueError(
            f"no task {task_name!r} in domain {DOMAIN!r}; there are {', '.join(SUITE)}"
        )
    if domain_name not in dm_suite._DOMAINS:  # noqa: SLF001
        raise ValueError(
            f"no domain {domain_name!r}; there are {DOMAIN} and those of "
            f"dm_control.suite: {', '.join(sorted(dm_suite.TASKS_BY_DOMAIN))}"
        )
    return dm_suite.load(
        domain_name,
        task_name,
        dict(task_kwargs or {}),
        dict(environment_kwargs) if environment_kwargs else None,
        visualize_reward,
    )


def load_anatomy(phantom: "str | Path | Anatomy") -> Anatomy:
    """Returns an anatomy: itself, an arch by name, or one saved in a directory.

    Raises:
      ValueError: if there is none; lists the names.
    """
    if isinstance(phantom, Anatomy):
        return phantom
    from cathsim_dmc.anatomy import phantoms

    if str(phantom) in phantoms.PHANTOMS:
        return phantoms.load(str(phantom))
    if not Path(phantom).is_dir():
        raise ValueError(
            f"no phantom at {str(phantom)!r}; give a directory written by `cathsim "
            f"phantom import` or `generate`, or one of {', '.join(phantoms.PHANTOMS)}"
        )
    return Anatomy.load(phantom)


def _arch_environment(name, goal, random, environment_kwargs, options):
    anatomy = load_anatomy(name)
    return _environment(anatomy, goal, random, environment_kwargs or {}, options)


def _environment(anatomy, goal, random, environment_kwargs, options):
    known = [field.name for field in dataclasses.fields(navigation.NavigationConfig)]
    unknown = sorted(set(options) - set(known))
    if unknown:
        raise ValueError(
            f"no task option {', '.join(map(repr, unknown))}; there are random, "
            f"{', '.join(known)}"
        )
    random_state = (
        random
        if isinstance(random, np.random.RandomState)
        else np.random.RandomState(random)
    )
    task = navigation.Navigation(
        anatomy, goal, navigation.NavigationConfig(**options), random_state
    )
    settings = {
        "strip_singleton_obs_buffer_dim": True,
        "recompile_mjcf_every_episode": False,
        # mj_step as it is, which the batched path runs too, bit for bit.
        "legacy_step": False,
        # Divergence ends the episode with a reason; it is no failure of the policy.
        "raise_exception_on_physics_error": False,
        **environment_kwargs,
    }
    return composer.Environment(task, random_state=random_state, **settings)


def _register() -> None:
    """Adds the domain to dm_control.suite; does nothing if it is there."""
    needed = ("_DOMAINS", "_get_tasks", "_get_tasks_by_domain", "ALL_TASKS", *_TAGGED)
    missing = [name for name in needed if not hasattr(dm_suite, name)]
    if missing:
        raise ImportError(
            f"dm_control.suite has no {', '.join(missing)} any more, so the domain "
            f"{DOMAIN!r} cannot be registered; install dm-control 1.0.50"
        )
    dm_suite._DOMAINS[DOMAIN] = sys.modules[__name__]  # noqa: SLF001
    tasks = dm_suite._get_tasks  # noqa: SLF001
    dm_suite.ALL_TASKS = tasks(None)
    for constant, tag in _TAGGED.items():
        setattr(dm_suite, constant, tasks(tag))
    everything = set(dm_suite.ALL_TASKS)
    dm_suite.EXTRA = tuple(sorted(everything - set(dm_suite.BENCHMARKING)))
    dm_suite.NO_REWARD_VIZ = tasks("no_reward_visualization")
    dm_suite.REWARD_VIZ = tuple(sorted(everything - set(dm_suite.NO_REWARD_VIZ)))
    dm_suite.TASKS_BY_DOMAIN = dm_suite._get_tasks_by_domain(  # noqa: SLF001
        dm_suite.ALL_TASKS
    )


_register()
