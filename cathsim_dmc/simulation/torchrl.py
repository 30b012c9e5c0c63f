"""The batched simulation as a TorchRL environment."""

import contextlib
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from dm_env import specs
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Binary, Bounded, Composite, TensorSpec, Unbounded
from torchrl.envs import EnvBase

from cathsim_dmc import bounds, rows, suite
from cathsim_dmc.simulation.batch import BatchSimulation
from cathsim_dmc.simulation.error_files import ErrorFiles
from cathsim_dmc.tasks.navigation import Navigation
from cathsim_dmc.tasks.snapshot import Snapshot
from cathsim_dmc.tasks.step import Step


class BatchedEnv(EnvBase):
    """N simulations of a task of the suite; batch size [N], on one device.

    Keys: the task's observations (float32, images uint8), "action" (N, A), "reward",
    "terminated" (success, physics error, `give_up`, or a failure by the objective),
    "truncated", and under "info" the figures of `tasks.step.Step.info` (float32 or
    bool), all (N, 1).

    A simulation whose episode has ended stays as it ended, with a reward of 0, until it
    is reset: transforms such as `FrameSkipTransform` step on. So does one that is
    restored from a snapshot of its end.

    Attributes:
        simulation: The simulations underneath, which are stepped on after their end.
    """

    simulation: BatchSimulation

    def __init__(
        self,
        task_name: str,
        num_envs: int = 16,
        *,
        num_threads: int | None = None,
        seed: int | Sequence[int] = 0,
        observation: str | Sequence[str] = "internal",
        task_kwargs: Mapping[str, Any] | None = None,
        device: str | torch.device = "cpu",
    ):
        """Builds the simulations.

        Args:
            num_envs: N.
            num_threads: Number of threads of the simulation, None for one per core.
            seed: Seed of each simulation, or of the first; the others count up, so
                those of independent batches lie at least N apart.
            observation: Name or names of observations.
            task_kwargs: Other options of the task.
            device: "cpu"; "cuda" or "cuda:1" for MuJoCo Warp on a GPU, where the
                tensors are then; "warp:cuda" and "warp:cpu" for MuJoCo Warp there with
                tensors on the CPU (docs/gpu.md).

        Raises:
            ImportError: if the device needs an extra that is not installed.
            NotImplementedError: if the device does not support an option of the task.
            ValueError: an option is not allowed.
        """
        options = bounds.options("task_kwargs", task_kwargs)
        if isinstance(device, torch.device):
            device = str(device)
        for given, argument in {"observation": "observation", "random": "seed"}.items():
            if given in options:
                own = f"without {given}, for which there is the argument {argument}"
                bounds.refuse("task_kwargs", options, own)
        options["observation"] = observation
        bounds.whole("num_envs", num_envs, 1, bounds.MOST_SIMULATIONS)
        seeds = bounds.seeds("seed", seed, num_envs)
        self._task_name, self._options = task_name, options
        self.simulation = _simulation(
            suite.make_task(task_name, **options),
            num_envs,
            bounds.text("device", device),
            num_threads=num_threads or 0,
            seeds=seeds,
        )
        place = "cpu" if device.startswith("warp:") else device
        super().__init__(device=place, batch_size=[num_envs])
        self._ended = np.zeros(num_envs, dtype=bool)
        self._last = TensorDict()  # the last step in which an episode ended
        self._kept: dict[int, Snapshot] = {}  # ends of simulations stepped on since
        self._declare_specs(self.simulation.task)

    def _declare_specs(self, task: Navigation) -> None:
        shape = self.batch_size
        entries = {k: _spec(spec, shape) for k, spec in task.observation_specs.items()}
        flag = Binary(1, (*shape, 1), dtype=torch.bool)
        number = Unbounded((*shape, 1), dtype=torch.float32)
        info = {
            key: (flag if kind is bool else number).clone()
            for key, kind in task.info_types.items()
        }
        entries["info"] = Composite(info, shape=shape)
        self.observation_spec = Composite(entries, shape=shape)
        self.action_spec = Bounded(
            -1.0, 1.0, (*shape, task.num_actions), dtype=torch.float32
        )
        self.reward_spec = number
        self.done_spec = Composite(
            done=flag, terminated=flag.clone(), truncated=flag.clone(), shape=shape
        )

    def __repr__(self) -> str:
        """Task, number of simulations and device."""
        (count,) = self.batch_size
        return f"BatchedEnv({self._task_name!r}, {count}, device={str(self.device)!r})"

    def snapshot(self, indices: np.ndarray | None = None) -> Snapshot:
        """The state of some or all simulations; see `BatchSimulation.snapshot`.

        That of a simulation whose episode has ended is the state of its end.
        """
        self._put_back(range(len(self._ended)))
        return self.simulation.snapshot(indices)

    def restore(self, snapshot: Snapshot) -> TensorDictBase:
        """Restores a snapshot of N simulations; returns what `reset` does.

        Where an episode has ended by the task's rules and time limit, which `ended`
        tells, the next step returns "done" and a reward of 0.

        With transforms, call `reset(snapshot=snapshot)` of the transformed environment,
        so that they process the observation.

        Raises:
            ValueError: if the snapshot is of another task or number of simulations.
        """
        return self.reset(snapshot=snapshot)

    @property
    def ended(self) -> np.ndarray:
        """(N,) bool, simulations whose episode has ended and which wait for a reset."""
        return self._ended.copy()

    def close(self, *, raise_if_closed: bool = True) -> None:
        """Closes the environment and frees GPU memory."""
        self.simulation.close()
        super().close(raise_if_closed=raise_if_closed)

    def record_errors(self, folder: str | Path) -> None:
        """Writes physics errors to a folder from now on, see `error_files`.

        Simulations without snapshots write none.
        """
        if self.simulation.stepper.has_snapshots:
            files = ErrorFiles(folder, self._task_name, self._options)
            self.simulation.error_files = files

    def _reset(
        self,
        tensordict: TensorDict | None = None,
        snapshot: Snapshot | None = None,
        **kwargs,
    ) -> TensorDict:
        if kwargs:
            raise TypeError(
                f"reset() of BatchedEnv takes a snapshot, not {', '.join(kwargs)}; "
                "set_seed(seed) gives the simulations their seeds"
            )
        if snapshot is not None:
            step = self.simulation.restore(snapshot)
            self._kept.clear()
            self._ended, self._last = step.terminated | step.truncated, self._all(step)
            return self._tensors(step)
        chosen = None
        if tensordict is not None and "_reset" in tensordict.keys():
            mask = tensordict["_reset"].reshape(self.batch_size).cpu().numpy()
            if not mask.any():  # TorchRL then keeps its present entries of all
                return self.observation_spec.zero()
            chosen = np.flatnonzero(mask)
        begins = np.arange(len(self._ended)) if chosen is None else chosen
        self._put_back(begins)  # with its random state
        self._ended[begins] = False
        return self._tensors(self.simulation.reset(chosen))

    def _step(self, tensordict: TensorDict) -> TensorDict:
        # Numpy has neither bfloat16 nor gradients.
        action = tensordict["action"].detach().cpu().double()
        self._keep()
        step = self.simulation.step(action.numpy())
        result = self._all(step)
        if self._ended.any():
            waiting = torch.as_tensor(np.flatnonzero(self._ended), device=self.device)
            result[waiting] = self._last[waiting]
            result["reward"][waiting] = 0.0
        ends = (step.terminated | step.truncated) & ~self._ended
        if ends.any():
            self._ended |= ends
            self._last = result.clone()
        return result

    def _keep(self) -> None:
        """Keeps the ends of simulations that are about to be stepped on."""
        new = np.array([n for n in np.flatnonzero(self._ended) if n not in self._kept])
        # `snapshot` raises where a device has none, or an effect's state has no copy.
        with contextlib.suppress(NotImplementedError, TypeError, ValueError):
            if len(new):
                ends = self.simulation.snapshot(new)
                self._kept |= {n: ends[k] for k, n in enumerate(new.tolist())}

    def _put_back(self, indices: Iterable[int]) -> None:
        """Puts simulations that were stepped on after their end back to it."""
        for index in sorted(self._kept.keys() & {*map(int, indices)}):
            self.simulation.restore(self._kept[index], np.array([index]))
            del self._kept[index]

    def _all(self, step: Step) -> TensorDict:
        """Entries of a control step."""
        result = self._tensors(step)
        result["reward"] = self._tensor(step.outcome.reward)[:, None]
        result["terminated"] = self._tensor(step.terminated)[:, None]
        result["truncated"] = self._tensor(step.truncated)[:, None]
        result["done"] = result["terminated"] | result["truncated"]
        return result

    def _tensors(self, step: Step) -> TensorDict:
        own = self._tensor
        entries = {key: own(value) for key, value in step.observation.items()}
        here = {"batch_size": self.batch_size, "device": self.device}
        entries["info"] = TensorDict(self._columns(step.info()), **here)
        return TensorDict(entries, **here)

    def _columns(self, info: dict[str, np.ndarray]) -> dict[str, torch.Tensor]:
        """Figures as tensors (N, 1); numbers go to the device in one transfer."""
        numbers = [key for key, value in info.items() if value.dtype != np.bool_]
        together = self._tensor(np.stack([info[key] for key in numbers]))
        found = dict(zip(numbers, together.unbind(), strict=True))
        return {
            key: (found[key] if key in found else self._tensor(value))[:, None]
            for key, value in info.items()
        }

    def _tensor(self, values: np.ndarray) -> torch.Tensor:
        """Tensor on the device; numbers become float32."""
        if values.dtype not in (np.uint8, np.bool_):
            values = rows.copied(values, np.float32)
        return torch.as_tensor(values).to(self.device)

    def _set_seed(self, seed: int | None) -> None:
        seeds = bounds.seeds("seed", 0 if seed is None else seed, len(self._ended))
        self._put_back(range(len(self._ended)))
        self.simulation.seed(seeds)

    @property
    def action_groups(self) -> tuple[int, ...]:
        """Group number of each action; the tip motors of one bending axis share one."""
        return self.simulation.task.scene.catheter.action_groups


def _spec(spec: specs.Array, batch: torch.Size) -> TensorSpec:
    """Spec of an entry of the observation; numbers are float32."""
    shape = (*batch, *spec.shape)
    dtype = torch.uint8 if spec.dtype == np.uint8 else torch.float32
    if not isinstance(spec, specs.BoundedArray):
        return Unbounded(shape, dtype=dtype)
    return Bounded(spec.minimum.item(), spec.maximum.item(), shape, dtype=dtype)


def _simulation(
    task: Navigation, num_envs: int, device: str, **options: Any
) -> BatchSimulation:
    """Makes the simulations on a device."""
    if device == "cpu":
        return BatchSimulation(task, num_envs, **options)
    from cathsim_dmc.simulation.warp.simulation import WarpSimulation  # an extra

    name = device.removeprefix("warp:")
    return WarpSimulation(task, num_envs, device=name, **options)
