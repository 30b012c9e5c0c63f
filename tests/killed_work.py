"""Work that is killed: functions for processes that a fork server starts.

The server has imported everything, so a process is at work at once; how long it has
worked is measured by its processor time, which a busy machine does not change.
"""

import multiprocessing
import os
import random
import signal
import sys
import time
from pathlib import Path

import synthetic_env
import test_agents_training as trainings

from cathsim_dmc.agents import train

# Never: what waits for a process this long has found that it hangs, s.
_PATIENCE = 1200


def train_on(run, frames):
    """Trains in a folder, or goes on there."""
    config = trainings.small_ppo(
        total_frames=frames, checkpoint_frames=512, keep_checkpoints=2
    )
    make_env = synthetic_env.make_env
    train(config, run, resume=True, progress=False, make_env=make_env)


def context():
    """A fork server that knows the tests and has imported this module."""
    paths = [str(Path(__file__).parent), *sys.path]
    before = os.environ.get("PYTHONPATH")
    os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, paths))
    try:
        server = multiprocessing.get_context("forkserver")
        server.set_forkserver_preload(["killed_work"])
        process = server.Process(target=os.getpid)  # starts the server
        process.start()
        process.join()
    finally:
        if before is None:
            del os.environ["PYTHONPATH"]
        else:
            os.environ["PYTHONPATH"] = before
    return server


def processor_time(pid):
    """Seconds that a process has worked so far."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def moments(longest, count=6):
    """Seconds of work after which to kill, a random one in each part of `longest`."""
    return [longest * (index + random.random()) / count for index in range(count)]


def kill(server, work, *arguments, after):
    """Kills a process after so many seconds of work."""
    process = server.Process(target=work, args=arguments, daemon=True)
    process.start()
    end = time.monotonic() + _PATIENCE
    try:
        while processor_time(process.pid) < after:
            assert process.is_alive(), f"ended by itself with {process.exitcode}"
            assert time.monotonic() < end, "hangs"
            time.sleep(0.01)
    finally:
        os.kill(process.pid, signal.SIGKILL)
        process.join()
    assert process.exitcode == -signal.SIGKILL


def finish(server, work, *arguments):
    """Lets a process work to its end."""
    process = server.Process(target=work, args=arguments, daemon=True)
    process.start()
    try:
        process.join(_PATIENCE)
        assert process.exitcode == 0
    finally:
        process.kill()
