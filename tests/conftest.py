"""Environments that many tests share; loading one takes a second."""

import contextlib
import dataclasses
import gc
import sys

import hypothesis
import numpy as np
import pytest

from cathsim_dmc import cli, suite
from cathsim_dmc.tasks import observations
from cathsim_dmc.tasks.navigation import Navigation
from cathsim_dmc.tasks.observation_kind import (
    BIPLANE,
    COAXIAL,
    COAXIAL_ROUTE,
    LIVING,
    OPENGL,
)

# A first call may import scipy or compile; how long it takes is not what is tested.
hypothesis.settings.register_profile("default", deadline=None)
hypothesis.settings.load_profile("default")

TASKS = ("type1_bca", "type1_lcca", "type2_bca", "type2_lcca")
# To parametrise with; the fast tests take one goal of each arch.
EACH_TASK = [
    pytest.param(name, marks=() if quick else pytest.mark.slow)
    for name, quick in zip(TASKS, (False, True, True, False), strict=True)
]
# Of one device and one plane, without OpenGL.
OBSERVATIONS = [
    name
    for name, row in observations.OBSERVATIONS.items()
    if row.needs not in (BIPLANE, COAXIAL, COAXIAL_ROUTE, LIVING, OPENGL)
]
SHORT_EPISODE = 12  # control steps


def twin(task, seed=0, **changes):
    """Another task on the scene of one that is built already.

    Building a scene takes as long as compiling it. No episode changes one: all that an
    environment changes is in the model that it compiles.

    Args:
        task: What to share the scene, the anatomies and the objective of.
        seed: Seed of the twin.
        **changes: Fields of the configuration that the scene does not depend on, such
            as observations, images, and what is randomised but for the goal.
    """
    config = dataclasses.replace(task.config, **changes)
    ranges = config.randomisation, task.config.randomisation
    assert ranges[0].farthest_shift == ranges[1].farthest_shift
    other = Navigation(task.scene, task.objective, config, seed, name=task.name)
    assert not task._cases or config.fluoroscopy == task.config.fluoroscopy
    other._cases = task._cases
    return other


def slow(*values):
    """The values of one argument with which a test is slow."""
    return [pytest.param(value, marks=pytest.mark.slow) for value in values]


def pytest_collection_finish():
    """Leaves what the imports have made out of all later garbage collections.

    A scene is made of so many small objects that each one built begins a full
    collection, which with torch in memory takes longer than the building.
    """
    gc.collect()
    gc.freeze()
    gc.set_threshold(5_000, 10, 10)


@pytest.fixture
def cathsim(monkeypatch, capsys):
    """Returns a function that runs `cathsim ARGUMENTS`: (code, stdout, stderr)."""

    def run(*arguments):
        monkeypatch.setattr(sys, "argv", ["cathsim", *map(str, arguments)])
        with pytest.raises(SystemExit) as end:
            cli.main()
        captured = capsys.readouterr()
        return end.value.code or 0, captured.out, captured.err

    return run


@pytest.fixture
def small_disk():
    """Returns a context manager in which no file can grow beyond so many bytes.

    What a process meets there is what it meets on a full disk or over its quota: an
    OSError in the middle of a write. Unlike a small file system it needs no root.
    """
    resource = pytest.importorskip("resource")

    @contextlib.contextmanager
    def limited(size):
        before = resource.getrlimit(resource.RLIMIT_FSIZE)
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
        try:
            yield
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, before)

    return limited


@pytest.fixture(scope="session")
def shared_environment():
    """Returns a function that loads an environment once: name, **options.

    A test must reset it before use, and seed it with `reseed` if that matters.
    """
    loaded = {}

    def load(task_name, **options):
        key = (task_name, repr(sorted(options.items())))
        if key not in loaded:
            loaded[key] = suite.load(
                "cathsim", task_name, task_kwargs={"random": 0, **options}
            )
        return loaded[key]

    yield load
    for environment in loaded.values():
        environment.close()


@pytest.fixture(scope="session")
def reseed():
    """Returns a function that resets an environment with a seed."""

    def reset(environment, seed):
        environment.task.random.set_state(np.random.RandomState(seed).get_state())
        return environment.reset()

    return reset


@pytest.fixture(scope="session")
def trained(tmp_path_factory):
    """Folder of finished runs, ppo and sac, of the synthetic task; to be copied."""
    from test_agents_training import run, small_ppo, small_sac

    runs = tmp_path_factory.mktemp("trained")
    run(small_ppo(total_frames=512), runs / "ppo")
    run(small_sac(total_frames=768), runs / "sac")
    return runs
