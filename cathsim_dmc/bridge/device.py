"""Interface of a device to its driver, and a simulated device."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np

from cathsim_dmc import bounds
from cathsim_dmc.tasks.config import CONTROL_TIMESTEP
from cathsim_dmc.tasks.interface import action_table, observation_table

HANDSHAKE = 5.0  # s, time limit of each message of the handshake
MOST_FRAMES = 50  # in one period; more are a flood
# Proposed threshold of rupture (arXiv 2604.20151).
FORCE_LIMIT = 1.5  # N
LIMITED = ("largest", "push")


def require_watchdog(watchdog: float, period: float) -> None:
    """Raise ValueError unless a watchdog, s, exceeds the period of the device, s."""
    if watchdog <= period:
        allowed = f"longer than a period of the device, {period:g} s"
        bounds.refuse("watchdog", watchdog, allowed)


class State(NamedTuple):
    """Measurements of a device in one period.

    Attributes:
        observation: Arrays by key, as in `Device.observation`.
        force: Measured forces by name, N: "largest", the largest contact with the wall,
            and "sum", over all contacts, are means over the period; "push" is the force
            at the base.
        time: Clock of the device, s.
        end: Why the episode is over: "success", "truncated", "physics_error" or
            "force_limit"; None while the episode runs.
    """

    observation: Mapping[str, np.ndarray]
    force: Mapping[str, float]
    time: float
    end: str | None = None


class Device(Protocol):
    """Interface of a device that can be served: a simulation or a robot.

    Attributes:
        name: Name for display.
        period: Duration of a control step, s.
        action: A dictionary for each entry of an action, see `interface.action_table`:
            "name" and "unit"; "scale", "low" and "high" where they are known. Entries
            whose unit contains "/s", such as m/s, are 0 when the device must hold
            still.
        observation: A dictionary for each array, see `interface.observation_table`:
            "key", "shape" and "dtype", and "unit" where it is known.
    """

    name: str
    period: float
    action: Sequence[Mapping[str, Any]]
    observation: Sequence[Mapping[str, Any]]

    def start(self, seed: int | None) -> State:
        """Go to the start of an episode; return its state."""
        ...

    def command(self, action: np.ndarray) -> None:
        """Apply the action (A,) of the present period; called when it arrives."""
        ...

    def read(self) -> State:
        """Return the measurements at the end of a period."""
        ...

    def stop(self) -> None:
        """Stop all motion; called after every episode, also after an error."""
        ...


_METHODS = "start", "command", "read", "stop"
_TABLES = {"action": ("name", "unit"), "observation": ("key", "shape", "dtype")}


def require_device(device: Any) -> None:
    """Raise ValueError unless an object has all attributes and methods of `Device`."""
    own = {name: getattr(device, name, None) for name in (*_METHODS, *_TABLES)}
    lacking = [name for name in _METHODS if not callable(own[name])]
    if isinstance(device, type) or lacking:
        allowed = f"an object, no class, with the methods {', '.join(_METHODS)}"
        bounds.refuse("device", device, allowed)
    bounds.text("name of the device", getattr(device, "name", None))
    period = getattr(device, "period", None)
    bounds.number("period of the device", period, unit="s", positive=True)
    for name, keys in _TABLES.items():
        given: Any = own[name]
        rows = given if isinstance(given, Sequence) else [None]
        if not all(isinstance(one, Mapping) and {*keys} <= {*one} for one in rows):
            allowed = f"a list of dictionaries with {', '.join(keys)}"
            bounds.refuse(f"{name} of the device", given, allowed)


class SimulatedDevice:
    """A task of the suite as a device."""

    period = CONTROL_TIMESTEP

    def __init__(self, environment: Any, name: str):
        """Takes a composer environment of `suite.load`."""
        self.name, self._env = name, environment
        task, chain = environment.task, environment.task.scene.catheter
        self.action: Sequence[Mapping[str, Any]] = action_table(chain)
        self.observation: Sequence[Mapping[str, Any]] = observation_table(task)

    def start(self, seed: int | None) -> State:
        """Reset; a seed gives the same episode as the suite's option `random`."""
        if seed is not None:
            self._env.random_state.seed(seed)
        return self._state(self._env.reset())

    def command(self, action: np.ndarray) -> None:
        """Store the action for `read`."""
        self._action = action

    def read(self) -> State:
        """Simulate a period with the stored action; return the measurements."""
        return self._state(self._env.step(self._action))

    def stop(self) -> None:
        """Do nothing: a simulation does not move between two steps."""

    def _state(self, timestep: Any) -> State:
        task = self._env.task
        info, end = task.info(), None
        if timestep.last():
            kinds = (k for k in ("success", "physics_error") if info[k])
            end = next(kinds, "truncated")
        measured = task.wall_force  # means over the period, as a load cell reads
        force = {"largest": measured.mean_max, "sum": measured.mean_sum}
        force["push"] = task.readings.push_force
        forces = {name: float(np.asarray(value)) for name, value in force.items()}
        return State(timestep.observation, forces, float(self._env.physics.time()), end)
