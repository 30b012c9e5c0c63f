"""Writes docs/leaderboard.md from the submissions in docs/data/leaderboard.

cathsim submit POLICY --task TASK --out docs/data/leaderboard/NAME.json
python docs/scripts/leaderboard.py              # replays all episodes, for an hour
python docs/scripts/leaderboard.py --no-replay  # trusts the files, and states it
"""

import argparse
import re
import sys

import figures

from cathsim_dmc.agents import entries

PAGE = figures.ROOT / "docs" / "leaderboard.md"
FOLDER = figures.DATA / "leaderboard"
SAFE = "0.5 N"
_PLAIN = re.compile(r"[\w:./+-]([\w:./+, -]{0,58}[\w:./+-])?", re.ASCII)


def cell(value):
    """A text of a submission for a table, as code or without markup."""
    text = str(value)
    if _PLAIN.fullmatch(text):
        return f"`{text}`"
    shown = [one if one.isprintable() else "\N{REPLACEMENT CHARACTER}" for one in text]
    # Character references prevent Markdown and HTML.
    return "".join(one if one.isalnum() else f"&#{ord(one)};" for one in shown[:60])


def table(found):
    """The table as lines of Markdown, sorted by task and safe success.

    Args:
        found: (entry, replay) of each submission; the replay may be None.
    """
    rows = [
        f"| task | policy | success, % (95 %) | safe, {SAFE}, % | time, s "
        "| mean force, mN | version, commit | policy SHA-256 | played again |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    lines = []
    for entry, again in found:
        values = entry.values
        result = (entry if again is None else again).result
        summary, (force, _) = result.summary(), result.mean_sd("forces.mean_force")
        low, high = summary["success_ci95"]
        digest, commit = values["policy_sha256"], values["commit"]
        safe = summary["safe_success"][SAFE]
        line = (
            f"| `{entry.result.task}` | {cell(entry.result.policy)} "
            f"| {100 * summary['success']:.0f} "
            f"({100 * low:.0f}–{100 * high:.0f}) "
            f"| {100 * safe:.0f} "
            f"| {0.04 * summary['length']:.1f} "
            f"| {1e3 * force:.1f} "
            f"| {cell(values['package'])}, {cell(commit) if commit else '–'} "
            f"| {cell(digest[:12]) if digest else '–'} | {replayed(again)} |"
        )
        lines.append((entry.result.task, -safe, line))
    return [*rows, *(line for *_, line in sorted(lines, key=lambda one: one[:2]))]


def replayed(again):
    """Text of a cell on the replay."""
    if again is None:
        return "no"
    return f"{again.source}: {again.equal} of {len(again.result.episodes)} equal"


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--no-replay", action="store_true", help="believe the files")
    parser.add_argument("--threads", type=int, help="of the simulation")
    options = parser.parse_args()
    found, refused = [], 0
    for path in sorted(FOLDER.glob("*.json")):
        try:
            entry = entries.read(path)
            again = None
            if not options.no_replay:
                again = entries.replay(entry, options.threads)
                print(f"{path.name}: {replayed(again)}", file=sys.stderr)
            found.append((entry, again))
        except ValueError as error:
            print(error, file=sys.stderr)
            refused += 1
    figures.put(PAGE, leaderboard=table(found))
    return int(refused > 0)


if __name__ == "__main__":
    sys.exit(main())
