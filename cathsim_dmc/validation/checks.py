"""Checks of measured values against bounds, and reports of checks."""

import dataclasses
import json
from collections.abc import Mapping, Sequence
from typing import Any


@dataclasses.dataclass(frozen=True)
class Check:
    """One measured value and its bound.

    Attributes:
        name: what was measured, unique in its report.
        value: measured value, in `unit`.
        unit: such as "%" or "mm"; "" for a pure number.
        bound: the bound as text, such as "<= 2".
        passed: whether the value keeps the bound.
        note: further quantities for the reader of the table.
    """

    name: str
    value: float
    unit: str
    bound: str
    passed: bool
    note: str = ""

    @classmethod
    def at_most(
        cls, name: str, value: float, bound: float, unit: str = "", note: str = ""
    ) -> "Check":
        """A check of value <= bound; NaN fails."""
        kept = bool(value <= bound)
        return cls(name, float(value), unit, f"<= {bound:g}", kept, note)

    @classmethod
    def at_least(
        cls, name: str, value: float, bound: float, unit: str = "", note: str = ""
    ) -> "Check":
        """A check of value >= bound; NaN fails."""
        kept = bool(value >= bound)
        return cls(name, float(value), unit, f">= {bound:g}", kept, note)

    @classmethod
    def deviation(
        cls,
        name: str,
        measured: float,
        expected: float,
        percent: float,
        unit: str = "",
        note: str = "",
    ) -> "Check":
        """A check that |measured / expected - 1| is at most `percent` %.

        The note states both quantities, in their unit, if none is given.
        """
        note = note or f"{measured:.5g} {unit}, expected {expected:.5g} {unit}".rstrip()
        return cls.at_most(name, 100 * abs(measured / expected - 1), percent, "%", note)


@dataclasses.dataclass(frozen=True)
class Report:
    """Results of one validation.

    Attributes:
        title: title of the validation.
        checks: values with a bound.
        findings: values without a bound, as JSON values.
        data: measurements behind the checks by name, for plots; not in JSON.
    """

    title: str
    checks: Sequence[Check]
    findings: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    data: Mapping[str, Any] = dataclasses.field(default_factory=dict, repr=False)

    @property
    def passed(self) -> bool:
        """Whether every check passed."""
        return all(check.passed for check in self.checks)

    def as_dict(self) -> dict[str, Any]:
        """The object that `--json` prints; NaN and infinities become null."""
        found = {
            "checks": [dataclasses.asdict(check) for check in self.checks],
            "title": self.title,
            "passed": self.passed,
            "findings": dict(self.findings),
        }
        text = json.dumps(found, default=lambda array: array.tolist())
        return json.loads(text, parse_constant=lambda _: None)

    def table(self):
        """A `rich.table.Table` of the checks."""
        from rich.table import Table
        from rich.text import Text

        table = Table(title=self.title)
        table.add_column("check", overflow="fold")  # names of devices end differently
        table.add_column("measured", justify="right")
        table.add_column("bound", justify="right")
        table.add_column("")
        table.add_column("behind it", style="dim", overflow="fold")
        for check in self.checks:
            value = f"{check.value:.3g} {check.unit}".rstrip()
            bound = f"{check.bound} {check.unit}".rstrip()
            kept = Text("pass", "green") if check.passed else Text("FAIL", "bold red")
            table.add_row(check.name, value, bound, kept, check.note)
        return table
