"""Fluoroscopy of a cannulation of the left common carotid artery.

Writes docs/images/cannulation_strip.png: the scripted expert in the task `type1_lcca`
at six times, above in AP with the vessel as a roadmap, below in LAO 45 with contrast;
the ring is the goal. Needs no OpenGL.
"""

import argparse
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from cathsim_dmc import policies, suite
from cathsim_dmc.imaging import angiograph as machines
from cathsim_dmc.imaging.angiograph import Angiograph
from cathsim_dmc.imaging.device import Shadow
from cathsim_dmc.imaging.options import FluoroscopyOptions
from cathsim_dmc.simulation.episodes import play_alone

OUTPUT = Path(__file__).parents[1] / "images" / "cannulation_strip.png"
TASK, SEED, MOMENTS = "type1_lcca", 3, 6
ROWS = {
    "AP, roadmap": FluoroscopyOptions(
        view="AP", size=256, contrast=False, roadmap=0.6, kerma=1e-7
    ),
    "LAO 45, contrast": FluoroscopyOptions(view="LAO45", size=256, kerma=1e-7),
}


def run() -> tuple[object, list[dict]]:
    """The task, and the state of the device at every control step."""
    env = suite.load("cathsim", TASK, task_kwargs={"random": SEED})
    act = policies.in_environment(policies.make_policy("expert"), env)
    task, states = env.task, []
    for _ in play_alone(env, act):
        states.append(
            {
                "time": env.physics.time(),
                "line": task.readings.centreline,
                "insertion": float(task.readings.insertion),
                "force": float(task.wall_force.mean_max),
            }
        )
    return task, states


def main() -> None:
    task, states = run()
    surface, random = task.scene.anatomy.surface, np.random.RandomState(0)
    chosen = np.linspace(0, len(states) - 1, MOMENTS).round().astype(int)
    figure = Figure(figsize=(12, 4.5), layout="constrained")
    axes = figure.subplots(len(ROWS), MOMENTS)
    for number, (title, options) in enumerate(ROWS.items()):
        row = axes[number]
        planes = Angiograph(surface, options).planes()
        carm = planes[0].carm
        goal, depth = carm.project(task.goal_position)
        radius = task.objective.goal_radius * carm.focal_length / depth
        for axis, index in zip(row, chosen, strict=True):
            state = states[index]
            device = Shadow(
                state["line"][None], task.scene.catheter.device.outer_radius
            )
            image = machines.images([planes], [device], [random])[0]
            axis.imshow(image[..., 0], cmap="gray", vmin=0, vmax=255)
            axis.add_patch(Circle(goal, radius, fill=False, color="limegreen"))
            axis.set_axis_off()
            if number == 0:
                axis.set_title(
                    f"{state['time']:.1f} s, {state['insertion'] * 1e3:.0f} mm in, "
                    f"{state['force']:.2f} N",
                    fontsize=8,
                )
        row[0].text(250, 246, title, ha="right", fontsize=8)
    figure.savefig(OUTPUT, dpi=100, pil_kwargs={"optimize": True})
    size = OUTPUT.stat().st_size / 1000
    print(f"{OUTPUT} ({size:.0f} kB): {task.termination} after {len(states) - 1} steps")


if __name__ == "__main__":
    argparse.ArgumentParser(description=__doc__.splitlines()[0]).parse_args()
    main()
