"""Routes of the observation `biplane` from roadmaps with errors, and the true ones.

    python benchmarks/roadmaps.py

Each phantom has 20 draws of the errors, towards the LCCA from the groin. The routes are
compared with the true centreline, as they are, and without what the reconstruction does
about errors: centring, smoothing of the radii, and a least radius of the tube.
"""

import sys
from unittest import mock

import numpy as np
import tyro

from cathsim_dmc.anatomy import phantoms
from cathsim_dmc.anatomy.centreline import arc_lengths
from cathsim_dmc.cli.options import show
from cathsim_dmc.imaging import biplane
from cathsim_dmc.imaging.angiograph import Angiograph
from cathsim_dmc.imaging.options import FluoroscopyOptions, RoadmapErrors
from cathsim_dmc.tasks import biplane_sight
from cathsim_dmc.tasks.retry import RetrySettings
from cathsim_dmc.tasks.route import Route, locate
from cathsim_dmc.validation.checks import Check, Report

ERRORS = RoadmapErrors(noise=0.5, erosion=0.25)
VIEWS = {"view": (60.0, 0.0), "biplane": (-30.0, 0.0), "third": "AP"}
STEP, LAST, LEAVING = 1e-3, 60e-3, 1e-3  # m
# Name, bound, unit, and factor to it from SI.
MEASURES = {
    "outside": ("last 60 mm of the centreline outside the tube", 5.0, "%", 1e2),
    "distance": ("mean distance of the centreline in the branch", 1.5, "mm", 1e3),
    "leaving": ("routes that leave the vessel by more than 1 mm", 2, "", 1),
    "short": ("mean distance of the end from the goal", 0.1, "mm", 1e3),
}


def routes(name: str, draws: int, tube: float) -> dict[str, float]:
    """Compares the routes of some draws with the centreline to the LCCA of a phantom.

    The centreline is outside the tube where it is farther out of the lumen of the route
    than the memory of attempts tolerates.

    Args:
        tube: Least radius, m, to which this excess is relative.

    Returns:
        Quantities of `MEASURES`, SI.
    """
    anatomy = phantoms.load(name, access="descending")
    goal = anatomy.goals["lcca"]
    true = anatomy.route(goal).resampled(STEP)
    last = true.points[-round(LAST / STEP) :]
    branch = true.points[-round(goal.arc_length / STEP) :]
    machine = Angiograph(anatomy.surface, FluoroscopyOptions(**VIEWS))
    tolerance, leaving = RetrySettings().tolerance, 0
    outside, distance, short = [], [], []
    for seed in range(draws):
        sight = biplane.Biplane(machine.planes(), machine.third(), ERRORS, seed)
        points = sight.route(anatomy.inlet.position, goal.position)
        route = Route(points, sight.radii(points), arc_lengths(points))
        place = locate(route, last)
        radius = np.interp(place.arc_length, route.arc_length, route.radii)
        outside.append(place.excess * radius / np.maximum(radius, tube) > tolerance)
        apart = np.linalg.norm(branch[:, None] - points, axis=2).min(axis=1)
        distance.append(apart.mean())
        leaving += anatomy.lumen(points).min() < -LEAVING
        short.append(np.linalg.norm(points[-1] - goal.position))
    return {
        "outside": float(np.mean(outside)),
        "distance": float(np.mean(distance)),
        "leaving": int(leaving),
        "short": float(np.mean(short)),
    }


def main(draws: int = 20, json: bool = False) -> int:
    """Compares the routes of both measured phantoms.

    Args:
        draws: Number of draws of the errors on each phantom.
        json: Whether to print one JSON object and nothing else.
    """
    checks, rows = [], []
    for name in phantoms.MEASURED:
        found = routes(name, draws, biplane_sight._LEAST_TUBE)
        with (
            mock.patch.object(biplane, "_CENTRINGS", 0),
            mock.patch.object(biplane, "_POOLED_LUMEN", 1e-6),
        ):
            plain = routes(name, draws, 0.0)
        for key, (label, bound, unit, scale) in MEASURES.items():
            value = scale * found[key]
            checks.append(Check.at_most(f"{label}, {name}", value, bound, unit))
            shown = (f"{scale * one[key]:.3g} {unit}".strip() for one in (found, plain))
            rows.append(f"| {label} | {name} | {' | '.join(shown)} |")
    head = "| quantity | phantom | as it is | without centring and smoothing |"
    table = "\n".join([head, "|---|---|---|---|", *sorted(rows)])
    return show(Report("roadmaps", checks, {"table": table, "draws": draws}), json)


if __name__ == "__main__":
    sys.exit(tyro.cli(main))
