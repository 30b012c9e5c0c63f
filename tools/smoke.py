"""Smoke test of an installed package: a task, images, the command line, an episode."""

import argparse
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import torchrl  # noqa: F401  goes before dm_control

import cathsim_dmc
from cathsim_dmc import suite
from cathsim_dmc.simulation.environments import VECTOR, make_env


def command_line(*words: str) -> str:
    """Output of the `cathsim` command of this environment."""
    program = Path(sys.executable).with_name("cathsim")
    done = subprocess.run([program, *words], stdout=subprocess.PIPE, text=True)
    assert done.returncode == 0, f"cathsim {words}: {done.returncode}"
    return done.stdout


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--installed", action="store_true", help="refuse the checkout")
    installed = parser.parse_args().installed
    home = Path(cathsim_dmc.__file__).resolve()
    checkout = Path(__file__).resolve().parents[1] / "cathsim_dmc"
    if installed:
        # The environment itself may be in the checkout, as with `make dist`.
        assert home.parent != checkout, f"{home} is the checkout, not the package"
    environment = suite.load("cathsim", "type1_lcca", task_kwargs={"random": 0})
    first = environment.reset()
    later = environment.step(np.ones(environment.action_spec().shape))
    assert first.observation.keys() == later.observation.keys()
    env = make_env("type1_bca", observation=["internal", "image"], num_envs=2)
    rollout = env.rollout(3)
    assert rollout[VECTOR].isfinite().all()
    assert rollout["pixels"].float().std() > 0
    lists = command_line("list", "--json")
    assert "type1_lcca" in lists
    push = ("push", "--task", "type1_bca", "--episodes", "1", "--no-baseline")
    evaluated = json.loads(command_line("eval", *push, "--json"))
    assert evaluated["policy"]["summary"]["success"] == 1.0
    print(f"cathsim-dmc {cathsim_dmc.__version__} works: {home.parent}")


if __name__ == "__main__":
    main()
