"""dm_control's own viewer on a display that nobody sees."""

import contextlib
import os
import shutil
import subprocess
import sys
import time

import pytest

_PROGRAM = """
import numpy as np
from dm_control import viewer
from cathsim_dmc import suite

env = suite.load("cathsim", "type1_lcca", task_kwargs={"random": 0})
steps = 0

def policy(timestep):
    global steps
    steps += 1
    if steps > 20:
        print("stepped", env.task.readings.insertion, flush=True)
        import os
        os._exit(0)
    action = np.zeros(21)
    action[-1] = 1.0
    return action

viewer.launch(env, policy)
"""


@contextlib.contextmanager
def display():
    """An X server of one's own, and its name."""
    for program in ("Xvfb", "xdotool"):
        if shutil.which(program) is None:
            pytest.skip(f"no {program} here")
    pytest.importorskip("tkinter")
    read, write = os.pipe()
    server = subprocess.Popen(
        ["Xvfb", "-displayfd", str(write), "-screen", "0", "1024x768x24"],
        pass_fds=[write],
        stderr=subprocess.DEVNULL,
    )
    os.close(write)
    try:
        with os.fdopen(read) as pipe:
            number = pipe.readline().strip()
        if not number:
            pytest.skip("Xvfb does not start here")
        yield f":{number}"
    finally:
        server.terminate()
        server.wait()


@pytest.mark.slow
def test_dm_controls_viewer_runs_a_policy(tmp_path):
    with display() as name:
        environment = {**os.environ, "DISPLAY": name, "MUJOCO_GL": "glfw"}
        program = subprocess.Popen(
            [sys.executable, "-c", _PROGRAM],
            env=environment,
            cwd=tmp_path,
            stdout=subprocess.PIPE,
            text=True,
        )
        try:
            # The viewer starts paused and answers to the space bar.
            for _ in range(60):
                time.sleep(2)
                if program.poll() is not None:
                    break
                press = ["xdotool", "search", "--onlyvisible", "--name", ".*"]
                press += ["windowfocus", "key", "space"]
                subprocess.run(press, env=environment, check=False)
            output, _ = program.communicate(timeout=10)
        finally:
            program.kill()
    assert program.returncode == 0
    word, insertion = output.split()[-2:]
    assert word == "stepped"
    assert float(insertion) > 0.01
