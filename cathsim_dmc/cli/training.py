"""`cathsim train`: every setting of the algorithm and the task is a typed option."""

import argparse
import copy
import dataclasses
import functools
import json
import shlex
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro import conf

# torchrl goes before dm_control.
from cathsim_dmc import agents  # isort: skip

from cathsim_dmc import files
from cathsim_dmc.agents.checkpoint import checkpoints_in
from cathsim_dmc.agents.learners import LEARNERS, config_from_dict
from cathsim_dmc.agents.training import CONFIG_FILE, no_run
from cathsim_dmc.cli.options import INTERRUPTED, Modules, say
from cathsim_dmc.cli.task_options import field_helps, task_kind

# Shorter names of settings.
_ALIASES = {"total_frames": ["--frames"], "num_threads": ["--threads"]}


@dataclasses.dataclass(frozen=True)
class _Run:
    """Options of a run.

    Attributes:
        out: Directory of the run: checkpoints, metrics.csv, config.json.
        algo: Algorithm that learns, with settings of its own: ppo, sac, bc or dagger.
        preset: Named settings that the options below start from: published, demo,
            tuned or tuned_image.
        resume: Whether to continue the run in OUT from its newest checkpoint.
        without_replay: Whether a run that is resumed starts with an empty replay (SAC,
            DAgger), as when its files are lost.
        quiet: Whether to show no progress.
        films: Kind of the film of an episode that is made of each checkpoint, in the
            folder films of OUT: gif, webp or, with the extra `video`, mp4.
    """

    out: Path
    algo: str = "ppo"
    preset: str = "published"
    resume: bool = False
    without_replay: bool = False
    quiet: bool = False
    films: Literal["gif", "webp", "mp4"] | None = None


def command(arguments: list[str]) -> Any:
    """Returns the command, whose options depend on the algorithm in the arguments.

    Raises:
        ValueError: the run to be resumed has no readable settings, or there is no such
            algorithm or preset.
    """
    settings, resumed = _settings(arguments)
    _refuse_others(arguments, settings)
    own, others = _setting_kind(settings), task_kind(vars(settings))
    name = conf.arg(help="Task of `cathsim list`.", metavar="TASK")
    task = dataclasses.field(default=settings.task if resumed else dataclasses.MISSING)
    fields: list[tuple[str, Any, Any]] = [
        ("task", conf.Positional[Annotated[str, name]], task),
        ("run", Annotated[_Run, conf.arg(name="")], dataclasses.field()),
        ("settings", Annotated[own, conf.arg(name="")], own()),
        ("options", Annotated[others, conf.arg(name="task")], others()),
    ]
    options = dataclasses.make_dataclass("Train", fields, kw_only=True, frozen=True)

    def train(options: Any) -> int:
        """Train an agent.

        The defaults of the settings are those of the algorithm and preset chosen; a run
        that is resumed keeps its own.
        """
        chosen = vars(options.settings)
        chosen = {**chosen, "modules": [*dict.fromkeys(chosen["modules"])] or None}
        config = settings.replace(
            task=options.task,
            **chosen,
            task_kwargs={**settings.task_kwargs, **options.options.given},
        )
        return _train(config, options.run)

    # The class of the options is made here, so no annotation can name it.
    train.__annotations__["options"] = Annotated[options, conf.arg(name="")]
    return train


def _train(config: agents.TrainingConfig, run: _Run) -> int:
    """Trains an agent, says what is left to do, and returns the exit code."""
    done = [int(each.name) for each in checkpoints_in(run.out)][-1:]
    filming = _filming(run.out / "films", f".{run.films}") if run.films else None
    result = agents.train(
        config, run.out, resume=run.resume, progress=not run.quiet,
        without_replay=run.without_replay, on_checkpoint=filming,
    )  # fmt: skip
    if result.interrupted:
        again = ["cathsim", "train", config.task, "--out", str(run.out), "--resume"]
        for module in config.modules or ():
            again += ["--import", module]
        say(
            f"interrupted after {result.frames} of {config.total_frames} frames, "
            f"which are saved; continue with: {shlex.join(again)}"
        )
        return INTERRUPTED
    if done and done[0] >= config.total_frames:
        say(
            f"{done[0]} frames are done, of --frames {config.total_frames}: nothing is "
            "left to train"
        )
    print(f"{result.frames} frames in {result.seconds:.0f} s: {result.checkpoint}")
    return 0


def _filming(folder: Path, suffix: str) -> Callable[[Path], Any]:
    """Returns a function that films a checkpoint; raises if films cannot be written."""
    # Imported late: trainings without films draw nothing.
    from cathsim_dmc.cli.agents import film_checkpoint
    from cathsim_dmc.pictures.films import check_film

    check_film(folder / f"film{suffix}")
    return lambda checkpoint: film_checkpoint(checkpoint, folder, suffix)


def _settings(arguments: list[str]) -> tuple[agents.TrainingConfig, bool]:
    """Returns the defaults of the options, and whether they are those of a run."""
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    # Wrong values are refused by the parser of all options.
    for name in ("--algo", "--preset", "--out"):
        parser.add_argument(name, nargs="?")
    parser.add_argument("--resume", action="store_true")
    found, _ = parser.parse_known_args(arguments)
    if found.resume and found.out:
        path = Path(found.out) / CONFIG_FILE
        if not (path.is_file() or checkpoints_in(Path(found.out))):
            raise ValueError(no_run(found.out))  # before the parser requires a task
        if path.is_file() and not found.preset:
            text = f"{path} holds no settings of a run"
            with files.refused(ValueError, text, (ValueError, TypeError)):
                config = config_from_dict(dict(json.loads(files.read_text(path))))
            if found.algo in (None, config.algorithm):
                return config, True
    given = {"algorithm": found.algo, "preset": found.preset}.items()
    chosen = {name: value for name, value in given if value is not None}
    return agents.make_config(**chosen), False


def _refuse_others(arguments: list[str], settings: agents.TrainingConfig) -> None:
    """Raises ValueError for a setting that only other algorithms have."""
    known = {item.name for item in dataclasses.fields(settings)}
    for option in (word.partition("=")[0] for word in arguments):
        name = option.removeprefix("--").removeprefix("no-").replace("-", "_")
        if not option.startswith("--") or name in known:
            continue
        have = [
            algorithm
            for algorithm, learner in LEARNERS.items()
            if name in {item.name for item in dataclasses.fields(learner.config)}
        ]
        if have:
            raise ValueError(
                f"{option} is a setting of {' and '.join(have)}, not of "
                f"{settings.algorithm}; leave it out, or train with --algo "
                f"{' or '.join(have)}"
            )


def _setting_kind(settings: agents.TrainingConfig) -> type:
    helps, fields = field_helps(type(settings)), []
    for item in dataclasses.fields(settings):
        if item.name in ("task", "task_kwargs"):
            continue
        if item.name == "modules":  # repeated options need a tuple, not None
            default = functools.partial(tuple, settings.modules or ())
            field = dataclasses.field(default_factory=default)
            fields.append((item.name, Modules, field))
            continue
        about = conf.arg(help=helps[item.name], aliases=_ALIASES.get(item.name))
        # A mapping may not be a default; every option gets one of its own.
        default = functools.partial(copy.copy, getattr(settings, item.name))
        field = dataclasses.field(default_factory=default)
        fields.append((item.name, Annotated[item.type, about], field))
    return dataclasses.make_dataclass("Settings", fields, kw_only=True, frozen=True)
