"""Entries of the leaderboard: submissions that are checked and played again."""

import dataclasses
import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from cathsim_dmc import bounds, files, suite
from cathsim_dmc.agents import evaluation, evaluation_files, protocols, submission
from cathsim_dmc.agents.checkpoint import CheckpointError
from cathsim_dmc.agents.episodes import EpisodeOutcome
from cathsim_dmc.agents.results import EvaluationResult, versions
from cathsim_dmc.agents.submission import PROTOCOL, RECORDED, RecordedActions
from cathsim_dmc.analysis.force_statistics import QUANTITIES
from cathsim_dmc.tasks.config import MAX_STEPS

MOST_BYTES = 2**22  # of a submission; one of 100 episodes has 110 kB
_WRONG = (
    OSError, LookupError, TypeError, ValueError, AttributeError, RecursionError,
    CheckpointError,
)  # fmt: skip


class Entry(NamedTuple):
    """A submission that passed the checks of `read`.

    Attributes:
        path: Path of its file.
        values: Content of the file.
        result: Its episodes, from which all figures are computed.
    """

    path: Path
    values: Mapping[str, Any]
    result: EvaluationResult


class Replay(NamedTuple):
    """Episodes of an entry that were played again.

    Attributes:
        result: The episodes played here.
        equal: Number of episodes that equal those of the entry, bit for bit.
        source: What was played, "policy" or "actions".
    """

    result: EvaluationResult
    equal: int
    source: str


def read(path: str | Path) -> Entry:
    """Reads and checks a submission.

    The digest must match. Protocol, seeds and task options must be those of the
    leaderboard, no two episodes may be equal, and the summary must follow from the
    episodes. This finds errors and careless changes; only `replay` shows that the
    episodes took place.

    Raises:
        ValueError: the file cannot be listed; says why.
    """
    path = files.as_path("path", path)
    with files.refused(ValueError, f"{path.name} is not listed", _WRONG):
        if path.stat().st_size > MOST_BYTES:
            raise ValueError(f"it is larger than {MOST_BYTES / 1e6:.0f} MB")
        values = json.loads(path.read_text(encoding="utf-8"))
        if values["sha256"] != submission.seal(values):
            raise ValueError("it was changed after it was written")
        return Entry(path, values, _result(values))


def replay(entry: Entry, num_threads: int | None = None) -> Replay | None:
    """Plays the episodes of an entry again.

    A policy that ships with the package acts itself; for another policy, the actions in
    the `.npz` file beside the submission are played.

    Args:
        entry: What `read` returned.
        num_threads: Number of threads of the simulation; None takes one per core.

    Returns:
        The episodes, or None if neither policy nor actions are there.

    Raises:
        ValueError: the actions are not those submitted, or an episode differs although
            versions and processor are the same.
    """
    with files.refused(ValueError, f"{entry.path.name} is not listed", _WRONG):
        player = _player(entry)
        if player is None:
            return None
        settings, own = entry.values["settings"], None
        if isinstance(player, RecordedActions):
            own = settings["observation"]
        result = evaluation.evaluate(
            player, entry.result.task, protocol=PROTOCOL, observation=own,
            task_kwargs=settings["task_kwargs"], num_threads=num_threads,
        )  # fmt: skip
        pairs = zip(entry.result.episodes, result.episodes, strict=True)
        equal = [_same(one, other) for one, other in pairs]
        here = submission.processor()
        alike = entry.values.get("processor", here) == here  # none in older files
        if alike and entry.result.versions == versions() and not all(equal):
            seeds = [s for s, one in zip(result.seeds, equal, strict=True) if not one]
            raise ValueError(
                f"{len(seeds)} of its {len(equal)} episodes are others when they are "
                f"played again, such as that of seed {seeds[0]}; submit it again"
            )
        source = "policy" if isinstance(player, str) else "actions"
        return Replay(result, sum(equal), source)


def _player(entry: Entry) -> str | RecordedActions | None:
    values, name = entry.values, entry.result.policy
    if submission.ships(name):
        if submission.digest_of(name) != values["policy_sha256"]:
            raise ValueError(f"its weights are not those of {name}")
        return name
    path = entry.path.with_suffix(RECORDED)
    if not path.is_file():
        return None
    if submission.file_digest(path) != values.get("actions_sha256"):
        raise ValueError(f"{path.name} is not the file of actions that was submitted")
    player = RecordedActions(path)
    player.require(entry.result.task)
    if player.task_kwargs != values["settings"]["task_kwargs"]:
        raise ValueError(f"{path.name} has other options of the task")
    return player


def _same(one: EpisodeOutcome, other: EpisodeOutcome) -> bool:
    own: dict[str, Any] = {"env": other.env}
    if one.start_insertion is None:  # not in older files
        own["start_insertion"] = other.start_insertion
    return dataclasses.replace(one, **own) == other


def _result(values: Mapping[str, Any]) -> EvaluationResult:
    settings = bounds.instance("settings", values["settings"], dict)
    task = bounds.choice("task", values["task"], suite.SUITE)
    bounds.choice("protocol", settings["protocol"], [PROTOCOL])
    options = settings["task_kwargs"]
    if options not in ({}, {"max_steps": MAX_STEPS}):
        raise ValueError(f"it changes the options of its task: {bounds.shown(options)}")
    rows = bounds.instance("episodes", values["episodes"], list)
    count = protocols.get(PROTOCOL).episodes
    if len(rows) != count:
        raise ValueError(f"it has {len(rows)} episodes; the protocol has {count}")
    seeds = submission.protocol_seeds(task, options, count)
    if [row["seed"] for row in rows] != seeds:
        raise ValueError(f"its seeds are not those of the {PROTOCOL} protocol")
    episodes = tuple(_episode(index, row) for index, row in enumerate(rows))
    if len({(one.reward, one.forces) for one in episodes}) < count:
        raise ValueError("some of its episodes are copies of others")
    for name in ("policy", "package"):
        bounds.text(name, values[name])
    for name in ("commit", "policy_sha256"):
        if values[name] is not None:
            bounds.text(name, values[name])
    made = values.get("versions", {})
    result = EvaluationResult(
        task, values["policy"], tuple(seeds), episodes, settings, versions=made
    )
    if not _close(json.loads(json.dumps(result.summary())), values["summary"]):
        raise ValueError("its summary is not that of its episodes")
    return result


def _episode(index: int, row: Mapping[str, Any]) -> EpisodeOutcome:
    """Returns an episode of a submission; ValueError for an impossible value."""
    found = evaluation_files.outcome({**row, "env": index})
    # Files from before 0.3 lack the means.
    for name in QUANTITIES:
        if getattr(found.forces, name) is None and not name.startswith("mean"):
            raise ValueError(f"episode {index} has no forces.{name}")
    bounds.whole("length", found.length, 1, MAX_STEPS)
    if found.success and (found.physics_error or not found.terminated):
        raise ValueError(f"episode {index} succeeds, but was not ended by the task")
    if not found.terminated and found.length != MAX_STEPS:
        raise ValueError(f"episode {index} is cut off after {found.length} steps")
    return found


def _close(one: Any, other: Any) -> bool:
    """Whether two JSON values are equal but for the last digits of numbers."""
    if isinstance(one, dict) and isinstance(other, dict):
        return one.keys() == other.keys() and all(
            _close(value, other[key]) for key, value in one.items()
        )
    if isinstance(one, list) and isinstance(other, list):
        return len(one) == len(other) and all(map(_close, one, other))
    if isinstance(one, float) and isinstance(other, float | int):
        return math.isclose(one, other, rel_tol=1e-9, abs_tol=1e-12)
    return bool(one == other)
