"""`cathsim serve` and `cathsim drive`."""

import dataclasses
import json as json_
import shlex
import types
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, cast

import numpy as np
from tyro import conf

# torchrl goes before dm_control.
from cathsim_dmc import agents  # isort: skip

from cathsim_dmc import bounds, bridge, suite
from cathsim_dmc.agents.policies import FunctionPolicy
from cathsim_dmc.bridge.device import listen
from cathsim_dmc.bridge.driver import Driver, connect
from cathsim_dmc.cli.options import CHECK_FAILED, Json, Modules, Task, print_json, say
from cathsim_dmc.cli.task_options import TaskOptions, task_kind
from cathsim_dmc.policies import Policy, View
from cathsim_dmc.tasks import observations

_GOOD = ("success", "truncated")


def serve(
    task: Task,
    /,
    host: str = "127.0.0.1",
    port: int = 5555,
    episodes: int | None = None,
    log: Path | None = None,
    json: Json = False,
    modules: Modules = (),
    *,
    how: Annotated[bridge.ServeOptions, conf.arg(name="")] = bridge.ServeOptions(),  # noqa: B008
    options: Annotated[TaskOptions, conf.arg(name="", constructor=task_kind(()))],
) -> int:
    """Serve a task as a device over TCP, for a driver in another program.

    The messages are in docs/robot_messages.md. One driver after the other; there is no
    password, so other machines are let in by --host alone.

    Args:
        host: Address to listen on; 0.0.0.0 for all of this machine.
        port: Port to listen on; 0 takes a free one.
        episodes: Number of episodes after which it ends; by default it goes on.
        log: File of JSON lines to write, with what was applied.
        how: How the device is served.
        options: Options of the task.
    """
    if episodes is not None:
        bounds.whole("episodes", episodes, 1)
    bridge.Log.require(log)
    env = suite.load(suite.DOMAIN, suite.known(task), options.given)
    env.reset()  # compiles what a first reset compiles
    device = bridge.SimulatedDevice(env, task)
    with listen(host, port) as listener, bridge.Log(log) as kept:
        place = "{}:{}".format(*listener.getsockname()[:2])
        say(f"{env.task!r} listens on {place}")
        done = bridge.serve(device, listener, how, episodes=episodes, log=kept, say=say)
    if json:
        print_json({"checks": [], "episodes": done})
    return 0 if all(one["end"] in _GOOD for one in done) else CHECK_FAILED


def drive(
    policy: Annotated[str, conf.Positional],
    /,
    address: Annotated[str, conf.arg(name="connect")],
    episodes: int = 1,
    seed: int | None = None,
    log: Path | None = None,
    json: Json = False,
    *,
    how: Annotated[bridge.DriveOptions, conf.arg(name="")] = bridge.DriveOptions(),  # noqa: B008
) -> int:
    """Drive a device over TCP with a trained policy.

    Args:
        policy: Directory of a run or checkpoint, or pretrained:NAME.
        address: Address of the device, host:port.
        episodes: Number of episodes.
        seed: Seed of the first episode, from which the others count up; by default the
            device chooses.
        log: File of JSON lines to write, with what was sent.
        how: How the device is driven.
    """
    bounds.whole("episodes", episodes, 1)
    bridge.Log.require(log)
    player = agents.load_policy(policy)
    if not isinstance(player, FunctionPolicy):
        raise ValueError(
            f"the policy {player.name!r} looks at the simulation, which is not in this "
            "program; give a run, a checkpoint or pretrained:NAME"
        )
    done = []
    link = connect(address)
    with bridge.Log(log) as kept:
        try:
            driver = Driver(link, kept)
            require_fit(player, driver.welcome)
            choose = _choose(player)
            warm = driver.warm_up(choose, how.warm_up)
            say(f"{driver.welcome['name']}: warm, {warm}")
            for number in range(episodes):
                own = None if seed is None else seed + number
                found = driver.episode(choose, own, how)
                done.append(dataclasses.asdict(found))
                say(f"{found.end} after {found.steps} steps, force {found.force:.3f} N")
                if found.end not in _GOOD:
                    break
        finally:
            link.close()
    if json:
        print_json({"checks": [], "warm_up": warm, "episodes": done})
    else:
        for one in done:
            print(*(f"{name}: {value}" for name, value in one.items()), sep="\n")
    return 0 if all(one["end"] in _GOOD for one in done) else CHECK_FAILED


def _choose(player: Policy) -> Any:
    return lambda observation: player.act(observation)[0]


def require_fit(player: Policy, welcome: Mapping[str, Any]) -> None:
    """ValueError unless a device gives what a policy reads and takes its actions."""
    view = types.SimpleNamespace(num_simulations=1, num_actions=len(welcome["action"]))
    player.reset(cast(View, view), np.ones(1, dtype=bool))
    if player.observation is None:
        return
    names = observations.resolve(player.observation)
    given = {one["key"] for one in welcome["observation"]}
    missing = {one.key for one in observations.entries(names)} - given
    if missing:
        options = {"observation": player.observation, **(player.task_kwargs or {})}
        words = [f"--{k.replace('_', '-')} {shlex.quote(_text(v))}"
                 for k, v in options.items()]  # fmt: skip
        raise ValueError(
            f"{player.name} reads {', '.join(sorted(missing))}, which the device "
            f"{welcome['name']!r} does not give; of the suite: cathsim serve "
            f"{player.task} {' '.join(words)}"
        )


def _text(value: Any) -> str:
    return value if isinstance(value, str) else json_.dumps(value)
