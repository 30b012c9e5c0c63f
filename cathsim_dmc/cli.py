"""The command `cathsim`. Thin: every command imports what it needs when it runs."""

import json
import os
import sys
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro import conf
from tyro.extras import SubcommandApp

# Exit codes beside 0: a check has failed; the input cannot be used.
CHECK_FAILED, BAD_INPUT = 1, 2
EVALUATION_SEED = 1_000_000  # apart from the seeds of training

Task = Annotated[str, conf.Positional]

app = SubcommandApp()
phantoms = SubcommandApp()
validations = SubcommandApp()
benchmarks = SubcommandApp()
app.command(phantoms, name="phantom", help="Make, import and check anatomies.")
app.command(validations, name="validate", help="Compare the physics with theory.")
app.command(benchmarks, name="benchmark", help="Measure speed; results table.")


def main() -> None:
    """Runs the command line."""
    try:
        code = app.cli(
            prog="cathsim", description=__doc__, config=(conf.OmitArgPrefixes,)
        )
        sys.stdout.flush()
    except BrokenPipeError:
        # The reader, such as `head`, has seen enough; nor may the exit flush again.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        code = 0
    except (ValueError, OSError, RuntimeError, ImportError) as error:
        # Errors with a message for the user; anything else is ours, with traceback.
        print(f"cathsim: {type(error).__name__}: {error}", file=sys.stderr)
        code = BAD_INPUT
    sys.exit(code)


def _print_json(values: Any) -> None:
    print(json.dumps(values, indent=2))


def _task_kwargs(phantom: str | None, goal: str | None) -> dict[str, Any]:
    chosen = {"phantom": phantom, "goal": goal}
    return {key: value for key, value in chosen.items() if value is not None}


# Tasks


@app.command(name="list")
def list_tasks(json: bool = False) -> int:
    """List the tasks, with one line each.

    Args:
        json: Print JSON instead of a table.
    """
    from rich.console import Console
    from rich.table import Table

    from cathsim_dmc import suite

    lines = {name: make.__doc__.splitlines()[0] for name, make in suite.SUITE.items()}
    if json:
        _print_json({"domain": suite.DOMAIN, "tasks": lines})
        return 0
    table = Table("task", "what to do", box=None)
    for name, line in lines.items():
        table.add_row(name, line)
    Console().print(table)
    return 0


# Agents


@app.command
def train(
    task: Task,
    /,
    out: Path,
    algo: Literal["ppo", "sac"] = "ppo",
    observation: str = "internal",
    frames: int = 600_000,
    preset: Literal["published", "demo"] = "published",
    phantom: str | None = None,
    goal: str | None = None,
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
        phantom: For `navigate`: directory of an anatomy.
        goal: For `navigate`: name of the goal.
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
            "task_kwargs": _task_kwargs(phantom, goal),
            "seed": seed,
            "num_threads": threads,
            "path": path,
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


@app.command(name="eval")
def evaluate(
    policy: Annotated[str, conf.Positional],
    /,
    task: str | None = None,
    episodes: int = 30,
    seed: int = EVALUATION_SEED,
    out: Path | None = None,
    baseline: bool = True,
    phantom: str | None = None,
    goal: str | None = None,
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
        phantom: For `navigate`: directory of an anatomy.
        goal: For `navigate`: name of the goal.
        threads: Of the simulation; one per core by default.
        json: Print one JSON object and nothing else.
    """
    from cathsim_dmc.agents import report

    result = report.evaluate(
        policy,
        task=task,
        episodes=episodes,
        seed=seed,
        task_kwargs=_task_kwargs(phantom, goal) or None,
        num_threads=threads,
        baseline=baseline,
        out_dir=out,
    )
    if json:
        _print_json(result.to_dict())
    else:
        result.print()
    return 0


@app.command
def record(
    policy: Annotated[str, conf.Positional],
    /,
    out: Path,
    task: str | None = None,
    seed: int = EVALUATION_SEED,
    max_steps: int | None = None,
    phantom: str | None = None,
    goal: str | None = None,
    fluoroscopy: bool = True,
) -> int:
    """Record one episode as a Rerun file, and as .npz beside it.

    Args:
        policy: Directory of a run or checkpoint, "random", "expert", or "push".
        out: The .rrd file.
        task: By default the one the checkpoint was trained on.
        seed: Of the episode.
        max_steps: Stop after so many control steps.
        phantom: For `navigate`: directory of an anatomy.
        goal: For `navigate`: name of the goal.
        fluoroscopy: Include X-ray images.
    """
    from cathsim_dmc.agents import report

    episode = report.record(
        policy,
        out,
        task=task,
        seed=seed,
        max_steps=max_steps,
        task_kwargs=_task_kwargs(phantom, goal) or None,
        fluoroscopy=fluoroscopy,
    )
    print(f"{episode.steps} steps, {episode.termination}: {out}")
    return 0


@app.command
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


@app.command
def play(
    task: Task,
    /,
    mode: Literal["fluoroscopy", "viewer"] = "fluoroscopy",
    out: Path | None = None,
    seed: int = 0,
    episodes: int | None = None,
    speed: float = 1.0,
    phantom: str | None = None,
    goal: str | None = None,
) -> int:
    """Cannulate by keyboard, with the forces on the screen.

    Args:
        task: A task of `cathsim list`.
        mode: A plain window with the X-ray image, or MuJoCo's viewer (needs OpenGL).
        out: Directory for the episodes as demonstrations (.npz).
        seed: Of the first episode.
        episodes: Stop after so many.
        speed: Times real time.
        phantom: For `navigate`: directory of an anatomy.
        goal: For `navigate`: name of the goal.
    """
    from cathsim_dmc.play import play as run

    kwargs = _task_kwargs(phantom, goal)
    written = run(
        task, mode, out, seed=seed, episodes=episodes, speed=speed, task_kwargs=kwargs
    )
    for path in written:
        print(path)
    return 0


@app.command
def demo(out: Path = Path("runs/demo"), frames: int = 150_000, seed: int = 0) -> int:
    """Train PPO briefly on type1_bca, evaluate it, draw and record it.

    Args:
        out: Directory of the run.
        frames: Control steps of training.
        seed: Of everything.
    """
    from cathsim_dmc.agents import report

    return report.demo(out, frames, seed)


# Anatomies


@phantoms.command(name="import")
def import_phantom(
    mesh: Annotated[Path, conf.Positional],
    /,
    centreline: list[Path],
    out: Path,
    name: str | None = None,
    units: Literal["mm", "cm", "m"] = "mm",
    frame: Literal["LPS", "RAS"] = "LPS",
    inlet: tuple[float, float, float] | None = None,
    wall: Literal["prisms", "coacd"] = "prisms",
    threshold_mm: float | None = None,
) -> int:
    """Turn the surface of a lumen and its centrelines into an anatomy.

    Args:
        mesh: Closed surface of the lumen: OBJ, STL or PLY.
        centreline: 3D Slicer curves (.mrk.json) or CSV files, one per branch.
        out: Directory of the anatomy.
        name: Of the anatomy.
        units: Of mesh, CSV centrelines and inlet.
        frame: Of mesh, CSV centrelines and inlet.
        inlet: Where the device enters: a free end, or a place to cut the lumen at.
        wall: Pieces near the surface, or CoACD's coarse ones (needs the extra coacd).
        threshold_mm: Of CoACD, the concavity of a piece; 3.5 by default.
    """
    from cathsim_dmc.anatomy import scan

    anatomy = scan.import_scan(
        mesh,
        centreline,
        units=units,
        mesh_frame=frame,
        name=name or out.name,
        inlet=inlet,
        wall=wall,
        threshold=None if threshold_mm is None else threshold_mm * 1e-3,
        progress=lambda text: print(text, file=sys.stderr),
    )
    anatomy.save(out)
    _print_json({"directory": str(out), **scan.describe(anatomy)})
    return 0


@phantoms.command
def generate(
    kind: Annotated[str, conf.Positional],
    /,
    out: Path,
    seed: int | None = None,
) -> int:
    """Generate an arch.

    Args:
        kind: A named arch such as type1, type2, type3, bovine; with a seed, one drawn
            from the anatomical distributions of that type.
        out: Directory of the anatomy.
        seed: Draw the arch at random.
    """
    import numpy as np

    from cathsim_dmc.anatomy import arch

    if kind not in arch.ARCHES:
        raise ValueError(f"no arch {kind!r}; there are {', '.join(arch.ARCHES)}")
    if seed is None:
        anatomy = arch.load(kind)
    else:
        drawn = {"type1": "I", "type2": "II", "type3": "III"}.get(kind)
        parameters = arch.sample(
            np.random.RandomState(seed), drawn, bovine=kind == "bovine"
        )
        anatomy = arch.build_arch(parameters, name=f"{kind}-{seed}")
    anatomy.save(out)
    print(f"{len(anatomy.wall)} wall pieces, goals {', '.join(anatomy.goals)}: {out}")
    return 0


@phantoms.command
def check(phantom: Annotated[str, conf.Positional], /, json: bool = False) -> int:
    """Check an anatomy: intrusion and coverage of its wall, patency of its vessels.

    Args:
        phantom: Directory of an anatomy, or the name of an arch.
        json: Print one JSON object and nothing else.
    """
    from cathsim_dmc import suite
    from cathsim_dmc.analysis import validation

    anatomy = suite.load_anatomy(phantom)
    return _show(validation.validate_anatomy({anatomy.name: anatomy}), json)


# Measurements


def _show(report: Any, as_json: bool) -> int:
    if as_json:
        _print_json(report.as_dict())
    else:
        from rich.console import Console

        Console().print(report.table())
    return 0 if report.passed else CHECK_FAILED


@validations.command
def rod(figure: Path | None = None, json: bool = False) -> int:
    """Bending, buckling and twist of the device against theory.

    Args:
        figure: Where to draw the comparison, a PNG.
        json: Print one JSON object and nothing else.
    """
    from cathsim_dmc.analysis import validation

    return _show(validation.validate_rod(figure), json)


@validations.command
def wall(
    figure: Path | None = None,
    phantom: list[str] = [],  # noqa: B006  # tyro reads it, nobody writes it
    convergence: bool = True,
    json: bool = False,
) -> int:
    """Fidelity of the wall, friction against the capstan equation, convergence.

    Args:
        figure: Where to draw the comparison, a PNG.
        phantom: Directories of further anatomies, such as an imported scan.
        convergence: Include the studies of time step and link length.
        json: Print one JSON object and nothing else.
    """
    from cathsim_dmc.analysis import validation

    report = validation.validate_wall(figure, phantom, with_convergence=convergence)
    return _show(report, json)


@validations.command
def forces(
    figure: Path | None = None,
    episode: Path | None = None,
    mean: float = 0.4,
    sd: float = 0.02,
    margin: float = 0.1,
    json: bool = False,
) -> int:
    """Force balance, known loads, and the published protocol.

    Args:
        figure: Where to draw density and cumulative plots, a PNG.
        episode: Recorded cannulation (.npz of `cathsim record`) for the protocol;
            scripted insertions by default.
        mean: Of the normal reference, N; the published one is unverified.
        sd: Standard deviation of the reference, N.
        margin: Of the equivalence test, N.
        json: Print one JSON object and nothing else.
    """
    from cathsim_dmc.analysis import validation

    report = validation.validate_forces(figure, episode, mean, sd, margin)
    return _show(report, json)


@benchmarks.command
def speed(json: bool = False) -> int:
    """Measure how fast the simulator is. Run it with nothing else running.

    Args:
        json: Print one JSON object and nothing else.
    """
    from cathsim_dmc.analysis.speed import report

    return _show(report.speed(lambda text: print(text, file=sys.stderr)), json)


if __name__ == "__main__":
    main()
