"""Wall time of `cathsim phantom import` for a surface and for a label map.

    python benchmarks/import_times.py lumen.obj

Both measured phantoms are written as surfaces in millimetres, Type I also as a label
map with voxels of 1 mm. Each import is a separate process that also builds the field of
the lumen and the picture; no field comes from a cache. The time is the median of three,
to be measured with nothing else running.
"""

import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import nibabel
import numpy as np
import trimesh
import tyro

from cathsim_dmc.anatomy import phantoms
from cathsim_dmc.cli.options import show
from cathsim_dmc.validation.checks import Check, Report

RUNS = 3
_MM = 1e3
_BORDER = 3  # voxels around the lumen


def surface(name: str, folder: Path) -> Path:
    """STL file, in mm, of the lumen of a phantom."""
    lumen = phantoms.load(name).surface
    path = folder / f"{name}.stl"
    trimesh.Trimesh(lumen.vertices * _MM, lumen.faces, process=False).export(path)
    return path


def label_map(name: str, folder: Path) -> Path:
    """NIfTI file of a phantom, with label 1 in the lumen and voxels of 1 mm."""
    anatomy = phantoms.load(name)
    corners = anatomy.surface.vertices * _MM
    first = np.floor(corners.min(axis=0)) - _BORDER
    shape = (np.ceil(corners.max(axis=0)) + _BORDER - first).astype(int) + 1
    points = np.stack(np.indices(shape), axis=-1) + first
    inside = anatomy.lumen(points.reshape(-1, 3) / _MM).reshape(shape) > 0
    affine = np.eye(4)
    affine[:3, 3] = first
    path = folder / f"{name}.nii.gz"
    nibabel.save(nibabel.Nifti1Image(inside.astype(np.uint8), affine), path)
    return path


def seconds(path: Path, folder: Path) -> float:
    """Median wall time of imports of a file, s."""
    taken = []
    for run in range(RUNS):
        command = [sys.executable, "-m", "cathsim_dmc.cli", "phantom", "import", path]
        home = {**os.environ, "XDG_CACHE_HOME": str(folder / f"cache-{run}")}
        start = time.perf_counter()
        subprocess.run(
            [*map(str, command), "--out", str(folder / f"{path.name}-{run}")],
            check=True,
            env=home,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        taken.append(time.perf_counter() - start)
    return statistics.median(taken)


def main(scan: tyro.conf.Positional[Path], json: bool = False) -> int:
    """Time the import of a scan, of both phantoms and of a label map.

    Args:
        scan: Surface of a lumen.
        json: Whether to print one JSON object and nothing else.
    """
    with tempfile.TemporaryDirectory() as folder:
        folder = Path(folder)
        files = {
            "the scan": scan,
            "the surface of type1": surface("type1", folder),
            "the surface of type2": surface("type2", folder),
            "a label map of type1": label_map("type1", folder),
        }
        checks = [
            Check.at_most(f"import of {what}", seconds(path, folder), 15, "s")
            for what, path in files.items()
        ]
    return show(Report("import times", checks, {}), json)


if __name__ == "__main__":
    sys.exit(tyro.cli(main))
