"""Figures of README and the pages: kept in docs/data, written between markers.

    python docs/scripts/figures.py                          # writes all pages
    python docs/scripts/figures.py NAME COMMAND             # keeps a report, from stdin

A page quotes a figure as `<!-- = NAME -->` VALUE `<!-- -->`; this script writes VALUE.
`docs/data/figures.json` holds single figures: value, unit, command, date, machine and
commit by name. A report of a command (`--json`) is a separate file there, with the last
four beside its checks and findings; its figures are called `FILE: CHECK` and `FILE:
FINDING: …`. `{.1f}` after a name is the format of its value.

The marker `report FILE` of a page holds the report's own `table`, or else its checks:
one row, with the worst value, for checks whose names differ only in numbers or devices.
"""

import argparse
import datetime
import json
import os
import re
import statistics
import subprocess
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path

ROOT = Path(__file__).parents[2]
DATA = ROOT / "docs" / "data"
ORIGIN = ("command", "date", "machine", "commit")
QUOTED = re.compile(r"<!-- = (.+?)(?: \{(\S+)\})? -->(.*?)<!-- -->", re.DOTALL)
REPORT = re.compile(r"<!-- report (\w+) -->")
# Rows of the table of training.md on force in the reward, and their trainings.
_WITH_FORCE = {
    "imitation": "dagger-internal-published",
    "gentle": "ppo-internal-tuned-gentle",
    "control": "ppo-internal-tuned-control",
}
_VARIED = re.compile(r"\b(?:\w+_\w+|type\d|patient)\b(?: in \w+_\w+)?|\d+(?:\.\d+)?")


def pages() -> list[Path]:
    """Paths of README and all pages."""
    return [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]


def between(text: str, name: str, content: str) -> str:
    """The text with the part between `<!-- name -->` and `<!-- /name -->` replaced."""
    head, rest = text.split(f"<!-- {name} -->\n")
    _, tail = rest.split(f"<!-- /{name} -->")
    return f"{head}<!-- {name} -->\n{content.rstrip()}\n<!-- /{name} -->{tail}"


def put(page: Path, **blocks: str | list[str]) -> None:
    """Replaces blocks of a page; `_` in a name means a blank."""
    text = page.read_text(encoding="utf-8")
    for name, content in blocks.items():
        lines = content if isinstance(content, str) else "\n".join(content)
        text = between(text, name.replace("_", " "), lines)
    page.write_text(text, encoding="utf-8")


def grid(header: Sequence[str], rows: Iterable[Sequence]) -> list[str]:
    """A table as lines of Markdown."""
    first, *rest = (f"| {' | '.join(map(str, cells))} |" for cells in (header, *rows))
    return [first, "|---" * len(header) + "|", *rest]


def git(*arguments: str) -> subprocess.CompletedProcess:
    """A finished git command in the repository."""
    return subprocess.run(["git", *arguments], capture_output=True, text=True, cwd=ROOT)


def origin(command: str) -> dict[str, str]:
    """Origin of a figure: command, date of today, this machine and commit.

    The commit is the newest common one with main, since a commit of a branch may be
    rebased away; it has a "+" if the package or its benchmarks differ from it.
    """
    model = next(
        line.split(":")[1].strip()
        for line in Path("/proc/cpuinfo").read_text().splitlines()
        if line.startswith("model name")
    )
    commit = git("merge-base", "HEAD", "main").stdout.strip()[:7]
    measured = "cathsim_dmc", "benchmarks", "examples", "docs/scripts"
    if git("diff", "--quiet", commit, "--", *measured).returncode:
        commit += "+"
    values = command, str(datetime.date.today()), f"{os.cpu_count()} × {model}", commit
    return dict(zip(ORIGIN, values, strict=True))


def keep(name: str, report: dict, command: str) -> None:
    """Writes a report with its origin to docs/data."""
    values = {**origin(command), **report}
    (DATA / f"{name}.json").write_text(json.dumps(values, indent=1) + "\n")


def since(report: dict) -> str:
    """Sentence on date, machine and command of the measurement of a report."""
    return (
        f"Measured on {report['date']} by `{report['command']}` on {report['machine']} "
        f"(shared), commit {report['commit']}."
    )


def families(checks: list[dict]) -> dict[str, list[dict]]:
    """Groups of checks whose names differ only in numbers or devices."""
    found = {}
    for check in checks:
        name = _VARIED.sub("…", check["name"]).removeprefix("…: ")
        found.setdefault((name, check["unit"], check["bound"]), []).append(check)
    return {
        (key[0] if len(group) > 1 else group[0]["name"], *key[1:]): group
        for key, group in found.items()
    }


def table(checks: list[dict]) -> list[str]:
    """Table with the worst value of each family, as lines of Markdown."""
    rows = ["| check | worst | bound | checks |", "|---|---|---|---|"]
    for (name, unit, bound), group in families(checks).items():
        worst = max if bound.startswith("<=") else min
        value = f"{worst(check['value'] for check in group):.3g} {unit}".strip()
        if not all(check["passed"] for check in group):
            value = f"**{value}**, missed"
        rows.append(f"| {name} | {value} | {bound} {unit} | {len(group)} |")
    return rows


def figures() -> dict[str, dict]:
    """All figures by name."""
    found = json.loads((DATA / "figures.json").read_text())
    for path in sorted(DATA.glob("*.json")):
        report = json.loads(path.read_text())
        if not isinstance(report, dict) or "checks" not in report:
            continue
        source = {key: report[key] for key in ORIGIN}
        for check in report["checks"]:
            name = f"{path.stem}: {check['name']}"
            found[name] = {"value": check["value"], "unit": check["unit"], **source}
        for name, value in _leaves(path.stem, report.get("findings", {})):
            found[name] = {"value": value, "unit": "", **source}
    return found | _forces_by_reward()


def _forces_by_reward() -> dict[str, dict]:
    """Forces of the trained policies by seed, means over episodes, mN."""
    found = {}
    for row, training in _WITH_FORCE.items():
        for path in sorted((ROOT / "results").glob(f"*-{training}-seed*.json")):
            result = json.loads(path.read_text())
            cell, machine = result["cell"], result["machine"]
            model, finished = machine["processor"] or "?", result["finished"]
            commit, mark = result["commit"][:7], result["commit"][40:]
            source = {
                "unit": "mN",
                "command": f"python benchmarks/trainings.py --only {path.stem}",
                "date": finished.partition("T")[0],
                "machine": f"{machine['cores']} × {model}",
                "commit": commit + mark,
            }
            for name, key in (("largest sum", "largest_sum"), ("mean", "mean_force")):
                value = 1e3 * statistics.fmean(result["evaluation"]["episodes"][key])
                place = f"{name}: {cell['task']}: {row}, seed {cell['seed']}"
                found[place] = {"value": value, **source}
    return found


def _leaves(name, value):
    if isinstance(value, dict):
        for key, each in value.items():
            yield from _leaves(f"{name}: {key}", each)
    elif isinstance(value, (int, float)):
        yield name, value


def filled(text: str, known: dict[str, dict]) -> str:
    """The text with the known value of every quoted figure.

    Raises:
        KeyError: if the text quotes an unknown figure.
    """

    def write(match: re.Match) -> str:
        name, form, _ = match.groups()
        if name not in known:
            raise KeyError(f"no figure {name!r} in docs/data")
        value, unit = known[name]["value"], known[name]["unit"]
        shown = value if isinstance(value, str) else format(value, form or ".3g")
        if shown.endswith("%"):
            shown, unit = shown.replace("%", " %"), ""
        head = match.group(0).split("-->")[0]
        return f"{head}-->{shown} {unit}".rstrip() + "<!-- -->"

    return QUOTED.sub(write, text)


def written() -> dict[Path, str]:
    """Texts of all pages with current figures, by path."""
    known, texts = figures(), {}
    for page in pages():
        text = filled(page.read_text(encoding="utf-8"), known)
        for name in REPORT.findall(text):
            report = json.loads((DATA / f"{name}.json").read_text())
            own = report.get("findings", {}).get("table")
            lines = [since(report), "", own or "\n".join(table(report["checks"]))]
            text = between(text, f"report {name}", "\n".join(lines))
        texts[page] = text
    import freshness  # imported here, as it imports this module

    page = ROOT / "docs" / "figures.md"
    if freshness.has_history():
        texts[page] = between(texts[page], "figures", sources(known))
    return texts


def quoted() -> set[str]:
    """Names of the figures that some page quotes."""
    return {m[1] for page in pages() for m in QUOTED.finditer(page.read_text())}


def sources(known: dict[str, dict]) -> str:
    """The table of the figures that some page quotes, with their origin and age."""
    import freshness  # imported here, as it imports this module

    names = sorted(quoted())
    rows = [
        *freshness.summary(names, known),
        "",
        "| figure | value | command | date | commit | changed since |",
        "|---|---|---|---|---|---|",
    ]
    for name in names:
        one = known[name]
        value = one["value"]
        form = ",.0f" if not isinstance(value, str) and value >= 1000 else ".3g"
        shown = value if isinstance(value, str) else format(value, form)
        rows.append(
            f"| {name} | {shown} {one['unit']} | `{one['command']}` | {one['date']} "
            f"| {one['commit']} "
            f"| {', '.join(freshness.moved(freshness.parts_of(name), one['commit']))} |"
        )
    return "\n".join(rows)


def main(arguments: list[str]) -> None:
    if arguments:
        name, command = arguments
        keep(name, json.load(sys.stdin), command)
    for page, text in written().items():
        page.write_text(text, encoding="utf-8")
    for commit in sorted({one["commit"] for one in figures().values()}):
        if git("merge-base", "--is-ancestor", commit.rstrip("+"), "HEAD").returncode:
            print(f"commit {commit} of some figure is not in the history")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("report", nargs="*", metavar="NAME COMMAND", help="see above")
    main(parser.parse_args().report)
