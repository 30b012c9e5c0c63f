"""From nothing to a trained, measured and recorded policy: `cathsim demo`."""

from collections.abc import Callable
from pathlib import Path

from cathsim_dmc.agents import learners, report, training
from cathsim_dmc.agents.checkpoint import Checkpoint


def demo(
    out: str | Path,
    frames: int,
    seed: int,
    say: Callable[[str], None] = lambda text: None,
) -> bool:
    """Train PPO on type1_bca, evaluates, draws and records it.

    A run that is there is continued or, if it is complete, only evaluated.

    Args:
        out: Directory of the run.
        frames: Number of control steps of training.
        seed: Seed of networks, exploration and environments.
        say: Function that is told what happens.

    Returns:
        Whether it came to the end; an interrupted training can be continued.
    """
    out = Path(out)
    config = learners.make_config(
        "ppo", "demo", task="type1_bca", total_frames=frames, seed=seed
    )
    say(f"1/3 training PPO on {config.task}, {frames} frames -> {out}")
    result = training.train(config, out, resume=(out / "config.json").exists())
    if result.interrupted:
        say(f"interrupted at {result.frames} frames; run it again to go on")
        return False
    say("2/3 evaluating 30 episodes, and the random policy on the same seeds")
    report.evaluate(out, out_dir=out).print()
    say("3/3 recording an episode")
    episode = report.record(out, out / "episode.rrd")
    checkpoint = Checkpoint.open(out)
    say(
        f"{episode.steps} steps, {episode.termination}. In {out}: "
        f"{checkpoint.path.relative_to(out)} (policy), metrics.csv, evaluation.json, "
        f"heatmap.png, episode.rrd (open it: cathsim replay {out / 'episode.rrd'})"
    )
    return True
