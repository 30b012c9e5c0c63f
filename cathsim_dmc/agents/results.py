"""Results of an evaluation: figures over its episodes, success with its interval."""

import itertools
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal

import numpy as np

from cathsim_dmc import __version__, bounds, json_options
from cathsim_dmc.agents import evaluation_files
from cathsim_dmc.agents.episodes import EpisodeOutcome
from cathsim_dmc.agents.protocols import count_distinct
from cathsim_dmc.analysis.force_statistics import FIGURES, QUANTITIES, STATISTICS
from cathsim_dmc.analysis.intervals import success_interval

# Largest sums of the force on the wall up to which success is called safe, N.
SAFE_FORCES = (0.5, 1.0, 2.0)
_DECIDING = ("mujoco", "dm-control", "numpy", "numba", "torch")
_ON_GPU = ("mujoco-warp", "warp-lang", "numba-cuda")


def versions(simulated_on: str = "cpu") -> dict[str, str]:
    """Returns the versions of the packages that determine the episodes on a device."""
    names = _DECIDING if simulated_on == "cpu" else (*_DECIDING, *_ON_GPU)
    return {"cathsim-dmc": __version__, **{name: version(name) for name in names}}


@dataclass(frozen=True)
class EvaluationResult:
    """Episodes of one policy on one task.

    Attributes:
        task: Name of the task.
        policy: Name of the policy.
        seeds: Seed of each episode.
        episodes: Episodes in the order of their seeds.
        settings: Protocol, observation, further task_kwargs, frames of a checkpoint,
            "started", the digest of the snapshot at which the episodes began, if they
            did, "lumens", name and digest of each anatomy that the option `anatomy`
            names, and "simulated_on", the device, if it is not the CPU.
        distinct: Whether all episodes can differ by more than the jitter of the start.
            If not, no interval over them is given.
        conditions: What was drawn for each episode; empty without randomisation.
        versions: Versions of the packages that determine the episodes, by name; empty
            in files from before 0.3.
    """

    task: str
    policy: str
    seeds: tuple[int, ...]
    episodes: tuple[EpisodeOutcome, ...]
    settings: Mapping[str, Any]
    distinct: bool = True
    conditions: tuple[Mapping[str, Any], ...] = ()
    versions: Mapping[str, str] = field(default_factory=dict)

    def __repr__(self) -> str:
        """Policy, task, protocol and successes."""
        protocol = self.settings.get("protocol", "no protocol")
        return (
            f"<EvaluationResult of {self.policy!r} on {self.task!r}, {protocol}: "
            f"{self.successes} of {len(self.episodes)} episodes succeed>"
        )

    @classmethod
    def load(
        cls, path: str | Path, which: Literal["policy", "baseline"] = "policy"
    ) -> "EvaluationResult":
        """Read an evaluation that `cathsim eval --out` or `evaluate` has written.

        Args:
            path: File, or folder with an `evaluation.json`.
            which: The policy, or the baseline beside it, which `cathsim eval` plays.

        Returns:
            The evaluation as it was written: options that are objects are texts.

        Raises:
            ValueError: the file holds no evaluation, or not this one.
            OSError: there is no such file.
        """
        bounds.choice("which", which, evaluation_files.WHICH)
        found = evaluation_files.read(path)
        if which not in found:
            raise ValueError(
                f"{path} has no {which}; there is {', '.join(found)}"
                " (`cathsim eval --no-baseline` plays no baseline)"
            )
        return cls(**found[which])

    @property
    def num_conditions(self) -> int:
        """Number of different conditions among the episodes.

        Differences in noise and C-arm do not count, nor those of a start within 2 mm,
        see `protocols.count_distinct`. Where no conditions are recorded it is the
        number of episodes if all can differ, and 1 otherwise.
        """
        if self.conditions:
            places = [episode.start_insertion for episode in self.episodes]
            began = [{} if x is None else {"insertion": x} for x in places]
            pairs = zip(self.conditions, began, strict=True)
            return count_distinct([{**drawn, **own} for drawn, own in pairs])
        return len(self.episodes) if self.distinct else 1

    def values(self, name: str) -> np.ndarray:
        """Return a figure of every episode, float64 (episodes,); NaN where unknown.

        Args:
            name: Name of an attribute of `EpisodeOutcome`, with dots for nested ones,
                such as "reward" or "forces.peak_sum.maximum".

        Raises:
            ValueError: there is no figure of that name; lists those that are.
        """

        def value(outcome: Any) -> Any:
            for part in name.split("."):
                outcome = None if outcome is None else getattr(outcome, part)
            return outcome

        try:
            return np.array([value(e) for e in self.episodes], dtype=np.float64)
        except (AttributeError, TypeError):
            known = [f.name for f in fields(EpisodeOutcome) if f.name != "forces"]
            known += [f"forces.{one}" for one in FIGURES]
            each = f"{' or '.join(QUANTITIES)} and {' or '.join(STATISTICS)}"
            allowed = f"one of {', '.join(known)}, or forces.QUANTITY.STATISTIC, {each}"
            bounds.refuse("the figure", name, allowed)

    def mean_sd(self, name: str) -> tuple[float | None, float | None]:
        """Return mean and sample standard deviation over the episodes, or None."""
        values = self.values(name)
        values = values[~np.isnan(values)]
        if not len(values):
            return None, None
        deviation = float(values.std(ddof=1)) if len(values) > 1 else 0.0
        return float(values.mean()), deviation

    @property
    def successes(self) -> int:
        """Number of episodes that reached the goal."""
        return sum(episode.success for episode in self.episodes)

    def safe_success(self, limit: float) -> float:
        """Return the fraction of episodes that succeed with little force on the wall.

        Args:
            limit: Largest allowed sum of the magnitudes over all contacts, mean over a
                control step (`EpisodeForces.largest_sum`), N.

        Returns:
            Fraction in [0, 1]; an episode whose force is not known is not safe.
        """
        safe = self.values("forces.largest_sum") <= limit
        return float(np.mean((self.values("success") > 0) & safe))

    def summary(self) -> dict[str, Any]:
        """Return means with deviations over the episodes, success with its interval.

        The interval is None where the episodes are not distinct. The shares of episodes
        that failed or were given up are there where there are any. Forces in N, by
        quantity and statistic as docs/forces.md defines them.
        """
        count, successes = len(self.episodes), self.successes
        interval = list(success_interval(successes, count)) if self.distinct else None
        result: dict[str, Any] = {"episodes": count}
        for name in ("reward", "length", "path_ratio"):
            result[name], result[f"{name}_sd"] = self.mean_sd(name)
        # Files from before 0.3 lack the means over a control step.
        quantities = [
            name
            for name in QUANTITIES
            if any(getattr(one.forces, name) is not None for one in self.episodes)
        ]
        result["forces"] = {quantity: {} for quantity in quantities}
        for quantity, name in itertools.product(quantities, STATISTICS):
            mean, deviation = self.mean_sd(f"forces.{quantity}.{name}")
            result["forces"][quantity][name] = {"mean": mean, "sd": deviation}
        result["physics_errors"] = sum(e.physics_error for e in self.episodes)
        for name in "failed", "given_up":
            if found := sum(getattr(e, name) for e in self.episodes):
                result[name] = found / count
        result |= {"success": successes / count, "success_ci95": interval}
        result["safe_success"] = {
            f"{limit:g} N": self.safe_success(limit) for limit in SAFE_FORCES
        }
        return result

    def to_dict(self) -> dict[str, Any]:
        """Return identity, summary and every episode, JSON-able; objects as texts."""
        options = json_options.as_texts(self.settings.get("task_kwargs", {}))
        drawn = [{"conditions": dict(one)} for one in self.conditions]
        drawn = drawn or [{}] * len(self.seeds)
        played = zip(self.seeds, self.episodes, drawn, strict=True)
        episodes = [
            {"seed": seed, **asdict(episode), **conditions}
            for seed, episode, conditions in played
        ]
        return {
            "task": self.task,
            "policy": self.policy,
            "seed": self.seeds[0],
            "settings": {**self.settings, "task_kwargs": options},
            "versions": dict(self.versions),
            "distinct": self.distinct,
            "summary": self.summary(),
            "episodes": episodes,
        }
