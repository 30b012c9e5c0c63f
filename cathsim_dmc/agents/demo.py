"""From nothing to a trained, measured and recorded policy: `cathsim demo`.

DAgger, because it steers into the left common carotid after a minute, where PPO from
nothing takes half an hour.
"""

from collections.abc import Callable
from pathlib import Path

from cathsim_dmc.agents import evaluation, learners, report, training
from cathsim_dmc.agents.checkpoint import Checkpoint

TASK = "type1_lcca"
_PUSHES = 4  # they jam, and every control step of a jam takes long


def demo(
    out: str | Path,
    frames: int,
    seed: int,
    say: Callable[[str], None] = lambda text: None,
) -> bool:
    """Trains DAgger on type1_lcca, evaluates, draws and records it.

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
        "dagger", "demo", task=TASK, total_frames=frames, seed=seed
    )
    say(f"1/3 learning {config.task} from the expert, {frames} frames -> {out}")
    result = training.train(config, out, resume=(out / "config.json").exists())
    if result.interrupted:
        say(f"interrupted at {result.frames} frames; run it again to go on")
        return False
    say("2/3 evaluating 30 episodes, and the random policy on the same seeds")
    report.evaluate(out, out_dir=out).print()
    push = evaluation.evaluate("push", TASK, _PUSHES)
    say(f"a straight push reaches the goal in {push.successes} of {_PUSHES} episodes")
    say("3/3 recording an episode")
    episode = report.record(out, out / "episode.rrd")
    checkpoint = Checkpoint.open(out)
    say(
        f"{episode.steps} steps, {episode.termination}. In {out}: "
        f"{checkpoint.path.relative_to(out)} (policy), metrics.csv, evaluation.json, "
        f"heatmap.png, episode.rrd (open it: cathsim replay {out / 'episode.rrd'})"
    )
    return True
