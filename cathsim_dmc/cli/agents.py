"""`cathsim eval`, `submit`, `record`, `demos` and `play`."""

import contextlib
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from tyro import conf

# torchrl goes before dm_control.
from cathsim_dmc import agents  # isort: skip

from cathsim_dmc import bounds, files, suite
from cathsim_dmc import play as by_hand
from cathsim_dmc.agents import evaluation, evaluation_files, protocols, submission
from cathsim_dmc.agents.demonstrations import DEMONSTRATION_SEED
from cathsim_dmc.agents.evaluation import EvaluationResult
from cathsim_dmc.agents.policies import require_actions, task_and_options
from cathsim_dmc.agents.training_log import LINE_INTERVAL, progress_bar
from cathsim_dmc.analysis.force_statistics import millinewtons, recorded_forces
from cathsim_dmc.cli.options import (
    Json,
    Modules,
    Ray,
    Task,
    Threads,
    print_json,
    say,
    told_of_losses,
    told_of_replaced,
)
from cathsim_dmc.cli.result_tables import print_episodes, print_results
from cathsim_dmc.cli.task_options import TaskOptions, task_kind
from cathsim_dmc.pictures import recorded
from cathsim_dmc.pictures.films import SUFFIXES, check_film
from cathsim_dmc.policies import in_environment
from cathsim_dmc.recording.episode import Episode
from cathsim_dmc.recording.recorder import EpisodeRecorder
from cathsim_dmc.tasks.config import EVALUATION_SEED
from cathsim_dmc.tasks.snapshot import Snapshot

_POLICY = (
    "Directory of a run or checkpoint, or name of a policy: random, push, expert, "
    "idle, curl, random_curl, pretrained:NAME."
)
PolicyName = Annotated[str, conf.Positional, conf.arg(help=_POLICY)]
_TASK = (
    "Task of `cathsim list`; by default the one that the policy was trained on, or "
    "navigate where `--anatomy` names another anatomy."
)
PolicysTask = Annotated[str | None, conf.arg(help=_TASK)]
Options = Annotated[TaskOptions, conf.arg(name="", constructor=task_kind())]


def evaluate(
    policy: PolicyName,
    /,
    task: PolicysTask = None,
    episodes: int | None = None,
    seed: int = EVALUATION_SEED,
    protocol: Literal["published", "varied"] = "published",
    out: Path | None = None,
    baseline: bool = True,
    start: Path | None = None,
    threads: Threads = None,
    simulation_device: str = "cpu",
    ray: Ray = False,
    report: bool = False,
    json: Json = False,
    modules: Modules = (),
    *,
    options: Options,
) -> int:
    """Play episodes with a policy and report reward, forces and success.

    Args:
        episodes: Number of episodes, each with a seed of its own; by default 30, and
            100 of the varied protocol.
        seed: Seed of the first episode; those of the others are larger.
        protocol: Conditions: "published", where episodes differ by 1 mm of the start,
            or "varied", where start, roll, friction, stiffness, damping, delay, device
            and noise differ from episode to episode.
        out: Directory for evaluation.json, heatmap.png (of one anatomy only), and
            errors/ with the last physics errors.
        baseline: Whether to evaluate the random policy too, on the same seeds.
        start: File of a snapshot (`snapshot().save`) from which the episodes start, one
            for each of its simulations.
        simulation_device: Where the simulations run: "cpu", or "cuda" for MuJoCo Warp
            on a GPU, "cuda:1" on the second one (extra gpu, docs/gpu.md).
        report: Whether to print each episode too: seed, anatomy, device, end, time,
            path and forces (docs/start.md).
        options: Options of the task, over those that the policy was trained with.
    """
    began = time.monotonic()
    player = agents.load_policy(policy, seed)
    task, task_kwargs = task_and_options(player, task, options.given)
    suite.known(task)
    task_kwargs = protocols.get(protocol).beside(task_kwargs, options.given)
    contacts = evaluation.ContactLog()
    asked: Any = {
        "task": task, "episodes": episodes, "seed": seed, "protocol": protocol,
        "task_kwargs": task_kwargs, "num_threads": threads, "on_cluster": ray,
        "simulation_device": simulation_device,
        "start": None if start is None else Snapshot.load(start),
    }  # fmt: skip

    def play(who: Any, error_dir: Path | None = None) -> EvaluationResult:
        log = contacts if who is player else None
        with _observer(who, log, ray) as observer:
            return agents.evaluate(who, observer=observer, error_dir=error_dir, **asked)

    if out is not None:
        for path in _written(out):  # checked first: the evaluation would be lost
            files.require_file(path, later=True)
    results = {"policy": play(player, None if out is None else out / "errors")}
    if baseline and policy != "random":
        results["baseline"] = play("random")
    values: dict[str, Any] = {name: one.to_dict() for name, one in results.items()}
    values["seconds"] = round(time.monotonic() - began, 1)
    try:
        if out is not None:
            _write_evaluation(out, values, results["policy"], contacts)
    finally:  # also on a full disk, where the episodes would be lost
        if json:
            # Figures of a policy have no bounds, so there are no checks.
            print_json({"checks": [], **values})
        else:
            print_results(list(results.values()))
            if report:
                print_episodes(results["policy"])
    return 0


def _write_evaluation(
    out: Path,
    values: dict[str, Any],
    result: EvaluationResult,
    contacts: evaluation.ContactLog,
) -> None:
    # Another process may have written there meanwhile.
    target, picture = _written(out)
    with told_of_replaced([target, picture]):
        evaluation_files.write(target, values)
        contacts.draw(result, picture)


def _written(out: Path) -> tuple[Path, Path]:
    """Returns the files of an evaluation: its figures and its picture."""
    return out / evaluation_files.FILE, out / "heatmap.png"


@contextlib.contextmanager
def _observer(
    who: Any, log: evaluation.ContactLog | None, on_cluster: bool
) -> Iterator[Callable[[Any, np.ndarray], None] | None]:
    """Yields an observer of episodes: the log and, on one machine, the progress."""
    if on_cluster:
        with told_of_losses():
            yield log
        return
    with progress_bar(getattr(who, "name", who), " steps", delay=LINE_INTERVAL) as bar:

        def observe(env: Any, running: np.ndarray) -> None:
            if log is not None:
                log(env, running)
            text = f"{np.count_nonzero(running)} of {len(running)} episodes run"
            bar.set_postfix_str(text, refresh=False)
            bar.update()

        yield observe


def submit(
    policy: PolicyName,
    /,
    out: Path,
    task: PolicysTask = None,
    episodes: int | None = None,
    threads: Threads = None,
    modules: Modules = (),
) -> int:
    """Play a policy under the varied protocol and write a file for the leaderboard.

    Also takes a file of agents.record_actions, whose actions it repeats.

    Args:
        out: File to write, ending in .json.
        episodes: Number of episodes; fewer than the 100 of the protocol are not listed.
    """
    with told_of_replaced([out, out.with_suffix(submission.RECORDED)]):
        done = submission.submit(
            policy, out, task, episodes=episodes, num_threads=threads
        )
    rates = {"success": done["summary"]["success"]}
    safe = done["summary"]["safe_success"].items()
    rates |= {f"safe success, {limit}": rate for limit, rate in safe}
    text = "; ".join(f"{name}: {100 * rate:.0f} %" for name, rate in rates.items())
    print(f"{out}: {len(done['episodes'])} episodes; {text}; SHA-256 {done['sha256']}")
    return 0


def record(
    policy: PolicyName,
    /,
    out: Path | None = None,
    gif: Annotated[Path | None, conf.arg(aliases=("--mp4", "--film"))] = None,
    task: PolicysTask = None,
    seed: int = EVALUATION_SEED,
    start: Path | None = None,
    fluoroscopy: bool = True,
    modules: Modules = (),
    *,
    options: Annotated[
        TaskOptions,
        conf.arg(name="", constructor=task_kind(("observation", "fluoroscopy"))),
    ],
) -> int:
    """Record one episode: as a Rerun file, and as .npz beside it; or as a film.

    Args:
        out: File to write: .rrd (Rerun, with an .npz beside it), .npz (arrays), or a
            film as of --film.
        gif: Path of a film: .gif, .webp or, with the extra `video`, .mp4; needs no
            OpenGL.
        seed: Seed of the episode; with --start, of the policy only.
        start: File of a snapshot (`snapshot().save`) of a running episode, which
            the policy continues.
        fluoroscopy: Whether an .rrd file has X-ray images.
        options: Options of the task, over those that the policy was trained with.
    """
    targets = [path for path in (out, gif) if path is not None]
    if not targets:
        raise ValueError(
            "nothing is to be written; give --out, an .rrd file, or --film"
        )
    if gif == out:
        raise ValueError(f"--out and --film are both {out}; leave one of them out")
    for path, endings in (out, recorded.FORMATS), (gif, SUFFIXES):
        if path is not None and path.suffix not in endings:
            raise ValueError(f"{path} does not end in {' or '.join(endings)}")
    beside = () if out is None or out.suffix != ".rrd" else (out.with_suffix(".npz"),)
    targets += beside
    for path in targets:
        if path.suffix in SUFFIXES:
            check_film(path)
    bounds.seed("seed", seed)
    player = agents.load_policy(policy, seed)
    task, task_kwargs = task_and_options(player, task, options.given)
    suite.known(task)
    # Checked first: an episode that cannot be written would be lost.
    for path in targets:
        files.require_file(path, later=True)
    begin = None if start is None else Snapshot.load(start)
    if start is not None and any(p.exists() and p.samefile(start) for p in targets):
        raise ValueError(
            f"--out {out} would replace the snapshot {start}; give another name"
        )
    episode, env = _played(player, task, task_kwargs, seed, begin)
    for path in targets:
        files.require_file(path, make=True)
    with told_of_replaced(targets):
        if out is not None:
            recorded.write(episode, env, out, fluoroscopy)
        for path in beside:
            episode.save(path)
        if gif is not None:
            recorded.write(episode, env, gif)
    print(f"{episode.steps} steps, {episode.termination}:", *targets)
    forces = recorded_forces(episode)
    if forces.mean_force is not None:
        print(
            f"mean force {millinewtons(forces.mean_force)} mN (sum over contacts), max "
            f"force {millinewtons(forces.max_force)} mN (largest single contact)"
        )
    return 0


def _played(
    player: Any,
    task: str,
    task_kwargs: Mapping[str, Any],
    seed: int,
    start: Snapshot | None = None,
) -> tuple[Episode, Any]:
    """Plays an episode of a policy; returns it and its environment."""
    require_actions(player, task, task_kwargs)
    options = dict(task_kwargs)
    if player.observation is not None:
        options["observation"] = player.observation
    env = suite.load(suite.DOMAIN, task, {**options, "random": seed})
    recorder, act = EpisodeRecorder(env, task, options), in_environment(player, env)
    drawn = seed if start is None else None
    return recorder.record_episode(act, drawn, start=start), env


def film_checkpoint(checkpoint: Path, folder: Path, suffix: str) -> Path:
    """Film an episode of a checkpoint's policy, on the task as it is evaluated.

    Args:
        folder: Directory of the films; the file has the name of the checkpoint.
        suffix: Ending of the file, of `pictures.films.SUFFIXES`.
    """
    seed = EVALUATION_SEED
    player = agents.load_policy(str(checkpoint), seed)
    task, task_kwargs = task_and_options(player, None, {})
    episode, env = _played(player, task, task_kwargs, seed)
    folder.mkdir(exist_ok=True)
    return recorded.write(episode, env, folder / f"{checkpoint.name}{suffix}")


def demos(
    task: Task,
    /,
    out: Path,
    episodes: int = 20,
    observation: tuple[str, ...] = ("tracking",),
    noise: float = 0.0,
    seed: int = DEMONSTRATION_SEED,
    threads: Threads = None,
    json: Json = False,
    modules: Modules = (),
    *,
    options: Options,
) -> int:
    """Write demonstrations of the expert as a Minari dataset.

    Args:
        out: Directory of the dataset, which must not exist. `minari.load_dataset`
            finds it if its name ends in a version, such as lcca-v0.
        episodes: Number of episodes, each with a seed of its own.
        observation: Names of the observations to store for learners.
        noise: Standard deviation of normal noise added to every entry of the expert's
            action, so that the dataset contains its corrections.
        seed: Seed of the first episode; the others count up.
        options: Options of the task.
    """
    names = observation if len(observation) != 1 else observation[0]
    done = agents.record_demonstrations(
        task, out, episodes, observation=names, seed=seed, noise=noise,
        task_kwargs=options.given, num_threads=threads, say=say,
    )  # fmt: skip
    if json:
        print_json({**vars(done), "path": str(done.path)})
        return 0
    print(
        f"{done.successes} of {done.episodes} episodes succeed, {done.steps} steps, "
        f"mean force {millinewtons(done.mean_force)} mN, max force "
        f"{millinewtons(done.max_force)} mN: {done.path}"
    )
    return 0


def play(
    task: Task,
    /,
    out: Path | None = None,
    seed: int = 0,
    episodes: int | None = None,
    speed: float = 1.0,
    policy: str | None = None,
    hands: Literal["keyboard", "gamepad", "spacemouse"] = "keyboard",
    modules: Modules = (),
    *,
    options: Options,
) -> int:
    """Cannulate by hand, with the forces on the screen.

    Args:
        out: Directory for the episodes as demonstrations (.npz).
        seed: Seed of the first episode; the others count up.
        episodes: Number of episodes; by default until you quit.
        speed: Speed of the simulation, in multiples of real time.
        policy: Policy to watch instead of playing yourself: directory of a run or of
            a checkpoint, or name of a policy, such as "pretrained:type1_bca".
        hands: Input device, with the extra `hands` also a gamepad, which vibrates with
            the largest contact, or a SpaceMouse; the keys work in any case.
        options: Options of the task, over those that the policy was trained with.
    """
    player = agents.load_policy(policy, seed) if policy else None
    given = options.given
    if player is not None:
        _, given = task_and_options(player, suite.known(task), given)
        require_actions(player, task, given)
    for path in by_hand.play(
        task, out, seed=seed, episodes=episodes, speed=speed, task_kwargs=given,
        policy=player, hands=hands,
    ):  # fmt: skip
        print(path)
    return 0
