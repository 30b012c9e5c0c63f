"""Values that no field takes, as hypothesis strategies, and how a refusal must look."""

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
    """What is no name of anything; hypothesis draws words of the package as text."""
    bad = [st.integers(), st.text(max_size=12).map(lambda text: text + "?")]
    bad.append(st.sampled_from(["", "../x", "a\0b", b"x"]))
    bad.append(st.sampled_from([math.nan, [], {}, (1, 2), True]))
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
