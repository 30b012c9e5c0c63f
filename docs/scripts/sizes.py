"""Packages and MB that each extra adds to the base, for docs/install.md.

    python docs/scripts/sizes.py

Counts files of the current environment, and of those whose site-packages are in
PYTHONPATH; the table names packages that are installed in none of them. Writes the
table between the markers of the page.
"""

import argparse
import tomllib
from importlib import metadata
from pathlib import Path

from figures import grid, put
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parents[2]
OWN = "cathsim-dmc"
HEAD = "extra", "brings", "packages", "MB", "largest"


def needed(requirements: list[str], found: dict[str, set[str]]) -> dict[str, set[str]]:
    """Packages of requirements and of their dependencies, as sets of extras by name."""
    for text in requirements:
        one = Requirement(text)
        name = canonicalize_name(one.name)
        if name == "labmaze":
            continue
        missing = set(one.extras or {""}) - found.get(name, set())
        wanted = one.marker is None or one.marker.evaluate({"extra": ""})
        if not wanted or not missing:
            continue
        found.setdefault(name, set()).update(missing, {""})
        try:
            theirs = metadata.requires(name) or []
        except metadata.PackageNotFoundError:
            continue
        kept = []
        for each in theirs:
            marker = Requirement(each).marker
            extras = {"", *one.extras}
            if marker is None or any(marker.evaluate({"extra": e}) for e in extras):
                kept.append(each.partition(";")[0])
        needed(kept, found)
    return found


def size(name: str) -> float | None:
    """Size of an installed package, MB; None if it is not installed."""
    try:
        files = metadata.files(name) or []
    except metadata.PackageNotFoundError:
        return None
    there = [Path(str(one.locate())) for one in files]
    return sum(one.stat().st_size for one in there if one.is_file()) / 1e6


def row(label: str, brings: str, names: set[str]) -> list[str]:
    """A row of the table for an extra and the packages that it adds."""
    sizes = {name: size(name) for name in names}
    known = {name: one for name, one in sizes.items() if one is not None}
    missing = sorted(name for name, one in sizes.items() if one is None)
    largest = sorted(known, key=known.__getitem__, reverse=True)[:3]
    words = [f"{name} {known[name]:.0f}" for name in largest]
    words += [f"not measured: {', '.join(missing)}"] if missing else []
    total = f"{sum(known.values()):.0f}"
    return [label, brings, str(len(names)), total, ", ".join(words)]


def main() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    base = set(needed(project["dependencies"], {}))
    rows = [row("none", "the base", base)]
    for name, texts in extras.items():
        own = [x for x in texts if not x.startswith(OWN)]
        inner = [x[len(OWN) + 1 : -1] for x in texts if x.startswith(OWN)]
        own += [x for one in inner for x in extras[one]]
        brought = [Requirement(x).name for x in texts if not x.startswith(OWN)]
        brings = ", ".join([*(f"`{x}`" for x in inner), *brought])
        more = set(needed(own, {})) - base
        rows.append(row(f"`{name}`", brings, more))
    lines = grid(HEAD, rows)
    put(ROOT / "docs" / "install.md", sizes=lines)
    print(*lines, sep="\n")


if __name__ == "__main__":
    argparse.ArgumentParser(description=__doc__.splitlines()[0]).parse_args()
    main()
