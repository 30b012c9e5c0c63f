"""Actions of the episodes of a protocol, to play them again without the policy."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from cathsim_dmc import bounds, files
from cathsim_dmc.agents import evaluation, protocols
from cathsim_dmc.agents.policies import PolicyLike, load_policy
from cathsim_dmc.policies import Policy, View

FORMAT = "cathsim-actions"
SUFFIX = ".npz"


class RecordedActions(Policy):
    """Plays the actions of a file; zeros where they have ended.

    Attributes:
        seeds: Seed of each episode.
    """

    def __init__(self, path: str | Path):
        """Reads a file of `record_actions`; ValueError if it is none or damaged."""
        names = ("header", "seeds", "lengths", "actions")
        try:
            header, *arrays = files.read_arrays(Path(path), names).values()
            values = json.loads(str(header))
            if values["format"] != FORMAT:
                raise ValueError(f"its format is {values['format']!r}")
            seeds = bounds.array("seeds", arrays[0], "i", (-1,))
            lengths = bounds.array("lengths", arrays[1], "i", seeds.shape)
            actions = bounds.array("actions", arrays[2], "f", (lengths.sum(), -1))
            self.name = f"{values['policy']}, recorded actions"
            self.task, self.task_kwargs = values["task"], dict(values["task_kwargs"])
            self.observation = values["observation"]
        except (LookupError, TypeError, ValueError) as error:
            raise ValueError(f"{path} holds no recorded actions: {error}") from error
        self.seeds: tuple[int, ...] = tuple(seeds.tolist())
        actions = actions.astype(np.float32)
        self._episodes = np.split(actions, np.cumsum(lengths)[:-1])
        self._view, self._first, self._step = None, 0, 0

    def reset(self, view: View, which: np.ndarray) -> None:
        """Begin episodes; those of a new view follow those of the one before."""
        if view is not self._view:
            if self._view is not None:
                self._first += self._view.num_simulations
            self._view, self._step = view, 0

    def act(self, observation: Any) -> np.ndarray:
        """Actions (N, A) float32 of the step."""
        assert self._view is not None  # reset comes first
        action = np.zeros(
            (self._view.num_simulations, self._episodes[0].shape[1]), np.float32
        )
        chosen = self._episodes[self._first : self._first + len(action)]
        for one, episode in zip(action, chosen, strict=True):
            if self._step < len(episode):
                one[:] = episode[self._step]
        self._step += 1
        return action


class _Recorder(Policy):
    """Another policy, whose actions are kept: arrays (N, A) by batch and step."""

    def __init__(self, policy: Policy):
        self._policy, self.name, self.task = policy, policy.name, policy.task
        self.observation, self.task_kwargs = policy.observation, policy.task_kwargs
        self._view, self.batches = None, []

    def reset(self, view: View, which: np.ndarray) -> None:
        if view is not self._view:
            self._view = view
            self.batches.append([])
        self._policy.reset(view, which)

    def act(self, observation: Any) -> np.ndarray:
        action = self._policy.act(observation)
        self.batches[-1].append(np.array(action, np.float32))
        return action


def record_actions(
    policy: PolicyLike,
    out: str | Path,
    task: str | None = None,
    *,
    episodes: int | None = None,
    observation: str | None = None,
    task_kwargs: Mapping[str, Any] | None = None,
    num_threads: int | None = None,
) -> evaluation.EvaluationResult:
    """Play the varied protocol and write the actions, for `cathsim submit`.

    Args:
        policy: Policy, or what names one, see `policies.load_policy`.
        out: File to write, ending in .npz.
        task: Name of the task; None takes the one that the policy was trained on.
        episodes: Number of episodes, fewer than those of the protocol to try it out.
        observation: As for `evaluate`.
        task_kwargs: As for `evaluate`.
        num_threads: As for `evaluate`.

    Returns:
        What the policy reached.
    """
    recorder = _Recorder(load_policy(policy, evaluation.EVALUATION_SEED))
    with files.atomic_path(out, SUFFIX) as path:
        result = evaluation.evaluate(
            recorder, task, episodes, protocol="varied", observation=observation,
            task_kwargs=task_kwargs, num_threads=num_threads,
        )  # fmt: skip
        simulations = (
            one for batch in recorder.batches for one in np.stack(batch, axis=1)
        )  # (N, steps, A)
        lengths = [episode.length for episode in result.episodes]
        kept = [one[:n] for one, n in zip(simulations, lengths, strict=True)]
        own = {name: result.settings[name] for name in ("observation", "task_kwargs")}
        header = {"format": FORMAT, "policy": result.policy, "task": result.task, **own}
        with open(path, "wb") as stream:
            np.savez_compressed(
                stream,
                header=np.array(json.dumps(header)),
                seeds=np.array(result.seeds),
                lengths=np.array(lengths),
                actions=np.concatenate(kept),
            )
    return result


def require_protocol(actions: RecordedActions, episodes: int | None) -> None:
    """Refuse actions of other episodes than the varied protocol's; ValueError."""
    conditions = protocols.get("varied")
    number = conditions.episodes if episodes is None else episodes
    parts = protocols.parts(
        conditions, actions.task or "", actions.task_kwargs or {}, number,
        evaluation.EVALUATION_SEED,
    )  # fmt: skip
    if actions.seeds != tuple(seed for part in parts for seed in part.seeds):
        raise ValueError(
            f"the {len(actions.seeds)} episodes recorded are not the {number} of the "
            "varied protocol; record them with agents.record_actions"
        )
