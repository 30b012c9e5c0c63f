"""metrics.csv: whole rows, appended, and continued without duplicates."""

import csv
import io
from collections.abc import Mapping, Sequence
from pathlib import Path

from cathsim_dmc import files


class MetricsError(ValueError):
    """A metrics file does not belong to this run."""


class MetricsFile:
    """A CSV file of numbers, a row for each value of the frame counter."""

    def __init__(
        self, path: Path, columns: Sequence[str], resume_at: int | None = None
    ):
        """Starts the file, or keeps the first rows of one.

        Args:
            path: Path of the file.
            columns: Names of the columns; the first is the frame counter.
            resume_at: Frame up to which existing rows are kept; later ones are dropped
                (a killed run writes rows past its last checkpoint). None starts a new
                file.
        """
        self.path = Path(path)
        self.columns = list(columns)
        kept = [] if resume_at is None else self._rows_until(resume_at)
        text = io.StringIO()
        csv.writer(text, lineterminator="\n").writerows([self.columns, *kept])
        files.write_text(self.path, text.getvalue())

    def append(self, values: Mapping[str, float | None]) -> None:
        """Writes one row; None and what is left out leave a field empty.

        Raises:
            ValueError: a value has no column.
        """
        row = {k: f"{v:.9g}" if isinstance(v, float) else v for k, v in values.items()}
        with files.naming(self.path), open(self.path, "a", newline="") as file:
            writer = csv.DictWriter(file, self.columns, lineterminator="\n")
            if not file.tell():  # the file was removed, and begins anew
                writer.writeheader()
            writer.writerow(row)

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


def read_metrics(path: Path) -> list[dict[str, float | None]]:
    """The rows of a metrics.csv; empty fields become None."""
    with open(path, newline="") as file:
        return [
            {name: float(cell) if cell else None for name, cell in row.items()}
            for row in csv.DictReader(file)
        ]
