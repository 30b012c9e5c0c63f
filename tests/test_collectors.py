"""TorchRL's multi-process collector with spawned workers."""

import functools

import pytest
import torch

# Workers are spawned and import this module: it imports the registration of the
# domain, and the factories are at module level.
from torchrl.collectors import MultiSyncCollector
from torchrl.envs import DMControlEnv
from torchrl.modules import RandomPolicy

import cathsim_dmc.suite  # noqa: F401

MAX_STEPS = 12


def make_env(task, seed, **options):
    env = DMControlEnv("cathsim", task, max_steps=MAX_STEPS, **options)
    env.set_seed(seed)
    return env


@pytest.mark.slow
def test_spawned_workers_collect():
    factories = [
        functools.partial(make_env, "simple1_bca", seed, observation="image")
        for seed in (1, 2)
    ]
    env = factories[0]()
    first = env.reset()
    collector = MultiSyncCollector(
        factories,
        RandomPolicy(env.action_spec),
        frames_per_batch=32,
        total_frames=64,
        cat_results=0,
    )
    try:
        batches = list(collector)
    finally:
        collector.shutdown()
    assert [batch.numel() for batch in batches] == [32, 32]
    for batch in batches:
        assert batch["image"].shape[-3:] == first["image"].shape
        assert batch["next", "reward"].isfinite().all()
    # Episodes end by time, and go on with the next one.
    flat = torch.cat([batch.flatten() for batch in batches])
    assert (
        flat["next", "truncated"].sum() == 64 // 16
        and not flat["next", "terminated"].any()
    )
