"""Draws the image observations of a task for several options.

Writes docs/images/observation_views.png and endoluminal.png.
"""

import argparse
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from cathsim_dmc import suite
from cathsim_dmc.anatomy import phantoms
from cathsim_dmc.imaging import endoluminal as views

IMAGES = Path(__file__).parents[1] / "images"
TASK, SEED, STEPS = "type1_bca", 1, 60
# Options of the fluoroscopy and the shown observation, by title.
PANELS = {
    "AP": ({}, "image"),
    "LAO45": ({"view": "LAO45"}, "image"),
    "LATERAL": ({"view": "LATERAL"}, "image"),
    "RAO30": ({"view": "RAO30"}, "image"),
    "contrast off": ({"contrast": False}, "image"),
    "noise": ({"noise": True}, "image"),
    "noise, a quarter of the dose": ({"noise": True, "kerma": 6e-9}, "image"),
    "roadmap": ({"contrast": False, "roadmap": 0.7}, "image"),
    "biplane, first": ({"biplane": "LATERAL"}, "image"),
    "biplane, second": ({"biplane": "LATERAL"}, "image"),
    "(20, -25) degrees": ({"view": (20, -25)}, "image"),
    "magnified on the arch": (
        {"magnification": 2.5, "centre": (-0.01, 0, 0.06)},
        "image",
    ),
    "segmentation: device": ({}, "segmentation"),
    "segmentation: vessel": ({}, "segmentation"),
    "sequential, as colours": ({}, "sequential"),
    "tracking_2d on the image": ({}, "tracking_2d"),
}


def load(**options):
    return suite.load("cathsim", TASK, {"random": SEED, "goal_radius": 1e-3, **options})


def drive(env):
    """The last observation after a push with a bend, into the arch."""
    timestep = env.reset()
    action = np.zeros(env.action_spec().shape)
    for step in range(STEPS):
        action[-1] = 1.0
        action[1:20:2] = -0.1 if step > STEPS // 2 else 0.05
        timestep = env.step(action)
    return timestep.observation


def fluoroscopy() -> Path:
    figure = Figure(figsize=(9.6, 10.2), layout="constrained")
    axes = figure.subplots(4, 4)
    for axis, (title, (options, name)) in zip(axes.flat, PANELS.items(), strict=True):
        names = [name, "image"] if name == "tracking_2d" else name
        seen = drive(load(observation=names, fluoroscopy=options))
        picture = seen["image"] if name == "tracking_2d" else seen[name]
        channel = int("second" in title or "vessel" in title)
        if name != "sequential":
            picture = picture[..., channel]
        axis.imshow(picture, cmap="gray", vmin=0, vmax=255)
        if name == "tracking_2d":
            axis.plot(*seen["tracking_pixels"].reshape(-1, 2).T, ".", color="orange")
            axis.plot(*seen["tracking_goal_pixels"], "x", color="limegreen")
            axis.set_xlim(-0.5, 127.5), axis.set_ylim(127.5, -0.5)
        axis.set_title(title, fontsize=9)
        axis.set_axis_off()
    path = IMAGES / "observation_views.png"
    figure.savefig(path, dpi=100, pil_kwargs={"optimize": True})
    return path


def endoluminal() -> Path:
    """Draws endoluminal views along the route to the LCCA of `type3`, looking ahead."""
    anatomy = phantoms.load("type3")
    way = anatomy.route("lcca")
    figure = Figure(figsize=(10, 5.2), layout="constrained")
    axes = figure.subplots(2, 4)
    for column, share in zip(axes.T, (0.1, 0.3, 0.5, 0.65), strict=True):
        place = way.at(share * way.length)
        forward = place.tangent
        across = np.cross([0.0, 1.0, 0.0], forward)
        across /= np.linalg.norm(across)
        frame = np.stack([across, np.cross(forward, across), forward], axis=1)
        heads, still = place.position[None], [views.AT_REST]
        seen = views.views([anatomy.lumen], still, heads, frame[None], (256, 256))
        grey, distance = (each[0, ..., 0] for each in seen)
        column[0].imshow(grey, cmap="gray", vmin=0, vmax=255)
        far = column[1].imshow(1e3 * distance, cmap="viridis_r", vmin=0, vmax=130)
        column[0].set_title(f"{1e3 * share * way.length:.0f} mm from the inlet")
        column[0].set_axis_off(), column[1].set_axis_off()
    figure.colorbar(far, ax=axes[1], label="distance (mm)", shrink=0.8)
    path = IMAGES / "endoluminal.png"
    figure.savefig(path, dpi=70, pil_kwargs={"optimize": True})
    return path


def main() -> None:
    print(fluoroscopy())
    print(endoluminal())


if __name__ == "__main__":
    argparse.ArgumentParser(description=__doc__.splitlines()[0]).parse_args()
    main()
