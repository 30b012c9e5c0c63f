"""Effects on the simulation: forces, fields of the model, commands of the drives.

A task lists them: `suite.make_task(name, effects=[...])`. An effect restarts with each
episode and acts once in a control step on the arrays of all simulations; in every
physics step acts a function that is compiled and that MuJoCo calls, `Effect.forces`.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import mujoco
import numpy as np
from numpy.random import RandomState

from cathsim_dmc.anatomy import Anatomy
from cathsim_dmc.entities.chain import Chain
from cathsim_dmc.imaging.angiograph import Deviation
from cathsim_dmc.physics.readings import Bodies, ModelIndex, Readings

# Numbers of `userdata` before the parameters of an effect: its mark and their number.
_HEADER = 2


@dataclasses.dataclass(frozen=True)
class Episode:
    """What was drawn for an episode; None where the model's own value stands.

    Attributes:
        displacement: (3,) of the tip at the start, frame of the inlet, m.
        friction: Coulomb coefficient.
        stiffness: factor.
        loss: factor.
        viscosity: factor.
        deviation: of the angiography machine.
        goal_shift: m along the branch.
        roll: rad.
        delay: control steps.
        insertion: m, beyond the task's own start.
    """

    displacement: np.ndarray
    friction: float | None = None
    stiffness: float | None = None
    loss: float | None = None
    viscosity: float | None = None
    deviation: Deviation = Deviation()
    goal_shift: float | None = None
    roll: float | None = None
    delay: int = 0
    insertion: float | None = None


@dataclasses.dataclass(frozen=True)
class World:
    """N simulations, as an effect finds them.

    Attributes:
        model: The compiled scene, as it is without effects.
        chain: The entity of the device, or of several in each other.
        index: Places of the task's quantities in the model.
        start_depth: Way of the chain's end past the mouth of the sheath at zero
            insertion, m.
        arrays: The state, arrays (N, ...) with MuJoCo's names: those of
            `ModelIndex.FIELDS` and of `Effect.data_fields`.
        field: Gives a field of the model that one simulation has for itself, by its
            number and MuJoCo's name, to be written.
        parameters: (N, P) numbers of the effect's own, which the compiled function
            reads; they are part of MuJoCo's state, and 0 when an episode begins.
    """

    model: mujoco.MjModel
    chain: Chain
    index: ModelIndex
    start_depth: float
    arrays: Any
    field: Callable[[int, str], np.ndarray]
    parameters: np.ndarray

    @property
    def num_simulations(self) -> int:
        """N."""
        return len(self.arrays.qpos)


class Effect:
    """Changes nothing; a subclass overrides what it needs.

    Attributes:
        data_fields: Fields of `mujoco.MjData` that it reads, beside
            `ModelIndex.FIELDS`.
        model_fields: Fields of `mujoco.MjModel` that it writes.
        forces: Static method with parameters (P,), time in s and `Bodies`: plain loops
            that add to `xfrc_applied`, which numba compiles and MuJoCo calls in every
            physics step; None for none.
        world: The simulations, there from `bind` on.
    """

    data_fields: tuple[str, ...] = ()
    model_fields: tuple[str, ...] = ()
    forces: Callable[[np.ndarray, float, Bodies], None] | None = None
    world: World

    def num_parameters(self, chain: Chain) -> int:
        """P, how many parameters it has; the compiled function needs one or more."""
        return 0

    def bind(self, world: World) -> None:
        """Finds what it acts on; no episode has begun yet."""
        self.world = world

    def enter(self, index: int, anatomy: Anatomy) -> None:
        """Takes the anatomy of one simulation, before an episode begins in it."""

    def restart(self, index: int, episode: Episode, random_state: RandomState) -> None:
        """Begins an episode of one simulation, whose device lies at its start.

        Args:
            index: Number of the simulation.
            episode: What the task has drawn for it.
            random_state: Source of what the effect draws itself.
        """

    def act(self, action: np.ndarray, state: Readings) -> np.ndarray:
        """Acts once, before the physics steps of a control step.

        Args:
            action: (N, A), of the agent or of the effect before this one.
            state: Readings after the last control step.

        Returns:
            What the next effect gets, and after the last one the actuators.
        """
        return action


def userdata_size(effects: Sequence[Effect], chain: Chain) -> int:
    """Numbers of MuJoCo's `userdata` that some effects take."""
    counts = [effect.num_parameters(chain) for effect in effects]
    taken = sum(_HEADER + count for count in counts if count)
    return taken + 1 if taken else 0


def bind(effects: Sequence[Effect], world: World) -> dict[int, float]:
    """Gives each effect its part of the world.

    Args:
        effects: Of one rollout only.
        world: Simulations; its parameters are all of `userdata`.

    Returns:
        What `userdata` holds beside parameters, by place, in every episode.

    Raises:
        ValueError: if the scene was built for other effects.
    """
    user, needed = world.parameters, userdata_size(effects, world.chain)
    if user.shape[1] != needed:
        raise ValueError(
            f"the effects of the task take {needed} numbers of userdata, and the "
            f"scene has room for {user.shape[1]}: build it with the same configuration"
        )
    from cathsim_dmc.collision.own import OWN  # late, as numba takes long

    labels: dict[int, float] = {needed - 1: OWN} if needed else {}
    start = 0
    for effect in effects:
        count, mark = effect.num_parameters(world.chain), 0
        if effect.forces is not None and not count:
            raise ValueError(
                f"{type(effect).__name__} has forces, but num_parameters is 0, so they "
                "would not be called; return 1 or more"
            )
        first = start + _HEADER if count else start
        if count and effect.forces is not None:
            from cathsim_dmc.physics import callbacks

            mark = callbacks.install(effect.forces)
        if count:
            labels |= {start: mark, start + 1: count}
        start = first + count
        effect.bind(dataclasses.replace(world, parameters=user[:, first:start]))
    check()
    return labels


def check() -> None:
    """Puts back what somebody has removed from MuJoCo's callbacks.

    Raises:
        RuntimeError: if a Python function stands in a callback.
    """
    from cathsim_dmc.collision import callbacks

    callbacks.restore()


def raise_fault() -> None:
    """Raises RuntimeError if a compiled function has raised an error in a step."""
    from cathsim_dmc.physics import callbacks

    callbacks.raise_fault()
