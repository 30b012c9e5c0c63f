"""Submissions to the leaderboard: a policy under the varied protocol, with hashes."""

import copy
import functools
import hashlib
import json
import platform
import re
import subprocess
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from cathsim_dmc import __version__, bounds, files, suite
from cathsim_dmc.agents import evaluation, pretrained, protocols
from cathsim_dmc.agents.checkpoint import Checkpoint, read_newest
from cathsim_dmc.agents.policies import PolicyLike, load_policy
from cathsim_dmc.policies import POLICIES, Policy, View
from cathsim_dmc.tasks.config import EVALUATION_SEED, MAX_STEPS

PROTOCOL = "varied"
RECORDED = ".npz"  # suffix of a file of actions


def submit(
    policy: str,
    out: str | Path,
    task: str | None = None,
    *,
    episodes: int | None = None,
    num_threads: int | None = None,
) -> dict[str, Any]:
    """Plays a policy under the varied protocol and writes its submission.

    The protocol and its seeds are fixed, so whoever has the policy, or its actions,
    and the same versions gets the same episodes. The actions of a policy that does not
    ship with the package are written beside the submission, as .npz.

    Args:
        policy: Name of a policy, "pretrained:NAME", file of a pretrained policy or of
            `record_actions`, or directory of a run.
        out: File to write, ending in .json; the actions go into a file beside it.
        task: Name of the task; None takes the one that the policy was trained on.
        episodes: Number of episodes, fewer than those of the protocol to try it out.
        num_threads: Number of threads of the simulation; None takes one per core.

    Returns:
        The submission; "sha256" is the digest of all other entries.

    Raises:
        ValueError: `out` is no .json file, no such task, or recorded actions are
            damaged, of another task or of other episodes.
        CheckpointError: there is no such policy, or it is damaged.
    """
    out = files.as_path("out", out)
    if out.suffix != ".json":
        raise ValueError(f"the submission is to be written to {out}; give a .json file")
    if task is not None:
        bounds.choice("task", task, suite.SUITE)
    player: str | RecordedActions | _Recorder = policy
    weights, recorded = digest_of(policy), b""
    if policy.endswith(RECORDED):
        player, recorded = RecordedActions(policy), Path(policy).read_bytes()
        if task not in (None, player.task):
            raise ValueError(f"{policy} holds actions of {player.task}, not of {task}")
        player.require(bounds.choice("task", player.task, suite.SUITE), episodes)
    elif not ships(policy):
        player = _Recorder(load_policy(policy, EVALUATION_SEED))
    # A training may have saved a newer one meanwhile.
    if checkpoint := getattr(player, "checkpoint", None):
        weights = _digest(checkpoint)
    ours: dict[str, Any] = {
        "policy_sha256": weights, "package": __version__, "commit": _commit(),
        "processor": processor(),
    }  # fmt: skip
    files.require_file(out, later=True)
    if not isinstance(player, str):
        files.require_file(out.with_suffix(RECORDED), later=True)
    result = evaluation.evaluate(
        player, task, episodes, protocol=PROTOCOL, num_threads=num_threads
    )
    submission: dict[str, Any] = {}

    def write(path: Path) -> None:
        if not isinstance(player, str):
            beside = path.with_suffix(RECORDED)
            if isinstance(player, _Recorder):
                player.write(beside, result)
            elif not (beside.exists() and beside.samefile(policy)):
                files.write_bytes(beside, recorded)
            ours["actions_sha256"] = file_digest(beside)
        values = {**ours, **result.to_dict()}
        submission.update(json.loads(json.dumps(values, default=str)))
        submission["sha256"] = seal(submission)
        files.write_text(path, text(submission))

    files.write_result(out, write, "the submission")
    return submission


def text(submission: dict[str, Any]) -> str:
    """Returns a submission as JSON: a line for each entry and each episode."""
    episodes = ",\n  ".join(map(json.dumps, submission["episodes"]))
    lines = {key: json.dumps(value) for key, value in submission.items()}
    lines["episodes"] = f"[\n  {episodes}\n ]"
    body = ",\n ".join(f'"{key}": {value}' for key, value in lines.items())
    return f"{{\n {body}\n}}\n"


def seal(submission: dict[str, Any]) -> str:
    """Returns the SHA-256 of all entries of a submission but "sha256"."""
    rest = {key: value for key, value in submission.items() if key != "sha256"}
    return hashlib.sha256(json.dumps(rest, sort_keys=True).encode()).hexdigest()


def ships(policy: str) -> bool:
    """Whether a policy ships with the package, under a name."""
    shipped = pretrained.pretrained_names()
    return policy in POLICIES or policy in [pretrained.PREFIX + n for n in shipped]


def protocol_seeds(task: str, options: Mapping[str, Any], episodes: int) -> list[int]:
    """Returns the seeds of the protocol's episodes in the order of playing."""
    return list(_protocol_seeds(task, json.dumps(options, sort_keys=True), episodes))


@functools.lru_cache(256)
def _protocol_seeds(task: str, options: str, episodes: int) -> tuple[int, ...]:
    conditions, seed = protocols.get(PROTOCOL), EVALUATION_SEED
    parts = protocols.parts(conditions, task, json.loads(options), episodes, seed)
    return tuple(seed for part in parts for seed in part.seeds)


def file_digest(path: Path) -> str:
    """SHA-256 of a file."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def digest_of(policy: str) -> str | None:
    """Returns the SHA-256 of a policy's weights or actions; None without a file."""
    if policy in POLICIES:
        return None
    path = pretrained.pretrained_path(policy)
    if policy.endswith(RECORDED):
        path = files.require_source(policy, "a file of agents.record_actions")
    if path is not None:
        return file_digest(path)
    return read_newest(policy, _digest)


def _digest(checkpoint: Checkpoint) -> str:
    sums = json.dumps(dict(checkpoint.sha256), sort_keys=True)
    return hashlib.sha256(sums.encode()).hexdigest()


def processor() -> str:
    """Returns the name of this machine's processor; another one may round otherwise."""
    listed = Path("/proc/cpuinfo")
    text = listed.read_text(errors="replace") if listed.is_file() else ""
    found = re.search(r"(?m)^model name\s*: *(.+)$", text)
    return found[1] if found else platform.processor() or platform.machine()


def _commit() -> str | None:
    command = ["git", "describe", "--always", "--dirty=+", "--abbrev=12"]
    home = Path(__file__).parents[2]
    if not (home / ".git").exists():
        return None
    done = subprocess.run(
        command, cwd=home, capture_output=True, text=True, check=False
    )
    return done.stdout.strip() or None


class RecordedActions(Policy):
    """Plays the actions of a file, episode after episode.

    Past the last step of the file, its last action is repeated.

    Attributes:
        actions: (episodes, steps, A) in [-1, 1]; zeros after the end of an episode.
        seeds: Seeds of the episodes.
    """

    def __init__(self, path: str | Path):
        """Reads a file of `record_actions`; ValueError if it is none or damaged."""
        wrong = LookupError, TypeError, ValueError
        with files.refused(ValueError, f"{path} holds no recorded actions", wrong):
            names = "header", "seeds", "actions"
            header, seeds, actions = files.read_arrays(path, names).values()
            values = json.loads(str(header))
            self.name = f"{values['policy']}, recorded actions"
            self.task, self.task_kwargs = values["task"], dict(values["task_kwargs"])
            self.observation = values["observation"]
            self.seeds = bounds.array("seeds", seeds, "i", (-1,)).tolist()
            shape = len(self.seeds), -1, -1
            self.actions = bounds.array("actions", actions, "f", shape)
            bounds.whole("steps", self.actions.shape[1], 1, MAX_STEPS)
        self.num_actions = self.actions.shape[-1]
        self._rows, self._step = slice(0, 0), 0

    def reset(self, view: View, which: np.ndarray) -> None:
        """Begin the next episodes of the file, if all simulations are reset."""
        if which.all():
            first = self._rows.stop
            self._rows, self._step = slice(first, first + view.num_simulations), 0

    def require(self, task: str, episodes: int | None = None) -> None:
        """Raise ValueError unless the actions are of the protocol on a task."""
        options = self.task_kwargs or {}
        count = episodes or protocols.get(PROTOCOL).episodes
        bounds.whole("max_steps", options.get("max_steps", MAX_STEPS), 1, MAX_STEPS)
        if self.task != task or self.seeds != protocol_seeds(task, options, count):
            raise ValueError(
                f"{self.name} of {self.task} are {len(self.seeds)} episodes, not the "
                f"{count} of the {PROTOCOL} protocol on {task}; record them with "
                "agents.record_actions"
            )

    def act(self, observation: Any) -> np.ndarray:
        """Return the actions (N, A) of the next step."""
        step = min(self._step, self.actions.shape[1] - 1)
        self._step += 1
        return self.actions[self._rows, step]


class _Recorder(Policy):
    """Wraps a policy and records its actions (N, A) by batch and step."""

    def __init__(self, policy: Policy):
        self._policy, self.name, self.task = policy, policy.name, policy.task
        self.observation, self.task_kwargs = policy.observation, policy.task_kwargs
        self.checkpoint = getattr(policy, "checkpoint", None)
        self.num_actions = policy.num_actions
        self.batches: list[list[np.ndarray]] = []

    def reset(self, view: View, which: np.ndarray) -> None:
        if which.all():
            self.batches.append([])
        self._policy.reset(view, which)

    def among(self, first: int, count: int) -> Policy:
        part = copy.copy(self)  # with the same batches
        part._policy = self._policy.among(first, count)
        return part

    def act(self, observation: Any) -> np.ndarray:
        action = self._policy.act(observation)
        self.batches[-1].append(np.array(action, np.float32))
        return action

    def write(self, path: Path, result: evaluation.EvaluationResult) -> None:
        """Writes the actions of the episodes, with zeros after their ends."""
        length = max(map(len, self.batches))
        found = [np.stack(batch, axis=1) for batch in self.batches]  # (N, steps, A)
        rest = [((0, 0), (0, length - one.shape[1]), (0, 0)) for one in found]
        actions = np.concatenate(list(map(np.pad, found, rest)))
        for episode, one in zip(result.episodes, actions, strict=True):
            one[episode.length :] = 0.0
        own = {name: result.settings[name] for name in ("observation", "task_kwargs")}
        header = json.dumps({"policy": result.policy, "task": result.task, **own})
        arrays = {"header": header, "seeds": result.seeds, "actions": actions}
        with files.atomic_path(path, RECORDED) as part, open(part, "wb") as stream:
            np.savez_compressed(stream, **arrays)


def record_actions(
    policy: PolicyLike, out: str | Path, task: str | None = None, **options: Any
) -> evaluation.EvaluationResult:
    """Play the varied protocol and write the actions, for `cathsim submit`.

    Args:
        policy: Policy, or its name, path or function, see `policies.load_policy`.
        out: File to write, ending in .npz.
        task: Name of the task; None takes the one that the policy was trained on.
        **options: Of `evaluate`: episodes (fewer than those of the protocol to try it
            out), observation, task_kwargs, num_threads.

    Returns:
        Result of the evaluation.
    """
    recorder = _Recorder(load_policy(policy, EVALUATION_SEED))
    if files.require_file(out, later=True).suffix != RECORDED:
        raise ValueError(f"the actions are to be written to {out}; give a .npz file")
    result = evaluation.evaluate(recorder, task, protocol=PROTOCOL, **options)
    write = functools.partial(recorder.write, result=result)
    files.write_result(Path(out), write, "the file of actions")
    return result
