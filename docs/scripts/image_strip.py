"""`pretrained:navigator_image` reaches a left carotid artery from biplane images.

    python docs/scripts/image_strip.py

Writes docs/images/image_strip.png: the live images of both planes at six times of an
episode on the phantom `type2`, entered in the descending aorta. The dashed line is the
policy's route, with the errors of its roadmaps; the ring is the goal. Needs no OpenGL.
"""

import argparse
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from cathsim_dmc.agents.policies import load_policy  # isort: skip
from cathsim_dmc import policies, suite
from cathsim_dmc.agents import protocols
from cathsim_dmc.simulation.episodes import play_alone

OUTPUT = Path(__file__).parents[1] / "images" / "image_strip.png"
POLICY, SEED, MOMENTS = "pretrained:navigator_image", 12, 6
WHERE = {"anatomy": "type2", "goal": "lcca", "access": "descending"}


def main() -> None:
    """Plays the episode and draws the figure."""
    policy = load_policy(POLICY)
    assert not isinstance(policy.observation, str) and policy.observation is not None
    options = {
        **WHERE, "fluoroscopy": (policy.task_kwargs or {})["fluoroscopy"],
        "observation": [*policy.observation, "image"], "max_steps": 1000,
        "randomisation": protocols.VARIED_RANGES, "random": SEED,
    }  # fmt: skip
    env = suite.load("cathsim", "navigate", task_kwargs=options)
    task, frames = env.task, []
    for _, timestep in play_alone(env, policies.in_environment(policy, env)):
        insertion, force = 1e3 * task.readings.insertion, task.wall_force.mean_sum
        memory = task.rollout.memory
        state = "withdraws" if memory.retracting[0] else "advances"
        title = f"{env.physics.time():.1f} s, {float(insertion):.0f} mm in, {state}\n"
        title += f"{1e3 * float(force):.0f} mN, {int(memory.attempts[0])} retries"
        frames.append((title, np.array(timestep.observation["image"])))
    sensors = task.rollout._sensors
    route = sensors.sight._routes[0].points
    figure = Figure(figsize=(12, 4.6), layout="constrained")
    axes = figure.subplots(2, MOMENTS)
    chosen = np.linspace(0, len(frames) - 1, MOMENTS).round().astype(int)
    for plane, (row, fluoroscope) in enumerate(
        zip(axes, sensors.planes[0], strict=True)
    ):
        arm = fluoroscope.carm
        goal, depth = arm.project(task.goal_position)
        radius = task.objective.goal_radius * arm.focal_length / depth
        line = arm.project(route)[0]
        middle, half = line.mean(axis=0), np.ptp(line, axis=0).max() / 2 + 6
        for axis, index in zip(row, chosen, strict=True):
            title, image = frames[index]
            axis.imshow(image[..., plane], cmap="gray", vmin=0, vmax=255)
            axis.plot(*line.T, "--", color="tab:orange", linewidth=0.8)
            axis.add_patch(Circle(goal, radius, fill=False, color="limegreen"))
            axis.set(xlim=middle[0] + [-half, half], ylim=middle[1] + [half, -half])
            axis.set_axis_off()
            if plane == 0:
                axis.set_title(title, fontsize=8)
    figure.savefig(OUTPUT, dpi=80, pil_kwargs={"optimize": True})
    size = OUTPUT.stat().st_size / 1000
    print(f"{OUTPUT} ({size:.0f} kB): {task.termination} after {len(frames) - 1} steps")


if __name__ == "__main__":
    argparse.ArgumentParser(description=__doc__.splitlines()[0]).parse_args()
    main()
