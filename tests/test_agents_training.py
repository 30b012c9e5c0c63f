import os
import shutil
import signal
import types

import pytest
import synthetic_env
import torch
from tensordict import TensorDict

from cathsim_dmc.agents import ConfigError, collection, evaluate, make_config, train
from cathsim_dmc.agents.checkpoint import Checkpoint, checkpoints_in
from cathsim_dmc.agents.networks import NetworkShapes
from cathsim_dmc.agents.ppo import PPO
from cathsim_dmc.agents.sac import SAC
from cathsim_dmc.agents.training import _truncate_diverged
from cathsim_dmc.agents.training_log import read_metrics

CLOCKS = ("seconds", "frames_per_second")
SMALL = {
    "task": "reach", "num_envs": 16, "learning_rate": 1e-3, "total_frames": 1_024,
    "normalisation_frames": 256,
}  # fmt: skip


def small_ppo(**changes):
    own = {
        "steps_per_update": 512, "minibatch_size": 128, "epochs": 2,
        "metrics_frames": 512, "checkpoint_frames": 512,
    }  # fmt: skip
    return make_config("ppo", **{**SMALL, **own, **changes})


def small_sac(**changes):
    own = {
        "batch_size": 64, "random_frames": 512, "replay_frames": 4_096,
        "updates_per_frame": 0.03125, "initial_alpha": 0.1,
        "metrics_frames": 256, "checkpoint_frames": 256,
    }  # fmt: skip
    return make_config("sac", **{**SMALL, **own, **changes})


def run(config, out, **kwargs):
    kwargs.setdefault("make_env", synthetic_env.make_env)
    kwargs.setdefault("progress", False)
    return train(config, out, **kwargs)


def column(out, name):
    return [row[name] for row in read_metrics(out / "metrics.csv")]


def without_clocks(rows):
    return [{k: v for k, v in row.items() if k not in CLOCKS} for row in rows]


@pytest.mark.slow
def test_ppo_learns_to_reach(tmp_path):
    run(small_ppo(total_frames=10_240, epochs=6), tmp_path)
    rewards = column(tmp_path, "episode_reward")
    assert rewards[-1] > rewards[1] + 15


def test_an_annealed_learning_rate_falls_in_a_line_to_nothing(tmp_path, capsys):
    config = small_ppo(anneal=True, num_envs=8, total_frames=1_024, epochs=1)
    sizes = dict.fromkeys(("steps_per_update", "metrics_frames"), 256)
    run(config.replace(**sizes), tmp_path, progress=True)
    assert ": 1024 frames [" in capsys.readouterr().err
    falling = pytest.approx([1e-3, 0.75e-3, 0.5e-3, 0.25e-3])
    assert column(tmp_path, "learning_rate") == falling
    off_policy = small_sac(anneal=True, num_envs=8, steps_per_env=32, total_frames=1024)
    run(off_policy, tmp_path / "sac")
    assert column(tmp_path / "sac", "learning_rate") == falling


def test_sac_learns_the_best_action_of_each_state(tmp_path):
    torch.manual_seed(0)
    config = small_sac(
        learning_rate=1e-2, gamma=0.5, tau=0.05, updates_per_frame=0.1,
        initial_alpha=0.01, target_entropy=-4.0,
    )  # fmt: skip
    learner = SAC(config, NetworkShapes(1, None, 1), tmp_path)
    state = torch.rand(1, 2_500, 1) * 2 - 1
    action = torch.rand(1, 2_500, 1) * 2 - 1
    ended = torch.ones(1, 2_500, 1, dtype=torch.bool)
    experience = TensorDict(
        {
            "observation_vector": state,
            "action": action,
            "next": {
                "observation_vector": state.clone(),
                "reward": -(action - 0.5 * state.sign()).square(),
                "done": ended,
                "terminated": ended.clone(),
            },
        },
        [1, 2_500],
    )
    losses = learner.update(experience, 0.0)
    assert losses["gradient_steps"] == 250
    asked = TensorDict({"observation_vector": torch.tensor([[-0.6], [0.6]])}, [2])
    chosen = learner.policy(asked)["action"].flatten()
    torch.testing.assert_close(chosen, torch.tensor([-0.5, 0.5]), atol=0.15, rtol=0)


def test_random_actions_fill_whole_batches_also_in_a_run_that_is_resumed(monkeypatch):
    def begun(env, policy, **options):
        return options["frames_per_batch"], options["init_random_frames"]

    monkeypatch.setattr(collection, "Collector", begun)
    config = small_sac(num_envs=8, steps_per_env=4, random_frames=100)
    learner = types.SimpleNamespace(
        random_frames=100, policy=None, device=torch.device("cpu")
    )
    for seen, left in ((0, 128), (64, 64), (96, 32), (128, None)):
        found = collection.make_collector(config, learner, None, None, seen)
        assert found == (32, left)


SMALL_IMAGES = {
    "observation": "image", "critic_observation": "internal",
    "convolutions": ((4, 8, 8), (4, 3, 2)), "cnn_features": 16, "hidden": (16,),
    "subtract_background": True,
}  # fmt: skip


@pytest.mark.parametrize("make", [small_ppo, small_sac])
def test_a_critic_that_reads_more_than_the_policy(tmp_path, make):
    sizes = {"steps_per_update": 128} if make is small_ppo else {"random_frames": 128}
    sizes |= {"metrics_frames": 128, "checkpoint_frames": 128}
    config = make(**SMALL_IMAGES, **sizes, normalisation_frames=64, total_frames=256)
    run(config, tmp_path)
    saved = Checkpoint.open(tmp_path)
    assert saved.shapes == NetworkShapes(0, (1, 128, 128), synthetic_env.ACTIONS)
    # Its statistics are those of what was collected, and come back on resuming.
    kept = saved.learning_state()["learner"]["normalisers"]["0.module.count"]
    assert kept == (128 + 64 + 128 if make is small_ppo else 256)
    assert evaluate(tmp_path, episodes=2, make_env=synthetic_env.make_env).episodes
    run(config.replace(total_frames=384), tmp_path, resume=True)
    state = Checkpoint.open(tmp_path).learning_state()["learner"]
    assert state["normalisers"]["0.module.count"] == kept + 128


def test_a_critic_of_its_own_has_statistics_where_the_policy_is_taken_over(
    tmp_path, monkeypatch
):
    config = small_ppo(
        **SMALL_IMAGES, steps_per_update=128, normalisation_frames=64, total_frames=128
    )
    run(config, tmp_path / "first")
    counts, update = [], PPO.update

    def watched(learner, *arguments):
        (critic,) = learner.critic_normalisers
        counts.append(float(critic.module.count))
        return update(learner, *arguments)

    monkeypatch.setattr(PPO, "update", watched)
    taken = str(tmp_path / "first")
    run(config.replace(initial_policy=taken), tmp_path / "second")
    assert counts == [64.0]


@pytest.mark.parametrize(
    ("observation", "critic"),
    [
        ("internal", "tracking"),
        ("internal", "image"),
        (("image", "internal"), "tracking"),
        ("image", "sequential"),
    ],
)
def test_what_a_critic_cannot_read_is_refused(tmp_path, observation, critic):
    config = small_ppo(observation=observation, critic_observation=critic)
    with pytest.raises(ConfigError, match="critic_observation=.* is not allowed"):
        run(config, tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("make", [small_ppo, small_sac])
def test_a_compiled_loss_has_the_same_gradients(tmp_path, make):
    weights, figures = [], []
    for compiled in (False, True):
        out = tmp_path / str(compiled)
        run(make(total_frames=1_024, torch_compile=compiled), out)
        weights.append(Checkpoint.open(out).policy_state())
        figures.append(without_clocks(read_metrics(out / "metrics.csv"))[-1])
    torch.testing.assert_close(*weights, rtol=1e-3, atol=1e-5)
    assert figures[1] == pytest.approx(figures[0], rel=1e-3, abs=1e-5, nan_ok=True)
    # Either goes on from the other.
    run(make(total_frames=1_280), tmp_path / "True", resume=True)


def test_a_compiled_loss_needs_a_compiler(tmp_path, monkeypatch):
    def missing(*args):
        raise RuntimeError("No working C++ compiler found")

    monkeypatch.setattr(torch, "compile", missing)
    said = "torch_compile=True needs a C\\+\\+ compiler .*; leave it out: No working"
    with pytest.raises(ConfigError, match=said):
        run(small_ppo(torch_compile=True), tmp_path / "run")
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("make", [small_ppo, small_sac])
def test_same_seed_same_run(tmp_path, make):
    config = make(total_frames=1_024)
    for name in "ab":
        run(config, tmp_path / name)
    first, second = (read_metrics(tmp_path / name / "metrics.csv") for name in "ab")
    assert without_clocks(first) == without_clocks(second)
    run(config.replace(seed=1), tmp_path / "c")
    other = read_metrics(tmp_path / "c" / "metrics.csv")
    assert without_clocks(first) != without_clocks(other)


@pytest.mark.parametrize("make", [small_ppo, small_sac])
def test_resuming_continues_counters_rows_and_weights(tmp_path, make):
    first = run(make(total_frames=1_024), tmp_path)
    before = Checkpoint.open(tmp_path).learning_state()
    again = run(make(total_frames=1_024), tmp_path, resume=True)
    assert again.frames == 1_024
    assert again.metrics == pytest.approx(first.metrics, rel=1e-6)
    assert Checkpoint.open(tmp_path).frames == 1_024

    seconds = Checkpoint.open(tmp_path).seconds
    second = run(make(total_frames=2_048), tmp_path, resume=True)
    assert (first.frames, second.frames) == (1_024, 2_048)
    assert second.seconds > first.seconds
    rows = read_metrics(tmp_path / "metrics.csv")
    # The speed is that of this process.
    rate = 1_024 / (rows[-1]["seconds"] - seconds)
    assert rows[-1]["frames_per_second"] == pytest.approx(rate, rel=1e-4)
    frames = [row["frames"] for row in rows]
    assert frames == sorted(set(frames))
    for name in ("gradient_steps", "episodes", "seconds"):
        values = [row[name] for row in rows]
        assert values == sorted(values)
    after = Checkpoint.open(tmp_path).learning_state()
    steps = [state["learner"]["gradient_steps"] for state in (before, after)]
    assert 0 < steps[0] < steps[1]


def test_what_a_kill_leaves_behind_does_not_count(tmp_path):
    """Later rows, half a row, half a checkpoint."""
    run(small_sac(total_frames=1_024), tmp_path)
    saved = Checkpoint.open(tmp_path)
    with open(tmp_path / "metrics.csv", "a") as file:
        columns = len(file_header(tmp_path)) - 1
        file.write(f"{saved.frames + 64}" + ",0" * columns + "\n")
        file.write(f"{saved.frames - 1},0.")
    for name in (".0000000009.0123456789ab.partial", "0000000009", "best"):
        (tmp_path / "checkpoints" / name).mkdir()
    (tmp_path / "checkpoints" / ".DS_Store").touch()

    goal = saved.frames + 512
    result = run(small_sac(total_frames=goal), tmp_path, resume=True)
    assert result.frames == goal
    frames = column(tmp_path, "frames")
    assert frames == sorted(set(frames))
    assert saved.frames + 64 not in frames
    assert frames[-1] == goal
    assert result.metrics["replay_frames"] == min(goal, 4_096)
    left = set((tmp_path / "checkpoints").iterdir()) - set(checkpoints_in(tmp_path))
    assert {path.name for path in left} == {"best", ".DS_Store"}  # the user's own


def test_running_figures_go_on_where_a_run_is_resumed(tmp_path):
    """Of fresh episodes the short ones, which succeed, would end first."""
    run(small_ppo(total_frames=2_048), tmp_path)
    before = Checkpoint.open(tmp_path).learning_state()["window"]
    row = read_metrics(tmp_path / "metrics.csv")[-1]
    assert len(before) > 10
    rewards = [episode[0] for episode in before]
    assert sum(rewards) / len(rewards) == pytest.approx(row["episode_reward"], 1e-6)
    run(small_ppo(total_frames=3_584), tmp_path, resume=True)
    after = Checkpoint.open(tmp_path).learning_state()["window"]
    new = int(read_metrics(tmp_path / "metrics.csv")[-1]["episodes"] - row["episodes"])
    assert 0 < new < 100
    assert after[:-new] == before[len(before) + new - len(after) :]


@pytest.mark.slow
def test_a_run_saves_by_the_clock_too(tmp_path):
    config = small_ppo(
        total_frames=4_096, checkpoint_frames=10**6, keep_checkpoints=100
    )
    run(config, tmp_path / "frames")
    assert [path.name for path in checkpoints_in(tmp_path / "frames")] == ["0000004096"]
    run(config.replace(checkpoint_seconds=1e-3), tmp_path / "clock")
    found = [int(path.name) for path in checkpoints_in(tmp_path / "clock")]
    assert found == list(range(512, 4_097, 512))
    # Saving disturbs nothing.
    rows = [read_metrics(tmp_path / n / "metrics.csv") for n in ("frames", "clock")]
    assert without_clocks(rows[0]) == without_clocks(rows[1])


def test_there_must_be_a_run_to_resume(tmp_path):
    with pytest.raises(ConfigError, match="there is no run in .* to resume"):
        run(small_ppo(), tmp_path / "none", resume=True)
    assert not (tmp_path / "none").exists()
    # One that was killed before its first checkpoint begins anew.
    (tmp_path / "config.json").write_text("{}")
    assert run(small_ppo(total_frames=512), tmp_path, resume=True).frames == 512


def file_header(path):
    return (path / "metrics.csv").read_text().splitlines()[0].split(",")


def test_an_interrupt_saves_and_can_be_resumed(tmp_path, capsys):
    interrupting = synthetic_env.calling(
        lambda: os.kill(os.getpid(), signal.SIGINT), at=70
    )
    config = small_ppo(total_frames=10_240, checkpoint_frames=10_240)
    handler = signal.getsignal(signal.SIGINT)
    result = run(config, tmp_path, make_env=interrupting, progress=True)
    assert result.interrupted
    assert "ends after this batch, with a checkpoint" in capsys.readouterr().err
    assert 0 < result.frames < 10_240
    assert Checkpoint.open(tmp_path).frames == result.frames
    assert signal.getsignal(signal.SIGINT) is handler
    more = config.replace(total_frames=result.frames + 512)
    assert run(more, tmp_path, resume=True).frames == result.frames + 512


def test_a_run_is_neither_overwritten_nor_resumed_with_other_settings(tmp_path):
    run(small_ppo(total_frames=512), tmp_path)
    with pytest.raises(ConfigError, match="already holds a run: resume .*--resume"):
        run(small_ppo(total_frames=512), tmp_path)
    with pytest.raises(ConfigError, match="clip: it has 0.1, given is 0.3"):
        run(small_ppo(clip=0.3), tmp_path, resume=True)
    # The others come with the algorithm.
    with pytest.raises(
        ConfigError, match=r"\(algorithm: it has 'ppo', given is 'sac'\)"
    ):
        run(small_sac(), tmp_path, resume=True)


def test_checkpoints_hold_weights_only_and_act_alike(tmp_path):
    run(small_ppo(total_frames=2_048, keep_checkpoints=2), tmp_path)
    found = checkpoints_in(tmp_path)
    assert [path.name for path in found] == ["0000001536", "0000002048"]
    for path in found:
        assert sorted(child.name for child in path.iterdir()) == [
            "checkpoint.json",
            "learning.pt",
            "policy.pt",
        ]
        for name in ("learning.pt", "policy.pt"):
            torch.load(path / name, weights_only=True)
    before = evaluate(tmp_path, episodes=3, make_env=synthetic_env.make_env)
    observation = synthetic_env.make_env("reach", num_envs=5).reset()
    location = Checkpoint.open(tmp_path).policy()(observation.clone())["loc"]
    # A checkpoint is complete in itself: it may be moved and its run deleted.
    alone = tmp_path / "elsewhere"
    found[-1].rename(alone)
    shutil.rmtree(tmp_path / "checkpoints")
    after = evaluate(alone, episodes=3, make_env=synthetic_env.make_env)
    assert after.episodes == before.episodes
    assert torch.equal(
        Checkpoint.open(alone).policy()(observation.clone())["loc"], location
    )
    assert location.abs().max() > 0


def test_a_diverged_simulation_is_truncated_not_terminated():
    flags = torch.tensor([[[True], [True], [False]]])
    batch = TensorDict(
        {
            "next": {
                "terminated": flags.clone(),
                "done": flags.clone(),
                "info": {"physics_error": torch.tensor([[[True], [False], [False]]])},
            }
        },
        [1, 3],
    )
    _truncate_diverged(batch)
    assert batch["next", "terminated"].flatten().tolist() == [False, True, False]
    assert torch.equal(batch["next", "done"], flags)


def test_a_learner_is_not_told_that_a_diverged_simulation_ended(tmp_path, monkeypatch):
    step, update, seen = synthetic_env.ReachEnv._step, PPO.update, []

    def diverging(env, state):
        found, lost = step(env, state), torch.as_tensor(env.count == 3)[:, None]
        found["info", "physics_error"] = lost.float()
        for flag in ("terminated", "done"):
            found[flag] |= lost
        return found

    def noted(learner, batch, progress):
        seen.append(batch)
        return update(learner, batch, progress)

    monkeypatch.setattr(synthetic_env.ReachEnv, "_step", diverging)
    monkeypatch.setattr(PPO, "update", noted)
    run(small_ppo(total_frames=512), tmp_path)
    ends = seen[0]["next"]
    lost = ends["info", "physics_error"].bool()
    assert lost.any() and ends["done"][lost].all()
    assert not ends["terminated"][lost].any()


def test_the_threads_of_torch_are_the_runs_and_then_those_before(tmp_path):
    before, seen = torch.get_num_threads(), []

    def make_env(*arguments, **options):
        seen.append(torch.get_num_threads())
        return synthetic_env.make_env(*arguments, **options)

    config = small_ppo(total_frames=512, torch_threads=before + 1)
    run(config, tmp_path, make_env=make_env)
    assert (seen, torch.get_num_threads()) == ([before + 1], before)


def test_training_has_its_own_reward_and_episodes_and_evaluation_the_tasks(tmp_path):
    """Without shaping: the published rule judges, whatever was learnt from."""
    asked = []

    def make_env(task, *, task_kwargs, **options):
        asked.append(dict(task_kwargs))
        own = {k: v for k, v in task_kwargs.items() if k == "max_steps"}
        return synthetic_env.make_env(task, task_kwargs=own, **options)

    config = small_ppo(
        total_frames=512,
        task_kwargs={"friction": 0.1},
        training_reward={"path": -1.0, "success": 10.0},
        training_max_steps=20,
    )
    train(config, tmp_path, progress=False, make_env=make_env)
    (row,) = read_metrics(tmp_path / "metrics.csv")
    assert row["episode_length"] <= 20
    result = evaluate(tmp_path, episodes=4, make_env=make_env)
    assert max(episode.length for episode in result.episodes) > 20
    shaped = {"reward": {"path": -1.0, "success": 10.0}, "max_steps": 20}
    assert asked == [{"friction": 0.1, **shaped}, {"friction": 0.1}]
