"""Policies by name, from a checkpoint, or from a function."""

import contextlib
import types
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, cast

import numpy as np
import numpy.typing as npt
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

from cathsim_dmc import files, suite
from cathsim_dmc.agents import pretrained
from cathsim_dmc.agents.checkpoint import Checkpoint, CheckpointError, read_newest
from cathsim_dmc.policies import POLICIES, Policy, View, make_policy
from cathsim_dmc.simulation import environments
from cathsim_dmc.tasks import observations

# Function from the standard observations (N, ...) to the actions (N, A), or to a
# TensorDict with "action".
PolicyFunction = Callable[
    [TensorDictBase], TensorDictBase | torch.Tensor | npt.ArrayLike
]
_OWN = "; one of your own is known once its module is imported (--import MODULE)"
PolicyLike = str | Path | Checkpoint | Policy | PolicyFunction


class FunctionPolicy(Policy):
    """A function of the standard observations.

    A network acts deterministically: in evaluation mode, without dropout, and with the
    middle of its distribution. Of a network inside another function only the latter
    holds; call its `eval()`. A TensorDict module that reads "is_init", as recurrent
    modules of TorchRL do, also reads what it has written under "next" in the step
    before.
    """

    def __init__(self, function: PolicyFunction, name: str | None = None):
        """Wraps a function; the name for reports is by default that of the function."""
        self._function = function
        self.name = name or getattr(function, "__name__", type(function).__name__)
        self._keys = tuple(getattr(function, "in_keys", ()))
        self._begun: torch.Tensor | None = None  # (N,) bool; None for all
        self._memory: dict[Any, Any] = {}

    def reset(self, view: View, which: np.ndarray) -> None:
        """Begins new episodes, in whose first step "is_init" is true."""
        began = torch.as_tensor(np.array(which))
        if began.all():
            self._begun, self._memory = None, {}
        elif self._begun is not None:
            self._begun |= began

    def among(self, first: int, count: int) -> Policy:
        """Returns a policy that calls the function with rows for all episodes."""
        return _Among(self, first, count)

    @torch.no_grad()
    def act(self, observation: Any) -> np.ndarray:
        """Returns the actions (N, A) float32."""
        observation = environments.as_batch(observation)
        if "is_init" in self._keys:
            observation = self._recalled(observation)
        middle = set_exploration_type(ExplorationType.DETERMINISTIC)
        with middle, _evaluating(self._function):
            try:
                answer: Any = self._function(observation)
            except Exception as error:
                error.add_note(_called(self.name, observation))
                raise
        if "is_init" in self._keys and isinstance(answer, TensorDictBase):
            written = answer.get("next", TensorDict())
            kept = {key: written.get(key, None) for key in self._keys}
            self._memory = {k: one for k, one in kept.items() if one is not None}
            self._begun = torch.zeros(answer.batch_size, dtype=torch.bool)
        with files.refused(
            TypeError,
            f"policy {self.name} answered with a {type(answer).__name__}; it must be "
            "actions (N, A) or a TensorDict with them as 'action'",
            (TypeError, ValueError, RuntimeError, KeyError),
        ):
            action = answer["action"] if isinstance(answer, TensorDictBase) else answer
            return torch.as_tensor(action, dtype=torch.float32).numpy()

    def _recalled(self, observation: TensorDictBase) -> TensorDictBase:
        """Returns a copy of the observation with the memory of the function."""
        begun = self._begun
        if begun is None:
            begun = torch.ones(observation.batch_size, dtype=torch.bool)
        return observation.copy().update({**self._memory, "is_init": begun[:, None]})


def _called(name: str, observation: TensorDictBase) -> str:
    """Says what a function that has failed was called with."""
    inputs = (environments.VECTOR, environments.PIXELS)
    shapes = {
        key: tuple(observation[key].shape) for key in inputs if key in observation
    }
    return (
        f"the policy {name} was called with a TensorDict, with {shapes}; a network of "
        f"a tensor is given as lambda seen: network(seen[{environments.VECTOR!r}])"
    )


@contextlib.contextmanager
def _evaluating(function: PolicyFunction) -> Iterator[None]:
    """Puts a network into evaluation mode for a while."""
    parts = function.modules() if isinstance(function, torch.nn.Module) else ()
    training = [part for part in parts if part.training]
    for part in training:
        part.training = False
    try:
        yield
    finally:
        for part in training:
            part.training = True


class _Among(Policy):
    """Policy of some of several simulations; calls a function with rows for all.

    Matrix products round differently with another number of rows, but a row of the
    result does not depend on the values in other rows.
    """

    def __init__(self, policy: FunctionPolicy, first: int, count: int):
        self._policy, self._first, self._count = policy, first, count
        self.name = policy.name

    def reset(self, view: View, which: np.ndarray) -> None:
        self._policy.reset(view, np.asarray(which)[self._rows(len(which))])

    def act(self, observation: Any) -> np.ndarray:
        own = len(observation)
        if own == self._count:
            return self._policy.act(observation)
        rows = torch.from_numpy(self._rows(own))
        return self._policy.act(observation[rows])[self._first : self._first + own]

    def _rows(self, own: int) -> np.ndarray:
        """Own row (count,) that stands in each row of all episodes."""
        return (np.arange(self._count) - self._first).clip(0, own - 1)


class TrainedPolicy(FunctionPolicy):
    """A trained policy, with frozen observation statistics.

    Attributes:
        network: Raw observation in, action out.
        config: Settings of its training.
        shapes: Sizes of its observation and action.
        checkpoint: Checkpoint of the policy; None if it is from a `.safetensors` file.
        card: Card of a policy from such a file, see `pretrained.read_card`.
    """

    checkpoint: Checkpoint | None = None
    card: dict[str, Any] | None = None

    def __init__(self, source: Checkpoint | Path):
        """Loads a checkpoint or a `.safetensors` file; CheckpointError if damaged."""
        if isinstance(source, Checkpoint):
            self.checkpoint, self.network = source, source.policy()
            self.shapes, self.config = source.shapes, source.config
            self.task, self.task_kwargs = source.config.task, source.config.task_kwargs
            name = f"{source.config.algorithm} {source.path.name}"
        else:
            card, network, shapes, config = pretrained.read_pretrained(source)
            self.network, self.shapes, self.config = network, shapes, config
            self.card, self.task = card, card["task"]
            self.task_kwargs, name = card["task_kwargs"], f"pretrained:{card['name']}"
        super().__init__(self._answer, name)
        self.observation = self.config.observation
        self.num_actions = self.shapes.actions

    def reset(self, view: View, which: np.ndarray) -> None:
        """Raises ValueError if the simulations have another number of actions."""
        _require(self, "has actions of", self.shapes.actions, view.num_actions)

    def require_observations(self, names: Sequence[str]) -> None:
        """Raises ValueError if `names` lack an observation of the training."""
        own, given = map(observations.plain_keys, (self.config.observation, names))
        if not {*own} <= {*given}:
            raise ValueError(
                f"{self.name} reads the observation {self.observation!r}, and the "
                f"environment has {', '.join(names)}; make it with the option "
                f"observation={self.observation!r}"
            )

    def _answer(self, observation: TensorDictBase) -> TensorDictBase:
        # In training the critic alone may have read the vector.
        if environments.VECTOR in self.network.in_keys:
            vector = observation.get(environments.VECTOR, None)
            size = 0 if vector is None else vector.shape[-1]
            _require(self, "reads", self.shapes.vector, size)
        if environments.PIXELS in self.network.in_keys:
            pixels = observation.get(environments.PIXELS, None)
            seen = None if pixels is None else tuple(pixels.shape[-3:])
            _require(self, "reads images of", self.shapes.pixels, seen)
        return self.network(observation)


def require_actions(policy: Policy, task: str, options: Mapping[str, Any]) -> None:
    """Raises ValueError if a policy has actions of another size than a task.

    The task is not made for this, which takes seconds.
    """
    if policy.num_actions is not None and task in suite.TASKS:
        given = suite.num_actions(task, **options)
        _require(policy, "has actions of", policy.num_actions, given)


def _require(policy: Policy, what: str, own: Any, given: Any) -> None:
    """Raises ValueError unless two sizes, or (channels, height, width), are equal."""
    if own != given:
        kind = " numbers" if isinstance(own, int) else " as (channels, height, width)"
        raise ValueError(
            f"{policy.name} {what} {own}{kind}, the task gives {given}: play it with "
            "the device, the observation and the options that it was trained with, "
            f"{policy.task} with observation {policy.observation!r} and "
            f"{policy.task_kwargs}"
        )


def load_policy(policy: PolicyLike, seed: int = 0, scripted: bool = True) -> Policy:
    """Returns a policy from its name, file, run or function.

    Args:
        policy: Name in `POLICIES`, "pretrained:NAME", "hf:OWNER/NAME@COMMIT" of the
            hub, file of a pretrained policy, directory of a run or of a checkpoint,
            Checkpoint, policy, or function as for `FunctionPolicy`.
        seed: Seed of a named policy's own randomness.
        scripted: Whether an error lists `POLICIES`, which not every caller takes.

    Raises:
        CheckpointError: there is no policy of that name, or it is damaged.
        TypeError: the argument is none of these.
        ValueError: the hub has no policy of that name.
        ModuleNotFoundError: the hub needs an extra that is not installed.
    """
    if isinstance(policy, Policy):
        return policy
    if isinstance(policy, Checkpoint):
        return TrainedPolicy(policy)
    if isinstance(policy, type):
        raise TypeError(f"policy is the class {policy.__name__}; give an instance")
    if callable(policy):
        return FunctionPolicy(policy)
    if not isinstance(policy, str | Path):
        raise TypeError(
            f"policy is {policy!r}; it must be a name, a path, a Checkpoint, a Policy "
            "or a function"
        )
    if policy in POLICIES:
        return make_policy(str(policy), seed)
    path = pretrained.pretrained_path(policy)
    if not (path or Path(policy)).exists():
        named = [*(POLICIES if scripted else ()), "pretrained:NAME"]
        raise CheckpointError(
            f"no policy {policy}: it is no file or directory, and none of "
            f"{', '.join(named)}{_OWN if scripted else ''}"
        )
    return read_newest(policy, TrainedPolicy) if path is None else TrainedPolicy(path)


# Options of a task that say which devices a policy drives.
_DEVICES = ("device", "devices", "rotation")


def task_and_options(
    policy: Policy, task: str | None, options: Mapping[str, Any] | None
) -> tuple[str, dict[str, Any]]:
    """Returns the task to play with a policy, and the options merged with its own.

    Args:
        task: Name of the task; None takes the one that the policy was trained on, or
            `navigate` where `options` name an anatomy that is no option of that one.
        options: Options of the task.

    Returns:
        Name of the task, and `options` over those of the training. For another task,
        the training's options of the anatomy are dropped; for `navigate`, its devices
        are kept. Settings of `fluoroscopy` are merged one by one.

    Raises:
        ValueError: `task` is None, and the policy was trained on none; or the task is
            from modules that are not imported, see `suite.known`.
    """
    options, trained = dict(options or {}), dict(policy.task_kwargs or {})
    definition = suite.TASKS.get(policy.task or "")
    own = definition.own_options if definition else ()
    if task is None and "anatomy" in {*options} - {*own}:
        task = "navigate"
    if task == "navigate" and definition:  # which names no devices of its own
        devices = definition.options
        trained = {n: devices[n] for n in _DEVICES if n in devices} | trained
    task = task or policy.task
    if task is None:
        raise ValueError(
            f"the policy {policy.name!r} was not trained on a task, so it needs a "
            "task to play, such as type1_lcca; `cathsim list` has all"
        )
    config = getattr(policy, "config", None)
    if task == policy.task and config is not None and config.modules:
        suite.known(task, config.modules)
    if task != policy.task:
        trained = {name: value for name, value in trained.items() if name not in own}
    machine, asked = trained.get("fluoroscopy"), options.get("fluoroscopy")
    if isinstance(machine, Mapping) and isinstance(asked, Mapping):
        options["fluoroscopy"] = {**machine, **asked}
    return task, {**trained, **options}


def view_of(env: EnvBase) -> View:
    """Returns the view of the simulations of a TorchRL environment.

    For an environment of another package, the view has only the numbers of simulations
    and actions.
    """
    base = getattr(env, "base_env", env)
    if hasattr(base, "simulation"):
        return View(base.simulation)
    sizes = {"num_simulations": env.batch_size[0]}
    sizes["num_actions"] = env.action_spec.shape[-1]
    return cast(View, types.SimpleNamespace(**sizes))


def start_insertions(env: EnvBase) -> list[float | None]:
    """Returns where the episodes began, m, see `EpisodeOutcome.start_insertion`.

    For an environment of another package it is None.
    """
    base = getattr(env, "base_env", env)
    if not hasattr(base, "simulation"):
        return [None] * env.batch_size[0]
    return base.simulation.rollout.start_insertions
