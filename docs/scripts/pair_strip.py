"""Two devices at work: a Simmons catheter reforms, and a pair cannulates a carotid.

    python docs/scripts/pair_strip.py

Writes docs/images/pair_simmons.png and docs/images/pair_cannulation.png. Needs no
OpenGL; the same seeds give the same pictures.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.lines import Line2D

from cathsim_dmc import policies, suite
from cathsim_dmc.pictures.figure import DEVICES, Picture, background, draw_scene
from cathsim_dmc.pictures.moment import Moment

IMAGES = Path(__file__).parents[1] / "images"
DPI, HEIGHT = 130, 3.2
BELOW = 0.18  # share of the picture below which nothing happens
SIMMONS = ("wire_035_amplatz", "diagnostic_5f_simmons")


def simmons() -> list[Moment]:
    """A stiff wire straightens a Simmons catheter in the arch; then it is withdrawn."""
    env = suite.load(
        "cathsim",
        "type1_lcca_pair",
        {"devices": SIMMONS, "lead": 0.01, "random": 0, "goal_radius": 1e-4},
    )
    env.reset()
    seen = []
    for push, steps in (((0.6, 0.6), 75), ((-0.6, 0.0), 25), ((-0.6, 0.0), 20)) + (
        ((-0.6, 0.0), 20),
        ((-0.6, 0.0), 45),
    ):
        for _ in range(steps):
            env.step(np.array([push[0], 0.0, push[1], 0.0]))
        back = np.diff(env.task.devices.insertion)[0]
        where = "ahead" if back < 0 else "behind"
        seen.append(_titled(env, f"wire {1e3 * abs(back):.0f} mm {where}"))
    env.close()
    return seen


def cannulation(
    task: str = "femoral_type1_lcca_pair", seed: int = 0, moments: int = 6
) -> list[Moment]:
    """The scripted expert drives both devices from the groin into a carotid."""
    env = suite.load("cathsim", task, {"random": seed, "observation": "tracking"})
    act = policies.in_environment(policies.make_policy("expert"), env)
    timestep, seen = env.reset(), []
    while True:
        wire, catheter = 1e3 * env.task.devices.insertion
        words = f"{env.physics.time():.0f} s: {wire:.0f} and {catheter:.0f} mm"
        seen.append(_titled(env, words))
        if timestep.last():
            break
        timestep = env.step(act(timestep))
    print(f"{task}, seed {seed}: {env.task.termination} after {len(seen) - 1} steps")
    env.close()
    chosen = np.linspace(0, len(seen) - 1, moments).round().astype(int)
    return [seen[index] for index in chosen]


def _titled(env, words: str) -> Moment:
    """The present state without contact forces, which would hide the small shapes."""
    nothing = np.zeros((0, 3))
    return dataclasses.replace(
        Moment.of(env), title=words, position=nothing, force=nothing
    )


def strip(snapshots: Sequence[Moment], path: Path) -> None:
    """Draws snapshots of one anatomy side by side, from the front."""
    projection, picture = background(snapshots[0].surface, "front", 700)
    left, right, low, high = projection.extent_mm
    low += BELOW * (high - low)
    width = HEIGHT * (right - left) / (high - low)
    figure = Picture(
        figsize=(width * len(snapshots), HEIGHT + 0.5), dpi=DPI, layout="constrained"
    )
    panels = figure.subplots(1, len(snapshots), squeeze=False)[0]
    for panel, snapshot in zip(panels, snapshots, strict=True):
        draw_scene(panel, snapshot, projection, picture)
        panel.set_title(snapshot.title, fontsize=9)
        panel.set_ylim(low, high)
        panel.set_axis_off()
    names = ("guidewire", "catheter")
    lines = [
        Line2D([], [], color=dark, lw=3, label=name)
        for name, (dark, _) in zip(names, DEVICES, strict=False)
    ]
    figure.legend(handles=lines, loc="outside lower center", ncols=2, frameon=False)
    figure.savefig(path, pil_kwargs={"optimize": True})
    print(f"{path.name}: {path.stat().st_size / 1e3:.0f} kB")


def main() -> None:
    strip(simmons(), IMAGES / "pair_simmons.png")
    strip(cannulation(), IMAGES / "pair_cannulation.png")


if __name__ == "__main__":
    main()
