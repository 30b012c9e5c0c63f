"""Fluoroscopy of a type-I arch with a catheter in the left common carotid artery.

Writes docs/images/fluoroscopy_views.png: the four named views at 128 x 128, and
below, contrast off, roadmap, segmentation, and a 512 x 512 image of the tip.
"""

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from scipy.ndimage import gaussian_filter1d

from cathsim_dmc.anatomy.arch.arch import ARCHES, arch_tree
from cathsim_dmc.anatomy.surface import lumen_surface
from cathsim_dmc.imaging.carm import VIEWS, CArm
from cathsim_dmc.imaging.device import Shadow
from cathsim_dmc.imaging.fluoroscopy import Fluoroscope
from cathsim_dmc.imaging.options import DETECTOR_SIZE

OUTPUT = Path(__file__).parents[1] / "images" / "fluoroscopy_views.png"
CATHETER_RADIUS = 0.84e-3  # 5F
LINK_LENGTH = 7e-3


def catheter(tree) -> np.ndarray:
    """Joints (n, 3), m, of a catheter along the middle of the vessels, base to tip."""
    route = tree.route("aorta", "lcca", 0.03).resampled(0.5e-3)
    # The catheter is straight before the inlet; the filter models its stiffness.
    first = route.points[1] - route.points[0]
    first /= np.linalg.norm(first)
    outside = route.points[0] - first * np.arange(0.06, 0.0, -0.5e-3)[:, None]
    line = gaussian_filter1d(
        np.concatenate([outside, route.points]), 28, axis=0, mode="nearest"
    )
    step = round(LINK_LENGTH / 0.5e-3)
    return line[::-1][::step][::-1]


def views(tree, surface) -> dict[str, np.ndarray]:
    """Images by title, (rows, columns) or (rows, columns, 3) uint8."""
    points = catheter(tree)
    device = [Shadow(points, CATHETER_RADIUS)]
    images = {}
    for name in VIEWS:
        carm = CArm.view(name, detector_size=DETECTOR_SIZE).centred_on(surface.vertices)
        scope = Fluoroscope.from_surface(surface, carm)
        images[name] = scope.render(device, np.random.RandomState(0))

    carm = CArm.view("LAO45", detector_size=DETECTOR_SIZE).centred_on(surface.vertices)
    scope = Fluoroscope.from_surface(surface, carm)
    live = replace(scope, contrast=0.0)
    road = replace(live, roadmap=0.7)
    images["LAO45, contrast off"] = live.render(device, np.random.RandomState(1))
    images["LAO45, roadmap"] = road.render(device, np.random.RandomState(2))
    coloured = live.render(device).repeat(3, axis=-1) // 2 + 100
    coloured[scope.vessel_mask] = (140, 170, 220)
    coloured[scope.device_mask(device)] = (200, 30, 30)
    images["LAO45, masks"] = coloured

    close = CArm.view("LAO45", magnification=2.5, resolution=(512, 512))
    close = replace(close, isocentre=tuple(points[-5]))
    scope = Fluoroscope.from_surface(surface, close, kerma=100e-9)
    images["LAO45, 2.5x, 512 x 512"] = scope.render(device, np.random.RandomState(3))
    return images


def main() -> None:
    tree = arch_tree(ARCHES["simple1"])
    images = views(tree, lumen_surface(tree))
    figure = Figure(figsize=(9.6, 5.1), layout="constrained")
    axes = figure.subplots(2, 4)
    for axis, (title, image) in zip(axes.flat, images.items(), strict=True):
        axis.imshow(image.squeeze(), cmap="gray", vmin=0, vmax=255)
        axis.set_title(title, fontsize=9)
        axis.set_axis_off()
    figure.savefig(OUTPUT, dpi=100, pil_kwargs={"optimize": True})
    print(f"{OUTPUT} ({OUTPUT.stat().st_size / 1000:.0f} kB)")


if __name__ == "__main__":
    argparse.ArgumentParser(description=__doc__.splitlines()[0]).parse_args()
    main()
