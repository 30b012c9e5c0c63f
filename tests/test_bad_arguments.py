"""Bad arguments of every command: exit code 2, one message, nothing written."""

import sys

import pytest
from bad_values import Tally
from hypothesis import strategies as st

from cathsim_dmc import cli

WORDS = st.sampled_from(["", "x", "1e", "nan", "inf", "None", "1,2", "--", "é", "1 2"])
WHOLE = st.one_of(WORDS, st.sampled_from(["1.5", "-1e3", "0x1"]))
POSITIVE = st.one_of(WHOLE, st.integers(max_value=0).map(str))
SEED = st.one_of(WHOLE, st.integers(max_value=-1).map(str), st.just("4294967296"))
NUMBER = st.sampled_from(["", "x", "1,5", "--", "1 mm", "1e", "None"])
# "None" is a value of options that may be left to the task.
OPTIONAL_WHOLE, OPTIONAL_NUMBER = (
    values.filter(lambda word: word != "None") for values in (POSITIVE, NUMBER)
)
NAME = st.one_of(
    st.just(""), st.text("abcxyz/._-", min_size=2, max_size=9).map("q".__add__)
)
EVAL = ("eval", "push", "--task", "type1_bca", "--out", "OUT")
RECORD = ("record", "push", "--task", "type1_bca", "--out", "OUT.rrd")
TRAIN = ("train", "type1_bca", "--out", "OUT")
# Command with what it needs; option to bad values. Without an option it is a command's
# own argument that is bad.
COMMANDS = [
    ((), "", NAME),
    (("eval", "--task", "type1_bca", "--out", "OUT"), "", NAME),
    (EVAL, "--episodes", POSITIVE),
    (EVAL, "--seed", SEED),
    (EVAL, "--threads", OPTIONAL_WHOLE),
    (("eval", "push", "--out", "OUT"), "--task", NAME),
    (RECORD, "--seed", SEED),
    (RECORD, "--max-steps", OPTIONAL_WHOLE),
    (("record", "push", "--out", "OUT.rrd"), "--task", NAME),
    (("record", "push", "--task", "type1_bca"), "--out", NAME),
    (("train", "--out", "OUT"), "", NAME),
    (TRAIN, "--algo", NAME),
    (TRAIN, "--preset", NAME),
    (TRAIN, "--num-envs", POSITIVE),
    (TRAIN, "--frames", POSITIVE),
    (TRAIN, "--learning-rate", st.one_of(NUMBER, st.just("-1"), st.just("0"))),
    (TRAIN, "--gamma", st.one_of(NUMBER, st.sampled_from(["2", "-0.1"]))),
    (TRAIN, "--friction", st.one_of(OPTIONAL_NUMBER, st.sampled_from(["3", "-0.1"]))),
    (TRAIN, "--max-steps", OPTIONAL_WHOLE),
    (TRAIN, "--device", NAME),
    (TRAIN, "--observation", NAME),
    (("phantom", "generate", "--out", "OUT"), "", NAME),
    (("phantom", "generate", "I", "--out", "OUT"), "--seed", WHOLE),
    (("phantom", "generate", "test", "--out", "OUT"), "--index", SEED),
    (("phantom", "generate", "type1", "--out", "OUT"), "--access", NAME),
    (("phantom", "check"), "", NAME),
    (("phantom", "build", "--out", "OUT"), "", NAME),
    (("phantom", "import", "--out", "OUT"), "", NAME),
    (("phantom", "import", "none.stl", "--out", "OUT"), "--units", NAME),
    (("phantom", "import", "none.stl", "--out", "OUT"), "--axes", NAME),
    (("phantom", "import", "none.stl", "--out", "OUT"), "--wall", NAME),
    (("replay",), "", NAME),
    (("replay-error",), "", NAME),
    (EVAL, "--start", NAME),
    (("validate",), "", NAME),
    (("benchmark",), "", NAME),
]


@pytest.fixture
def refuse(tmp_path, monkeypatch, capfd):
    """Returns a function that tries every command so often, and gives the tally."""
    monkeypatch.chdir(tmp_path)
    tally = Tally()

    def run(given):
        monkeypatch.setattr(sys, "argv", ["cathsim", *given])
        try:
            cli.main()
            code = 0
        except SystemExit as end:
            code = end.code or 0
        out, err = capfd.readouterr()
        written = sorted(p.name for p in tmp_path.iterdir())
        if code != 2 or out or "Traceback" in err or written or not err.strip():
            return f"code {code}, wrote {written}, said {out[-80:]!r} {err[-200:]!r}"
        raise ValueError("refused")

    def every(examples):
        for command, option, bad in COMMANDS:

            def check(value, command=command, option=option):
                given = [*command, option, value] if option else [*command, value]
                name = f"cathsim {' '.join(command[:2])} {option}".strip()
                tally.refused(name, lambda: run(given), ["refused"], note=repr(value))

            tally.draw(bad, examples, check)
        print(tally.report())
        shown = "\n".join(sorted(set(tally.wrong))[:100])
        assert not tally.wrong, f"{len(tally.wrong)} of {tally.tried.total()}:\n{shown}"
        return tally

    return every


@pytest.mark.parametrize("examples", [1, pytest.param(8, marks=pytest.mark.slow)])
def test_bad_arguments_end_with_two_and_write_nothing(refuse, examples):
    assert refuse(examples).tried.total() >= 5 * examples * len(COMMANDS) // 8
