"""Label maps of segmented scans (NIfTI, NRRD), and the surface of some labels."""

from __future__ import annotations

import importlib
import importlib.util
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cathsim_dmc.anatomy.scan.units import UNITS, frame_sign

# Endings of files, the package that reads each, and its name for pip.
FORMATS = {
    ".nii": ("nibabel", "nibabel"),
    ".nii.gz": ("nibabel", "nibabel"),
    ".nrrd": ("nrrd", "pynrrd"),
}
MOST = 600_000_000  # voxels; a whole body at 1 mm has 200 million
BLUR = 0.7  # voxels, standard deviation that takes the steps off a surface
_NIFTI_UNITS = {"meter": 1.0, "mm": 1e-3, "micron": 1e-6, "unknown": 1e-3}
_SPACES = {
    "left-posterior-superior": "LPS",
    "lps": "LPS",
    "right-anterior-superior": "RAS",
    "ras": "RAS",
}


def is_label_map(path: str | Path) -> bool:
    """Whether a file's ending is that of a label map."""
    return str(path).lower().endswith(tuple(FORMATS))


def label_surface(
    path: str | Path, labels: Sequence[int] = ()
) -> tuple[np.ndarray, np.ndarray, str]:
    """Surface of some labels of a label map.

    Args:
        path: NIfTI (.nii, .nii.gz) or NRRD (.nrrd, .seg.nrrd) with whole numbers.
        labels: values whose union is the lumen; none where the file holds one only.

    Returns:
        (vertices (V, 3) m in LPS, faces (F, 3), a line that says what was taken).

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is no label map, the package that reads it is missing, or
            the labels are not in it; lists those that are.
    """
    from scipy.ndimage import gaussian_filter
    from skimage.measure import marching_cubes

    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(
            f"no label map {path}; give the path of a segmentation (NIfTI or NRRD)."
        )
    voxels, matrix, origin, names = _read(path)
    chosen = _chosen(path, voxels, labels, names)
    mask = np.isin(voxels, chosen)
    if not mask.any():
        raise ValueError(f"{path}: no voxel has the label {chosen}.")
    inside = [np.flatnonzero(mask.any(axis=tuple({0, 1, 2} - {k}))) for k in range(3)]
    low = np.array([rows[0] for rows in inside])
    box = tuple(slice(rows[0], rows[-1] + 1) for rows in inside)
    pad = 3
    part = gaussian_filter(np.pad(mask[box], pad).astype(np.float32), BLUR)
    points, faces, _, _ = marching_cubes(part, 0.5)
    vertices = (points + low - pad) @ matrix.T + origin
    if np.linalg.det(matrix) > 0.0:
        faces = faces[:, ::-1]
    size = " x ".join(f"{x * 1e3:.2g}" for x in np.linalg.norm(matrix, axis=0))
    called = ", ".join(f"{k} {names[k]}" if k in names else str(k) for k in chosen)
    return (
        vertices,
        faces.astype(np.int64),
        f"label {called} of {path.name}: {int(mask.sum()):,} voxels of {size} mm; unit "
        "and frame are the file's",
    )


def _chosen(path, voxels, labels: Sequence[int], names: dict[int, str]) -> list[int]:
    there, count = np.unique(voxels, return_counts=True)
    seen = {int(k): int(n) for k, n in zip(there, count, strict=True) if k != 0}
    listed = ", ".join(
        f"{k}{' ' + names[k] if k in names else ''} ({n:,} voxels)"
        for k, n in list(seen.items())[:20]
    )
    if not labels:
        if len(seen) != 1:
            raise ValueError(
                f"{path} has {len(seen)} labels: {listed or 'all voxels are 0'}; "
                "choose those of the lumen (--label)."
            )
        return list(seen)
    missing = [k for k in labels if k not in seen]
    if missing:
        raise ValueError(f"{path} has no label {missing[0]}; it has {listed}.")
    return [int(k) for k in labels]


def _read(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray, dict[int, str]]:
    """Voxels, matrix (3, 3) and origin (3,) to m in LPS, names of labels."""
    kind = next(k for k in (".nii.gz", *FORMATS) if str(path).lower().endswith(k))
    module, package = FORMATS[kind]
    if importlib.util.find_spec(module) is None:
        raise ValueError(
            f"{path} needs {package}: pip install 'cathsim-dmc[segmentation]'."
        )
    library = importlib.import_module(module)
    try:
        read = _nifti if module == "nibabel" else _nrrd
        voxels, matrix, origin, names = read(library, path)
    except ValueError:
        raise
    except Exception as error:  # readers raise whatever their format leads to
        said = re.sub(r"\s+", " ", str(error)).strip()[:150] or type(error).__name__
        raise ValueError(
            f"{path} cannot be read as {kind.strip('.')}: {said}. Export it again."
        ) from error
    if voxels.dtype.kind not in "iub":
        whole = np.rint(voxels)
        if not np.array_equal(whole, voxels):
            raise ValueError(
                f"{path} holds numbers that are not whole, so it is an image or a "
                "probability map; give a segmentation (label map)."
            )
        voxels = whole.astype(np.int32)
    if not (np.isfinite(matrix).all() and np.isfinite(origin).all()):
        raise ValueError(f"{path} has a transform that is not finite; export it again.")
    if not 1e-12 < abs(np.linalg.det(matrix)) < 1e-6:
        raise ValueError(
            f"{path} has voxels of {abs(np.linalg.det(matrix)) * 1e9:.3g} mm^3; is the "
            "unit of its transform right?"
        )
    return voxels, matrix, origin, names


def _check_shape(path: Path, shape: Sequence[int]) -> None:
    if len(shape) != 3 or min(shape) < 2:
        raise ValueError(
            f"{path} has the shape {tuple(shape)}; give one label map in three "
            "dimensions (3D Slicer: export the segmentation as a label map)."
        )
    if np.prod(np.array(shape, dtype=float)) > MOST:
        raise ValueError(
            f"{path} has {np.prod(np.array(shape, dtype=float)) / 1e6:.0f} million "
            f"voxels; at most {MOST / 1e6:g} million are read. Crop it."
        )


def _nifti(nibabel: Any, path: Path):
    image = nibabel.load(path)
    shape = tuple(size for size in image.shape if size != 1 or len(image.shape) <= 3)
    _check_shape(path, shape)
    affine = np.asarray(image.affine, dtype=float)
    unit = _NIFTI_UNITS.get(image.header.get_xyzt_units()[0], 1e-3)
    to_lps = np.diag(frame_sign("RAS")) * unit
    voxels = np.asanyarray(image.dataobj).reshape(shape)
    return voxels, to_lps @ affine[:3, :3], to_lps @ affine[:3, 3], {}


def _nrrd(nrrd: Any, path: Path):
    header = nrrd.read_header(str(path))
    _check_shape(path, [int(size) for size in header["sizes"]])
    space = str(header.get("space", "left-posterior-superior")).lower()
    if space not in _SPACES:
        raise ValueError(f"{path} is in the space {space!r}; export it as LPS or RAS.")
    if "space directions" not in header:
        raise ValueError(f"{path} has no space directions; export it again.")
    sign = np.diag(frame_sign(_SPACES[space])) * UNITS["mm"]
    rows = np.asarray(header["space directions"], dtype=float)
    origin = np.asarray(header.get("space origin", np.zeros(3)), dtype=float)
    names = {
        int(header[f"Segment{k}_LabelValue"]): str(header.get(f"Segment{k}_Name", k))
        for k in range(1000)
        if f"Segment{k}_LabelValue" in header
    }
    voxels = nrrd.read(str(path))[0]
    return voxels, sign @ rows.T, sign @ origin, names
