"""`cathsim train`: every setting of the algorithm and the task is a typed option."""

import argparse
import copy
import dataclasses
import functools
import json
import shlex
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro import conf

from cathsim_dmc.cli.options import INTERRUPTED, NO_ANATOMY, OwnAnatomy
from cathsim_dmc.cli.task_options import field_helps, task_kind
from cathsim_dmc.cli.task_options import given as given_options

_ALGORITHM, _PRESET = "ppo", "published"
_SUMMARY = "Train an agent."
_DETAILS = (
    "The defaults of the settings are those of the algorithm and preset chosen; a run "
    "that is resumed keeps its own."
)
# Shorter names of settings.
_ALIASES = {"total_frames": "--frames", "num_threads": "--threads"}


def command(arguments: Sequence[str]) -> Callable[..., int]:
    """The command for a command line, whose options depend on the algorithm in it.

    Args:
        arguments: Arguments of `cathsim`. If they are for another command, it has no
            options, only a line in the list of commands.

    Raises:
        ValueError: the run to be resumed has no readable settings.
    """
    if list(arguments[:1]) != ["train"]:

        def unused() -> int:
            raise AssertionError("the command line was read twice, differently")

        unused.__doc__ = _SUMMARY
        return unused
    base, resumed = _base(arguments[1:])
    kind = _options(base, resumed)

    def train(options: Any) -> int:
        return _run(options, base)

    # The class of the options is made here, so no annotation can name it.
    train.__annotations__["options"] = Annotated[kind, conf.arg(name="")]

    train.__doc__ = f"{_SUMMARY}\n\n{_DETAILS}"
    return train


def _base(arguments: Sequence[str]) -> tuple[Any, bool]:
    """Settings that the options start from, and whether they are those of a run."""
    # torchrl goes before dm_control.
    from cathsim_dmc.agents.learners import LEARNERS, config_from_dict, make_config

    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    # Values may be missing here: that is an error that the real parser words.
    for name in ("--algo", "--preset", "--out"):
        parser.add_argument(name, nargs="?")
    parser.add_argument("--resume", action="store_true")
    given, _ = parser.parse_known_args(arguments)
    path = Path(given.out or ".") / "config.json"
    if given.resume and given.out and not given.preset and path.is_file():
        try:
            config = config_from_dict(dict(json.loads(path.read_text())))
        except (ValueError, TypeError) as error:
            raise ValueError(f"{path} holds no settings of a run: {error}") from error
        if given.algo in (None, config.algorithm):
            return config, True
    algorithm = given.algo if given.algo in LEARNERS else _ALGORITHM
    presets = LEARNERS[algorithm].config.presets
    preset = given.preset if given.preset in presets else _PRESET
    return make_config(algorithm, preset), False


def _options(base: Any, resumed: bool) -> type:
    """A dataclass of all options, from the fields of the settings."""
    from cathsim_dmc.agents.learners import LEARNERS

    field = dataclasses.field
    task = {"default": base.task} if resumed else {}
    fields: list[tuple[str, Any, Any]] = [
        (
            "task",
            conf.Positional[_explained(str, "Task of `cathsim list`.", metavar="TASK")],
            field(**task),
        ),
        (
            "out",
            _explained(
                Path, "Directory of the run: checkpoints, metrics.csv, config.json."
            ),
            field(),
        ),
        (
            "algo",
            _explained(
                Literal[tuple(LEARNERS)],
                "Algorithm that learns; each has settings of its own.",
            ),
            field(default=base.algorithm),
        ),
        (
            "preset",
            _explained(
                Literal[tuple(base.presets)],
                "Named settings that the options below start from.",
            ),
            field(default=_PRESET),
        ),
        (
            "resume",
            _explained(
                bool, "Whether to continue the run in OUT from its newest checkpoint."
            ),
            field(default=False),
        ),
        (
            "without_replay",
            _explained(
                bool,
                "Whether a run that is resumed starts with an empty replay (SAC), as "
                "when its files are lost.",
            ),
            field(default=False),
        ),
        (
            "quiet",
            _explained(bool, "Whether to show no progress."),
            field(default=False),
        ),
        ("anatomy", OwnAnatomy, field(default=NO_ANATOMY)),
        (
            "options",
            Annotated[_task_options(base), conf.arg(name="task")],
            field(default_factory=_task_options(base)),
        ),
    ]
    helps = field_helps(type(base))
    for item in dataclasses.fields(base):
        if item.name in ("task", "task_kwargs"):
            continue
        aliases = [_ALIASES[item.name]] if item.name in _ALIASES else None
        kind = _explained(item.type, helps[item.name], aliases=aliases)
        value = getattr(base, item.name)
        # A mapping may not be a default; every option gets one of its own.
        default = functools.partial(copy.copy, value)
        fields.append((item.name, kind, field(default_factory=default)))
    return dataclasses.make_dataclass("Train", fields, kw_only=True, frozen=True)


def _task_options(base: Any) -> type:
    return task_kind(frozenset(item.name for item in dataclasses.fields(base)))


def _explained(kind: Any, text: str, **more: Any) -> Any:
    return Annotated[kind, conf.arg(help=text, **more)]


def _run(options: Any, base: Any) -> int:
    from cathsim_dmc import agents

    names = {item.name for item in dataclasses.fields(base)}
    given = {name: value for name, value in vars(options).items() if name in names}
    config = base.replace(
        **given,
        task_kwargs={
            **base.task_kwargs,
            **given_options(options.options),
            **options.anatomy.task_kwargs,
        },
    )
    result = agents.train(
        config,
        options.out,
        resume=options.resume,
        progress=not options.quiet,
        without_replay=options.without_replay,
    )
    if result.interrupted:
        again = ["cathsim", "train", config.task, "--out", str(options.out), "--resume"]
        print(
            f"interrupted after {result.frames} of {config.total_frames} frames, which "
            f"are saved; go on with: {shlex.join(again)}",
            file=sys.stderr,
        )
        return INTERRUPTED
    print(f"{result.frames} frames in {result.seconds:.0f} s: {result.checkpoint}")
    return 0
