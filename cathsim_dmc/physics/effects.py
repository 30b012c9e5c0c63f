"""Effects on the simulation: forces, fields of the model, commands of the drives.

A task lists them: `suite.make_task(name, effects=[...])`. An effect restarts with each
episode and acts once in a control step on the arrays of all simulations. In every
physics step acts its law, a function of its parameters that is compiled and that MuJoCo
calls through `dispatcher`. The parameters of all effects of a simulation lie one after
the other in MuJoCo's `userdata`; its last number says by which layout.
"""

import dataclasses
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple, TypeVar

import mujoco
import numpy as np
from numpy.random import RandomState

from cathsim_dmc.anatomy import Anatomy
from cathsim_dmc.entities.chain import Chain
from cathsim_dmc.laws import parameters as declared
from cathsim_dmc.physics.readings import ModelIndex, Readings


@dataclasses.dataclass(frozen=True)
class Draw:
    """What was drawn for an episode; None where the model's own value stands.

    Attributes:
        displacement: (3,) of the tip at the start, frame of the inlet, m.
        friction: Coulomb coefficient.
        stiffness: factor.
        loss: factor.
        viscosity: factor.
        view: added to the angles of the C-arms, primary and secondary, whole degrees.
        gain: factor of the gain of the angiography machine.
        kerma: factor of its kerma.
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
    view: tuple[int, int] = (0, 0)
    gain: float = 1.0
    kerma: float = 1.0
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
        parameters: Those of the effect's law, `Effect.parameters` of views (N, ...);
            they are part of MuJoCo's state, and 0 when an episode begins.
    """

    model: mujoco.MjModel
    chain: Chain
    index: ModelIndex
    start_depth: float
    arrays: Any
    field: Callable[[int, str], np.ndarray]
    parameters: Any

    @property
    def num_simulations(self) -> int:
        """N."""
        return len(self.arrays.qpos)


E = TypeVar("E", bound="Effect")


class NoParameters(NamedTuple):
    """Parameters of a law that has none."""

    unused: Any


class Effect:
    """Changes nothing; a subclass overrides what it needs.

    Attributes:
        data_fields: Fields of `mujoco.MjData` that it reads, beside
            `ModelIndex.FIELDS`.
        model_fields: Fields of `mujoco.MjModel` that it writes.
        step_fields: Those of `model_fields` that `act` writes. The device writes its
            own in every control step: what it has from its hinges and masses follows
            from options of the task, and an effect that declares one is refused.
        state: Names of its attributes, arrays with a leading axis N, that are its state
            beside parameters and fields: what an episode goes on from. A snapshot keeps
            them, and writes into them in place; what MuJoCo derives it does not keep,
            so `act` reads that from its argument `state`.
        parameters: NamedTuple of what its law reads, see `laws.parameters`; None for
            none.
        law: Static method, plain loops that numba compiles and MuJoCo calls in every
            physics step: parameters of one simulation, time in s, and in "control" the
            `laws.device.Links`, to whose `xfrc_applied` it adds forces, in "passive"
            the `laws.device.Device`, to whose `qfrc_passive` it adds, in "contact" a
            `laws.device.Contact`, whose `solref` it changes. None for none.
        acts_in: "control", "passive" or "contact".
        adapter: Name of a function of `physics.adapters` in place of `law`.
        world: The simulations, there from `bind` on.
    """

    data_fields: tuple[str, ...] = ()
    model_fields: tuple[str, ...] = ()
    step_fields: tuple[str, ...] = ()
    state: tuple[str, ...] = ()
    parameters: Any = None
    law: Callable[[Any, float, Any], None] | None = None
    acts_in: str = "control"
    adapter: str | None = None
    world: World

    def bind(self, world: World) -> None:
        """Finds what it acts on; no episode has begun yet."""
        self.world = world

    def enter(self, index: int, anatomy: Anatomy) -> None:
        """Takes the anatomy of one simulation, before an episode begins in it."""

    def restart(self, index: int, episode: Draw, random_state: RandomState) -> None:
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
            (N, A), what the next effect gets; the drives get it clipped to [-1, 1].
        """
        return action


def check_action(effect: Effect, action: Any, shape: tuple[int, ...]) -> None:
    """Refuses (ValueError) what `act` of an effect has returned."""
    name = f"act of {type(effect).__name__} returns"
    if action is None:
        raise ValueError(f"{name} None; return the action that takes effect")
    if np.shape(action) != shape:
        raise ValueError(
            f"{name} an array of shape {np.shape(action)}; return the action that "
            f"takes effect, of shape {shape}"
        )


def _kind(effect: Effect) -> Any:
    """Class of the parameters of an effect; None for one without."""
    acts = effect.law is not None or effect.adapter is not None
    return effect.parameters or (NoParameters if acts else None)


def _sizes(chain: Chain) -> dict[str, int]:
    """The sizes that shapes of parameters name."""
    sizes = {"links": len(chain.links), "joints": len(chain.bends) // 2}
    if chain.coaxial:
        stack: Any = chain
        sizes |= {"devices": len(stack.devices), "nodes": len(stack.stack.nodes)}
    return sizes


def of_kind(effects: Iterable[Effect], kind: type[E]) -> E | None:
    """The effect of a class among some; None if there is none."""
    return next((effect for effect in effects if isinstance(effect, kind)), None)


def userdata_size(effects: Iterable[Effect], chain: Chain) -> int:
    """Numbers of MuJoCo's `userdata` that some effects take."""
    sizes, kinds = _sizes(chain), [_kind(effect) for effect in effects]
    found = [declared.total(kind, sizes) for kind in kinds if kind is not None]
    return sum(found) + 1 if found else 0


def views(kind: Any, rows: np.ndarray, sizes: Mapping[str, int]) -> Any:
    """Parameters (N, ...) in rows (N, P), of a class."""
    found, start = [], 0
    for shape in declared.shapes(kind, sizes).values():
        count = math.prod(shape)
        found.append(rows[:, start : start + count].reshape((len(rows), *shape)))
        start += count
    return kind._make(found)


class Layout:
    """Where the parameters of some effects lie in `userdata`.

    Attributes:
        effects: They.
    """

    def __init__(self, effects: Sequence[Effect], world: World, places: Any = None):
        """Gives each effect its part of the world, and has MuJoCo call the laws.

        Args:
            effects: Of one rollout only.
            world: Simulations; its parameters are all of `userdata`, (N, n).
            places: `dispatcher.Places` of the device; None for those of a task's scene.

        Raises:
            ValueError: if the scene was built for other effects.
            RuntimeError: if a Python function stands in one of MuJoCo's callbacks.
        """
        from cathsim_dmc.physics import dispatcher  # late, as numba takes long

        self.effects = tuple(effects)
        self._user, sizes = world.parameters, _sizes(world.chain)
        needed = userdata_size(effects, world.chain)
        if self._user.shape[1] != needed:
            raise ValueError(
                f"the effects of the task take {needed} numbers of userdata, and the "
                f"scene has room for {self._user.shape[1]}: build it with the same "
                "configuration"
            )
        laws, start = [], 0
        for effect in effects:
            kind, parameters = _kind(effect), None
            if kind is not None:
                count = declared.total(kind, sizes)
                parameters = views(kind, self._user[:, start : start + count], sizes)
                laws += dispatcher.laws(effect, kind, start)
                start += count
            effect.bind(dataclasses.replace(world, parameters=parameters))
        places = places or dispatcher.Places.of(world.model, world.index)
        self._callbacks = dispatcher.layout(world.model, places, laws)
        self._stand = dispatcher.stand

    def begin(self, indices: np.ndarray) -> None:
        """Has laws act on simulations (K,), whose `userdata` have been reset.

        Raises:
            RuntimeError: if a Python function stands in one of MuJoCo's callbacks.
        """
        self._stand()
        self._user[indices, -1] = self._callbacks.label

    def raise_fault(self) -> None:
        """Raises RuntimeError if a law has raised an error since the last call."""
        self._callbacks.raise_fault()
