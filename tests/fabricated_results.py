"""Files of finished cells with made-up figures, for the page of results."""

import numpy as np
import trainings


def values(task, label, algorithm, observation, seed, rate, episodes=30):
    """Values of a file: success rises from 0 to `rate`."""
    random = np.random.default_rng(seed)
    frames = np.linspace(2048, 409_600, 200).astype(int).tolist()
    success = (rate / (1 + np.exp(-(np.array(frames) - 1.5e5) / 2e4))).tolist()
    name = f"{task}-{algorithm}-{observation}-tuned-seed{seed}"
    rows = [
        {"frames": f, "seconds": f / 100, "episodes": f // 100, "success": s}
        for f, s in zip(frames, success, strict=True)
    ]
    reached = round(rate * episodes)
    force = {"mean": {"mean": 0.01, "sd": 0.002}}
    columns = {
        "reward": (-20 - 5 * random.random(episodes)).tolist(),
        "length": random.integers(80, 200, episodes).tolist(),
        "success": [1] * reached + [0] * (episodes - reached),
        "mean_force": (0.02 + 0.003 * random.random(episodes)).tolist(),
        "mean_contact_force": (0.01 + 0.003 * random.random(episodes)).tolist(),
        "max_force": (0.05 + 0.1 * random.random(episodes)).tolist(),
    }
    count = random.integers(0, 20, (97, 51))
    field = {
        "x": [-0.05, 0.052],
        "z": [-0.16, 0.034],
        "shape": [97, 51],
        "index": np.flatnonzero(count > 18).tolist(),
        "mean": (0.02 * random.random((count > 18).sum())).tolist(),
        "count": count[count > 18].tolist(),
        "outside": 0,
    }
    return {
        "format": trainings.FORMAT,
        "cell": {
            "name": name, "label": label, "task": task, "algorithm": algorithm,
            "preset": "tuned", "observation": observation, "seed": seed,
            "total_frames": 400_000, "settings": {}, "variant": "", "evaluation": {},
        },
        "config": {"algorithm": algorithm, "seed": seed},
        "training": {
            "frames": 409_600, "seconds": 4096.0, "solved": trainings.solved(rows),
            "curve": trainings.learning_curve(rows), "sessions": [], "load": 2.1,
        },
        "evaluation": {
            "task": task, "seed": 1_000_000, "seconds": 60.0,
            "summary": {
                "episodes": episodes, "success": reached / episodes,
                "success_ci95": [0.8, 1.0], "forces": {"sum": force, "max": force},
            },
            "episodes": columns,
            "force_map": field,
        },
        "versions": {"python": "3.11.7"},
        "machine": {"cores": 2, "processor": "made up"},
        "finished": "2026-11-22T05:00:00+00:00",
        "commit": "0123456789abcdef",
        "modified": False,
    }  # fmt: skip


def write(directory, *arguments, **options):
    """Writes a file; returns its path."""
    made = values(*arguments, **options)
    path = directory / f"{made['cell']['name']}.json"
    return trainings.write_result(path, made)
