"""The same seed gives the same bytes, in any process and on any number of threads."""

import hashlib
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from cathsim_dmc import suite
from cathsim_dmc.anatomy.arch import arch
from cathsim_dmc.simulation.batch import BatchSimulation

STEPS = 15
RANDOM = {"randomisation": True}


def digest(*arrays):
    """Of the bytes of arrays."""
    sum_ = hashlib.sha256()
    for array in arrays:
        array = np.ascontiguousarray(array)
        sum_.update(str((array.dtype, array.shape)).encode())
        sum_.update(array.tobytes())
    return sum_.hexdigest()


def actions(seed, count):
    return np.random.RandomState(seed).uniform(-1, 1, (STEPS, 1, count))


def trajectory(threads, simulations=3, **options):
    """Digest of what one batch does: states, rewards, forces and observations."""
    task = suite.make_task("type1_lcca", **options)
    batch = BatchSimulation(task, simulations, num_threads=threads, seeds=7)
    step = batch.reset()
    seen = [*map(np.array, step.observation.values())]
    for action in actions(1, batch.num_actions):
        step = batch.step(np.tile(action, (simulations, 1)))
        seen += [batch.batch.qpos.copy(), step.outcome.reward, step.wall_force.peak_max]
        seen += [np.array(value) for _, value in sorted(step.observation.items())]
    return digest(*seen)


def anatomy_digest():
    anatomy = arch.build_seed(arch.arch_set("train")[3])
    return digest(
        anatomy.surface.vertices, anatomy.surface.faces, *anatomy.lumen.arrays
    )


IN_PROCESS = """
import test_determinism as t
print(t.trajectory(1, **t.RANDOM), t.trajectory(1, observation="image"),
      t.anatomy_digest())
"""


def elsewhere():
    """The digests in a process of its own, with another hash seed."""
    paths = [str(Path(__file__).parent), *sys.path]
    done = subprocess.run(
        [sys.executable, "-c", IN_PROCESS],
        env={
            **os.environ,
            "PYTHONPATH": os.pathsep.join(filter(None, paths)),
            "PYTHONHASHSEED": "123",
        },
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.split()


@pytest.mark.slow
def test_processes_agree_on_trajectories_images_and_anatomies():
    here = [
        trajectory(1, **RANDOM),
        trajectory(1, observation="image"),
        anatomy_digest(),
    ]
    assert elsewhere() == here


@pytest.mark.slow
def test_the_number_of_threads_changes_nothing():
    options = {**RANDOM, "observation": ["internal", "image"]}
    one = trajectory(1, **options)
    assert one == trajectory(2, **options) == trajectory(8, **options)
