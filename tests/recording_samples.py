"""Made-up episodes for the tests of recording and analysis."""

import numpy as np

from cathsim_dmc.anatomy.parts import Surface
from cathsim_dmc.recording.episode import Episode


def make_episode(steps=6, links=4, actions=21, seed=0, counts=None, **changes):
    rng = np.random.default_rng(seed)
    if counts is None:
        counts = rng.integers(0, 4, steps)
    contact_step = np.repeat(np.arange(steps), counts)
    force = rng.normal(size=(len(contact_step), 3))
    magnitude = np.linalg.norm(force, axis=1)
    largest = np.zeros(steps)
    np.maximum.at(largest, contact_step, magnitude)
    quaternion = rng.normal(size=(steps + 1, 3, 4))
    quaternion /= np.linalg.norm(quaternion, axis=-1, keepdims=True)
    values = {
        "task": "type1_bca",
        "seed": seed,
        "meta": {"success": True, "termination": "success"},
        "time": 0.04 * np.arange(steps + 1),
        "qpos": rng.normal(size=(steps + 1, 9)),
        "catheter": rng.normal(size=(steps + 1, links + 1, 3)),
        "body_pos": rng.normal(size=(steps + 1, 3, 3)),
        "body_quat": quaternion,
        "action": rng.uniform(-1, 1, (steps, actions)),
        "reward": rng.normal(size=steps),
        "insertion": np.linspace(0, 0.1, steps + 1),
        "wall_force_sum": np.bincount(contact_step, magnitude, minlength=steps),
        "wall_force_max": largest,
        "push_force": rng.normal(size=steps),
        "contact_step": contact_step,
        "contact_position": rng.normal(size=force.shape),
        "contact_force": force,
    }
    return Episode(**{**values, **changes})


def same(one, other):
    """Whether two episodes hold the same values, bit for bit."""
    pairs = zip(vars(one).values(), vars(other).values(), strict=True)
    return all(np.array_equal(a, b) for a, b in pairs)


def make_tube(radius=0.02, length=0.08, sides=12, rings=5):
    """Surface of an open tube along z about the origin."""
    angle = np.linspace(0, 2 * np.pi, sides, endpoint=False)
    ring = radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    height = np.linspace(-length / 2, length / 2, rings)
    vertices = np.concatenate(
        [np.column_stack([ring, np.full(sides, z)]) for z in height]
    )
    a = (np.arange(rings - 1)[:, None] * sides + np.arange(sides)).ravel()
    b = a - a % sides + (a + 1) % sides
    faces = np.concatenate(
        [np.stack([a, b, b + sides], 1), np.stack([a, b + sides, a + sides], 1)]
    )
    return Surface(vertices, faces)
