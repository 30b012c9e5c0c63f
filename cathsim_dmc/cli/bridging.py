"""`cathsim serve` and `cathsim drive`."""

import dataclasses
import json as json_
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

from rich.table import Table
from tyro import conf

# torchrl goes before dm_control.
from cathsim_dmc import agents  # isort: skip

from cathsim_dmc import bounds, bridge, suite
from cathsim_dmc.agents.policies import FunctionPolicy, task_and_options
from cathsim_dmc.bridge import fit
from cathsim_dmc.bridge.device import require_watchdog
from cathsim_dmc.bridge.driver import Driver, connect
from cathsim_dmc.bridge.serving import listen
from cathsim_dmc.cli.options import (
    CHECK_FAILED,
    Json,
    Modules,
    Task,
    console,
    print_json,
    say,
)
from cathsim_dmc.cli.task_options import TaskOptions, task_kind
from cathsim_dmc.policies import Policy
from cathsim_dmc.tasks.config import CONTROL_TIMESTEP
from cathsim_dmc.tasks.interface import action_table, observation_table

_GOOD = ("success", "truncated")
_MOST = 5  # differences that an error names


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

    The messages are in docs/robot_messages.md. Drivers are served one after the other,
    without a password; by default only programs on this machine can connect (--host).

    Args:
        host: Address to listen on, IPv4 or IPv6; 0.0.0.0 for all addresses of this
            machine.
        port: Port to listen on; 0 takes a free one.
        episodes: Number of episodes after which it ends; no limit by default.
        log: File to write: applied actions and forces, as JSON lines.
        how: How the device is served.
        options: Options of the task.
    """
    if episodes is not None:
        bounds.whole("episodes", episodes, 1)
    bridge.Log.require(log)
    if not how.lockstep:
        require_watchdog(how.watchdog, CONTROL_TIMESTEP)
    suite.known(task)
    listen(host, port).close()  # checked first: compiling below may take a minute
    env = suite.load(suite.DOMAIN, task, options.given)
    env.reset()  # compiles before a driver connects
    device = bridge.SimulatedDevice(env, task)
    with listen(host, port) as listener, bridge.Log(log) as kept:
        at, taken = listener.getsockname()[:2]
        place = f"[{at}]:{taken}" if ":" in at else f"{at}:{taken}"
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
    unchecked: bool = False,
    json: Json = False,
    modules: Modules = (),
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
        log: File to write: sent actions and forces, as JSON lines.
        unchecked: Whether to drive a device that announces another period, or other
            names, units or scales of actions or observations, than the policy was
            trained with. The policy's actions in [-1, 1] are sent unchanged.
        how: How the device is driven.
    """
    bounds.whole("episodes", episodes, 1)
    if seed is not None:
        bounds.seeds("seed", seed, episodes)
    bridge.Log.require(log)
    player = agents.load_policy(policy, scripted=False)
    if not isinstance(player, FunctionPolicy):
        raise ValueError(
            f"the policy {player.name!r} reads the simulation, which is not in this "
            "program; give a run, a checkpoint or pretrained:NAME"
        )
    done = []
    link = connect(address)
    with bridge.Log(log) as kept:
        try:
            driver = Driver(link, kept)
            keys = require_fit(player, driver.welcome, unchecked)
            if keys is not None:
                driver.read_only(keys)
            choose = _choose(player)
            warm = driver.warm_up(choose, how.warm_up)
            if warm is not None:
                figures = ", ".join(f"{name} {ms:.1f}" for name, ms in warm.items())
                say(f"{driver.welcome['name']}: warm, ms of an action: {figures}")
            for number in range(episodes):
                own = None if seed is None else seed + number
                found = driver.episode(choose, own, how)
                done.append(dataclasses.asdict(found))
                reason = "" if found.reason is None else f": {found.reason}"
                text = f"{found.end} after {found.steps} steps{reason}"
                say(f"{text}; largest force {found.force:.3f} N")
                if found.end not in _GOOD:
                    break
        finally:
            link.close()
    if json:
        print_json({"checks": [], "warm_up": warm, "episodes": done})
    else:
        console().print(_table(done))
    return 0 if all(one["end"] in _GOOD for one in done) else CHECK_FAILED


def _choose(player: Policy) -> Any:
    return lambda observation: player.act(observation)[0]


def _table(episodes: Sequence[Mapping[str, Any]]) -> Table:
    """Returns a table of driven episodes, one column each."""
    table = Table("", *(f"episode {n}" for n in range(1, len(episodes) + 1)))
    for name in ("end", "reason", "steps", "skipped", "late"):
        if any(one[name] is not None for one in episodes):
            table.add_row(name, *(str(one[name]) for one in episodes))
    table.add_row("largest force, N", *(f"{one['force']:.3f}" for one in episodes))
    for name, what in (
        ("compute", "state to action, ms"),
        ("period", "state to state, ms"),
    ):
        for figure in next((one[name] for one in episodes if one[name]), ()):
            cells = (
                f"{one[name][figure]:.1f}" if one[name] else "" for one in episodes
            )
            table.add_row(f"{what}: {figure}", *cells)
    return table


def require_fit(
    player: Policy, welcome: Mapping[str, Any], unchecked: bool = False
) -> set[str] | None:
    """Require that a device gives what a policy reads and takes its actions.

    Args:
        player: A policy; nothing is checked if it names no observation.
        welcome: Welcome of the device, see `bridge.Driver`.
        unchecked: Whether period, names, units and scales may differ from those of the
            training.

    Returns:
        Keys of the arrays that the policy reads; None if they are not known.

    Raises:
        ValueError: the device does not fit; says what was given and what is wanted.
    """
    if player.observation is None:
        return None
    try:
        wanted = _interface(player)
    except (ValueError, OSError) as error:
        if unchecked:
            return None
        raise ValueError(
            f"the interface of {player.name} is not known here, so the device "
            f"{welcome['name']!r} cannot be compared with it; give what is missing, or "
            f"drive it --unchecked: {error}"
        ) from error
    keys = {one["key"] for one in wanted.observation}
    wrong = fit.sizes(wanted, welcome)
    missing = keys - {one["key"] for one in welcome["observation"]}
    if missing:
        options = {"observation": player.observation, **(player.task_kwargs or {})}
        words = [f"--{k.replace('_', '-')} {shlex.quote(_text(v))}"
                 for k, v in options.items()]  # fmt: skip
        raise ValueError(
            f"{player.name} reads {', '.join(sorted(missing))}, which the device "
            f"{welcome['name']!r} does not give; of the suite: cathsim serve "
            f"{player.task} {' '.join(words)}"
        )
    if wrong:
        raise ValueError(_misfit(player, welcome, wrong, "mend what it announces"))
    wrong = [] if unchecked else fit.meanings(wanted, welcome)
    if wrong:
        way = "convert on the device, or leave out what is announced wrongly; "
        way += "--unchecked drives it as it is"
        raise ValueError(_misfit(player, welcome, wrong, way))
    return keys


def _misfit(
    player: Policy, welcome: Mapping[str, Any], wrong: Sequence[str], way: str
) -> str:
    more = f"; {len(wrong) - _MOST} more" if len(wrong) > _MOST else ""
    return (
        f"the device {welcome['name']!r} is not one that {player.name} was trained "
        f"for: {'; '.join(wrong[:_MOST])}{more} (docs/robots.md): {way}"
    )


def _interface(player: Policy) -> fit.Interface:
    """Returns the interface of a policy's training.

    Raises:
        ValueError, OSError: the task or its anatomy is not available here.
    """
    given = {"observation": player.observation}
    name, options = task_and_options(player, None, given)
    if suite.TASKS[suite.known(name)].random_arch and "numbers" not in options:
        options["pool"] = 1  # one arch suffices, and more take longer
    task = suite.make_task(name, **options)
    chain = task.scene.catheter
    return fit.Interface(CONTROL_TIMESTEP, action_table(chain), observation_table(task))


def _text(value: Any) -> str:
    return value if isinstance(value, str) else json_.dumps(value)
