"""A lumen as an import uses it: read, scaled, turned and mended."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from cathsim_dmc.anatomy.parts import Surface
from cathsim_dmc.anatomy.scan.labels import is_label_map, label_surface
from cathsim_dmc.anatomy.scan.mesh import guess_units, read_triangles
from cathsim_dmc.anatomy.scan.repair import mend
from cathsim_dmc.anatomy.scan.units import UNITS, frame_sign, metres_per, upright

# Diagonal of the box around a vessel tree, m: an intracranial segment, a whole aorta
# with arms and legs.
SIZE = (15e-3, 2.5)


@dataclass(frozen=True)
class Lumen:
    """The closed surface of a lumen.

    Attributes:
        surface: closed, normals outwards, m, LPS.
        units: of the file.
        notes: what was guessed and what was mended, a line for each.
    """

    surface: Surface
    units: str
    notes: tuple[str, ...]


def read_lumen(
    path: str | Path,
    units: str | None = None,
    frame: str = "LPS",
    axes: str | ArrayLike | None = None,
    labels: Sequence[int] = (),
    say: Callable[[str], None] = lambda text: None,
) -> Lumen:
    """Read the surface of a lumen and mend it.

    Args:
        path: OBJ, STL, PLY or VTP; ends open or capped, any orientation, thin or
            with the wall's thickness. Or a label map (NIfTI, NRRD), whose unit and
            frame are its own.
        units: of its coordinates, a key of ``units.UNITS``, or None to guess by the
            lumen's width.
        frame: "LPS" or "RAS".
        axes: how the scan is turned if it does not stand upright; see
            ``units.upright``.
        labels: of a label map, those that are the lumen; see `labels.label_surface`.
        say: called with a line of text for every step.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is no such surface; says how to mend it.
    """
    if units is not None:
        metres_per(units)
    sign, turn = frame_sign(frame), upright(axes)
    if is_label_map(path):
        vertices, faces, why = label_surface(path, labels)
        units, vertices = "mm", vertices @ turn.T
    else:
        if len(labels):
            raise ValueError(
                f"label is for label maps (NIfTI, NRRD); {path} is a surface."
            )
        vertices, faces = read_triangles(path)
        say(f"mesh: {len(faces):,} triangles read")
        try:
            units, why = guess_units(vertices, faces, units)
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from error
        vertices = (vertices * sign * UNITS[units]) @ turn.T
    size = float(np.linalg.norm(np.ptp(vertices, axis=0)))
    if not SIZE[0] <= size <= SIZE[1]:
        raise ValueError(
            f"{path} is {size:.3g} m across when its unit is {units!r}, which no "
            f"vessel tree is (allowed {SIZE[0]:g} to {SIZE[1]:g} m). Check the unit in "
            f"which the mesh was exported ({why})."
        )
    surface, changed = mend(str(path), vertices, faces)
    return Lumen(surface, units, (why, *changed))
