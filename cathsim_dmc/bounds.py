"""Checks of user input: type, finiteness, range.

A check returns the value as a plain Python object or numpy array. It raises a
ValueError that names the argument, the value given and the values allowed.
"""

import dataclasses
import math
import numbers
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NoReturn

import numpy as np

# Largest seed of numpy's RandomState.
MOST_SEED = 2**32 - 1
# Simulations or episodes; more would fill the memory.
MOST_SIMULATIONS = 100_000
MOST_THREADS = 4096
# Control steps of an episode: more than a year of 40 ms.
MOST_STEPS = 1_000_000_000
# Pixels along a side of an image; detectors of angiography have 1,024 to 2,480.
MOST_PIXELS = 4096
# Largest fraction of the route at which an episode may start.
MOST_START_SHARE = 0.95
# Largest distance of an anatomy from the origin, m.
FAR = 10.0

# Largest magnitude of any number: its square is finite in single precision, and no
# quantity in SI units is larger (a Young's modulus is up to 1e12 Pa).
LARGEST = 1e15

_SHOWN = 80  # characters of a value in an error
# Python and numpy register booleans and timedelta64 as integers.
_NO_NUMBERS = bool, np.bool_, np.timedelta64


def refuse(name: str, value: Any, allowed: str) -> NoReturn:
    """Raises a ValueError with the value given and the values allowed."""
    raise ValueError(f"{name} is {shown(value)}; it must be {allowed}")


def shown(value: Any) -> str:
    """Returns the representation of a value, one line of at most 80 characters."""
    try:
        text = " ".join(repr(value).split())
    except Exception:  # from the __repr__ of a user's class
        text = f"a {type(value).__name__}"
    return text if len(text) <= _SHOWN else text[: _SHOWN - 3] + "..."


def number(
    name: str,
    value: Any,
    low: float = -math.inf,
    high: float = math.inf,
    unit: str = "",
    *,
    positive: bool = False,
) -> float:
    """Returns a finite float in [low, high]; with `positive`, also above 0."""
    good = is_number(value) and low <= value <= high and (value > 0 or not positive)
    if good and abs(value) > LARGEST:
        refuse(name, value, f"at most {LARGEST:g} in magnitude")
    if not good:
        refuse(name, value, _allowed("a finite number", low, high, unit, positive))
    return float(value)


def fields(
    owner: Any,
    limits: Mapping[str, tuple[float, float, str]],
    prefix: str = "",
    positive: Sequence[str] = (),
) -> dict[str, float]:
    """Returns the checked numeric attributes of an object by name; see `number`.

    Args:
        owner: Object with the attributes.
        limits: (low, high, unit) by the name of the attribute.
        prefix: Prefix of the names in error messages.
        positive: Names of the attributes that must exceed 0.
    """
    found = {}
    for name, (low, high, unit) in limits.items():
        value, above = getattr(owner, name), name in positive
        found[name] = number(f"{prefix}{name}", value, low, high, unit, positive=above)
    return found


def settings(owner: Any, limits: Mapping[str, tuple[float, float]]) -> None:
    """Checks the fields of a dataclass that differ from their defaults.

    Integers and numbers are at least 0; other values are of the default's class.

    Args:
        limits: Other (low, high) by name.
    """
    for field in dataclasses.fields(owner):
        name, usual = field.name, field.default
        value, (least, most) = getattr(owner, name), limits.get(name, (0, math.inf))
        if isinstance(usual, int):
            low, high = (None if math.isinf(end) else int(end) for end in (least, most))
            whole(name, value, low, high)
        elif isinstance(usual, float):
            if value is not usual and value != usual:
                number(name, value, least, most)
        elif isinstance(usual, tuple):
            for one in _row(value) or refuse(name, value, "one number or more"):
                number(f"an entry of {name}", one, least, most)
        else:
            instance(name, value, type(usual))


def whole(
    name: str, value: Any, low: int | None = None, high: int | None = None
) -> int:
    """Returns an integer in [low, high]; refuses a bool."""
    least, most = -math.inf if low is None else low, math.inf if high is None else high
    if not _is_whole(value) or not least <= value <= most:
        refuse(name, value, _allowed("an integer", least, most))
    return int(value)


def seed(name: str, value: Any) -> int:
    """Returns a seed of numpy's RandomState, from 0 to 2**32 - 1."""
    return whole(name, value, 0, MOST_SEED)


def seeds(name: str, value: Any, count: int) -> list[int]:
    """Returns one seed for each of `count` simulations.

    Args:
        value: Seed of the first simulation, from which the others count up, or one
            seed for each.
    """
    if _is_whole(value):
        last = whole(name, value, 0, MOST_SEED - count + 1) + count
        return list(range(last - count, last))
    each = _row(value)
    if each is None:
        refuse(name, value, f"an integer, or {count} seeds")
    if len(each) != count:
        raise ValueError(
            f"{len(each)} seeds for {count} simulations; give one each, or the first"
        )
    return [seed(f"an entry of {name}", one) for one in each]


def indices(
    name: str, value: Any, count: int, *, ascending: bool = False
) -> np.ndarray:
    """Returns sorted, unique indices (K,) int of some of `count` simulations.

    Args:
        value: Sequence or 1-D array of at least one integer; None selects all.
        ascending: Whether to refuse unsorted or repeated indices.
    """
    if value is None:
        return np.arange(count)
    row = _row(value)
    if not row or not all(_is_whole(one) and 0 <= one < count for one in row):
        allowed = f"None for all, or integers from 0 to {count - 1} in a row"
        refuse(name, value, f"{allowed}; np.flatnonzero(mask) makes them of a mask")
    found = np.array(row, dtype=int)
    if ascending and (np.diff(found) <= 0).any():
        refuse(name, value, "in ascending order, each once")
    return np.unique(found)


def option_threads(value: int | None) -> None:
    """Checks the number of threads of an option --threads, None for one per core."""
    if value is not None:
        whole("num_threads (--threads)", value, 1, MOST_THREADS)


SIMULATION_DEVICE = re.compile(r"cpu|cuda(:\d+)?")
SIMULATION_DEVICES = "'cpu', 'cuda' or 'cuda:1'"


def option_simulation_device(value: Any) -> dict[str, str]:
    """Returns `make_env` arguments of --simulation-device; tensors stay on the CPU."""
    found = isinstance(value, str) and SIMULATION_DEVICE.fullmatch(value)
    if not found:
        name = "simulation_device (--simulation-device)"
        refuse(name, value, f"one of {SIMULATION_DEVICES}")
    return {} if value == "cpu" else {"device": f"warp:{value}"}


def random_state(name: str, value: Any) -> np.random.RandomState:
    """Returns the RandomState given, or a new one of a seed; None draws the seed."""
    if isinstance(value, np.random.RandomState):
        return value
    if value is not None and not _is_whole(value):
        refuse(name, value, "a numpy.random.RandomState, or an integer as its seed")
    return np.random.RandomState(None if value is None else seed(name, value))


def switch(name: str, value: Any) -> bool:
    """Returns True or False; refuses 0 and 1."""
    if not isinstance(value, bool | np.bool_):
        refuse(name, value, "True or False")
    return bool(value)


def text(name: str, value: Any) -> str:
    """Returns a string of 1 to 200 characters."""
    if not isinstance(value, str) or not 0 < len(value) <= 200:
        refuse(name, value, "a text of 1 to 200 characters")
    return value


def several(name: str, value: Any, allowed: str) -> list[Any]:
    """Returns the elements of an iterable that is neither a text nor empty."""
    listed = isinstance(value, Iterable) and not isinstance(value, str | bytes)
    return (list(value) if listed else []) or refuse(name, value, allowed)


def choice(name: str, value: Any, choices: Sequence[str] | Mapping[str, Any]) -> str:
    """Returns one of the names in `choices`."""
    if not isinstance(value, str) or value not in choices:
        refuse(name, value, f"one of {', '.join(choices)}")
    return value


def vector(
    name: str,
    value: Any,
    count: int,
    low: float = -math.inf,
    high: float = math.inf,
    unit: str = "",
) -> tuple[float, ...]:
    """Returns `count` finite floats in [low, high]."""
    values = _entries(value, count, is_number, low, high)
    if values is None:
        allowed = _allowed("a finite number", low, high, unit)
        refuse(name, value, f"{count} numbers, each {allowed}")
    return tuple(float(one) for one in values)


def interval(
    name: str,
    value: Any,
    low: float = -math.inf,
    high: float = math.inf,
    unit: str = "",
    *,
    integers: bool = False,
) -> tuple[float, float]:
    """Returns the ends of an interval that lies in [low, high]."""
    values = _entries(value, 2, _is_whole if integers else is_number, low, high)
    if values is None or not values[0] <= values[1]:
        kind = "an integer" if integers else "a finite number"
        allowed = _allowed(kind, low, high, unit)
        refuse(name, value, f"(low, high) with low <= high, each {allowed}")
    return values[0], values[1]


def array(
    name: str, value: Any, kinds: str = "fiu", shape: tuple[int, ...] | None = None
) -> np.ndarray:
    """Returns an array of finite numbers; its dtype stays as given.

    Args:
        value: Array, or nested sequences.
        kinds: Allowed values of `dtype.kind`.
        shape: Required shape, -1 for any size; None for any shape.
    """
    try:
        given = np.asarray(value)
    except ValueError:  # rows of different lengths
        given = np.array(None)
    fits = not given.size or given.dtype.kind in kinds
    if shape is not None and shape != given.shape:
        sizes = zip(shape, given.shape, strict=False)
        fits &= len(shape) == given.ndim and all(m in (-1, n) for m, n in sizes)
    if fits and (not given.size or np.isfinite(given).all()):
        return given
    what = f"an array of {'finite numbers' if 'f' in kinds else 'integers'}"
    if shape is not None:
        wanted = ", ".join("n" if n < 0 else str(n) for n in shape)
        what = f"{what} of shape ({wanted})"
        if not fits:
            raise ValueError(
                f"{name} is {given.dtype} of shape {given.shape}; it must be {what}"
            )
    return refuse(name, value, what)


def actions(value: Any, shape: tuple[int, ...]) -> np.ndarray:
    """Returns finite actions of a shape as float64, clipped to [-1, 1]."""
    try:
        given = array("the action", value, shape=shape)
    except ValueError as error:
        raise ValueError(
            f"{error}, in [-1, 1]: tip motors from proximal to distal (x before y), "
            "translation, and rotation if the task has it"
        ) from None
    # Faster than `np.clip`.
    return np.minimum(np.maximum(given.astype(np.float64), -1.0), 1.0)


def instance(name: str, value: Any, kind: type) -> Any:
    """Returns an object of the class `kind`."""
    if not isinstance(value, kind):
        article = "an" if kind.__name__[0] in "AEIOU" else "a"
        refuse(name, value, f"{article} {kind.__name__}")
    return value


def pixels(name: str, value: Any) -> tuple[int, int]:
    """Returns (rows, columns) of an image, given as a pair or one number for both."""
    given = [value, value] if _is_whole(value) else value
    values = _entries(given, 2, _is_whole, 1, MOST_PIXELS)
    if values is None:
        allowed = f"an integer from 1 to {MOST_PIXELS}"
        refuse(name, value, f"{allowed}, or (rows, columns), each {allowed}")
    return int(values[0]), int(values[1])


def mapping(
    name: str, value: Any, known: Iterable[str], others: str = ""
) -> Mapping[str, Any]:
    """Returns a mapping with keys in `known`; `others` precedes these in the error."""
    if not isinstance(value, Mapping) or set(value) - set(known):
        refuse(name, value, f"{others}a mapping with some of {', '.join(known)}")
    return value


def made(name: str, value: Any, kind: type, others: str = "") -> Any:
    """Returns an object of a dataclass, given itself or as a mapping of its fields."""
    if isinstance(value, kind):
        return value
    known = [field.name for field in dataclasses.fields(kind)]
    fields = mapping(name, value, known, others)
    try:
        return kind(**fields)
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from error


def options(name: str, value: Any) -> dict[str, Any]:
    """Returns a new dictionary of options by name; empty for None."""
    if value is None:
        return {}
    if not isinstance(value, Mapping) or not all(isinstance(key, str) for key in value):
        refuse(name, value, "None, or a mapping of names to values")
    return dict(value)


def _entries(
    value: Any, count: int, fits: Callable[[Any], bool], low: float, high: float
) -> list[Any] | None:
    """Returns a row of `count` entries in [low, high] as a list; None for others."""
    row = _row(value)
    if row is None or len(row) != count:
        return None
    low, high = max(low, -LARGEST), min(high, LARGEST)
    return row if all(fits(one) and low <= one <= high for one in row) else None


def _row(value: Any) -> list[Any] | None:
    """Returns a sequence or 1-D array as a list; None for other values."""
    if isinstance(value, np.ndarray):
        return list(value) if value.ndim == 1 else None
    if isinstance(value, Sequence) and not isinstance(value, str | bytes):
        return list(value)
    return None


def is_number(value: Any) -> bool:
    """Whether a value is a finite number; a bool is not."""
    if not isinstance(value, numbers.Real) or isinstance(value, _NO_NUMBERS):
        return False
    try:
        return math.isfinite(value)
    except OverflowError:  # an integer beyond all floats
        return False


def _is_whole(value: Any) -> bool:
    return isinstance(value, numbers.Integral) and not isinstance(value, _NO_NUMBERS)


def _allowed(
    kind: str, low: float, high: float, unit: str = "", positive: bool = False
) -> str:
    unit = f" {unit}" if unit else ""
    # An integer in full: a seed may be 4294967295, not 4.29497e+09.
    least, most = (f"{n}" if isinstance(n, int) else f"{n:g}" for n in (low, high))
    above = " above 0" if positive and low <= 0 else ""
    if math.isinf(low) and math.isinf(high):
        return kind + above
    if math.isinf(high):
        return f"{kind}{above}" if above else f"{kind}, at least {least}{unit}"
    if math.isinf(low) or above:
        return f"{kind}{above}, at most {most}{unit}"
    return f"{kind} from {least} to {most}{unit}"
