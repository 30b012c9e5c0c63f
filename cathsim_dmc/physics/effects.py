"""Effects on the simulation: forces, fields of the model, commands of the drives.

A task lists them: `suite.make_task(name, effects=[...])`. An effect restarts with each
episode and acts once per control step on the arrays of all simulations. Its law acts in
every physics step: a compiled function of the effect's parameters, which MuJoCo calls
through `dispatcher`. The parameters of all effects of a simulation lie one after the
other in MuJoCo's `userdata`; the last number of `userdata` is the label of the layout.
"""

import copy
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
from cathsim_dmc.physics.effect_checks import check_state
from cathsim_dmc.physics.readings import ModelIndex, Readings


@dataclasses.dataclass(frozen=True, eq=False)
class Draw:
    """Values drawn for an episode; None keeps the model's own value.

    Attributes:
        displacement: (3,) of the tip at the start, frame of the inlet, m.
        friction: Coulomb coefficient.
        stiffness: factor of EI and GJ.
        loss: factor of the loss factor of the material.
        viscosity: factor of the viscosity of blood.
        view: added to the angles of the C-arms, primary and secondary, whole degrees.
        gain: factor of the gain of the angiography machine.
        kerma: factor of its kerma.
        goal_shift: shift of the goal along its branch, m.
        roll: roll of the device about its axis, rad.
        delay: delay of the action, control steps.
        insertion: insertion beyond the task's own start, m.
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


@dataclasses.dataclass(frozen=True, eq=False)
class World:
    """N simulations that an effect acts on.

    Attributes:
        model: The compiled scene, as it is without effects.
        chain: The entity of the device, or of coaxial devices.
        index: Indices of the task's quantities in the model.
        start_depth: (N,), distance of the chain's end past the mouth of the sheath at
            zero insertion, m; it depends on the anatomy.
        stroke: (N,), largest insertion, m; it depends on the anatomy.
        arrays: The state, arrays (N, ...) with MuJoCo's names: those of
            `ModelIndex.FIELDS` and of `Effect.data_fields`.
        field: Returns a field of one simulation's own model, to be written, by the
            index of the simulation and MuJoCo's name of the field. It keeps its value
            from episode to episode: `restart` scales that of `model`, not the last one.
            ValueError for a field that no effect has in its `model_fields`.
        parameters: Parameters of the effect's law, `Effect.parameters` of views
            (N, ...). They are part of MuJoCo's state, and 0 when an episode begins.
    """

    model: mujoco.MjModel
    chain: Chain
    index: ModelIndex
    start_depth: np.ndarray
    stroke: np.ndarray
    arrays: Any
    field: Callable[[int, str], np.ndarray]
    parameters: Any

    @property
    def num_simulations(self) -> int:
        """Number N of simulations."""
        return len(self.arrays.qpos)


E = TypeVar("E", bound="Effect")


class NoParameters(NamedTuple):
    """Parameters of a law that has none."""

    unused: Any


class Effect:
    """Base class of effects, which changes nothing; subclasses override its methods.

    Each environment acts by a copy of the effect with arrays of its own.

    Attributes:
        data_fields: Fields of `mujoco.MjData` that it reads, beside
            `ModelIndex.FIELDS`.
        model_fields: Fields of `mujoco.MjModel` that it writes.
        step_fields: Those of `model_fields` that `act` writes. Fields that the device
            writes in every control step, such as those of its hinges, are refused:
            `restart` or options of the task set them.
        state: Names of its attributes, arrays of numbers with a leading axis N, made in
            `bind`, that are its state beside parameters and fields. A snapshot saves
            them and restores them in place. It does not save quantities that MuJoCo
            derives; `act` reads these from its argument `state`.
        parameters: NamedTuple class of the parameters of its law, see
            `laws.parameters`; None for none.
        law: Static method law(parameters, time, state) of plain loops, which numba
            compiles and MuJoCo calls in every physics step: parameters of one
            simulation, time in s, and a state by `acts_in`. In "control" it adds to
            `xfrc_applied` of `laws.device.Links`, in "passive" to `qfrc_passive` of
            `laws.device.Device`, in "contact" it changes `solref` of
            `laws.device.Contact`. It returns nothing and writes finite numbers. None
            for none.
        acts_in: "control", "passive" or "contact".
        adapter: Name of a function of `physics.adapters` in place of `law`.
        world: The simulations, set before `bind`.
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
        """Takes the simulations that it acts on, before their first episode."""

    def enter(self, index: int, anatomy: Anatomy) -> None:
        """Takes the anatomy of one simulation, before an episode begins in it.

        `world.start_depth` and `world.stroke` are those in this anatomy.
        """

    def restart(self, index: int, episode: Draw, random_state: RandomState) -> None:
        """Begins an episode of one simulation, whose device is at its start.

        Args:
            index: Index of the simulation.
            episode: Values that the task has drawn for the episode.
            random_state: Source of the effect's own draws.
        """

    def conditions(self, index: int) -> Mapping[str, float]:
        """Values that `restart` has drawn for the episode of one simulation, by name.

        It is read from the effect's state, so that it is that of a restored episode.
        Names begin with that of the effect and a dot, such as "wind.speed".
        """
        del index
        return {}

    def act(self, action: np.ndarray, state: Readings) -> np.ndarray:
        """Acts once, before the physics steps of a control step.

        Args:
            action: (N, A), from the agent or from the effect before this one.
            state: Readings after the last control step.

        Returns:
            (N, A), action for the next effect; the drives get it clipped to [-1, 1].
        """
        return action


def copied(effect: Effect) -> Effect:
    """Returns a copy for one rollout, with its own arrays.

    Arrays that cannot be written and other attributes stay shared.
    """
    one = copy.copy(effect)
    for name, value in vars(one).items():
        if isinstance(value, np.ndarray) and value.flags.writeable:
            vars(one)[name] = value.copy()
    return one


def _kind(effect: Effect) -> Any:
    """Class of the parameters of an effect; None for one without."""
    acts = effect.law is not None or effect.adapter is not None
    return effect.parameters or (NoParameters if acts else None)


def _declared(effects: Sequence[Effect], field: Callable[[int, str], np.ndarray]):
    """`World.field` that gives the fields which some effect declares, and no others."""
    known = {name for effect in effects for name in effect.model_fields}

    def declared(index: int, name: str) -> np.ndarray:
        if name not in known:
            raise ValueError(
                f"an effect writes {name}, a field of the model that is not in its "
                "model_fields; name it there, so that snapshots save it"
            )
        return field(index, name)

    return declared


def _sizes(chain: Chain) -> dict[str, int]:
    """Sizes of a chain, by the names in the shapes of parameters."""
    sizes = {"links": len(chain.links), "joints": len(chain.bends) // 2}
    if chain.coaxial:
        stack: Any = chain
        sizes |= {"devices": len(stack.devices), "nodes": len(stack.stack.nodes)}
    return sizes


def of_kind(effects: Iterable[Effect], kind: type[E]) -> E | None:
    """The first effect of a class; None if there is none."""
    return next((effect for effect in effects if isinstance(effect, kind)), None)


def userdata_size(effects: Iterable[Effect], chain: Chain) -> int:
    """Length of MuJoCo's `userdata` for some effects, the label included."""
    sizes, kinds = _sizes(chain), [_kind(effect) for effect in effects]
    found = [declared.total(kind, sizes) for kind in kinds if kind is not None]
    return sum(found) + 1 if found else 0


def views(kind: Any, rows: np.ndarray, sizes: Mapping[str, int]) -> Any:
    """Parameters of a NamedTuple class: views (N, ...) of rows (N, P)."""
    found, start = [], 0
    for shape in declared.shapes(kind, sizes).values():
        count = math.prod(shape)
        found.append(rows[:, start : start + count].reshape((len(rows), *shape)))
        start += count
    return kind._make(found)


class Layout:
    """Layout of the parameters of effects in `userdata`.

    Attributes:
        effects: The effects, in their order in `userdata`.
    """

    def __init__(self, effects: Sequence[Effect], world: World, places: Any = None):
        """Binds the effects to their parameters, and has MuJoCo call their laws.

        Args:
            effects: Effects, not shared with another rollout.
            world: Simulations; `parameters` is the whole `userdata`, (N, n).
            places: `dispatcher.Places` of the device; None for those of a task's scene.

        Raises:
            ValueError: if the scene was built for other effects, or an effect lacks a
                state that it names.
            RuntimeError: if one of MuJoCo's callbacks is a Python function.
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
        world = dataclasses.replace(world, field=_declared(effects, world.field))
        laws, start = [], 0
        for effect in effects:
            kind, parameters = _kind(effect), None
            if kind is not None:
                count = declared.total(kind, sizes)
                parameters = views(kind, self._user[:, start : start + count], sizes)
                laws += dispatcher.laws(effect, kind, start)
                start += count
            effect.world = dataclasses.replace(world, parameters=parameters)
            effect.bind(effect.world)
            for name in effect.state:
                check_state(effect, name, world.num_simulations)
        places = places or dispatcher.Places.of(world.model, world.index)
        self._callbacks = dispatcher.layout(world.model, places, laws)
        self._stand = dispatcher.stand

    def begin(self, indices: np.ndarray) -> None:
        """Switches the laws on in simulations (K,) whose `userdata` have been reset.

        Raises:
            RuntimeError: if one of MuJoCo's callbacks is a Python function.
        """
        self._stand()
        self._user[indices, -1] = self._callbacks.label

    def raise_fault(self, warned: np.ndarray) -> None:
        """Raises RuntimeError if a law has failed since the last call.

        Args:
            warned: (N,) bool, whether MuJoCo has warned: the law may then write numbers
                that are not finite.
        """
        self._callbacks.raise_fault(warned)
