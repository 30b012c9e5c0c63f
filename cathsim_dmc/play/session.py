"""Sessions of cannulation by hand: episodes that are recorded."""

import contextlib
import itertools
import time
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from cathsim_dmc import bounds, files, suite
from cathsim_dmc.play.controls import Controls
from cathsim_dmc.play.hands import HANDS, Hand, hand
from cathsim_dmc.play.window import FluoroscopyWindow
from cathsim_dmc.policies import Policy, in_environment
from cathsim_dmc.recording.episode import SUFFIX, Episode
from cathsim_dmc.recording.recorder import EpisodeRecorder
from cathsim_dmc.tasks.config import CONTROL_TIMESTEP

_PAUSE = 1.0  # s, for which the end of an episode is shown
_FASTEST = 1000.0  # times real time


def play(
    task: str,
    out: str | Path | None = None,
    *,
    seed: int = 0,
    episodes: int | None = None,
    speed: float = 1.0,
    task_kwargs: Mapping[str, Any] | None = None,
    policy: Policy | None = None,
    hands: str = "keyboard",
) -> list[Path]:
    """Plays a task by hand in real time and records the episodes.

    Args:
        out: Directory for the episodes (npz), made if it is not there; None for none.
        seed: Seed of the first episode; the others count up.
        episodes: Number of episodes, None until the operator quits.
        speed: Speed of the simulation, in multiples of real time.
        policy: Policy that plays while the operator watches, such as
            `agents.load_policy` returns; None for the operator.
        hands: Input device, one of `hands.HANDS`; the keys act too, and a gamepad
            vibrates with the largest contact force.

    Returns:
        The files written, one for each episode of at least one step.

    Raises:
        ValueError: if an argument is wrong, no window can be opened, or no such device
            is connected.
        ModuleNotFoundError: the extra `hands` is not installed.
    """
    bounds.number("speed", speed, high=_FASTEST, positive=True)
    if episodes is not None:
        bounds.whole("episodes", episodes, 1, bounds.MOST_SIMULATIONS)
    bounds.seeds("seed", bounds.seed("seed", seed), episodes or 1)
    bounds.choice("hands", hands, HANDS)
    if policy is not None and not isinstance(policy, Policy):
        bounds.refuse("policy", policy, "what agents.load_policy returns, or None")
    options = bounds.options("task_kwargs", task_kwargs)
    if out is not None:
        files.require_place(out)
    held = hand(hands)
    with contextlib.closing(held) if held else contextlib.nullcontext():
        seeds = (
            itertools.count(seed) if episodes is None else range(seed, seed + episodes)
        )
        return _play(task, out, seeds, speed, options, policy, held)


def _play(
    task: str,
    out: str | Path | None,
    seeds: Iterable[int],
    speed: float,
    options: dict[str, Any],
    policy: Policy | None,
    held: Hand | None,
) -> list[Path]:
    # The operator observes the window, so the task needs only a cheap observation.
    observation = (policy and policy.observation) or "tracking"
    env = suite.load(suite.DOMAIN, task, {"observation": observation, **options})
    chosen = policy and in_environment(policy, env)
    controls = Controls.of(env.task.scene, watching=policy is not None, hand=held)
    window = FluoroscopyWindow(env.task, controls)
    if out is not None:
        files.require_folder(out, make=True)
    due = time.monotonic()

    def quits() -> bool:
        return window.closed or controls.requested == "quit"

    def act(timestep: Any) -> np.ndarray:
        nonlocal due
        due += CONTROL_TIMESTEP / speed
        controls.feel(float(env.task.wall_force.mean_max))
        window.show(env.task, until=due)
        # A machine that cannot keep pace runs slower and does not catch up later.
        due = max(due, time.monotonic() - CONTROL_TIMESTEP)
        if quits() or controls.requested == "restart":
            raise StopIteration
        return chosen(timestep) if chosen else controls.action(CONTROL_TIMESTEP)

    recorder, written = EpisodeRecorder(env, task, options), []
    try:
        for seed in seeds:
            controls.restart()
            due = time.monotonic()
            episode = recorder.record_episode(act, seed)
            if out is not None and episode.steps:
                written.append(_save(episode, Path(out)))
            until = time.monotonic() + _PAUSE / speed
            text = f"{episode.termination} after {episode.time[-1]:.1f} s"
            while time.monotonic() < until and not controls.requested and not quits():
                window.show(env.task, text, time.monotonic() + 0.02)
            if quits():
                break
    finally:
        window.close()
    return written


def _save(episode: Episode, directory: Path) -> Path:
    """Saves an episode by the next number that is free, also of other sessions."""
    for number in itertools.count():
        path = directory / f"{episode.task}_{number:03d}{SUFFIX}"
        with contextlib.suppress(FileExistsError):
            path.open("xb").close()
            break
    try:
        return episode.save(path)
    except BaseException:
        path.unlink()
        raise
