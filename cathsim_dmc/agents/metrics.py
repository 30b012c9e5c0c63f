"""metrics.csv: whole rows, appended, and continued without duplicates."""

import csv
import io
from collections.abc import Mapping, Sequence
from pathlib import Path

from cathsim_dmc import files


class MetricsError(ValueError):
    """A metrics file does not belong to this run."""


class MetricsFile:
    """Append rows of numbers keyed by the frame counter.

    Args:
        path: Path of the CSV file.
        columns: Names of the columns; the first is the frame counter.
        resume_at: Frame up to which existing rows are kept; later ones are dropped (a
            killed run writes rows past its last checkpoint). None starts a new file.
    """

    def __init__(
        self, path: Path, columns: Sequence[str], resume_at: int | None = None
    ):
        self.path = Path(path)
        self.columns = list(columns)
        kept = [] if resume_at is None else self._rows_until(resume_at)
        text = io.StringIO()
        csv.writer(text, lineterminator="\n").writerows([self.columns, *kept])
        files.write_text(self.path, text.getvalue())

    def append(self, values: Mapping[str, float | int | None]) -> None:
        """Write one row; None leaves a field empty."""
        unknown = set(values) - set(self.columns)
        if unknown:
            raise MetricsError(f"metrics without a column: {sorted(unknown)}.")
        cells = [_cell(values.get(name)) for name in self.columns]
        with files.naming(self.path), open(self.path, "a", newline="") as file:
            csv.writer(file, lineterminator="\n").writerow(cells)

    def _rows_until(self, frames: int) -> list[list[str]]:
        if not self.path.exists():
            return []
        with open(self.path, newline="") as file:
            header, *rows = list(csv.reader(file)) or [[]]
        if header != self.columns:
            raise MetricsError(
                f"{self.path} has columns {header}, this run writes {self.columns}."
            )
        # A row cut short by a crash has fewer fields.
        whole = (row for row in rows if len(row) == len(header))
        return [row for row in whole if row[0].isdecimal() and int(row[0]) <= frames]


def _cell(value: float | int | None) -> str:
    if value is None:
        return ""
    return str(value) if isinstance(value, int) else f"{value:.9g}"


def read_metrics(path: Path) -> list[dict[str, float | None]]:
    """The rows of a metrics.csv; empty fields become None."""
    with open(path, newline="") as file:
        return [
            {name: float(cell) if cell else None for name, cell in row.items()}
            for row in csv.DictReader(file)
        ]
