"""Definition of a task of the suite."""

import dataclasses
import inspect
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from cathsim_dmc import bounds
from cathsim_dmc.anatomy import Anatomy
from cathsim_dmc.tasks.navigation import Navigation
from cathsim_dmc.tasks.objectives import Cannulation, Objective

OF_ARCHES = "arches", "pool", "first", "numbers"  # options that choose random arches


@dataclasses.dataclass(frozen=True)
class TaskDefinition:
    """A registered task: its anatomy, goal, objective and options.

    Attributes:
        description: one line.
        anatomy: anatomy or its name, or a list of which each episode draws one; None
            where the user chooses.
        goal: name of a goal; None where the user chooses.
        access: where the device enters a phantom or arch, see `load_anatomy`.
        objective: function of an anatomy, a goal and keyword options, which become
            options of the task. An option `farthest_shift` receives the largest shift
            of the goal by randomisation, m.
        options: fields of `NavigationConfig` that differ from their defaults.
        random_arch: whether each episode draws one of the random arches that the
            task's options `arches`, `pool`, `first` and `numbers` choose; `anatomy` is
            None then.
        task: class of the task. A subclass of `Navigation` that overrides hooks of
            composer makes single environments; batches refuse it.

    Raises:
        ValueError: if a field is of another kind, or an anatomy is given with
            `random_arch`.
    """

    description: str
    anatomy: str | Anatomy | Sequence[str | Anatomy] | None
    goal: str | None
    access: str | None = None
    objective: Callable[..., Objective] = Cannulation.to
    options: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    random_arch: bool = False
    task: type[Navigation] = Navigation

    def __post_init__(self):
        if not isinstance(self.description, str):
            bounds.refuse("description", self.description, "a text")
        bounds.switch("random_arch", self.random_arch)
        if self.random_arch and self.anatomy is not None:
            raise ValueError(
                f"anatomy is {bounds.shown(self.anatomy)}, but random_arch draws it; "
                "leave one of the two out"
            )
        if not isinstance(self.options, Mapping):
            allowed = "a mapping of names to values, such as {'max_steps': 200}"
            bounds.refuse("options", self.options, allowed)
        made = self.objective
        of_class = isinstance(made, type) and issubclass(made, Cannulation)
        if of_class or not callable(made):
            allowed = "a function of an anatomy and a goal, such as Cannulation.to"
            bounds.refuse("objective", made, allowed)
        if not isinstance(self.task, type) or not issubclass(self.task, Navigation):
            bounds.refuse("task", self.task, "Navigation, or a subclass of it")

    @property
    def own_options(self) -> tuple[str, ...]:
        """Names of the options that choose the anatomy and the goal."""
        if self.random_arch:
            own = ("goal", "access") if self.goal == "any" else ()
            return (*OF_ARCHES, *own)
        own = () if self.anatomy is not None else ("anatomy", "access")
        return own if self.goal is not None else (*own, "goal")

    @property
    def objective_options(self) -> tuple[str, ...]:
        """Names of the options that the objective takes."""
        return tuple(self.objective_defaults)

    @property
    def objective_defaults(self) -> dict[str, Any]:
        """Options that the objective takes, with their defaults; None without one."""
        parameters = inspect.signature(self.objective).parameters.values()
        return {
            p.name: None if p.default is p.empty else p.default
            for p in parameters
            if p.kind is p.KEYWORD_ONLY
        }
