"""Comparison of evaluations: a row for each, and the rules under which it was played.

Rules are what decides whether two rows may be compared: task, protocol, seeds, options
of the task, and which reading of the force a file has.
"""

import dataclasses
import inspect
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from cathsim_dmc import json_options, suite
from cathsim_dmc.agents import evaluation_files
from cathsim_dmc.agents.results import EvaluationResult
from cathsim_dmc.analysis.force_statistics import millinewtons
from cathsim_dmc.tasks.config import NavigationConfig

# Options that decide what a policy observes or is paid for, which no column shows.
_NO_RULES = {
    "observation", "fluoroscopy", "cameras", "endoluminal_size", "reward",
    "farthest_shift",
}  # fmt: skip
SAFE = "0.5 N"
CAPTION = (
    "Success with Wilson's 95 % interval, none where episodes are nearly identical or "
    "recur. Conditions: different ones of all episodes. Safe: successes in which the "
    f"sum of the wall forces stays at or below {SAFE}. Steps and forces: mean ± "
    "standard deviation over episodes. Mean: sum over all contacts, mean over all "
    "steps; contact: largest contact, mean over the steps with contact; largest: "
    "largest contact of an episode."
)


class Row(NamedTuple):
    """One evaluation of a comparison.

    Attributes:
        path: File that it was read from.
        result: The evaluation.
        rules: Number of its rules in `Comparison.rules`, from 1.
    """

    path: Path
    result: EvaluationResult
    rules: int


@dataclasses.dataclass(frozen=True)
class Comparison:
    """Evaluations side by side.

    Attributes:
        rows: The evaluations, in the order given.
        rules: Rules that rows were played under, each once, in the order of the rows.
    """

    rows: tuple[Row, ...]
    rules: tuple[Mapping[str, Any], ...]

    def __repr__(self) -> str:
        """The table, its caption and the rules."""
        return "\n".join(self.markdown())

    _repr_markdown_ = __repr__  # of a notebook

    @classmethod
    def of(cls, paths: Iterable[str | Path], baseline: bool = True) -> "Comparison":
        """Reads files of evaluations, and those in folders.

        Args:
            paths: Files, and folders, which are searched with their folders.
            baseline: Whether the baselines of the files are rows too. Equal ones are
                one row.

        Raises:
            ValueError: a file holds no evaluation, or there is no list of paths.
            OSError: there is no such file, or none in a folder.
        """
        rows: list[Row] = []
        rules: list[Mapping[str, Any]] = []
        for path in evaluation_files.found_in(paths):
            for which, attributes in evaluation_files.read(path).items():
                result = EvaluationResult(**attributes)
                if which == "baseline" and (
                    not baseline or any(result == row.result for row in rows)
                ):
                    continue
                own = rules_of(result)
                if own not in rules:
                    rules.append(own)
                rows.append(Row(path, result, rules.index(own) + 1))
        return cls(tuple(rows), tuple(rules))

    def differences(self) -> list[dict[str, Any]]:
        """Returns the entries in which the rules differ, for each of `rules`."""
        names = dict.fromkeys(name for one in self.rules for name in one)
        varied = [
            name
            for name in names
            if any(one.get(name) != self.rules[0].get(name) for one in self.rules)
        ]
        return [{name: one.get(name) for name in varied} for one in self.rules]

    def markdown(self) -> list[str]:
        """Returns the table, its caption and the rules, as lines of Markdown."""
        results = [row.result for row in self.rows]
        ambiguous = len({(one.task, one.policy) for one in results}) < len(results)
        cells = []
        for row in self.rows:
            own = figures(row.result)
            if ambiguous:
                own["file"] = str(row.path)
            if len(self.rules) > 1:
                own["rules"] = str(row.rules)
            cells.append({name: text.replace("|", r"\|") for name, text in own.items()})
        lines = [_line(cells[0]), _line("---" for _ in cells[0])]
        lines += [_line(one.values()) for one in cells]
        return [*lines, "", CAPTION, *self._notes()]

    def _notes(self) -> list[str]:
        if len(self.rules) < 2:
            return []
        notes = ["", "**Rows with different rules cannot be compared.**", ""]
        columns = _columns(self.differences())
        texts = {name: _texts(values) for name, values in columns.items()}
        for number in range(len(self.rules)):
            told = "; ".join(f"{name}: {own[number]}" for name, own in texts.items())
            notes.append(f"- rules {number + 1}: {told}")
        return notes

    def as_dict(self) -> dict[str, Any]:
        """Returns all rows with their summaries, and all rules, JSON-able."""
        return {
            "rows": [
                {
                    "file": str(row.path),
                    "task": row.result.task,
                    "policy": row.result.policy,
                    "rules": row.rules,
                    "conditions": row.result.num_conditions,
                    "summary": row.result.summary(),
                }
                for row in self.rows
            ],
            "rules": {str(n): dict(one) for n, one in enumerate(self.rules, 1)},
            "differences": {
                str(n): one for n, one in enumerate(self.differences(), 1) if one
            },
        }


def rules_of(result: EvaluationResult) -> dict[str, Any]:
    """Returns the rules of an evaluation, JSON-able; defaults of options are filled in.

    The defaults are those of this version of the package.
    """
    settings, forces = result.settings, [one.forces for one in result.episodes]
    judged = any(one.mean_sum is not None for one in forces)
    rules = {
        "task": result.task,
        "protocol": settings.get("protocol"),
        "start": settings.get("started", "task"),
        "episodes": len(result.episodes),
        "seeds": list(result.seeds),
        "force": "mean over a control step" if judged else "end of a control step",
    }
    given = settings.get("task_kwargs", {})
    options = {**_defaults(result.task), **json_options.as_texts(given)}
    if settings.get("lumens"):  # the same path may hold another anatomy
        one, *more = settings["lumens"]
        options["anatomy"] = [one, *more] if more else one
    return rules | {n: options[n] for n in sorted(options) if n not in _NO_RULES}


def _defaults(task: str) -> dict[str, Any]:
    """Returns the options of a task without any that are given; none if unknown."""
    definition = suite.TASKS.get(task)
    if definition is None:
        return {}
    found = {
        field.name: field.default
        for field in dataclasses.fields(NavigationConfig)
        if field.default is not dataclasses.MISSING
    }
    parameters = inspect.signature(definition.objective).parameters
    found |= {name: parameters[name].default for name in definition.objective_options}
    found = {name: one for name, one in found.items() if name not in _NO_RULES}
    return json_options.as_texts({**found, **definition.options})


def figures(result: EvaluationResult) -> dict[str, str]:
    """Returns the cells of a row by the names of their columns."""
    summary = result.summary()

    def force(name: str) -> str:
        return millinewtons(*result.mean_sd(f"forces.{name}"))

    return {
        "task": result.task,
        "policy": result.policy,
        "success": success(summary),
        "conditions": f"{result.num_conditions} of {summary['episodes']}",
        "safe": f"{100 * summary['safe_success'][SAFE]:.0f} %",
        "steps": f"{summary['length']:.0f} ± {summary['length_sd']:.0f}",
        "mean, mN": force("mean_force"),
        "contact, mN": force("mean_contact_force"),
        "largest, mN": force("max_force"),
    }


def success(summary: Mapping[str, Any]) -> str:
    """Returns the success of a summary with its interval, if it has one, in percent."""
    text = f"{100 * summary['success']:.0f} %"
    if summary["success_ci95"] is not None:
        low, high = (round(100 * bound) for bound in summary["success_ci95"])
        text += f" ({low}–{high})"
    return text


def _line(cells: Iterable[str]) -> str:
    return f"| {' | '.join(cells)} |"


def _columns(rows: Sequence[Mapping[str, Any]]) -> dict[str, list[Any]]:
    """Returns the values of each entry, of mappings those of entries that differ."""
    columns: dict[str, list[Any]] = {}
    for name in rows[0]:
        values = [row[name] for row in rows]
        if all(isinstance(value, Mapping) for value in values):
            parts = dict.fromkeys(part for value in values for part in value)
            for part in parts:
                own = [value.get(part, "not given") for value in values]
                if any(one != own[0] for one in own):
                    columns[f"{name}.{part}"] = own
        else:
            columns[name] = values
    return columns


def _texts(values: Sequence[Any]) -> list[str]:
    """Returns the texts of an entry, whole where shortening makes two of them equal."""
    whole = [_told(value) for value in values]
    short = [
        text if len(text) <= 60 else f"{text[:40]} … {text[-15:]}" for text in whole
    ]
    return short if len(set(short)) == len(set(whole)) else whole


def _told(value: Any) -> str:
    """Returns the text of a rule; of seeds the ends, if they count up."""
    if value is None:
        return "default"
    whole = isinstance(value, list) and all(isinstance(one, int) for one in value)
    if whole and len(value) > 2 and value == list(range(value[0], value[-1] + 1)):
        return f"{value[0]} to {value[-1]}"
    return str(value)
