"""`cathsim eval`, `record`, `demos`, `replay` and `play`."""

import dataclasses
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Literal

from tyro import conf
from tyro.extras import SubcommandApp

from cathsim_dmc.cli.options import (
    DEMONSTRATION_SEED,
    EVALUATION_SEED,
    NO_ANATOMY,
    Json,
    MaxSteps,
    OwnAnatomy,
    PolicyName,
    Task,
    Threads,
    print_json,
)  # fmt: skip
from cathsim_dmc.cli.task_options import given, task_kind


def add_to(app: SubcommandApp) -> None:
    """Adds the commands."""
    app.command(name="eval")(evaluation([]))
    for command in (submit, record, demos, replay, play):
        app.command(command)


@dataclasses.dataclass(frozen=True)
class NoOptions:
    """Stands for the options of a task where another command is called."""


def evaluation(arguments: Sequence[str]) -> Callable[..., int]:
    """The command `eval` for a command line.

    Args:
        arguments: Arguments of `cathsim`. If they are for another command, the options
            of the task, which take time to import, are left out.
    """
    kind: type = NoOptions
    if list(arguments[:1]) == ["eval"]:
        from cathsim_dmc import agents  # noqa: F401  torchrl goes before dm_control

        kind = task_kind(frozenset({"observation"}))
    evaluate.__annotations__["options"] = Annotated[kind, conf.arg(name="")]
    return evaluate


def evaluate(
    policy: PolicyName,
    /,
    task: str | None = None,
    episodes: int | None = None,
    seed: int = EVALUATION_SEED,
    protocol: Literal["published", "varied"] = "published",
    out: Path | None = None,
    baseline: bool = True,
    anatomy: OwnAnatomy = NO_ANATOMY,
    threads: Threads = None,
    report: bool = False,
    json: Json = False,
    *,
    options: NoOptions,
) -> int:
    """Play episodes with a policy and report reward, forces and success.

    Args:
        task: Task of `cathsim list`; by default the one that the policy was trained on,
            or navigate where `--anatomy` names another anatomy.
        episodes: Number of episodes, each with a seed of its own; by default 30, and
            100 of the varied protocol.
        seed: Seed of the first episode; the others lie above it.
        protocol: Conditions: "published", where episodes differ by 1 mm of the start,
            or "varied", where start, roll, friction, stiffness, damping, delay, device
            and noise differ from episode to episode.
        out: Directory for evaluation.json and heatmap.png.
        baseline: Whether to compare with the random policy on the same seeds.
        anatomy: Where the task takes place.
        report: Whether to print each episode too: seed, anatomy, device, end, time,
            path and forces (docs/start.md).
        options: Options of the task, over those that the policy was trained with.
    """
    from cathsim_dmc.agents import report as reports

    result = reports.evaluate(
        policy,
        task=task,
        episodes=episodes,
        seed=seed,
        protocol=protocol,
        task_kwargs={**given(options), **anatomy.task_kwargs},
        num_threads=threads,
        baseline=baseline,
        out_dir=out,
    )
    if json:
        # No figure of a policy has a bar to keep.
        print_json({"checks": [], **result.to_dict()})
    else:
        result.print()
        if report:
            result.print_episodes()
    return 0


def submit(
    policy: PolicyName,
    /,
    out: Path,
    task: str | None = None,
    episodes: int | None = None,
    threads: Threads = None,
) -> int:
    """Play a policy under the varied protocol and write a file for the leaderboard.

    In place of a policy, a file of agents.record_actions is played again.

    Args:
        out: File to write, ending in .json.
        task: Task of `cathsim list`; by default the one that the policy was trained on.
        episodes: Number of episodes; fewer than the 100 of the protocol are not listed.
    """
    from cathsim_dmc.agents import submission

    given = {"episodes": episodes, "num_threads": threads}
    done = submission.submit(policy, out, task, **given)
    rates = done["summary"]["success"], done["summary"]["safe_success"]
    print(f"{out}: success {rates[0]}, safe success {rates[1]}, {done['sha256']}")
    return 0


def record(
    policy: PolicyName,
    /,
    out: Path | None = None,
    gif: Path | None = None,
    task: str | None = None,
    seed: int = EVALUATION_SEED,
    max_steps: MaxSteps = None,
    anatomy: OwnAnatomy = NO_ANATOMY,
    fluoroscopy: bool = True,
) -> int:
    """Record one episode: as a Rerun file, and as .npz beside it; or as a film.

    Args:
        out: Path of the .rrd file.
        gif: Path of a film for slides, .gif or .webp; needs no OpenGL.
        task: Task of `cathsim list`; by default the one that the policy was trained on,
            or navigate where `--anatomy` names another anatomy.
        seed: Seed of the episode.
        anatomy: Where the task takes place.
        fluoroscopy: Whether to include X-ray images.
    """
    from cathsim_dmc.agents import report
    from cathsim_dmc.analysis.force_statistics import millinewtons, recorded_forces

    episode = report.record(
        policy,
        out,
        task=task,
        seed=seed,
        max_steps=max_steps,
        task_kwargs=anatomy.task_kwargs,
        fluoroscopy=fluoroscopy,
        gif=gif,
    )
    written = " ".join(str(path) for path in (out, gif) if path is not None)
    print(f"{episode.steps} steps, {episode.termination}: {written}")
    forces = recorded_forces(episode)
    if forces.mean_force is not None:
        print(
            f"mean force {millinewtons(forces.mean_force)} mN (sum over contacts), max "
            f"force {millinewtons(forces.max_force)} mN (largest single contact)"
        )
    return 0


def demos(
    task: Task,
    /,
    out: Path,
    episodes: int = 20,
    observation: tuple[str, ...] = ("tracking",),
    noise: float = 0.0,
    seed: int = DEMONSTRATION_SEED,
    max_steps: MaxSteps = None,
    anatomy: OwnAnatomy = NO_ANATOMY,
    threads: Threads = None,
    json: Json = False,
) -> int:
    """Write demonstrations of the expert as a Minari dataset.

    Args:
        out: Directory of the dataset, which must not exist. `minari.load_dataset`
            knows it if its name ends in a version, such as lcca-v0.
        episodes: Number of episodes, each with a seed of its own.
        observation: Names of the observations that a learner is to see.
        noise: Standard deviation of normal noise added to every entry of the expert's
            action, so that it shows how it comes back to its way.
        seed: Seed of the first episode; the others count up.
        anatomy: Anatomy of one's own, for the task `navigate`.
    """
    from cathsim_dmc import agents
    from cathsim_dmc.analysis.force_statistics import millinewtons

    limit = {} if max_steps is None else {"max_steps": max_steps}
    done = agents.record_demonstrations(
        task,
        out,
        episodes,
        observation=observation if len(observation) != 1 else observation[0],
        seed=seed,
        noise=noise,
        task_kwargs={**limit, **anatomy.task_kwargs},
        num_threads=threads,
        say=lambda text: print(text, file=sys.stderr, flush=True),
    )
    if json:
        print_json({**vars(done), "path": str(done.path)})
        return 0
    print(
        f"{done.successes} of {done.episodes} episodes succeed, {done.steps} steps, "
        f"mean force {millinewtons(done.mean_force)} mN, max force "
        f"{millinewtons(done.max_force)} mN: {done.path}"
    )
    return 0


def replay(
    recording: Annotated[Path, conf.Positional],
    /,
    web: bool = False,
    port: int = 9090,
) -> int:
    """Open a recording in the Rerun viewer.

    Args:
        recording: Path of an .rrd file.
        web: Whether to serve it to a browser instead of opening a window.
        port: Port of the web page.
    """
    from cathsim_dmc.recording import viewer

    viewer.open_viewer(recording, web=web, port=port)
    return 0


def play(
    task: Task,
    /,
    out: Path | None = None,
    seed: int = 0,
    episodes: int | None = None,
    speed: float = 1.0,
    policy: str | None = None,
    anatomy: OwnAnatomy = NO_ANATOMY,
) -> int:
    """Cannulate by keyboard, with the forces on the screen.

    Args:
        out: Directory for the episodes as demonstrations (.npz).
        seed: Seed of the first episode; the others count up.
        episodes: Number of episodes; by default until you quit.
        speed: Speed of the simulation, in multiples of real time.
        policy: Policy to watch instead of playing yourself: directory of a run or of
            a checkpoint, or name of a policy, such as "pretrained:type1_bca".
        anatomy: Where the task takes place.
    """
    watched = None
    if policy is not None:
        # torchrl goes before dm_control.
        from cathsim_dmc.agents import load_policy

        watched = load_policy(policy, seed)
    from cathsim_dmc.play import play as run

    written = run(
        task,
        out,
        seed=seed,
        episodes=episodes,
        speed=speed,
        task_kwargs=anatomy.task_kwargs,
        policy=watched,
    )
    for path in written:
        print(path)
    return 0
