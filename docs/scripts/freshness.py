"""Lists figures whose dependencies have changed since they were measured.

    python docs/scripts/freshness.py  # exits with 1 if there are any

`docs/data/depends.json` lists the files of the package that each figure depends on, and
the commits between which a part of them gave the same results although its files
changed. The current files are compared with those of the commit of the figure.
"""

import argparse
import fnmatch
import functools
import json
import re
import sys
from collections.abc import Iterable
from pathlib import Path

import figures

_COMMIT = re.compile(r'"commit": "([^"]+)"')
TABLE = json.loads((figures.DATA / "depends.json").read_text())


def parts_of(name: str) -> list[str]:
    """Parts of the package that a figure depends on, by the first matching pattern."""
    patterns = TABLE["figures"]
    return next(parts for one, parts in patterns if fnmatch.fnmatchcase(name, one))


def moved(parts: Iterable[str], commit: str) -> list[str]:
    """Parts whose results may differ from those at a commit.

    Args:
        parts: Names of parts.
        commit: Commit of the measurement; with "+" if files differed from it.

    Returns:
        Names of these parts; all parts if the commit is not in the history.
    """
    return [part for part in parts if _has_moved(part, commit.rstrip("+"))]


@functools.cache
def _has_moved(part: str, commit: str) -> bool:
    for span in TABLE["equal"]:
        first, last = span["first"], span["last"]
        if part not in span["parts"]:
            continue
        if _is_before(first, commit) and _is_before(commit, last):
            commit = last
    changed = figures.git("diff", "--quiet", commit, "--", *TABLE["parts"][part])
    return changed.returncode != 0


@functools.cache
def _is_before(first: str, last: str) -> bool:
    return not figures.git("merge-base", "--is-ancestor", first, last).returncode


def has_history() -> bool:
    """Whether the history has the commits of the table, unlike a shallow clone."""
    ends = {span[key] for span in TABLE["equal"] for key in ("first", "last")}
    return all(_is_before(end, "HEAD") for end in ends)


def files() -> dict[str, list[str]]:
    """Parts that have changed since each file of results was written, by file."""
    found = {}
    for pattern, parts in TABLE["files"].items():
        for path in sorted(figures.ROOT.glob(pattern)):
            name = str(path.relative_to(figures.ROOT))
            old = {one for args in _measured(path, parts) for one in moved(*args)}
            found[name] = sorted(old)
    return found


def _measured(path: Path, parts: list[str]) -> set[tuple[tuple[str, ...], str]]:
    """Parts and commits of what a file holds, of all of it or of each row.

    A commit is one that the file or the row names, else the last one that changed the
    file. A row with the values of an entry of "rows" depends on the parts there, too.
    """
    text, own = path.read_text(), TABLE["rows"].get(path.name, [])
    found = set()
    for row in text.splitlines() if path.suffix == ".jsonl" else [text]:
        values = json.loads(row)
        more = [extra for some, extra in own if some.items() <= values.items()]
        commits = _COMMIT.findall(row) or [_last_change(path)]
        found |= {((*parts, *sum(more, [])), commit) for commit in commits}
    return found


@functools.cache
def _last_change(path: Path) -> str:
    """The last commit that changed a file."""
    return figures.git("log", "-1", "--format=%h", "--", str(path)).stdout.strip()


def summary(names: list[str], known: dict[str, dict]) -> list[str]:
    """Lines of Markdown on the age of figures and files of results."""
    old = {name: moved(parts_of(name), known[name]["commit"]) for name in names}
    count = sum(map(bool, old.values()))
    lines = [
        f"Of {len(names)} figures {count} are older than the last change of what they "
        "depend on (last column; `docs/data/depends.json` says what that is). Files of "
        "results older than such a change:",
        "",
    ]
    groups, rows = {}, []
    for name, parts in files().items():
        groups.setdefault(name.rpartition("/")[0], {})[name] = parts
    for folder, found in groups.items():
        if len(found) < 10:
            rows += [
                (f"`{name}`", "yes" if parts else "no", _shown(parts))
                for name, parts in found.items()
            ]
        else:
            older = sum(map(bool, found.values()))
            parts = sorted(set().union(*found.values()))
            rows.append((f"`{folder}`", f"{older} of {len(found)}", _shown(parts)))
    return lines + figures.grid(("files", "older", "changed since"), rows)


def _shown(parts: list[str]) -> str:
    return ", ".join(parts) or "–"


def main() -> int:
    """Prints what is older than a change of its parts; returns the exit status."""
    old = {
        name: moved(parts_of(name), one["commit"])
        for name, one in figures.figures().items()
        if name in figures.quoted()
    } | files()
    for name, parts in old.items():
        if parts:
            print(f"{name}: {_shown(parts)}")
    return int(any(old.values()))


if __name__ == "__main__":
    argparse.ArgumentParser(description=__doc__.splitlines()[0]).parse_args()
    sys.exit(main())
