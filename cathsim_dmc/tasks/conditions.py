"""Drawn values of an episode, for logs, recordings and conditioned policies."""

import dataclasses
from collections.abc import Collection, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from cathsim_dmc.physics.effect_checks import check_conditions
from cathsim_dmc.physics.effects import Draw, Effect
from cathsim_dmc.tasks.scene import Scene
from cathsim_dmc.tasks.snapshot import Snapshot
from cathsim_dmc.tasks.start import Started


class Conditions(NamedTuple):
    """Values that an episode has drawn; None where the task keeps its own value.

    Without `randomisation` `delay`, `view`, `gain` and `kerma` are not None: they are
    0, (0, 0), 1 and 1, which change nothing.

    Attributes:
        anatomy: Name of the anatomy.
        goal: Name of the goal in it.
        insertion: Insertion at the start beyond the task's own start, m.
        displacement: (3,) of the head at the start, frame of the inlet, m. It differs
            from the drawn one where the vessel is too narrow for that, and by the error
            of a linearised posture.
        friction: Coulomb coefficient of an uncoated device on the wall.
        stiffness: Factor of EI and GJ.
        loss: Factor of the loss factor of the material.
        viscosity: Factor of the viscosity of blood.
        roll: Roll of the device about its axis at the start, rad.
        delay: Delay of the action, control steps.
        goal_shift: Shift of the goal along its branch, m, positive away from the
            ostium.
        view: Deviation of the C-arms' angles, primary and secondary, whole degrees.
        gain: Factor of the gain of the angiography machine.
        kerma: Factor of its kerma.
        effects: What the effects have drawn (`Effect.conditions`). Of a living vessel:
            "flow.rate" (heart, 1/min), "flow.peak" (m/s), "flow.phase" (0 to 1),
            "flow.wave_speed" (m/s), "wall.modulus" (Pa), "wall.thickness" (m, missing
            for that of an artery), "wall.support" (0 to 1), "motion.heart" (m),
            "motion.breathing" (factor), "motion.distensibility" (1/kPa),
            "motion.rate" (1/min), "motion.phase" (0 to 1), "motion.wave_speed" (m/s),
            "motion.breath_rate" (1/min) and "motion.breath_phase" (0 to 1).
    """

    anatomy: str
    goal: str
    insertion: float | None
    displacement: tuple[float, float, float] | None
    friction: float | None
    stiffness: float | None
    loss: float | None
    viscosity: float | None
    roll: float | None
    delay: int | None
    goal_shift: float | None
    view: tuple[int, int] | None
    gain: float | None
    kerma: float | None
    effects: Mapping[str, float]

    def as_dict(self) -> dict[str, Any]:
        """Returns the values by name, JSON-able."""
        plain = {
            name: list(x) for name, x in self._asdict().items() if type(x) is tuple
        }
        return {**self._asdict(), **plain, "effects": dict(self.effects)}


# Numbers of each quantity of an episode, in the order of the columns.
_SIZES = {
    "insertion": 1, "displacement": 3, "friction": 1, "stiffness": 1, "loss": 1,
    "viscosity": 1, "roll": 1, "delay": 1, "goal_shift": 1, "view": 2, "gain": 1,
    "kerma": 1,
}  # fmt: skip
_WHOLE = "delay", "view"
_ARRAY = "conditions._values"  # its name in a snapshot


def drawn_in(snapshot: Snapshot, names: Collection[str]) -> np.ndarray:
    """Returns what the K episodes of a snapshot have drawn.

    Args:
        names: Names of quantities of `Conditions` that are numbers.

    Returns:
        (K, n) in the units of `Conditions`, a column for each number of the quantities;
        NaN where nothing is drawn.
    """
    columns = np.repeat(list(_SIZES), list(_SIZES.values()))
    return completed(snapshot).arrays[_ARRAY][:, np.isin(columns, list(names))]


def completed(snapshot: Snapshot) -> Snapshot:
    """Returns a snapshot with unknown conditions, if it is from before there were.

    They change no episode, so such a snapshot is restored all the same.
    """
    unknown = np.full((len(snapshot), sum(_SIZES.values())), np.nan)
    arrays = {_ARRAY: unknown, **snapshot.arrays}
    return dataclasses.replace(snapshot, arrays=arrays)


class DrawnConditions:
    """The numbers that N episodes have drawn."""

    state = ("_values",)  # see `snapshot`

    def __init__(self, count: int):
        """Takes the number N of simulations; no episode has drawn anything."""
        self._values = np.full((count, sum(_SIZES.values())), np.nan)

    def keep(self, index: int, draw: Draw, start: Started) -> None:
        """Keeps what the episode of one simulation has drawn, and where it starts."""
        found = {**vars(draw), **start._asdict()}
        numbers = [np.nan if found[n] is None else found[n] for n in _SIZES]
        self._values[index] = np.hstack(numbers)

    @property
    def insertions(self) -> list[float | None]:
        """Insertion at the start of each episode, m, see `Conditions`."""
        place = list(_SIZES).index("insertion")
        return [None if np.isnan(x) else float(x) for x in self._values[:, place]]

    def of(self, index: int, scene: Scene, effects: Sequence[Effect]) -> Conditions:
        """Returns the conditions of one simulation, which is in a scene."""
        found: dict[str, Any] = {}
        ends = np.cumsum(list(_SIZES.values()))[:-1]
        parts = np.split(self._values[index], ends)
        for name, numbers in zip(_SIZES, parts, strict=True):
            if np.isnan(numbers).any():
                found[name] = None
                continue
            values = numbers.astype(int if name in _WHOLE else float).tolist()
            found[name] = tuple(values) if len(values) > 1 else values[0]
        drawn: dict[str, float] = {}
        for effect in effects:
            drawn |= check_conditions(effect, effect.conditions(index))
        return Conditions(scene.anatomy.name, scene.goal.name, effects=drawn, **found)
