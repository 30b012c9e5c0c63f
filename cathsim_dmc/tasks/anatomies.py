"""Anatomies that a task can be given: a phantom, a directory, random arches."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from cathsim_dmc import bounds
from cathsim_dmc.anatomy import Anatomy
from cathsim_dmc.tasks import placement

# Goals in the branches of an arch.
BRANCHES = ("bca", "rcca", "lcca", "lsa", "rsa")
GOALS = (*BRANCHES, "rva", "lva")  # with the vertebral arteries of a neck
POOL = 16  # default number of arches that an episode draws from


def load_anatomy(anatomy: str | Path | Anatomy, access: str | None = None) -> Anatomy:
    """Returns an anatomy: itself, a phantom by name, or one saved in a directory.

    Args:
        access: Where the device enters a phantom, "ascending" (also with None) or
            "descending"; an anatomy or a directory has its own inlet.

    Raises:
        ValueError: if there is no such anatomy, or it has no such access.
    """
    if not isinstance(anatomy, str | Path | Anatomy):
        bounds.refuse("anatomy", anatomy, "an Anatomy, a name or a directory")
    from cathsim_dmc.anatomy import phantoms  # late: what builds them is slow to import

    if not isinstance(anatomy, Anatomy) and str(anatomy) in phantoms.PHANTOMS:
        return phantoms.load(
            str(anatomy), **({} if access is None else {"access": access})
        )
    if access is not None:
        raise ValueError(
            f"access {access!r} is given, but only a phantom "
            f"({', '.join(phantoms.PHANTOMS)}) has several; leave it out, or import "
            "the scan with another inlet (--inlet); for a list of anatomies, give a "
            "list with None for this one"
        )
    if isinstance(anatomy, Anatomy):
        return anatomy
    path = Path(anatomy)
    if not path.is_dir():
        kind = ", which is a file" if path.exists() else ""
        raise ValueError(
            f"no anatomy at {str(anatomy)!r}{kind}; give a directory written by "
            "`cathsim phantom import`, `build` or `generate`, or one of "
            f"{', '.join(phantoms.PHANTOMS)}"
        )
    return Anatomy.load(anatomy)


def is_pool(anatomy: Any) -> bool:
    """Whether an option `anatomy` is a list, of which each episode draws one."""
    return isinstance(anatomy, Sequence) and not isinstance(anatomy, str)


def anatomy_name(anatomy: str | Path | Anatomy) -> str:
    """Returns the name of an anatomy that `load_anatomy` takes, without loading it."""
    return anatomy.name if isinstance(anatomy, Anatomy) else Path(anatomy).name


def lumens(anatomy: Any) -> list[str]:
    """Returns name and digest of each lumen that an option `anatomy` names."""
    given = anatomy if is_pool(anatomy) else [anatomy]
    return [f"{one.name} {one.digest}" for one in map(load_anatomy, given)]


def load_pool(
    anatomy: Any, access: Any, goal: Any
) -> tuple[list[Anatomy], list[str | Sequence[float]]]:
    """Returns the anatomies that the options of a task name, and the goal in each.

    Args:
        anatomy: As for `load_anatomy`, or a list of such.
        access: As for `load_anatomy`, or a list with one for each anatomy.
        goal: A goal, or a list with one for each of several anatomies.

    Raises:
        ValueError: if there is no such anatomy or access, a list is empty, or lists
            differ in length.
    """
    if not is_pool(anatomy):
        return [load_anatomy(anatomy, access)], [goal]
    if not anatomy:
        bounds.refuse("anatomy", anatomy, "an anatomy, or a list with one at least")
    ways, goals = (
        _one_for_each(name, one, len(anatomy))
        for name, one in {"access": access, "goal": goal}.items()
    )
    return [load_anatomy(a, w) for a, w in zip(anatomy, ways, strict=True)], goals


def _one_for_each(name: str, given: Any, count: int) -> list[Any]:
    """Returns an option as a list with an entry for each of several anatomies."""
    if given is None or isinstance(given, str):
        return [given] * count
    if not isinstance(given, Sequence) or len(given) != count:
        bounds.refuse(name, given, f"one name, or a list of {count}, as of anatomies")
    return list(given)


def arch_numbers(options: Mapping[str, Any]) -> tuple[int, ...]:
    """Returns the numbers in their set of the arches that options choose.

    Args:
        options: Options of `load_arches`.

    Raises:
        ValueError: if the set or an arch does not exist, or `numbers` is empty or given
            together with `pool` or `first`.
    """
    from cathsim_dmc.anatomy.arch import arch  # late, as in `load_anatomy`

    arches, numbers = options.get("arches", "train"), options.get("numbers")
    size = len(arch.arch_set(bounds.choice("arches", arches, arch.SETS)))
    if numbers is None:
        pool, first = options.get("pool", POOL), options.get("first", 0)
        bounds.whole(f"pool of arches {arches!r}", pool, 1, size)
        bounds.whole(f"first of arches {arches!r}", first, 0, size - pool)
        return tuple(range(first, first + pool))
    if not {"pool", "first"}.isdisjoint(options):
        raise ValueError(
            "option numbers names the arches; leave out pool and first, which do so too"
        )
    found = tuple(bounds.array("numbers", numbers, "i", (-1,)).tolist())
    if not found:
        raise ValueError("option numbers names no arch; leave it out, or give some")
    for number in found:
        bounds.whole(f"numbers of arches {arches!r}", number, 0, size - 1)
    return found


def load_arches(
    arches: str = "train",
    pool: int = POOL,
    first: int = 0,
    *,
    numbers: Sequence[int] | None = None,
    access: str = "ascending",
) -> list[Anatomy]:
    """Random arches of a named set, in the order of their seeds; see `arch_set`.

    Args:
        arches: Name of the set, one of `arch.SETS`.
        pool: Number of arches; building one takes about a second and a half.
        first: Number of the first one in the set.
        numbers: Numbers of the arches in the set, in place of pool and first.
        access: Where the device enters, "ascending" or "descending"; "any" alternates
            by the number in the set, and takes the other one if no sheath fits.

    Raises:
        ValueError: if the set or an arch does not exist, or no sheath fits before the
            inlet of an arch.
    """
    from cathsim_dmc.anatomy.arch import arch
    from cathsim_dmc.anatomy.builder import ACCESSES

    bounds.choice("access", access, ("any", *ACCESSES))
    chosen = {"arches": arches, "numbers": numbers}
    if numbers is None or (pool, first) != (POOL, 0):
        chosen |= {"pool": pool, "first": first}
    chosen_numbers, seeds, found = arch_numbers(chosen), arch.arch_set(arches), []
    for number in chosen_numbers:
        way = ACCESSES[number % 2] if access == "any" else access
        anatomy = arch.build_seed(seeds[number], access=way)
        if access == "any" and placement.sheath_direction(anatomy) is None:
            way = ACCESSES[1 - number % 2]
            anatomy = arch.build_seed(seeds[number], access=way)
        found.append(anatomy)
    closed = [a.name for a in found if placement.sheath_direction(a) is None]
    if closed:
        instead = "other numbers" if numbers else "another first, or a smaller pool"
        raise ValueError(
            f"no sheath fits before the inlet of {', '.join(closed)}, whose aorta "
            f"bends back across it; give {instead}"
        )
    return found


def load_arches_to(
    goal: str | Sequence[str], options: Mapping[str, Any]
) -> tuple[list[Anatomy], list[str]]:
    """Returns the random arches that options choose, and the name of each one's goal.

    Args:
        goal: See `goals_for`.
        options: Options of `load_arches`.

    Raises:
        ValueError: see `load_arches` and `goals_for`; goals are checked before any arch
            is built.
    """
    numbers = arch_numbers(options)
    each = goals_for(goal, numbers)
    found = load_arches(**options)
    return found, list(map(goal_of, found, each, numbers))


def goals_for(goal: str | Sequence[str], numbers: Sequence[int]) -> list[str]:
    """Expands the option `goal` to a list with one name or "any" for each arch.

    Raises:
        ValueError: if a name does not exist, or there are not as many as arches.
    """
    if isinstance(goal, str) or not isinstance(goal, Sequence):
        each = [goal] * len(numbers)
    else:
        each = list(goal)
    for one in each:
        bounds.choice("goal", one, ("any", *GOALS))
    if len(each) != len(numbers):
        raise ValueError(
            f"option goal has {len(each)} names for {len(numbers)} arches; give one "
            "name for all of them, or one for each"
        )
    return each


def goal_of(anatomy: Anatomy, goal: str, number: int) -> str:
    """Returns the name of a goal; "any" cycles through the branches by `number`."""
    if goal != "any":
        return goal
    branches = [name for name in GOALS if name in anatomy.goals]
    return branches[number // 2 % len(branches)]
