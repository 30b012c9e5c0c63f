"""Run the tutorials and write their outputs into them.

`python docs/scripts/notebooks.py [NAME …]` runs all, or those whose file names contain
a name. Cells run in an empty folder, so that outputs do not depend on the machine.

`python docs/scripts/notebooks.py --repository OWNER/NAME` runs nothing: it writes the
address of the public repository into the cells for Colab, with a badge that opens the
notebook there.
"""

import argparse
import os
import re
import tempfile
import time
from pathlib import Path

import nbformat
from nbclient import NotebookClient

TUTORIALS = Path(__file__).parents[1] / "tutorials"
TIMEOUT = 3600  # seconds a cell
COLAB = "colab"  # id of the cell
_BADGE = (
    "[![Colab](https://colab.research.google.com/assets/colab-badge.svg)]"
    "(https://colab.research.google.com/github/{repository}/blob/main/"
    "docs/tutorials/{name})"
)
_INSTALL = """\
# In Colab: installs the package and keeps Colab's torch. Elsewhere: no effect.
import sys

# OWNER/NAME on GitHub, or a wheel of `make dist` that you upload.
REPOSITORY = "{repository}"
if "google.colab" in sys.modules:
    from IPython import get_ipython

    wheel = REPOSITORY.endswith(".whl")
    place = REPOSITORY if wheel else f"git+https://github.com/{{REPOSITORY}}"
    get_ipython().run_line_magic("pip", f"install -q {{place}}")"""


def notebooks() -> list[Path]:
    return sorted(TUTORIALS.glob("*.ipynb"))


def executed(path: Path) -> nbformat.NotebookNode:
    """The notebook with the outputs of a fresh kernel; raises errors of its cells."""
    notebook = nbformat.read(path, as_version=4)
    with tempfile.TemporaryDirectory() as folder:
        NotebookClient(
            notebook,
            timeout=TIMEOUT,
            record_timing=False,
            # Otherwise the grouping of lines differs from run to run.
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


def for_colab(notebook: nbformat.NotebookNode, name: str, repository: str) -> None:
    """Inserts the installing cell for Colab, and the badge, after the title.

    Args:
        name: File name of the notebook.
        repository: OWNER/NAME of the public repository; empty for none.
    """
    notebook.cells = [one for one in notebook.cells if one.id != COLAB]
    title = notebook.cells[0]
    lines = [one for one in title.source.split("\n") if not one.startswith("[![Colab]")]
    source = _INSTALL.format(repository=repository)
    if repository:
        lines[1:1] = ["", _BADGE.format(repository=repository, name=name)]
    title.source = re.sub(r"\n{3,}", "\n\n", "\n".join(lines))
    cell = nbformat.v4.new_code_cell(source, id=COLAB, execution_count=None)
    cell.metadata["tags"] = ["colab"]
    notebook.cells.insert(1, cell)


def _processor_seconds() -> float:
    """Processor time, s, of all kernels that have ended."""
    times = os.times()
    return times.children_user + times.children_system


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", metavar="NAME", help="part of a file name")
    parser.add_argument("--repository", metavar="OWNER/NAME", help="for Colab")
    options = parser.parse_args()
    chosen, repository = options.names, options.repository
    if repository is not None:
        if chosen or not re.fullmatch(r"[\w.-]+/[\w.-]+|", repository):
            raise SystemExit("give --repository OWNER/NAME")
        for path in notebooks():
            notebook = nbformat.read(path, as_version=4)
            for_colab(notebook, path.name, repository)
            nbformat.write(notebook, path)
        return
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
