"""Nothing looks for a network: everything runs with the sockets shut."""

import os
import subprocess
import sys

import pytest

# Only sockets to elsewhere: processes of one machine talk through AF_UNIX.
SHUT = """
import socket, sys
real = socket.socket.connect

def refuse(name):
    def call(*arguments, **options):
        raise AssertionError(f"network: {name}{arguments!r}")
    return call

for name in ("create_connection", "getaddrinfo", "gethostbyname"):
    setattr(socket, name, refuse(name))

def connect(self, address):
    if self.family != socket.AF_UNIX:
        raise AssertionError(f"network: connect {address!r}")
    return real(self, address)

socket.socket.connect = socket.socket.connect_ex = connect
"""

RUN = """
import numpy as np
from pathlib import Path
from cathsim_dmc import pictures, suite
from cathsim_dmc.agents import evaluate, load_policy, make_config, train
environment = suite.load("cathsim", "type1_bca", task_kwargs={"observation": "image"})
environment.reset()
environment.step(np.zeros(environment.action_spec().shape))
config = make_config("ppo", task="type1_bca", total_frames=32, num_envs=2,
                     steps_per_update=32, minibatch_size=16, epochs=1,
                     normalisation_frames=16)
out = Path(sys.argv[1])
train(config, out / "run", progress=False)
evaluate(out / "run", episodes=1, task_kwargs={"max_steps": 3})
environment = suite.load("cathsim", "type1_bca")
pictures.record(environment, load_policy(out / "run"), out / "a.rrd", max_steps=2)
"""


def python(code, *arguments):
    return subprocess.run(
        [sys.executable, "-c", SHUT + code, *map(str, arguments)],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
        capture_output=True,
        text=True,
        timeout=300,
    )


@pytest.mark.slow
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="needs /proc")
def test_loading_stepping_training_evaluating_and_recording_need_no_network(tmp_path):
    code = RUN + (
        # Sockets of compiled code, which no patch of Python's sees.
        "lines = [line for name in ('tcp', 'tcp6', 'udp', 'udp6')\n"
        "         for line in open(f'/proc/self/net/{name}').readlines()[1:]]\n"
        "import os\n"
        "mine = set()\n"
        "for one in os.listdir('/proc/self/fd'):\n"
        "    try:\n"
        "        mine.add(os.readlink(f'/proc/self/fd/{one}'))\n"
        "    except OSError:\n"
        "        pass\n"
        "inodes = {f'socket:[{line.split()[9]}]' for line in lines}\n"
        "assert not mine & inodes, mine & inodes\n"
    )
    done = python(code, tmp_path)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "a.rrd").stat().st_size > 10_000
