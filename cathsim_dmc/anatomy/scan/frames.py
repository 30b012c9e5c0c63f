"""Orientation of label maps, and the questions that their headers leave open."""

from collections.abc import Mapping
from typing import Any

import numpy as np

_SAME_FRAME = 0.5  # mm, distance of voxels up to which two orientations are one


def of_nifti(image: Any, scale: float) -> str:
    """Question about the orientation of a NIfTI image, or "".

    Args:
        image: Image of nibabel.
        scale: Unit of its header, mm.
    """
    header = image.header
    if not (header["sform_code"] or header["qform_code"]):
        return (
            "question: its header gives no orientation (sform and qform are 0), so its "
            "axes are taken as left, front and head, as old files have them. If they "
            "are others, the patient is turned or mirrored: set them and import again"
        )
    if not (header["sform_code"] and header["qform_code"]):
        return ""
    differ = header.get_sform() - header.get_qform()
    corners = np.array(list(np.ndindex(2, 2, 2))) * image.shape[:3]
    apart = np.linalg.norm(corners @ differ[:3, :3].T + differ[:3, 3], axis=1)
    most = scale * float(apart.max())
    if most < _SAME_FRAME:
        return ""
    return (
        "question: its header gives two orientations, sform and qform, which place "
        f"voxels up to {most:.3g} mm apart; sform is taken. If that is wrong, the "
        "patient is turned, mirrored or of another size: set sform_code to 0 and "
        "import again"
    )


def of_nrrd(header: Mapping[str, Any]) -> tuple[str, str]:
    """Space of a NRRD file, such as "LPS", and a question about it, or ""."""
    if header.get("space") is not None:
        return str(header["space"]), ""
    return "LPS", (
        "question: its header names no space, so its axes are taken as left, back "
        "and head (LPS). If they are others, the patient is turned or mirrored: "
        "set it and import again"
    )


def of_meta(entries: Mapping[str, Any]) -> str:
    """Question about the orientation of a MetaImage by its header, or "".

    Raises:
        ValueError: if the header has no size of the voxels.
    """
    if not {"ElementSpacing", "ElementSize"} & set(entries):
        raise ValueError(
            "its header lacks the size of its voxels; add it, for voxels of 1 mm the "
            "line 'ElementSpacing = 1 1 1' before ElementDataFile"
        )
    if {"TransformMatrix", "Rotation", "Orientation"} & set(entries):
        return ""
    return (
        "question: its header has no TransformMatrix, so its axes are taken as left, "
        "back and head (LPS). If they are others, the patient is turned or mirrored: "
        "set it and import again"
    )


def directions(header: Mapping[str, Any]) -> np.ndarray:
    """Steps (3, 3) from voxel to voxel of a NRRD file, a row for each of its axes.

    Raises:
        ValueError: if it has none; the error shows a line that adds them.
    """
    if "space directions" in header:
        return np.asarray(header["space directions"], dtype=float)
    steps = np.atleast_1d(header.get("spacings", np.ones(3))).astype(float)
    rows = (f"({x:g},{y:g},{z:g})" for x, y, z in np.diag(steps[-3:]))
    raise ValueError(
        "its header lacks 'space directions', the size and axes of its voxels; add "
        f"them, for voxels along the axes of the space the line 'space directions: "
        f"{' '.join(rows)}'"
    )
