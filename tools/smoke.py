"""Smoke test of an installed package: a task, an image, a network, the command line."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import torchrl  # noqa: F401  goes before dm_control

import cathsim_dmc
from cathsim_dmc import suite
from cathsim_dmc.simulation.environments import VECTOR, make_env


def main() -> None:
    home = Path(cathsim_dmc.__file__).resolve()
    checkout = Path(__file__).resolve().parents[1] / "cathsim_dmc"
    if len(sys.argv) > 1 and sys.argv[1] == "--installed":
        # The environment itself may lie in the checkout, as that of `make dist` does.
        assert home.parent != checkout, f"{home} is the checkout, not the package"
    environment = suite.load("cathsim", "type1_lcca", task_kwargs={"random": 0})
    first = environment.reset()
    later = environment.step(np.ones(environment.action_spec().shape))
    assert first.observation.keys() == later.observation.keys()
    env = make_env("type1_bca", observation=["internal", "image"], num_envs=2)
    rollout = env.rollout(3)
    assert rollout[VECTOR].isfinite().all()
    assert rollout["pixels"].float().std() > 0
    done = subprocess.run(
        [sys.executable, "-m", "cathsim_dmc.cli", "list", "--json"],
        capture_output=True,
        text=True,
        check=True,
    )
    assert "type1_lcca" in done.stdout
    print(f"cathsim-dmc {cathsim_dmc.__version__} works: {home.parent}")


if __name__ == "__main__":
    main()
