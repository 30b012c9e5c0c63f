"""Checks of a saved anatomy: its parts lie where the lumen is."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from cathsim_dmc import bounds

if TYPE_CHECKING:
    from cathsim_dmc.anatomy.anatomy import Anatomy

EXTENT = 2.5  # m, diagonal of the box around an anatomy
AROUND = 50e-3  # m, of places outside the lumen's box
OFF = 5e-3  # m, of inlet and goals off their centrelines, beside the radius
WIDEST = 0.1  # m, radius of a vessel; the largest aneurysms have half of it


def check_places(anatomy: Anatomy) -> None:
    """Checks that inlet, goals and vessels lie where the lumen is."""
    vertices = anatomy.surface.vertices
    if not len(vertices) or not len(anatomy.surface.faces):
        raise ValueError("the surface has no triangles.")
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    size = float(np.linalg.norm(high - low))
    if not 1e-3 <= size <= EXTENT or np.abs(vertices).max() > bounds.FAR:
        raise ValueError(
            f"the surface is {size:.3g} m across and reaches "
            f"{np.abs(vertices).max():.3g} m from the origin (allowed 0.001 to "
            f"{EXTENT:g} m, {bounds.FAR:g} m); its unit is not the metre."
        )

    def near(points: np.ndarray, what: str) -> None:
        off = np.maximum(low - points, points - high).max()
        if off > AROUND:
            raise ValueError(
                f"{what} lies {off:.3g} m outside the box of the surface "
                f"(at most {AROUND:g} m)."
            )

    for vessel in anatomy.tree.vessels.values():
        near(vessel.centreline.points, f"vessel {vessel.name!r}")
        widest = float(vessel.centreline.radii.max())
        if widest > WIDEST:
            raise ValueError(
                f"vessel {vessel.name!r} has a radius of {widest:.3g} m (at "
                f"most {WIDEST:g} m); its unit is not the metre."
            )
    places = {"inlet": anatomy.inlet}
    places |= {f"goal {name!r}": goal for name, goal in anatomy.goals.items()}
    for what, place in places.items():
        line = anatomy.tree.vessel(place.vessel).centreline
        found = line.project(place.position)
        gap = float(found.distance - found.radius)
        if gap > OFF:
            raise ValueError(
                f"{what} lies {gap:.3g} m outside the vessel "
                f"{place.vessel!r} that it is in (at most {OFF:g} m)."
            )
    for goal in anatomy.goals.values():
        length = anatomy.tree.vessel(goal.vessel).centreline.length
        if not 0.0 <= goal.arc_length <= length + OFF:
            raise ValueError(
                f"goal {goal.name!r} has the arc length {goal.arc_length:.3g} "
                f"m; its vessel has 0 to {length:.3g} m."
            )
    for end in anatomy.ends:
        near(end.position[None], f"an end of {end.vessel!r}")
