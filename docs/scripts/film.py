"""The moving picture of the README: the expert cannulates a carotid from the groin.

Writes docs/images/cannulation.webp from an episode of the task `femoral_type1_lcca`.
Needs no OpenGL; the same seed gives the same film.
"""

from __future__ import annotations

from pathlib import Path

import cathsim_dmc
from cathsim_dmc import suite
from cathsim_dmc.pictures.animation import animate

OUTPUT = Path(__file__).parents[1] / "images" / "cannulation.webp"
TASK, POLICY, SEED = "femoral_type1_lcca", "expert", 3
LIMIT = 3_000_000  # bytes


def main() -> None:
    env = suite.load("cathsim", TASK)
    episode = cathsim_dmc.record(env, POLICY, seed=SEED)
    if not episode.success:
        raise RuntimeError(f"{POLICY} did not reach the goal of {TASK}, seed {SEED}")
    surface = env.task.scene.anatomy.surface
    animate(episode, surface, OUTPUT, frames=72, width=780, quality=72)
    size = OUTPUT.stat().st_size
    if size > LIMIT:
        raise RuntimeError(f"{OUTPUT.name} has {size} bytes, more than {LIMIT}")
    print(f"{OUTPUT}: {size / 1e6:.2f} MB, {episode.steps} steps")


if __name__ == "__main__":
    main()
