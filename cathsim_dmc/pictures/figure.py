"""A scene as a matplotlib figure: anatomy, device, goal, contact forces."""

from typing import Any

import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import LinearSegmentedColormap, Normalize
from matplotlib.patches import Circle
from scipy.interpolate import CubicSpline

from cathsim_dmc.anatomy.centreline import arc_lengths
from cathsim_dmc.imaging.options import FluoroscopyOptions
from cathsim_dmc.pictures.anatomies import (
    GOAL_COLOUR,
    GOAL_LIGHT,
    LETTERING_IN,
    VIEWS,
    Picture,
    background,
    prepare,
)
from cathsim_dmc.pictures.moment import Moment, fluoroscope_of, on_screen, xray
from cathsim_dmc.pictures.translucent import Glass, ParallelProjection
from cathsim_dmc.recording.geometry import force_colours, force_text

DEVICE_COLOUR, DEVICE_LIGHT = "#173a63", "#7fb2e5"
# Dark and light colour of coaxial devices from the innermost outwards, repeated; the
# second pair is that of a single device.
DEVICES = (
    ("#0b6b5a", "#7fe0c8"),
    (DEVICE_COLOUR, DEVICE_LIGHT),
    ("#5b3a86", "#c3a4ee"),
)
HEAD_COLOUR = "#ffb000"
PATH_COLOUR = "#c77f00"
# Length of the arrow of the largest force, mm; weaker ones are in proportion, but not
# shorter than the second.
ARROW_MM, ARROW_LEAST_MM = 22.0, 5.0
# Below this, N, a contact is drawn as a dot without an arrow.
ARROW_LEAST_N = 1e-4
_PIECES = 6  # of the drawn curve in each link
# Percentiles of an image that are shown as black and white.
WINDOW = (0.02, 99.5)
_HEIGHT_IN = 6.0
# Largest width of a figure, inches: that of a scan that lies is lower instead, apart
# from titles, axes and caption.
_WIDEST_IN = 16.0


def force_map() -> LinearSegmentedColormap:
    """The colours of forces as a matplotlib colour map, for values in [0, 1]."""
    colours = force_colours(np.linspace(0, 1, 64), 1.0) / 255
    return LinearSegmentedColormap.from_list("cathsim_force", list(colours))


def scene_figure(
    moment: Moment,
    *,
    views: tuple[str, ...] = ("front", "left"),
    fluoroscopy: bool = True,
    pixels: int = 900,
) -> Picture:
    """Draw a moment of an episode, without OpenGL.

    Args:
        views: Names of views, see `anatomies.VIEWS`.
        fluoroscopy: Whether to draw the X-ray image beside the views.
        pixels: Length of the longer side of a view, pixels.

    Raises:
        ValueError: if a view does not exist, or there is nothing to draw.
    """
    unknown = [view for view in views if view not in VIEWS]
    if unknown or not (views or fluoroscopy):
        raise ValueError(f"views are {views!r}; give some of {', '.join(VIEWS)}")
    moved = moment.surface is not moment.rest
    draw = background.__wrapped__ if moved else background  # only the latter is cached
    drawn = [draw(moment.surface, v, pixels, moment.rest) for v in views]
    ratios = [p.shape[1] / p.shape[0] for p, _ in drawn] + [1.0] * fluoroscopy
    size = _HEIGHT_IN * 0.84 * sum(ratios) + 1.6, _HEIGHT_IN
    if size[0] > _WIDEST_IN:
        size = _WIDEST_IN, (_WIDEST_IN - 1.6) / sum(ratios) + LETTERING_IN
    figure = Picture(figsize=size, dpi=120, layout="constrained")
    panels = figure.subplots(1, len(ratios), width_ratios=ratios, squeeze=False)[0]
    for panel, view, (projection, seen) in zip(panels, views, drawn, strict=False):
        draw_scene(panel, moment, projection, seen)
        prepare(panel, projection, view, moment.upright)
    if views:
        scale = Normalize(0, 1e3 * moment.force_scale)
        beside = panels[: len(views)].tolist()
        figure.colorbar(
            ScalarMappable(scale, force_map()), ax=beside, shrink=0.55, pad=0.01,
            extend="max", label="contact force on the wall, mN",
        )  # fmt: skip
    if fluoroscopy:
        draw_fluoroscopy(panels[-1], moment)
    caption, magnitude = "no contact with the wall", moment.magnitude
    if count := len(magnitude):
        total, largest = force_text(magnitude.sum()), force_text(magnitude.max())
        caption = f"{count} contact{'s' * (count > 1)}, {total} in all, "
        caption += f"{largest} the largest"
    figure.suptitle(f"{moment.title}; {caption}", fontsize=11)
    return figure


def draw_scene(
    axes: Any, moment: Moment, projection: ParallelProjection, picture: Glass
) -> None:
    """Draw a moment into axes whose units are millimetres."""
    extent = projection.extent_mm
    axes.imshow(picture.behind, extent=extent, zorder=1, interpolation="bilinear")
    prepare(axes, projection, None)
    goal, radius = projection.flat_mm(moment.goal).tolist(), 1e3 * moment.goal_radius
    inside = {"fc": GOAL_COLOUR, "alpha": 0.22, "zorder": 2}
    for look in (inside, {"fill": False, "lw": 1.6, "zorder": 7}):
        axes.add_patch(Circle(goal, radius, ec=GOAL_COLOUR, **look))
    way = projection.flat_mm(moment.path)
    axes.plot(way[:, 0], way[:, 1], color=PATH_COLOUR, lw=0.9, zorder=3)
    _draw_device(axes, moment, projection)
    axes.imshow(picture.glaze, extent=extent, zorder=6, interpolation="bilinear")
    _draw_forces(axes, moment, projection)


def _draw_device(axes: Any, moment: Moment, projection: ParallelProjection) -> None:
    joints = np.asarray(moment.device, np.float64)
    way, last = arc_lengths(joints), len(joints) - 1
    fine = np.interp(np.linspace(0, last, last * _PIECES + 1), np.arange(last + 1), way)
    line = projection.flat_mm(CubicSpline(way, joints)(fine))
    # Half as thick again as in reality, which would be two points wide in print.
    height = 72.0 * axes.get_position().height * axes.figure.get_figheight()  # points
    width = 3e3 * np.repeat(moment.radius, _PIECES) * height / np.ptp(axes.get_ylim())
    pieces = np.stack([line[:-1], line[1:]], axis=1)
    dark, light = DEVICE_COLOUR, DEVICE_LIGHT
    if moment.outermost is not None:
        own = [DEVICES[number % len(DEVICES)] for number in moment.outermost]
        dark, light = ([pair[shade] for pair in own] for shade in (0, 1))
        dark, light = np.repeat(dark, _PIECES), np.repeat(light, _PIECES)
    for colour, share in (("white", 1.5), (dark, 1.0), (light, 0.35)):
        look = {"linewidths": share * width, "colors": colour, "capstyle": "round"}
        axes.add_collection(LineCollection(list(pieces), zorder=4, **look))
    for number, end in enumerate(projection.flat_mm(moment.ends)):
        look = {"ms": 1.3 * width.max(), "mfc": DEVICES[number % len(DEVICES)][1]}
        axes.plot(end[0], end[1], "o", **look, mec="0.1", mew=0.8, zorder=5)
    look = {"ms": 1.6 * width[-1], "mfc": HEAD_COLOUR}
    x, y = line[-1]
    axes.plot(x, y, "o", **look, mec="white", mew=0.8, zorder=5)


def _draw_forces(axes: Any, moment: Moment, projection: ParallelProjection) -> None:
    magnitude = moment.magnitude
    if not magnitude.any():
        return
    place = projection.flat_mm(moment.position)
    colours = force_colours(magnitude, moment.force_scale) / 255
    x, y = place.T
    axes.scatter(x, y, s=16, c=colours, edgecolors="0.15", linewidths=0.5, zorder=8)
    largest = max(magnitude.max(), ARROW_LEAST_N)
    strong = magnitude > ARROW_LEAST_N
    length = np.maximum(ARROW_MM * magnitude / largest, ARROW_LEAST_MM)
    unit = moment.force / np.maximum(magnitude, 1e-12)[:, None]
    along = projection.flat_mm(unit) / 1e3 * length[:, None]
    axes.quiver(
        x[strong], y[strong], along[strong, 0], along[strong, 1],
        color=colours[strong], angles="xy",
        scale_units="xy", scale=1, units="inches", width=0.037,
        edgecolor="0.15", linewidth=0.4, zorder=8,
    )  # fmt: skip
    top = int(magnitude.argmax())
    end = place[top] + (along[top] if strong[top] else 0)
    # Text to the right of the axes would be hidden by what is beside them.
    side, shift = ("right", -5) if end[0] > np.mean(axes.get_xlim()) else ("left", 5)
    box = {"boxstyle": "round,pad=0.15", "fc": "white", "ec": "none", "alpha": 0.75}
    axes.annotate(
        force_text(magnitude[top]), end, xytext=(shift, 4), ha=side, bbox=box, zorder=9,
        textcoords="offset points", fontsize=9, fontweight="bold", color="0.1",
    )  # fmt: skip


def draw_fluoroscopy(
    axes: Any,
    moment: Moment,
    options: FluoroscopyOptions | None = None,
    seed: int = 0,
    window: Any = None,
) -> Any:
    """Draw the X-ray image of a moment, with the goal as a ring.

    Args:
        options: Set-up of the C-arm; None takes the task's, zoomed in.
        window: Grey levels that are black and white; percentiles of the image if None.

    Returns:
        The window.
    """
    options = options or on_screen(moment.x_ray.options)
    frame, carm = xray(moment, options, seed), fluoroscope_of(moment, options).carm
    black, white = np.percentile(frame, WINDOW) if window is None else window
    axes.imshow(frame, cmap="gray", vmin=black, vmax=white, interpolation="bilinear")
    (column, row), depth = carm.project(moment.goal)
    radius = moment.goal_radius * carm.focal_length / float(depth)
    ring = Circle((column, row), radius, fill=False, ec=GOAL_LIGHT, lw=1.4)
    axes.add_patch(ring)
    axes.set_title("fluoroscopy", fontsize=10)
    axes.set_xticks([])
    axes.set_yticks([])
    axes.spines[:].set_visible(True)
    return black, white
