"""Options of a task on the command line, from the fields of `NavigationConfig`."""

import dataclasses
import json
from collections.abc import Iterable
from typing import Annotated, Any

import docstring_parser
from tyro import conf
from tyro.constructors import PrimitiveConstructorSpec

from cathsim_dmc import bounds
from cathsim_dmc.tasks.config import NavigationConfig
from cathsim_dmc.tasks.objectives import Cannulation

_OWN = " Text or JSON; by default, and with null, that of the task or policy."
_LISTS = {"observation", "devices"}  # options that take several names, as a,b
_CONSTANTS = {"True": "true", "False": "false", "None": "null"}  # Python to JSON


@dataclasses.dataclass(frozen=True, kw_only=True)
class TaskOptions:
    """Options of a task.

    Attributes:
        anatomy: Directory of an anatomy, or name of a phantom (`navigate`), repeated
            for several, of which each episode draws one.
        goal: Name of a goal of the anatomy, or a point x,y,z in the lumen in the unit
            and frame of the file that it was imported from (`navigate`, by default
            bca). For random arches "any" cycles through the branches; lcca,any names
            one for each arch. For several anatomies one name for all, or one for each:
            lcca,bca.
        access: End of the aorta that the device enters: "ascending", or "descending" as
            from the femoral artery (`navigate`). For several anatomies one for all, or
            one for each, none for a scan: ascending,,descending.
        arches: Set of random arches that episodes draw from: train, test,
            test_variants, neck or test_neck (`arch_…`, `femoral_arch_…`, `neck_…`).
        pool: Number of arches that episodes draw from (the same tasks).
        first: Index in the set of the first arch of the pool (the same tasks).
        numbers: Indices of the arches in the set, in place of pool and first.
        option: Option of the objective of a task of your own, name=value, repeated for
            several; the value is text or JSON.
    """

    anatomy: Annotated[
        tuple[str, ...],
        conf.UseAppendAction,
        conf.arg(aliases=("--phantom",), metavar="ANATOMY"),
    ] = ()
    goal: str | None = None
    access: str | None = None
    arches: str | None = None
    pool: int | None = None
    first: int | None = None
    numbers: tuple[int, ...] | None = None
    option: Annotated[
        tuple[str, ...], conf.UseAppendAction, conf.arg(metavar="NAME=VALUE")
    ] = ()

    @property
    def given(self) -> dict[str, Any]:
        """The options that were given, by name."""
        given = {name: one for name, one in vars(self).items() if one is not None}
        chosen = given.pop("anatomy")
        if chosen:
            given["anatomy"] = list(chosen) if len(chosen) > 1 else chosen[0]
        if self.goal is not None and (several := _several(self.goal)):
            given["goal"] = several
        if self.access is not None and "," in self.access:
            given["access"] = [part.strip() or None for part in self.access.split(",")]
        for name in _LISTS & given.keys():
            if isinstance(given[name], str) and "," in given[name]:
                given[name] = [part.strip() for part in given[name].split(",")]
        for text in given.pop("option"):
            name, sign, value = text.partition("=")
            if not name or not sign or name in given:
                bounds.refuse("--option", text, "name=value, each name given once")
            given[name] = _read([value])
        return given


def _several(text: str) -> list[float] | list[str] | None:
    """Returns the parts of "12,-30.5,110" (a place) or "lcca,any"; None of one part.

    ValueError for another count of numbers.
    """
    parts = text.strip("[]() ").split(",")
    try:
        place = [float(part) for part in parts]
    except ValueError:
        return [part.strip() for part in parts] if len(parts) > 1 else None
    if len(place) == 1:
        return None
    if len(place) != 3:
        bounds.refuse("goal (--goal)", text, "a name, names, or a place x,y,z")
    return place


def _read(words: list[str]) -> Any:
    try:
        return json.loads(_CONSTANTS.get(words[0], words[0]))
    except ValueError:
        return words[0]


_VALUE = PrimitiveConstructorSpec(
    nargs=1,
    metavar="VALUE",
    instance_from_str=_read,
    is_instance=lambda value: True,
    str_from_instance=lambda value: [json.dumps(value)],
)


def task_kind(omitted: Iterable[str] = ("observation",)) -> type[TaskOptions]:
    """Returns `TaskOptions` with the fields of `NavigationConfig` and the objective.

    Args:
        omitted: Names of options that the command has no use for.
    """
    helps = field_helps(NavigationConfig)
    helps |= {name: _helps(Cannulation.to)[name] for name in ("reward", "goal_radius")}
    # Effects are objects, which no text can name.
    fields: list[tuple[str, Any, Any]] = [
        (name, Annotated[Any, _VALUE, conf.arg(help=_help(name, text))], None)
        for name, text in helps.items()
        if name not in {*omitted, "effects"}
    ]
    return dataclasses.make_dataclass(
        "TaskOptions", fields, bases=(TaskOptions,), kw_only=True, frozen=True
    )


def _help(name: str, text: str) -> str:
    return f"{text}{' Several as a,b.' if name in _LISTS else ''}{_OWN}"


def field_helps(kind: type) -> dict[str, str]:
    """Returns the descriptions of fields in the docstrings of a class and its bases."""
    helps: dict[str, str] = {}
    for one in reversed(kind.__mro__):
        if dataclasses.is_dataclass(one):
            helps |= _helps(one)
    return helps


def _helps(documented: Any) -> dict[str, str]:
    parameters = docstring_parser.parse(documented.__doc__ or "").params
    return {p.arg_name: " ".join((p.description or "").split()) for p in parameters}
