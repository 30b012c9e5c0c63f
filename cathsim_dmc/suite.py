"""The task suite `cathsim`, a domain of `dm_control.suite`.

Importing this module registers the domain, so that `dm_control.suite.load` and
TorchRL's `DMControlEnv` know it too.
"""

import dataclasses
import difflib
import inspect
import math
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from dm_control import composer
from dm_control import suite as dm_suite
from dm_control.utils import containers

from cathsim_dmc import bounds, compiled_ahead
from cathsim_dmc.anatomy import Anatomy, Goal
from cathsim_dmc.tasks import observations, placement, registered
from cathsim_dmc.tasks.anatomies import load_anatomy as load_anatomy
from cathsim_dmc.tasks.anatomies import load_arches as load_arches  # for users, too
from cathsim_dmc.tasks.anatomies import load_arches_to, load_pool
from cathsim_dmc.tasks.cases import check_parts
from cathsim_dmc.tasks.config import NavigationConfig, refuse_replaced
from cathsim_dmc.tasks.definition import OF_ARCHES
from cathsim_dmc.tasks.definition import TaskDefinition as TaskDefinition
from cathsim_dmc.tasks.environment import Environment
from cathsim_dmc.tasks.navigation import Navigation
from cathsim_dmc.tasks.objectives import Objective
from cathsim_dmc.tasks.registered import COAXIAL as COAXIAL
from cathsim_dmc.tasks.scene import (
    Scene,
    chosen_devices,
    count_actions,
    longest_tip,
)

DOMAIN = "cathsim"
SUITE = containers.TaggedTasks()

# Rewards are distances outside [0, 1], which dm_control cannot visualise.
_TAG = "no_reward_visualization"
_CONFIG_FIELDS = tuple(field.name for field in dataclasses.fields(NavigationConfig))
# Further names that an option of an objective must not have.
_TAKEN = "random", "environment_kwargs", "anatomy", "goal", "access", *OF_ARCHES

TASKS: dict[str, TaskDefinition] = {}
# Functions that are called with the name of each task that is registered.
LISTENERS: list[Callable[[str], None]] = []


def register(name: str, definition: TaskDefinition, *tags: str) -> None:
    """Adds a task to the suite.

    Args:
        name: Name of the task.
        definition: Anatomy, goal, objective and options of the task.
        *tags: Tags of dm_control's suite, such as "easy".

    Raises:
        ValueError: if the name is taken or has other characters than letters, digits
            and _ : . -, or an option of the objective has the name of an option that
            all tasks have.
    """
    if not re.fullmatch(r"[\w:.-]+", bounds.text("name", name)):
        bounds.refuse("name", name, "of letters, digits and the signs _ : . -")
    bounds.instance("definition", definition, TaskDefinition)
    if taken := sorted({*_TAKEN, *_CONFIG_FIELDS} & {*definition.objective_options}):
        raise ValueError(
            f"the objective of {name!r} has the options {', '.join(taken)}, which are "
            "options of tasks and would not reach it; give them other names"
        )
    if name in TASKS:
        raise ValueError(f"there is a task {name!r} already; choose another name")
    TASKS[name] = definition

    def factory(random=None, environment_kwargs=None, **options):
        settings = bounds.options("environment_kwargs", environment_kwargs)
        return environment(make_task(name, random=random, **options), **settings)

    factory.__name__, factory.__doc__ = name, definition.description
    SUITE.add(*tags, _TAG)(factory)
    _register_domain()
    for listen in LISTENERS:
        listen(name)


def known(name: Any, modules: Sequence[str] | None = None) -> str:
    """Returns the name of a registered task.

    Args:
        name: Candidate.
        modules: Modules in the settings of a run, which may register the task. They
            are not imported here: a file from elsewhere must not choose what runs.

    Raises:
        ValueError: there is no such task; lists similar names, or modules to import.
    """
    if isinstance(name, str) and name in TASKS:
        return name
    absent = [one for one in modules or () if one not in sys.modules]
    if absent:
        options = " ".join(f"--import {one}" for one in absent)
        raise ValueError(
            f"the run was made with the task {bounds.shown(name)} and the modules "
            f"{', '.join(modules or ())}; if you trust them, import them ({options}, "
            f"in Python: import {', '.join(absent)})"
        )
    like = difflib.get_close_matches(str(name), TASKS, 4) or list(TASKS)[:4]
    return bounds.refuse(
        "task",
        name,
        f"one of the {len(TASKS)} of `cathsim list`, such as {', '.join(like)}; a task "
        "of your own is known once its module is imported (--import MODULE)",
    )


def make_task(
    name: str, random: np.random.RandomState | int | None = None, **options: Any
) -> Navigation:
    """Returns a task of the suite, without compiling an environment.

    Args:
        name: Name of a task in `SUITE`.
        random: Seed or RandomState; None draws a seed.
        **options: Fields of `NavigationConfig`, options of the task's objective (such
            as `reward` and `goal_radius`); for `navigate`, `anatomy`, `goal` (a name,
            or (x, y, z) in the unit and frame of the file that the anatomy was
            imported from) and `access`, or a list of anatomies, of which each episode
            draws one, with a goal and an access for all or for each; for random arches,
            `goal` (a name, "any", or one for each arch), `access`, and `arches`,
            `pool`, `first` and `numbers`, see `load_arches`.

    Raises:
        ValueError: if the task or an option does not exist; lists those that do.
    """
    definition = TASKS[known(name)]
    chosen, config = _configured(name, options)
    own = {key: chosen.pop(key) for key in definition.own_options if key in chosen}
    # Checked before the anatomy is built, which takes seconds.
    coaxial, living = config.devices is not None, config.vessel.living
    compiled_ahead.expect("type1_lcca_pair" if coaxial else "femoral_type1_lcca")
    observations.resolve(config.observation, coaxial, living)
    random = bounds.random_state("random", random)
    goal = own.pop("goal", definition.goal or "bca")
    access = own.pop("access", definition.access)
    if definition.random_arch:
        entered = {} if access is None else {"access": access}
        anatomies, named = load_arches_to(goal, {**entered, **own})
    else:
        anatomy = own.get("anatomy", definition.anatomy or "type1")
        anatomies, named = load_pool(anatomy, access, goal)
    mixed = not definition.random_arch and len(anatomies) > 1
    if "farthest_shift" in definition.objective_options:
        chosen["farthest_shift"] = config.randomisation.farthest_shift
    goals = list(map(placement.resolve_goal, anatomies, named))
    config = _one_length(config, anatomies, goals)

    def room(number: int) -> tuple[Scene, Objective]:
        anatomy, goal = anatomies[number], goals[number]
        objective = definition.objective(anatomy, goal, **chosen)
        check_parts(objective)
        looks: dict[str, Any] = {"one_goal": mixed, "drawn": number == 0}
        looks["goal_radius"] = objective.goal_radius
        return Scene.build(anatomy, goal, config, **looks), objective

    others = map(room, range(1, len(anatomies))) if len(anatomies) > 1 else None
    scene, objective = room(0)
    kind = definition.task
    made = kind(scene, objective, config, random, others=others, name=name)
    made.options = dict(options)
    return made


def _configured(
    name: str, given: Mapping[str, Any]
) -> tuple[dict[str, Any], NavigationConfig]:
    """Splits options into those of the task and the configuration; or ValueError."""
    options = {**TASKS[name].options, **given}
    if unknown := sorted(set(options) - {*task_options(name)}):
        having = [task for task in TASKS if {*unknown} <= {*task_options(task)}]
        others = f"; {', '.join(having)} have it" if having else ""
        if "task_kwargs" in unknown:
            others = "; give the options themselves, not a mapping of them"
        raise ValueError(
            f"{name} has no task option {', '.join(map(repr, unknown))}; there are "
            f"random, {', '.join(task_options(name))}{others}"
        )
    if (devices := options.get("devices")) is not None:
        refuse_replaced(options, devices)  # the defaults, too
    config = {k: options.pop(k) for k in _CONFIG_FIELDS if k in options}
    return options, NavigationConfig(**config)


def num_actions(name: str, **options: Any) -> int:
    """Returns the number of entries of an action, without making the task."""
    return count_actions(_configured(known(name), options)[1])


def _one_length(
    config: NavigationConfig, anatomies: Sequence[Anatomy], goals: Sequence[Goal]
) -> NavigationConfig:
    """Returns the configuration with a working length for the farthest goal."""
    if len(anatomies) == 1 or config.working_length is not None:
        return config
    device = longest_tip(chosen_devices(config))
    shift = config.randomisation.farthest_shift
    longest = max(
        placement.place_device(anatomy, goal, device, None, shift).working_length
        for anatomy, goal in zip(anatomies, goals, strict=True)
    )
    return dataclasses.replace(config, working_length=longest)


def task_options(name: str) -> tuple[str, ...]:
    """Returns the options of a task other than `random` and `environment_kwargs`."""
    definition = TASKS[name]
    of_objective = (o for o in definition.objective_options if o != "farthest_shift")
    return (*definition.own_options, *of_objective, *_CONFIG_FIELDS)


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
        task_name: Name of a task of the domain, see `SUITE`.
        task_kwargs: Options of the task: `random` (a seed), and see `make_task`.
        environment_kwargs: Arguments of `environment`.
        visualize_reward: Has no effect.

    Raises:
        ValueError: if domain, task or an option does not exist; lists those that do.
    """
    if domain_name == DOMAIN:
        known(task_name)
    if domain_name not in dm_suite._DOMAINS:  # noqa: SLF001
        raise ValueError(
            f"no domain {domain_name!r}; there are {DOMAIN} and those of "
            f"dm_control.suite: {', '.join(sorted(dm_suite.TASKS_BY_DOMAIN))}"
        )
    return dm_suite.load(
        domain_name,
        task_name,
        bounds.options("task_kwargs", task_kwargs),
        bounds.options("environment_kwargs", environment_kwargs) or None,
        visualize_reward,
    )


def environment(task: Navigation, **environment_kwargs: Any) -> Environment:
    """Returns the composer environment of a task, with the settings of the suite.

    The MJCF model of the task is compiled once, here; later changes of the model have
    no effect.

    Args:
        task: Task that no other environment owns.
        **environment_kwargs: Arguments of `composer.Environment` other than
            `random_state` and `n_sub_steps`, which the task determines.

    Raises:
        ValueError: if another environment owns the task, or it has no such argument.
    """
    if hasattr(task, "rollout"):
        raise ValueError(f"{task!r} has an environment already; make another task")
    known = [*inspect.signature(composer.Environment).parameters][1:]
    for name in ("random_state", "n_sub_steps"):  # the task's
        known.remove(name)
    bounds.mapping("environment_kwargs", environment_kwargs, known)
    _check_settings(environment_kwargs)
    settings = {
        "strip_singleton_obs_buffer_dim": True,
        "recompile_mjcf_every_episode": False,
        # Plain mj_step, as in the batched simulation.
        "legacy_step": False,
        # Divergence ends the episode with a reason.
        "raise_exception_on_physics_error": False,
        **environment_kwargs,
    }
    return Environment(task, random_state=task.random, **settings)


def _check_settings(settings: Mapping[str, Any]) -> None:
    """Checks arguments of `composer.Environment`, which checks none of them."""
    for name, value in settings.items():
        if name == "time_limit":
            if not (isinstance(value, float) and value == math.inf):
                bounds.number(name, value, unit="s", positive=True)
        elif name == "max_reset_attempts":
            bounds.whole(name, value, 1)
        elif name == "delayed_observation_padding":
            bounds.instance(name, value, composer.ObservationPadding)
        else:
            bounds.switch(name, value)


def _register_domain() -> None:
    """Registers the domain and its tasks in dm_control.suite; may be repeated."""
    dm_suite._DOMAINS[DOMAIN] = sys.modules[__name__]  # noqa: SLF001
    dm_suite.ALL_TASKS = every = dm_suite._get_tasks(None)  # noqa: SLF001
    dm_suite.EXTRA = tuple(sorted(set(every) - set(dm_suite.BENCHMARKING)))
    grouped = dm_suite._get_tasks_by_domain(every)  # noqa: SLF001
    dm_suite.TASKS_BY_DOMAIN = grouped


for _name, _definition, _tags in registered.definitions():
    register(_name, _definition, *_tags)
