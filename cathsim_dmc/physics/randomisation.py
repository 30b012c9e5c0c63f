"""Domain randomisation: quantities that are drawn for each episode, from one source.

Composer and the batched path draw the same `Draw` in the same order;
`RandomisedModel` writes it to fields of the compiled model, so nothing is compiled
again.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import mujoco
import numpy as np
from dm_control.composer import variation
from numpy.random import RandomState

from cathsim_dmc import bounds
from cathsim_dmc.entities.chain import hinge_time
from cathsim_dmc.physics.effects import Draw, Effect, World
from cathsim_dmc.physics.readings import Readings, ids

# Published: radius of the ball of the random displacement of the tip.
START_JITTER = 1e-3  # m

# Lowest and highest value of a uniform distribution, or any composer Variation.
Range = Sequence[float] | variation.Variation
Drawn = float | Sequence[float]  # a number, or a range (low, high) that is drawn from

# Allowed range of each drawn quantity: far wider than the differences between sessions,
# within what can be simulated.
_RANGES = {
    "friction": (0.0, 2.0, ""),
    "stiffness": (0.01, 100.0, ""),
    "loss": (0.0, 100.0, ""),
    "viscosity": (0.0, 100.0, ""),
    "view": (-90.0, 90.0, "degrees"),
    "gain": (0.01, 100.0, ""),
    "kerma": (1e-3, 1e6, ""),
    "goal_shift": (-1.0, 1.0, "m"),
    "roll": (-2 * np.pi, 2 * np.pi, "rad"),
    "delay": (0, 250, "control steps"),
    "start_insertion": (0.0, 1.0, "m"),
}
_FARTHEST_START = 0.02  # m; the lumen is no wider
_MOST_NOISE = 0.01  # m


def start_displacement(
    random_state: RandomState, ball: float = START_JITTER
) -> np.ndarray:
    """Random displacement (3,) of the tip: uniform in a ball of that radius, m."""
    direction = random_state.normal(size=3)
    radius = ball * random_state.uniform() ** (1 / 3)
    return radius * direction / np.linalg.norm(direction)


def rolled(quaternion: np.ndarray, roll: float) -> np.ndarray:
    """Orientation (4,), wxyz, that is turned by a roll, rad, about its own z axis.

    Args:
        quaternion: (4,) float64, wxyz.
    """
    turn = np.array([np.cos(roll / 2), 0.0, 0.0, np.sin(roll / 2)])
    found = np.empty(4)
    mujoco.mju_mulQuat(found, quaternion, turn)
    return found


def check_drawn(options: Any, limits: Mapping[str, tuple[float, float, str]]) -> None:
    """Checks numbers and ranges against limits; ValueError names a field."""
    for name, (low, high, unit) in limits.items():
        value = getattr(options, name)
        if isinstance(value, str | float) or bounds.is_number(value):
            bounds.number(name, value, low, high, unit)
        elif value is not None or getattr(type(options), name) is not None:
            ends = bounds.interval(name, value, low, high, unit)
            object.__setattr__(options, name, ends)


def drawn(value: Drawn, random_state: RandomState) -> float:
    """A number as it is, or one drawn from a range (low, high)."""
    if isinstance(value, Sequence):
        low, high = value
        return float(random_state.uniform(low, high))
    return float(value)


@dataclasses.dataclass(frozen=True)
class Randomisation:
    """Quantities drawn at the start of an episode; None keeps the default.

    A range is `(low, high)` of a uniform distribution, or a composer Variation.

    Attributes:
        friction: Coulomb coefficient of an uncoated device on the wall; that of a
            hydrophilic device is this times its `friction_ratio`.
        stiffness: factor of EI and GJ; damping and steering torques are scaled alike,
            so relaxation time and steering angles do not change.
        loss: factor of the loss factor of the material. That of the simulated device is
            0.025 at least, which a physics step of 4 ms gives it; a metal has less, so
            half or twice as much changes nothing.
        viscosity: factor of the viscosity of blood.
        start_radius: radius of the ball in which the tip starts, m.
        view: deviation of the C-arm's angles, degrees, rounded to whole degrees.
        gain: factor of the image's gain.
        kerma: factor of the kerma, which sets the quantum noise (with `noise`).
        goal_shift: shift of the goal along its branch, m, positive away from the
            ostium.
        roll: rotation of the device about its own axis at the start, rad. A shaped
            device starts in its rest posture with this roll, which each reset
            simulates.
        delay: shortest and longest delay of the action, whole control steps.
        start_insertion: additional insertion at the start, m, in steps of 5 mm; scaled
            down where its largest value is more than half of the way to the goal.
        tracking_noise: standard deviation of each coordinate of the tracked points,
            m, drawn anew in every control step. The errors are drawn at the joints of
            the chain; a point of `tracking` between two of them, as those of wires and
            pairs, has their weighted mean, which is smaller by a factor of √2 at most.
    """

    friction: Range | None = None
    stiffness: Range | None = None
    loss: Range | None = None
    viscosity: Range | None = None
    start_radius: float = START_JITTER
    view: Range | None = None
    gain: Range | None = None
    kerma: Range | None = None
    goal_shift: Sequence[float] | None = None
    roll: Range | None = None
    delay: Sequence[int] | None = None
    start_insertion: Sequence[float] | None = None
    tracking_noise: float = 0.0

    def __post_init__(self):
        for name, (low, high, unit) in _RANGES.items():
            value = getattr(self, name)
            varied = isinstance(value, variation.Variation)
            if varied and name in ("delay", "goal_shift", "start_insertion"):
                raise ValueError(
                    f"{name} is a Variation; its bounds must be known before, so give "
                    "(low, high)"
                )
            if value is not None and not varied:
                whole = name == "delay"
                ends = bounds.interval(name, value, low, high, unit, integers=whole)
                object.__setattr__(self, name, ends)
        bounds.number("start_radius", self.start_radius, 0.0, _FARTHEST_START, "m")
        bounds.number("tracking_noise", self.tracking_noise, 0.0, _MOST_NOISE, "m")

    @classmethod
    def make(cls, value: "Randomisation | Mapping[str, Any] | bool") -> "Randomisation":
        """Builds it from an option: False, True for `DEFAULT_RANGES`, or fields."""
        if isinstance(value, bool):
            return DEFAULT_RANGES if value else cls()
        return bounds.made("randomisation", value, cls, "True, False, or ")

    @property
    def longest_delay(self) -> int:
        """Longest delay of the action, control steps."""
        return 0 if self.delay is None else int(self.delay[1])

    @property
    def farthest_shift(self) -> float:
        """Largest shift of the goal away from the ostium, m."""
        return max(0.0, max(self.goal_shift or (0.0,)))

    @property
    def farthest_insertion(self) -> float:
        """Largest insertion beyond the task's own start, m."""
        return 0.0 if self.start_insertion is None else self.start_insertion[1]

    def draw_in(self, random_state: RandomState, anatomies: int) -> tuple[int, Draw]:
        """Draws the index of one of `anatomies` anatomies, then an episode in it."""
        number = int(random_state.randint(anatomies)) if anatomies > 1 else 0
        return number, self.draw(random_state)

    def draw(self, random_state: RandomState) -> Draw:
        """Draws an episode; a quantity that is None draws nothing from the source."""

        def value(name: str) -> float | None:
            chosen = getattr(self, name)
            if chosen is None:
                return None
            if not isinstance(chosen, variation.Variation):
                return drawn(chosen, random_state)
            # A user's own distribution is checked when it is drawn.
            found = variation.evaluate(chosen, random_state=random_state)
            low, high, unit = _RANGES[name]
            return bounds.number(f"{name}, as drawn,", found, low, high, unit)

        displacement = start_displacement(random_state, self.start_radius)
        names = "friction", "stiffness", "loss", "viscosity"
        given: dict[str, Any] = {name: value(name) for name in names}
        primary, secondary = value("view"), value("view")
        gain, kerma = value("gain"), value("kerma")
        given |= {"goal_shift": value("goal_shift"), "roll": value("roll")}
        if self.delay is not None:
            low, high = map(int, self.delay)
            given["delay"] = int(random_state.randint(low, high + 1))
        given["insertion"] = value("start_insertion")
        given["view"] = round(primary or 0.0), round(secondary or 0.0)
        given["gain"] = 1.0 if gain is None else gain
        given["kerma"] = 1.0 if kerma is None else kerma
        return Draw(displacement, **given)


# Friction and EI span the values of real devices and lubrication (friction is usually
# randomised over 0.02-0.15), the rest the differences between two sessions.
DEFAULT_RANGES = Randomisation(
    friction=(0.02, 0.15),
    stiffness=(0.8, 1.25),
    loss=(0.5, 2.0),
    viscosity=(0.5, 2.0),
    start_radius=2e-3,
    view=(-5.0, 5.0),
    gain=(0.85, 1.15),
    kerma=(0.5, 2.0),
    goal_shift=(-0.005, 0.005),
    roll=(-np.pi, np.pi),
    delay=(0, 2),
)


# Fields of the model that each drawn quantity changes.
_WRITTEN = {
    "friction": ["geom_friction"],
    "stiffness": ["jnt_stiffness", "actuator_gainprm", "dof_damping"],
    "loss": ["dof_damping"],
    "roll": ["body_quat"],
}


class RandomisedModel(Effect):
    """Friction, stiffness, loss and roll of the device as drawn for each episode."""

    def __init__(self, randomisation: Randomisation):
        """Names the fields of the model that the randomisation changes."""
        drawn = [n for n in _WRITTEN if getattr(randomisation, n) is not None]
        self.model_fields = tuple({field for n in drawn for field in _WRITTEN[n]})

    def bind(self, world: World) -> None:
        """Finds the elements in the model, and their values without randomisation."""
        super().bind(world)
        model, chain = world.model, world.chain
        self._nominal = {
            name: getattr(model, name).copy() for name in self.model_fields
        }
        self._geoms = np.concatenate([world.index.walls, world.index.geoms])
        self._hinges = ids(model, chain.hinges)
        self._dofs = model.jnt_dofadr[self._hinges]
        self._motors = ids(model, chain.tip_motors)
        self._base = world.index.links.start
        # Coaxial devices have a ratio for each link, see `laws.coaxial.links`.
        self._ratio = 1.0 if chain.coaxial else chain.device.friction_ratio
        self._stiffness = model.jnt_stiffness[self._hinges].copy()

    def restart(self, index: int, episode: Draw, random_state: RandomState) -> None:
        """Writes what was drawn into the model of one simulation."""
        field, stiffness, loss = self.world.field, episode.stiffness, episode.loss
        if episode.friction is not None:
            friction = episode.friction * self._ratio
            field(index, "geom_friction")[self._geoms, 0] = friction
        if loss is not None or stiffness is not None:
            device, timestep = self.world.chain.device, self.world.chain.timestep
            factor = 1.0 if stiffness is None else stiffness
            material = device.relaxation_time * (1.0 if loss is None else loss)
            stiff = self._stiffness * factor
            field(index, "dof_damping")[self._dofs] = (
                hinge_time(material, timestep) * stiff
            )
        if stiffness is not None:
            for name, where in (
                ("jnt_stiffness", self._hinges),
                ("actuator_gainprm", (self._motors, 0)),
            ):
                field(index, name)[where] = self._nominal[name][where] * stiffness
        if episode.roll is not None:
            level = self._nominal["body_quat"][self._base]
            field(index, "body_quat")[self._base] = rolled(level, episode.roll)


class ActionDelay(Effect):
    """Delays actions by the drawn number of control steps."""

    state = ("_past", "_delay")

    def __init__(self, longest: int):
        """Takes the longest delay, control steps."""
        self._longest = longest

    def bind(self, world: World) -> None:
        """Starts without delay."""
        num_actions = len(world.chain.action_names)
        self._past = np.zeros((world.num_simulations, self._longest + 1, num_actions))
        self._delay = np.zeros(world.num_simulations, dtype=int)

    def restart(self, index: int, episode: Draw, random_state: RandomState) -> None:
        """Begins an episode of one simulation, whose past actions are 0."""
        self._past[index] = 0.0
        self._delay[index] = episode.delay

    def act(self, action: np.ndarray, state: Readings) -> np.ndarray:
        """Takes the action (N, A) of this step, returns the one that takes effect."""
        if not self._longest:
            return action
        self._past[:, 1:] = self._past[:, :-1]
        self._past[:, 0] = action
        return self._past[np.arange(len(self._delay)), self._delay]
