"""Judgement of a control step of N simulations by their objectives."""

import itertools
import math
from collections.abc import Mapping, Sequence
from typing import NoReturn

import numpy as np

from cathsim_dmc import bounds
from cathsim_dmc.physics.readings import part
from cathsim_dmc.tasks.objectives import Measurement, Objective, Outcome

# Objectives, each with the rows of its simulations.
Groups = Sequence[tuple[Objective, np.ndarray | slice]]


def judge(
    groups: Groups, measurement: Measurement, failed: np.ndarray | None = None
) -> Outcome:
    """Judges a control step of N simulations and checks the objectives' outcomes.

    Args:
        groups: Objectives with the rows of their simulations; all have the same terms.
        measurement: Measurement of the control step, arrays (N, ...).
        failed: (N,) bool, simulations whose physics failed: their reward, terms and
            success are 0. None for no failure.

    Returns:
        The outcomes; `failed` is an array, also true where the physics failed.

    Raises:
        ValueError: if an outcome has a wrong type or shape, or is not finite.
    """
    count, names = len(measurement.distance), tuple(groups[0][0].terms)
    reward, success = np.empty(count), np.empty(count, dtype=bool)
    ended = np.zeros(count, dtype=bool)
    terms = {name: np.empty(count) for name in names}
    for objective, rows in groups:
        # One objective judges all simulations, so there is nothing to select.
        own = measurement if isinstance(rows, slice) else part(measurement, rows)
        outcome = objective.outcome(own)
        if not isinstance(outcome, Outcome) or not isinstance(outcome.terms, Mapping):
            _refuse(objective, bounds.shown(outcome))
        if (*outcome.terms,) != names:
            _refuse(objective, f"the terms {[*outcome.terms]}, not {[*names]}")
        fails = outcome.failed is not None
        for name, value, kinds, into in (
            *((name, outcome.terms[name], "fiu", terms[name]) for name in names),
            ("reward", outcome.reward, "fiu", reward),  # often their sum
            ("success", outcome.success, "b", success),
            *([("failed", outcome.failed, "b", ended)] if fails else ()),
        ):
            if type(value) is not np.ndarray or value.dtype.kind not in kinds:
                _refuse(objective, f"{name} {bounds.shown(value)}")
            if value.shape != own.distance.shape:
                shapes = f"{value.shape}; it must be {own.distance.shape}"
                _refuse(objective, f"{name} of shape {shapes}")
            into[rows] = value
    judged = {"reward": reward, **terms}
    if failed is not None:
        ended |= failed
        for each in (success, *judged.values()):
            each[failed] = 0
    # Sums of plain numbers take a tenth of the time of `isfinite`.
    if not math.isfinite(sum(sum(each.tolist()) for each in judged.values())):
        for (objective, rows), (name, each) in itertools.product(
            groups, judged.items()
        ):
            if not np.isfinite(each[rows]).all():
                given = f"{name} {bounds.shown(each[rows])}, which is not finite"
                _refuse(objective, given)
    return Outcome(reward, success, terms, ended)


def path_distances(groups: Groups, head: np.ndarray, begun: np.ndarray) -> np.ndarray:
    """Lengths (N,) of the routes from heads (N, 3) at the start to the goals, m.

    Args:
        groups: See `judge`.
        head: World frame, m.
        begun: (K,) simulations that begin an episode; others may have diverged.

    Raises:
        ValueError: if an objective returns another type or shape, or if a length from a
            start is not finite.
    """
    found, starts = np.empty(len(head)), np.isin(np.arange(len(head)), begun)
    for objective, rows in groups:
        own = objective.path_distance(head[rows])
        shape, given = head[rows].shape[:1], getattr(own, "shape", None)
        fits = type(own) is np.ndarray and own.dtype.kind in "fiu" and given == shape
        if not fits or not ((own >= 0) & np.isfinite(own))[starts[rows]].all():
            raise ValueError(
                f"path_distance() of {type(objective).__name__} returns "
                f"{bounds.shown(own)}; it must return an array of finite numbers, at "
                f"least 0, of shape {shape}, m"
            )
        found[rows] = np.maximum(own, 1e-6)  # ratios to 0 are undefined
    return found


def _refuse(objective: Objective, given: str) -> NoReturn:
    raise ValueError(
        f"outcome() of {type(objective).__name__} returns {given}; it must return an "
        "Outcome(reward, success, terms, failed): arrays with one finite number, one "
        "bool, one finite number a term and one bool for each simulation; failed may "
        "be None"
    )
