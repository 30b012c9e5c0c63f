"""A session of cannulation by hand, episode after episode, recorded."""

import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from cathsim_dmc import suite
from cathsim_dmc.play.controls import CoaxialControls, Controls
from cathsim_dmc.play.window import FluoroscopyWindow
from cathsim_dmc.policies import Policy, in_environment
from cathsim_dmc.recording.episode import SUFFIX, Episode
from cathsim_dmc.recording.recorder import EpisodeRecorder
from cathsim_dmc.tasks.config import CONTROL_TIMESTEP
from cathsim_dmc.tasks.scene import Scene

_PAUSE = 1.0  # s, for which the end of an episode is shown


class Session:
    """Runs episodes in a window at the pace of the clock, by keyboard or policy."""

    def __init__(
        self,
        task: str,
        seed: int,
        speed: float,
        task_kwargs: Mapping[str, Any] | None,
        policy: Policy | None,
    ):
        """Loads the task and opens the window; arguments as of `play`."""
        if not speed > 0:
            raise ValueError(f"speed is {speed}; it must be > 0")
        self._options = dict(task_kwargs or {})
        # The screen is the operator's observation; the task's own would only cost.
        observation = (policy and policy.observation) or "tracking"
        self._environment = suite.load(
            suite.DOMAIN, task, {"observation": observation, **self._options}
        )
        self._policy = policy and in_environment(policy, self._environment)
        self._task_name, self._seed, self._speed = task, seed, speed
        navigation = self._environment.task
        self._controls = _controls_of(navigation.scene)
        self._window = FluoroscopyWindow(navigation, self._controls)
        self._next = time.monotonic()

    def run(self, out: Path | None = None, episodes: int | None = None) -> list[Path]:
        """Plays until the operator quits, or for a number of episodes."""
        if out is not None:
            Path(out).mkdir(parents=True, exist_ok=True)
        recorder = EpisodeRecorder(self._environment, self._task_name, self._options)
        written: list[Path] = []
        played = 0
        try:
            while episodes is None or played < episodes:
                self._controls.restart()
                self._next = time.monotonic()
                episode = recorder.record_episode(self._act, self._seed + played)
                played += 1
                if out is not None and episode.steps:
                    written.append(_save(episode, Path(out)))
                if self._quits():
                    break
                self._show_end(episode)
        finally:
            self._window.close()
        return written

    def _act(self, timestep: Any) -> np.ndarray:
        """Action of the operator or of the policy; StopIteration when asked to stop."""
        self._window.show(self._environment.task)
        self._next += CONTROL_TIMESTEP / self._speed
        while (left := self._next - time.monotonic()) > 0:
            self._window.poll()
            time.sleep(min(left, 0.005))
        # A machine that cannot keep pace runs slower and does not catch up later.
        self._next = max(self._next, time.monotonic() - CONTROL_TIMESTEP)
        self._window.poll()
        if self._quits() or self._controls.requested == "restart":
            raise StopIteration
        if self._policy is not None:
            return self._policy(timestep)
        return self._controls.action(CONTROL_TIMESTEP)

    def _quits(self) -> bool:
        return self._window.closed or self._controls.requested == "quit"

    def _show_end(self, episode: Episode):
        if self._controls.requested == "restart":
            return
        text = f"{episode.termination} after {episode.time[-1]:.1f} s"
        until = time.monotonic() + _PAUSE / self._speed
        while time.monotonic() < until and not self._quits():
            self._window.show(self._environment.task, text)
            self._window.poll()
            time.sleep(0.02)


def _controls_of(scene: Scene) -> Controls | CoaxialControls:
    catheter = scene.catheter
    if scene.coaxial:
        return CoaxialControls(len(catheter.devices))
    return Controls(len(catheter.tip_motors) // 2, catheter.rotation is not None)


def _save(episode: Episode, directory: Path) -> Path:
    """Saves under the first number that is free."""
    number = 0
    while (path := directory / f"{episode.task}_{number:03d}{SUFFIX}").exists():
        number += 1
    return episode.save(path)


def play(
    task: str,
    out: str | Path | None = None,
    *,
    seed: int = 0,
    episodes: int | None = None,
    speed: float = 1.0,
    task_kwargs: Mapping[str, Any] | None = None,
    policy: Policy | None = None,
) -> list[Path]:
    """Plays a task by keyboard and records demonstrations.

    Args:
        out: directory for the episodes (npz), made if it is not there; None for none.
        seed: of the first episode; the others count up.
        episodes: to play, None until the operator quits.
        speed: of the simulation against the clock.
        policy: that plays while the operator watches; None for the operator.

    Returns:
        The files written, one for each episode of at least one step.

    Raises:
        ValueError: if an argument is wrong or no window can be opened.
    """
    session = Session(task, seed, speed, task_kwargs, policy)
    return session.run(None if out is None else Path(out), episodes)
