"""Pictures of coaxial devices: a Simmons catheter reforms, a pair cannulates a carotid.

    python docs/scripts/pair_strip.py [SCAN]

Writes docs/images/pair_simmons.png and docs/images/pair_cannulation.png. With the
directory of an imported scan it writes only docs/images/pair_vertebral.png, in which
the learnt policy enters the left vertebral artery. Needs no OpenGL; the same seeds give
the same pictures.
"""

import argparse
import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.lines import Line2D

from cathsim_dmc import policies, suite
from cathsim_dmc.agents.policies import load_policy
from cathsim_dmc.pictures.anatomies import Picture, background
from cathsim_dmc.pictures.figure import DEVICES, draw_scene
from cathsim_dmc.pictures.moment import Moment
from cathsim_dmc.simulation.episodes import play_alone

IMAGES = Path(__file__).parents[1] / "images"
DPI, HEIGHT = 130, 3.2
BELOW = 0.18  # lower share of the picture that is left out
SIMMONS = ("wire_035_amplatz", "diagnostic_5f_simmons")


def simmons() -> list[Moment]:
    """Moments in which a stiff wire straightens a Simmons catheter and is withdrawn."""
    env = suite.load(
        "cathsim",
        "type1_lcca_pair",
        {"devices": SIMMONS, "lead": 0.01, "random": 0, "goal_radius": 1e-4},
    )
    env.reset()
    seen = []
    # Both advance, then the wire alone is withdrawn.
    for wire, catheter, steps in (
        (0.6, 0.6, 75), (-0.6, 0.0, 25), (-0.6, 0.0, 20), (-0.6, 0.0, 20),
        (-0.6, 0.0, 45),
    ):  # fmt: skip
        for _ in range(steps):
            env.step(np.array([wire, 0.0, catheter, 0.0]))
        back = np.diff(env.task.devices.insertion)[0]
        where = "ahead" if back < 0 else "behind"
        seen.append(_titled(env, f"wire {1e3 * abs(back):.0f} mm {where}"))
    env.close()
    return seen


def cannulation(
    task: str = "femoral_type1_lcca_pair", policy: str = "expert", **options: Any
) -> list[Moment]:
    """Moments of an episode of a policy that drives both devices into a branch."""
    player = load_policy(policy)
    options = {"random": 0, "observation": player.observation, **options}
    env = suite.load("cathsim", task, options)
    act = policies.in_environment(player, env)
    seen = []
    for _ in play_alone(env, act):
        wire, catheter = 1e3 * env.task.devices.insertion
        words = f"{env.physics.time():.0f} s: {wire:.0f} and {catheter:.0f} mm"
        seen.append(_titled(env, words))
    print(f"{task}: {env.task.termination} after {len(seen) - 1} steps")
    env.close()
    return seen


def _titled(env, words: str) -> Moment:
    """The current state without contact forces, which would hide small shapes."""
    nothing = np.zeros((0, 3))
    return dataclasses.replace(
        Moment.of(env), title=words, position=nothing, force=nothing
    )


def last(seen: Sequence[Moment], way: float = 1.0, moments: int = 6) -> list[Moment]:
    """Moments in which the head is within `way`, m, of its last position."""
    heads = np.array([one.device[-1] for one in seen])
    far = np.linalg.norm(heads - heads[-1], axis=1) > way
    first = np.flatnonzero(far)[-1] + 1 if far.any() else 0
    chosen = np.linspace(first, len(seen) - 1, moments).round().astype(int)
    return [seen[index] for index in chosen]


def strip(
    snapshots: Sequence[Moment], path: Path, view: str = "front", around: float = 0.0
) -> None:
    """Draws snapshots side by side; `around`, m, crops them around the last head."""
    size = 3600 if around else 700
    projection, picture = background(snapshots[0].surface, view, size)
    left, right, low, high = projection.extent_mm
    low += BELOW * (high - low)
    if around:
        x, y = projection.flat_mm(snapshots[-1].device[-1])
        left, right = x - 300.0 * around, x + 1e3 * around
        low, high = y - 400.0 * around, y + 400.0 * around
    width = HEIGHT * (right - left) / (high - low)
    figure = Picture(
        figsize=(width * len(snapshots), HEIGHT + 0.5), dpi=DPI, layout="constrained"
    )
    panels = figure.subplots(1, len(snapshots), squeeze=False)[0]
    for panel, snapshot in zip(panels, snapshots, strict=True):
        draw_scene(panel, snapshot, projection, picture)
        panel.set_title(snapshot.title, fontsize=9)
        panel.set_xlim(left, right)
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
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scan", nargs="?", help="directory of an imported scan")
    if scan := parser.parse_args().scan:
        options = {
            "anatomy": scan,
            "goal": "lva",
            "devices": suite.COAXIAL["pair"][0],
        }
        seen = cannulation("navigate", "pretrained:navigator_pair", **options)
        path = IMAGES / "pair_vertebral.png"
        strip(last(seen, 0.06, 4), path, "below", around=0.08)
        return
    strip(simmons(), IMAGES / "pair_simmons.png")
    strip(last(cannulation()), IMAGES / "pair_cannulation.png")


if __name__ == "__main__":
    main()
