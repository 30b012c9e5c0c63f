"""One objective for simulations with different objectives."""

from collections.abc import Sequence
from types import MappingProxyType
from typing import Any, cast

import numpy as np

from cathsim_dmc.tasks.objectives import (
    Measurement,
    Objective,
    Outcome,
    Shiftable,
    ask,
)


def together(objectives: Sequence[Objective], chosen: np.ndarray) -> Objective:
    """One objective for N simulations.

    Args:
        chosen: (N,), number of the objective of each simulation.
    """
    numbers = np.unique(chosen)
    if len(numbers) == 1:
        return objectives[int(numbers[0])]
    return ObjectivePool(
        [(objectives[number], np.flatnonzero(chosen == number)) for number in numbers]
    )


class ObjectivePool(Shiftable):
    """Objectives of groups of simulations, which share radius and reward terms.

    Attributes:
        goal: (N, 3), m, world frame.
        goal_radius: distance from the goal that counts as reached, m.
        terms: names of the reward terms.
    """

    def __init__(self, groups: Sequence[tuple[Objective, np.ndarray]]):
        """Takes each objective with the numbers of its simulations, N in all."""
        self._groups = tuple(groups)
        self._count = sum(len(rows) for _, rows in self._groups)
        self.goal = np.empty((self._count, 3))
        for objective, rows in self._groups:
            self.goal[rows] = objective.goal
        first = self._groups[0][0]
        self.goal_radius, self.terms = first.goal_radius, first.terms

    def outcome(self, measurement: Measurement) -> Outcome:
        """Judges a control step of N simulations."""
        parts = [
            (ask(objective, part(measurement, rows)), rows)
            for objective, rows in self._groups
        ]
        terms = {
            name: self._merged([(one.terms[name], rows) for one, rows in parts])
            for name in parts[0][0].terms
        }
        return Outcome(
            reward=self._merged([(one.reward, rows) for one, rows in parts]),
            success=self._merged([(one.success, rows) for one, rows in parts]),
            terms=MappingProxyType(terms),
        )

    def path_distance(self, head: np.ndarray) -> np.ndarray:
        """Way (N,) from heads (N, 3) to the goals through the lumen, m."""
        return self._merged(
            [
                (objective.path_distance(head[rows]), rows)
                for objective, rows in self._groups
            ]
        )

    def shifted(self, shift: np.ndarray) -> "ObjectivePool":
        """The same objectives with the goals moved along their branches by (N,) m."""
        return ObjectivePool(
            [
                (cast(Shiftable, objective).shifted(shift[rows]), rows)
                for objective, rows in self._groups
            ]
        )

    def _merged(self, parts: Sequence[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
        merged = np.empty(self._count, np.result_type(*(value for value, _ in parts)))
        for value, rows in parts:
            merged[rows] = value
        return merged


def part(measured: Any, rows: np.ndarray) -> Any:
    """Rows of all arrays of a named tuple, and of the tuples in it."""
    if measured is None or isinstance(measured, np.ndarray):
        return measured if measured is None else measured[rows]
    return type(measured)._make(part(value, rows) for value in measured)
