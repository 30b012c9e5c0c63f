"""Run the tutorials and write their outputs into them.

`python docs/scripts/notebooks.py [NAME …]` runs all, or those whose file names contain
a name. Cells run in an empty folder; nothing of this machine gets into the outputs.
"""

from __future__ import annotations

import os
import sys
import tempfile
import time
from pathlib import Path

import nbformat
from nbclient import NotebookClient

TUTORIALS = Path(__file__).parents[1] / "tutorials"
TIMEOUT = 3600  # seconds a cell


def notebooks() -> list[Path]:
    return sorted(TUTORIALS.glob("*.ipynb"))


def executed(path: Path) -> nbformat.NotebookNode:
    """The notebook with the outputs of a fresh kernel; raises what a cell raises."""
    notebook = nbformat.read(path, as_version=4)
    with tempfile.TemporaryDirectory() as folder:
        NotebookClient(
            notebook,
            timeout=TIMEOUT,
            record_timing=False,
            # Else how lines are grouped differs from run to run.
            coalesce_streams=True,
            resources={"metadata": {"path": folder}},
        ).execute()
    for cell in notebook.cells:
        for output in cell.get("outputs", ()):
            # Progress and warnings of libraries differ from run to run.
            output.get("metadata", {}).clear()
        if cell.cell_type == "code":
            cell.outputs = [o for o in cell.outputs if o.get("name") != "stderr"]
    return notebook


def _processor_seconds() -> float:
    """Of the kernels that have ended: a busy machine does not count."""
    times = os.times()
    return times.children_user + times.children_system


def main() -> None:
    chosen = sys.argv[1:]
    for path in notebooks():
        if chosen and not any(name in path.name for name in chosen):
            continue
        start, used = time.monotonic(), _processor_seconds()
        nbformat.write(executed(path), path)
        seconds = time.monotonic() - start
        size = path.stat().st_size / 1e3
        print(
            f"{path.name}: {seconds:.0f} s, {_processor_seconds() - used:.0f} s of the "
            f"processor, {size:.0f} kB",
            flush=True,
        )


if __name__ == "__main__":
    main()
