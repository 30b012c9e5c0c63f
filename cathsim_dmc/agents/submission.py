"""Submissions to the leaderboard: a policy under the varied protocol, with hashes."""

import hashlib
import json
import subprocess
from pathlib import Path
from typing import Any

from cathsim_dmc import __version__, bounds, files, suite
from cathsim_dmc.agents import actions, evaluation, pretrained
from cathsim_dmc.agents.checkpoint import Checkpoint
from cathsim_dmc.policies import POLICIES

PROTOCOL = "varied"


def submit(
    policy: str,
    out: str | Path,
    task: str | None = None,
    *,
    episodes: int | None = None,
    num_threads: int | None = None,
) -> dict[str, Any]:
    """Plays a policy under the varied protocol and writes its submission.

    The protocol and its seeds are fixed, so whoever has the policy, the package and
    the commit gets the same episodes.

    Args:
        policy: Name of a policy, "pretrained:NAME", file of a pretrained policy or of
            `actions.record_actions`, or directory of a run.
        out: File to write, ending in .json.
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
    out = Path(out)
    if out.suffix != ".json":
        raise ValueError(f"the submission is to be written to {out}; give a .json file")
    if task is not None:
        bounds.choice("task", task, suite.SUITE)
    weights = digest_of(policy)
    player: str | actions.RecordedActions = policy
    if policy.endswith(actions.SUFFIX):
        player = actions.RecordedActions(policy)
        if task not in (None, player.task):
            raise ValueError(f"{policy} holds actions of {player.task}, not of {task}")
        bounds.choice("task", player.task, suite.SUITE)
        actions.require_protocol(player, episodes)
    out.parent.mkdir(parents=True, exist_ok=True)
    result = evaluation.evaluate(
        player, task, episodes, protocol=PROTOCOL, num_threads=num_threads
    )
    submission = {
        "policy_sha256": weights,
        "package": __version__,
        "commit": _commit(),
        **result.to_dict(),
    }
    submission = json.loads(json.dumps(submission, default=str))
    submission["sha256"] = seal(submission)
    files.write_text(out, text(submission))
    return submission


def text(submission: dict[str, Any]) -> str:
    """A submission as JSON: a line for each entry and each episode."""
    episodes = ",\n  ".join(map(json.dumps, submission["episodes"]))
    lines = {key: json.dumps(value) for key, value in submission.items()}
    lines["episodes"] = f"[\n  {episodes}\n ]"
    body = ",\n ".join(f'"{key}": {value}' for key, value in lines.items())
    return f"{{\n {body}\n}}\n"


def seal(submission: dict[str, Any]) -> str:
    """SHA-256 of all entries of a submission but "sha256"."""
    rest = {key: value for key, value in submission.items() if key != "sha256"}
    return hashlib.sha256(json.dumps(rest, sort_keys=True).encode()).hexdigest()


def digest_of(policy: str) -> str | None:
    """SHA-256 of a policy's weights or recorded actions; None without a file."""
    if policy in POLICIES:
        return None
    if policy.startswith(pretrained.PREFIX):
        policy = str(pretrained.pretrained_path(policy))
    if policy.endswith((pretrained.SUFFIX, actions.SUFFIX)):
        return hashlib.sha256(Path(policy).read_bytes()).hexdigest()
    sums = json.dumps(dict(Checkpoint.open(policy).sha256), sort_keys=True)
    return hashlib.sha256(sums.encode()).hexdigest()


def _commit() -> str | None:
    command = ["git", "describe", "--always", "--dirty=+", "--abbrev=12"]
    home = Path(__file__).parents[2]
    if not (home / ".git").exists():
        return None
    done = subprocess.run(
        command, cwd=home, capture_output=True, text=True, check=False
    )
    return done.stdout.strip() or None
