"""`cathsim train`, `eval`, `record`, `replay`, `play` and `demo`."""

import json
import sys
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro import conf
from tyro.extras import SubcommandApp

from cathsim_dmc.cli.options import (
    EVALUATION_SEED,
    NO_ANATOMY,
    OwnAnatomy,
    Task,
    print_json,
)


def add_to(app: SubcommandApp) -> None:
    """Adds the commands."""
    app.command(train)
    app.command(evaluate, name="eval")
    for command in (record, replay, play, demo):
        app.command(command)


def train(
    task: Task,
    /,
    out: Path,
    algo: Literal["ppo", "sac"] = "ppo",
    observation: str = "internal",
    frames: int = 600_000,
    preset: Literal["published", "demo"] = "published",
    anatomy: OwnAnatomy = NO_ANATOMY,
    seed: int = 0,
    num_envs: int | None = None,
    threads: int | None = None,
    path: Literal["batched", "composer"] = "batched",
    resume: bool = False,
    tensorboard: bool = False,
    quiet: bool = False,
    settings: str = "{}",
) -> int:
    """Train an agent.

    Args:
        task: A task of `cathsim list`.
        out: Directory of the run: checkpoints, metrics.csv, config.json.
        algo: Learning algorithm.
        observation: What the agent sees.
        frames: Control steps, over all environments.
        preset: Settings of the published agents, or quicker ones.
        anatomy: Of one's own, for `navigate`.
        seed: Of everything.
        num_envs: Simulations side by side; the preset's by default.
        threads: Of the simulation; one per core by default.
        path: Batched simulation, or dm_control's environments one by one.
        resume: Continue the run in OUT from its newest checkpoint.
        tensorboard: Write event files too.
        quiet: Show no progress.
        settings: Further hyper-parameters as JSON, such as '{"gamma": 0.95}'.
    """
    from cathsim_dmc import agents

    overrides = _settings(settings)
    if num_envs is not None:
        overrides["num_envs"] = num_envs
    config = agents.make_config(
        algo,
        preset,
        **{
            "task": task,
            "observation": observation,
            "total_frames": frames,
            "task_kwargs": anatomy.task_kwargs,
            "seed": seed,
            "num_threads": threads,
            "backend": path,
            "tensorboard": tensorboard,
            **overrides,
        },
    )
    _check_task(task, config.task_kwargs, observation)
    result = agents.train(config, out, resume=resume, progress=not quiet)
    print(f"{result.frames} frames in {result.seconds:.0f} s: {result.checkpoint}")
    return 0


def _settings(text: str) -> dict[str, Any]:
    """Reads hyper-parameters given as a JSON object."""
    try:
        settings = json.loads(text)
    except json.JSONDecodeError as error:
        settings = error
    if not isinstance(settings, dict):
        raise ValueError(
            f"settings are {text!r}; give a JSON object such as '{{\"gamma\": 0.95}}'"
        )
    return settings


def _check_task(task: str, task_kwargs: dict[str, Any], observation: str) -> None:
    """Loads the task once, so that bad input fails before a run is set up."""
    from cathsim_dmc import suite

    kwargs = {**task_kwargs, "observation": observation}
    suite.load(suite.DOMAIN, task, task_kwargs=kwargs).close()


def evaluate(
    policy: Annotated[str, conf.Positional],
    /,
    task: str | None = None,
    episodes: int = 30,
    seed: int = EVALUATION_SEED,
    out: Path | None = None,
    baseline: bool = True,
    anatomy: OwnAnatomy = NO_ANATOMY,
    threads: int | None = None,
    json: bool = False,
) -> int:
    """Play episodes with a policy and report reward, forces and success.

    Args:
        policy: Directory of a run or checkpoint, "random", or "expert".
        task: By default the one the checkpoint was trained on.
        episodes: How many, each with a seed of its own.
        seed: Of the first episode.
        out: Directory for evaluation.json and heatmap.png.
        baseline: Compare with the random policy on the same seeds.
        anatomy: Of one's own, for `navigate`.
        threads: Of the simulation; one per core by default.
        json: Print one JSON object and nothing else.
    """
    from cathsim_dmc.agents import report

    result = report.evaluate(
        policy,
        task=task,
        episodes=episodes,
        seed=seed,
        task_kwargs=anatomy.task_kwargs or None,
        num_threads=threads,
        baseline=baseline,
        out_dir=out,
    )
    if json:
        # No figure of a policy has a bar to keep.
        print_json({"checks": [], **result.to_dict()})
    else:
        result.print()
    return 0


def record(
    policy: Annotated[str, conf.Positional],
    /,
    out: Path,
    task: str | None = None,
    seed: int = EVALUATION_SEED,
    max_steps: int | None = None,
    anatomy: OwnAnatomy = NO_ANATOMY,
    fluoroscopy: bool = True,
) -> int:
    """Record one episode as a Rerun file, and as .npz beside it.

    Args:
        policy: Directory of a run or checkpoint, "random", "expert", or "push".
        out: The .rrd file.
        task: By default the one the checkpoint was trained on.
        seed: Of the episode.
        max_steps: Stop after so many control steps.
        anatomy: Of one's own, for `navigate`.
        fluoroscopy: Include X-ray images.
    """
    from cathsim_dmc.agents import report

    episode = report.record(
        policy,
        out,
        task=task,
        seed=seed,
        max_steps=max_steps,
        task_kwargs=anatomy.task_kwargs or None,
        fluoroscopy=fluoroscopy,
    )
    print(f"{episode.steps} steps, {episode.termination}: {out}")
    return 0


def replay(
    recording: Annotated[Path, conf.Positional],
    /,
    web: bool = False,
    port: int = 9090,
) -> int:
    """Open a recording in the Rerun viewer.

    Args:
        recording: An .rrd file.
        web: Serve it to a browser instead of opening a window.
        port: Of the web page.
    """
    from cathsim_dmc.recording import viewer

    return viewer.open_viewer(recording, web=web, port=port, announce=print)


def play(
    task: Task,
    /,
    mode: Literal["fluoroscopy", "viewer"] = "fluoroscopy",
    out: Path | None = None,
    seed: int = 0,
    episodes: int | None = None,
    speed: float = 1.0,
    anatomy: OwnAnatomy = NO_ANATOMY,
) -> int:
    """Cannulate by keyboard, with the forces on the screen.

    Args:
        task: A task of `cathsim list`.
        mode: A plain window with the X-ray image, or MuJoCo's viewer (needs OpenGL).
        out: Directory for the episodes as demonstrations (.npz).
        seed: Of the first episode.
        episodes: Stop after so many.
        speed: Times real time.
        anatomy: Of one's own, for `navigate`.
    """
    from cathsim_dmc.play import play as run

    kwargs = anatomy.task_kwargs
    written = run(
        task, mode, out, seed=seed, episodes=episodes, speed=speed, task_kwargs=kwargs
    )
    for path in written:
        print(path)
    return 0


def demo(out: Path = Path("runs/demo"), frames: int = 150_000, seed: int = 0) -> int:
    """Train PPO briefly on type1_bca, evaluate it, draw and record it.

    Args:
        out: Directory of the run.
        frames: Control steps of training.
        seed: Of everything.
    """
    from cathsim_dmc.agents.demo import demo as run

    def say(text: str) -> None:
        print(text, file=sys.stderr, flush=True)

    return 0 if run(out, frames, seed, say) else 1
