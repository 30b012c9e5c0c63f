"""Values that no field takes, as hypothesis strategies, and how a refusal must look."""

import copy
import json
import math
from collections import Counter

from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

# No number of anything, to anybody.
_NO_NUMBERS = st.one_of(
    st.sampled_from(["", "x", "1", "nan", "None", "1 mm", b"1", 1j, (), [], {}]),
    st.sampled_from([[1.0], (1, 2, 3), {"a": 1}, True, False, object, {1.0}]),
    st.sampled_from([math.nan, math.inf, -math.inf]),
)
NONE = st.none()


def number(low=-math.inf, high=math.inf, *, positive=False, optional=False):
    """What is no finite number from `low` to `high`."""
    bad = [_NO_NUMBERS] if optional else [_NO_NUMBERS, NONE]
    if positive:
        bad.append(st.just(0.0))
        low = max(low, 0.0)
    if low > -math.inf:
        least = low - max(abs(low), 1.0) * 1e-3
        bad.append(st.floats(max_value=least, allow_infinity=False))
    if high < math.inf:
        most = high + max(abs(high), 1.0) * 1e-3
        bad.append(st.floats(min_value=most, allow_infinity=False))
    return st.one_of(bad)


def whole(low=None, high=None, *, optional=False):
    """What is no integer from `low` to `high`."""
    bad = [number(optional=optional), st.floats(0, 1e6).map(lambda x: x + 0.5)]
    if low is not None:
        bad.append(st.integers(max_value=low - 1))
    if high is not None:
        bad.append(st.integers(min_value=high + 1))
    return st.one_of(bad)


def flag():
    """What is neither True nor False."""
    return st.one_of(
        NONE, st.integers(), st.sampled_from(["", "True", "False", [], 0.0, math.nan])
    )


def word(*, optional=False):
    """What is no name of anything."""
    bad = [st.integers(), st.text(max_size=12).filter(lambda t: t not in "12")]
    bad += [st.sampled_from([math.nan, [], {}, (1, 2), b"x", True, "../x", "a\0b"])]
    return st.one_of(bad if optional else [*bad, NONE])


def span(low=-math.inf, high=math.inf, *, integers=False):
    """What is no (low, high)."""
    one = whole(int(low), int(high)) if integers else number(low, high)
    middle = 0 if low <= 0 <= high else low
    return st.one_of(
        one.filter(lambda value: value is not None),
        st.tuples(one, st.just(middle)),
        st.tuples(st.just(middle), one),
        st.sampled_from([(), (middle,), (middle,) * 3, "ab", {middle: middle}]),
    )


def pixels():
    """What is no size of an image."""
    one = whole(1, 4096)
    return st.one_of(
        one, st.tuples(one, st.just(64)), st.tuples(st.just(64), one), st.just((1,) * 3)
    )


def options():
    """What is no mapping of options."""
    values = ["x", 1, 1.5, [], [1], math.nan, {"no such option": 1}, {1: 2}]
    return st.sampled_from(values)


def wrong(value):
    """Values of another kind than that of an entry of a JSON document."""
    if isinstance(value, bool):
        return st.sampled_from([None, "true", 2, [], {}])
    if isinstance(value, int | float):
        bad = [None, "1", True, math.nan, math.inf, -math.inf, 1e300, [], {}, [1]]
        return st.sampled_from(bad)
    if isinstance(value, str):
        return st.sampled_from([None, 1, 1.5, True, [], {}, ["x"]])
    if isinstance(value, list):
        return st.sampled_from([None, 1, "x", True, {}, {"a": 1}])
    if isinstance(value, dict):
        return st.sampled_from([None, 1, "x", True, [], [1]])
    return st.sampled_from([1, True, [], {}, 0.5])


def places(document, path=()):
    """Paths of all entries of a JSON document; of a list the first two and the last."""
    items = {}
    if isinstance(document, dict):
        items = document
    elif isinstance(document, list):
        chosen = {0, 1, len(document) - 1}
        items = {i: document[i] for i in chosen if 0 <= i < len(document)}
    for key, value in items.items():
        yield (*path, key)
        yield from places(value, (*path, key))


@st.composite
def damaged_json(draw, document, harmless=lambda path, value: False):
    """A document with one entry of a wrong kind or left out, and where.

    Args:
        draw: From hypothesis.
        document: What is right.
        harmless: Whether an entry at a path may have a value, None for left out.
    """
    path = draw(st.sampled_from(sorted(places(document), key=repr)))
    changed = copy.deepcopy(document)
    *way, last = path
    inner = changed
    for key in way:
        inner = inner[key]
    leave_out = isinstance(inner, dict) and draw(st.integers(0, 4)) == 0
    value = "left out" if leave_out else draw(wrong(inner[last]))
    if harmless(path, value):
        value = "left out"  # of all
        return json.dumps([]), ()
    if leave_out:
        del inner[last]
    else:
        inner[last] = value
    return json.dumps(changed), path


@st.composite
def damaged_bytes(draw, data):
    """A file cut off, emptied, overwritten or with flipped bits."""
    way = draw(st.sampled_from(["cut", "empty", "text", "noise", "flip", "zeros"]))
    if way == "cut":
        return data[: draw(st.integers(1, len(data) - 1))]
    if way == "flip":
        at = draw(st.integers(0, len(data) - 1))
        return (
            data[:at] + bytes([data[at] ^ draw(st.integers(1, 255))]) + data[at + 1 :]
        )
    if way == "zeros":
        at = draw(st.integers(0, len(data) - 1))
        return data[:at] + bytes(len(data) - at)
    others = {"empty": b"", "text": b"not what it seems\n"}
    return others.get(way) or (b"" if way == "empty" else draw(st.binary(max_size=200)))


# What readers of files raise.
ERRORS = (ValueError, OSError, RuntimeError)


class Tally:
    """Counts bad inputs by entry, and what became of them."""

    def __init__(self):
        self.tried = Counter()
        self.wrong = []

    def refused(self, entry, call, words=(), errors=(ValueError, OSError), note=""):
        """Calls with bad input; the error must say so in one line with the words."""
        entry_, entry = entry, f"{entry} {note}".strip()
        self.tried[entry_] += 1
        try:
            result = call()
        except errors as error:
            text = str(error)
            missing = [w for w in map(str, words) if w not in text]
            if missing or "\n" in text.strip() or not text:
                self.wrong.append(f"{entry}: {missing} not in, or lines: {text[:300]}")
        except BaseException as error:
            self.wrong.append(f"{entry}: crashed with {type(error).__name__}: {error}")
        else:
            self.wrong.append(f"{entry}: accepted, gave {str(result)[:300]}")

    def draw(self, strategy, count, check):
        """Calls `check` with so many examples of a strategy."""

        # Failures are collected, so nothing is shrunk or tried again.
        @settings(
            max_examples=count,
            database=None,
            derandomize=True,
            phases=[Phase.generate],
            suppress_health_check=list(HealthCheck),
        )
        @given(strategy)
        def run(value):
            check(value)

        run()

    def report(self):
        """One line for each entry."""
        lines = [f"{count:6d}  {entry}" for entry, count in sorted(self.tried.items())]
        total = f"{self.tried.total():6d}  bad inputs, {len(self.wrong)} not refused"
        return "\n".join([*lines, total])


def try_json(tally, entry, path, load, examples, harmless=lambda path, value: False):
    """Damages one entry of a JSON file, and loads it."""
    good = path.read_text()

    def check(damaged):
        text, where = damaged
        path.write_text(text)
        tally.refused(f"{entry}, entries", load, [path.name], ERRORS, note=where)

    try:
        tally.draw(damaged_json(json.loads(good), harmless), examples, check)
    finally:
        path.write_text(good)
    load()


def try_bytes(tally, entry, path, load, examples, same=None, named=None):
    """Damages the bytes of a file, and loads it; `same` tells whether all is there."""
    good = path.read_bytes()

    def check(data):
        if data == good:
            return
        path.write_bytes(data)

        def read():
            result = load()
            if same is not None and same(result):
                # A flipped bit that nobody reads, such as the time of a zip's entry.
                raise ValueError(path.name)
            return result

        tally.refused(f"{entry}, bytes", read, [named or path.name], ERRORS)

    try:
        tally.draw(damaged_bytes(good), examples, check)
    finally:
        path.write_bytes(good)


def try_all(attempts, folder, examples, least):
    """Tries what damages files of a folder; all is refused and nothing is written."""
    tally, before = Tally(), sorted(folder.rglob("*"))
    for one in attempts:
        one(tally, folder, examples)
    assert sorted(folder.rglob("*")) == before, "something was written"
    print(tally.report())
    shown = "\n".join(sorted(set(tally.wrong))[:200])
    assert not tally.wrong, f"{len(tally.wrong)} of {tally.tried.total()}:\n{shown}"
    assert tally.tried.total() > least
