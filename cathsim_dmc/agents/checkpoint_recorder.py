"""Records an episode of every checkpoint of a run, beside the training.

In a process of its own that runs only when a core is idle: the training hands it the
directory of a checkpoint through a pipe and never waits for it, so neither a slow
viewer nor a crash there reaches the training. Behind the training it leaves
checkpoints out and takes the newest.
"""

import contextlib
import os
import subprocess
import sys
from pathlib import Path

from cathsim_dmc import suite
from cathsim_dmc.agents.config import ConfigError, TrainingConfig
from cathsim_dmc.recording.viewer import ViewerError, live_address

LOG_FILE = "training_rrd.log"
_PROCESS = "cathsim_dmc.agents.checkpoint_recording"
# Longest wait for the last episode after the end of the training, s.
PATIENCE = 120.0


class CheckpointRecorder(contextlib.AbstractContextManager):
    """The training's end: starts the process and tells it of checkpoints."""

    def __init__(self, run: Path, config: TrainingConfig):
        """Checks that it can be done.

        Args:
            run: Directory of the run.
            config: Settings of the run.

        Raises:
            ConfigError: the task is none of the suite, or the viewer cannot be used.
        """
        if config.task not in suite.SUITE:
            raise ConfigError(
                f"rerun=True needs a task of the suite, task is {config.task!r}: "
                "record its checkpoints with EpisodeRecorder, or leave rerun out."
            )
        self._run, self._every, self._count = run, config.rerun_every, 0
        self._command = [sys.executable, "-m", _PROCESS, str(run)]
        self._command += [str(config.rerun_steps)]
        if config.rerun_viewer is not None:
            try:
                self._command.append(live_address(config.rerun_viewer))
            except ViewerError as error:
                raise ConfigError(f"rerun_viewer: {error}.") from error
        self._process: subprocess.Popen | None = None

    def __enter__(self) -> "CheckpointRecorder":
        """Start the process."""
        with open(self._run / LOG_FILE, "ab") as log:
            process = subprocess.Popen(
                self._command,
                stdin=subprocess.PIPE,
                stdout=log,
                stderr=log,
                # Ctrl-C is for the training.
                start_new_session=True,
                env={**os.environ, "OMP_NUM_THREADS": "1"},
            )
        _run_when_idle(process.pid)
        if process.stdin is not None and hasattr(os, "set_blocking"):
            os.set_blocking(process.stdin.fileno(), False)
        self._process = process
        return self

    def saved(self, checkpoint: Path, last: bool = False) -> None:
        """Tell of a checkpoint; costs a system call.

        Args:
            checkpoint: Directory of the checkpoint.
            last: Whether it is the last one, which is recorded whatever its number.
        """
        self._count += 1
        if self._process is None or self._process.stdin is None:
            return
        if last or not self._count % self._every:
            # A process that is gone, or that has not read for long.
            with contextlib.suppress(OSError):
                line = f"{checkpoint}\n".encode()
                os.write(self._process.stdin.fileno(), line)

    def __exit__(self, *exception: object) -> None:
        """Let it record the last checkpoint, and say what went wrong, if anything."""
        process = self._process
        if process is None or process.stdin is None:
            return
        with contextlib.suppress(OSError):
            process.stdin.close()
        if exception[0] is not None:
            # It ends by itself; the error is not to wait.
            return
        # What is left is not beside the training any more.
        _run_as_usual(process.pid)
        try:
            code = process.wait(PATIENCE)
        except (subprocess.TimeoutExpired, KeyboardInterrupt):
            process.kill()
            code = process.wait()
        if code:
            print(
                f"the recording of the checkpoints ended early (exit code {code}); the "
                f"training is untouched, see {self._run / LOG_FILE}",
                file=sys.stderr,
            )


def _run_when_idle(pid: int) -> None:
    """Let a process run only on cores that nobody else wants."""
    with contextlib.suppress(OSError, AttributeError):
        os.setpriority(os.PRIO_PROCESS, pid, 19)
        os.sched_setscheduler(pid, os.SCHED_IDLE, os.sched_param(0))


def _run_as_usual(pid: int) -> None:
    """Take a process out of the class that may starve; its niceness stays."""
    with contextlib.suppress(OSError, AttributeError, ValueError):
        for thread in map(int, os.listdir(f"/proc/{pid}/task")):
            os.sched_setscheduler(thread, os.SCHED_OTHER, os.sched_param(0))
