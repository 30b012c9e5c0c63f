"""The table of observations is complete and up to date."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest

from cathsim_dmc import suite
from cathsim_dmc.imaging import FluoroscopyOptions
from cathsim_dmc.tasks import observations
from cathsim_dmc.tasks.cameras import CAMERAS, CameraOptions
from cathsim_dmc.tasks.descriptions import DESCRIPTIONS

SCRIPT = Path(__file__).parents[1] / "docs" / "scripts" / "observations.py"


@pytest.fixture(scope="module")
def script():
    spec = importlib.util.spec_from_file_location("docs_observations", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_every_entry_is_described():
    cameras = CameraOptions(names=CAMERAS)
    assert set(DESCRIPTIONS) == set(observations.OBSERVATIONS)
    for name, entries in DESCRIPTIONS.items():
        keys = observations.entries([name], FluoroscopyOptions(), cameras)
        described = {
            key.replace("<camera>", camera) for key in entries for camera in CAMERAS
        }
        assert set(keys) == described


def test_the_page_is_what_the_specs_say(script):
    assert script.OUTPUT.read_text(encoding="utf-8") == script.page(), (
        "docs/observations.md is out of date; run docs/scripts/observations.py"
    )


def test_values_lie_in_the_ranges_of_the_table():
    names = [n for n in DESCRIPTIONS if n not in ("rgb", "depth")]
    env = suite.load("cathsim", "type1_bca", {"observation": names, "random": 0})
    random = np.random.default_rng(0)
    timesteps = [env.reset()]
    timesteps += [env.step(random.uniform(-1, 1, 21)) for _ in range(20)]
    for name in names:
        for key, text in DESCRIPTIONS[name].items():
            values = np.stack([t.observation[key] for t in timesteps])
            assert text.low <= values.min(), key
            assert values.max() <= text.high, key
