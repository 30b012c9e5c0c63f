"""Every figure of the pages comes from docs/data, and prose states no other."""

import importlib
import json
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
STATED = json.loads((ROOT / "docs" / "data" / "stated.json").read_text())

_UNIT = (
    r"(?:%|°|(?:[mµkMG]?(?:N|m|s|g|Hz|B|Pa)|min|m[Ll]|rad|nats|times"
    r"|(?:control )?steps|episodes|frames|images)(?:[·/][\w²³]+)*(?!\w))"
)
_AMOUNT = r"[-+−±]?\d[\d,]*(?:\.\d+)?(?:[eE]-?\d+)?"
# A number or a range with its unit, or a rate such as "7 of 10".
_FIGURE = re.compile(
    rf"(?<![\w.,/^-]){_AMOUNT}(?:(?: (?:to|and|or|/|±) |[–±]){_AMOUNT})*\s?{_UNIT}"
    rf"|(?<!\w)\d+ of \d+(?!\w)"
)
# What holds no prose, or a figure with its source.
_ELSEWHERE = re.compile(
    r"```.*?```"
    r"|<!-- = .+? -->.*?<!-- -->"
    r"|<!-- ([\w ]+) -->\n.*?<!-- /\1 -->"
    r"|(?m:^    [^\n]*$)"
    r"|`[^`\n]+`|\]\([^)]*\)",
    re.DOTALL,
)


def figures_of(text, stated=()):
    """Figures in the prose of a page that are neither generated nor stated.

    A row of a table whose last column is called `source` names its source itself.
    """
    lines, sourced = [], False
    for line in _ELSEWHERE.sub(" ", text).splitlines():
        cells = [cell.strip() for cell in line.strip().strip("|").split("|")]
        if not line.startswith("|"):
            sourced = False
        elif cells[-1] == "source":
            sourced = True
        if not sourced or not cells[-1]:
            lines.append(line)
    prose = re.sub(r"\s+", " ", "\n".join(lines))
    return [one for one in _FIGURE.findall(prose) if one not in stated]


def text_of(page):
    """The text of a page; of a notebook, that between its cells of code."""
    text = (ROOT / page).read_text()
    if not page.endswith(".ipynb"):
        return text
    cells = json.loads(text)["cells"]
    prose = ["".join(one["source"]) for one in cells if one["cell_type"] == "markdown"]
    return "\n\n".join(prose)


def stated_in(page):
    """What a page may state: definitions, its own, by the reason they are there."""
    own = STATED.get(page, {})
    return {one for group in (STATED["everywhere"], own) for row in group.values()
            for one in row}  # fmt: skip


@pytest.fixture
def script(monkeypatch):
    """The module docs/scripts/figures.py."""
    monkeypatch.syspath_prepend(str(ROOT / "docs" / "scripts"))
    return importlib.import_module("figures")


@pytest.fixture
def history(script, monkeypatch, tmp_path):
    """The module freshness.py over a history of a law and of a note."""
    freshness = importlib.import_module("freshness")
    monkeypatch.setattr(script, "ROOT", tmp_path)
    who = ("-c", "user.name=a", "-c", "user.email=a@b.c")
    script.git("init", "-q")
    commits = []
    for name, text in [("law", "1"), ("note", "1"), ("law", "2"), ("law", "3")]:
        (tmp_path / name).write_text(text)
        script.git("add", ".")
        script.git(*who, "commit", "-qm", text)
        commits.append(script.git("rev-parse", "--short", "HEAD").stdout.strip())
    freshness._has_moved.cache_clear()
    table = {"parts": {"laws": ["law"], "notes": ["note"]}, "equal": []}
    table |= {"files": {"*.json*": ["laws"]}, "rows": {}}
    monkeypatch.setattr(freshness, "TABLE", table)
    yield freshness, commits
    freshness._has_moved.cache_clear()


def test_the_pages_hold_the_figures_of_their_data(script):
    for page, text in script.written().items():
        assert page.read_text() == text, (
            f"{page.name} is out of date; run docs/scripts/figures.py"
        )


def test_a_figure_is_older_than_a_change_of_its_files(history):
    freshness, (first, noted, second, third) = history
    assert freshness.moved(["laws", "notes"], first) == ["laws", "notes"]
    assert freshness.moved(["laws", "notes"], noted) == ["laws"]
    assert freshness.moved(["laws"], third) == []
    assert freshness.moved(["laws"], "0123abc") == ["laws"]


def test_equal_results_keep_a_figure_in_date(history, script):
    freshness, (first, noted, second, third) = history
    span = {"parts": ["laws"], "first": second, "last": third}
    freshness.TABLE["equal"].append(span)
    assert freshness.moved(["laws"], second) == []
    assert freshness.moved(["laws"], noted) == ["laws"]
    (script.ROOT / "law").write_text("4")  # not committed yet
    freshness._has_moved.cache_clear()
    assert freshness.moved(["laws"], second) == ["laws"]


def test_a_file_is_as_old_as_its_oldest_row(history, script):
    freshness, (first, noted, second, third) = history
    lines = [{"of": "a", "commit": third}, {"of": "b", "commit": f"{third}+"}]
    rows = script.ROOT / "rows.jsonl"
    rows.write_text("\n".join(map(json.dumps, lines)))
    assert freshness.files() == {"rows.jsonl": []}
    freshness.TABLE["rows"]["rows.jsonl"] = [[{"of": "b"}, ["notes"]]]
    (script.ROOT / "note").write_text("2")
    freshness._has_moved.cache_clear()
    assert freshness.files() == {"rows.jsonl": ["notes"]}
    rows.write_text(json.dumps({"of": "a", "commit": second}))
    assert freshness.files() == {"rows.jsonl": ["laws"]}
    rows.unlink()
    parts = [{"commit": third}, {"commit": second}]
    (script.ROOT / "whole.json").write_text(json.dumps({"parts": parts}))
    assert freshness.files() == {"whole.json": ["laws"]}


def test_every_quoted_figure_depends_on_known_parts(script):
    table = json.loads((ROOT / "docs" / "data" / "depends.json").read_text())
    known = set(table["parts"])
    for _, parts in table["figures"]:
        assert set(parts) <= known
    for pattern, parts in table["files"].items():
        assert set(parts) <= known and list(ROOT.glob(pattern)), pattern
    for rows in table["rows"].values():
        assert all(set(parts) <= known for _, parts in rows)
    for paths in table["parts"].values():
        assert all((ROOT / path.removeprefix(":!")).exists() for path in paths)


def test_every_figure_has_its_origin(script):
    for name, figure in script.figures().items():
        assert set(figure) == {"value", "unit", *script.ORIGIN}, name
        assert all(figure[key] for key in script.ORIGIN), name


def test_a_quoted_figure_follows_its_data(script):
    known = {"reset": {"value": 0.71234, "unit": "ms"}}
    text = "a reset takes <!-- = reset -->1.8 ms<!-- -->"
    assert script.filled(text, known).endswith("-->0.712 ms<!-- -->")
    known["images"] = {"value": 0.878, "unit": "x"}
    text = "<!-- = images {.0%} --><!-- --> of the rate"
    assert "-->88 %<!-- --> of" in script.filled(text, known)
    with pytest.raises(KeyError, match="no figure 'memory'"):
        script.filled("<!-- = memory -->166 MB<!-- -->", known)


def test_a_quoted_figure_does_not_begin_a_line(script):
    """It would be a block of HTML there, and end the paragraph."""
    for page in script.pages():
        assert "\n<!-- = " not in page.read_text(), page.name


@pytest.mark.parametrize(
    "text, found",
    [
        ("A reset takes 0.7 ms.", ["0.7 ms"]),
        ("intrusion of 0.42 mm and 30 of\n30 episodes", ["0.42 mm", "30 of 30"]),
        ("| memory | 233 MB |", ["233 MB"]),
        ("| a | source |\n|---|---|\n| 0.18 times | Jianu |\n\n9 N", ["9 N"]),
        ("| a | source |\n|---|---|\n| 0.18 times | |", ["0.18 times"]),
        ("a reset takes <!-- = reset -->0.7 ms<!-- -->; `0.7 ms`", []),
        ("<!-- cost -->\n| 5 ms |\n<!-- /cost -->", []),
        ("a control step of 40 ms", []),
    ],
)
def test_a_typed_figure_is_found(text, found):
    assert figures_of(text, stated={"40 ms"}) == found


WRITTEN = {
    "docs/results.md",
    "docs/results_detail.md",
}  # as a whole, by docs/scripts/results.py
PAGES = [
    ROOT / "README.md",
    ROOT / "CONTRIBUTING.md",
    *(ROOT / "docs").rglob("*.md"),
    *(ROOT / "docs" / "tutorials").glob("*.ipynb"),
]
NAMES = {str(page.relative_to(ROOT)) for page in PAGES} - WRITTEN


@pytest.mark.parametrize("page", sorted(NAMES))
def test_prose_states_no_figure_that_was_measured(page):
    left = figures_of(text_of(page), stated_in(page))
    assert not left, (
        f"{page} states {left}; quote them from docs/data (docs/scripts/figures.py), "
        "or give the reason in docs/data/stated.json"
    )


def test_what_may_be_stated_is_stated():
    """No entry outlives its sentence."""
    for page, groups in STATED.items():
        if page == "everywhere":
            continue
        found = set(figures_of(text_of(page)))
        left = {one for row in groups.values() for one in row} - found
        assert not left, f"{page} no longer states {sorted(left)}"
