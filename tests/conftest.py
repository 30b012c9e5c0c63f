"""Environments that many tests share; loading one takes a second."""

import hypothesis
import numpy as np
import pytest

from cathsim_dmc import suite

# A first call may import scipy or compile; how long it takes is not what is tested.
hypothesis.settings.register_profile("default", deadline=None)
hypothesis.settings.load_profile("default")

TASKS = ("type1_bca", "type1_lcca", "type2_bca", "type2_lcca")
SHORT_EPISODE = 12  # control steps


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
