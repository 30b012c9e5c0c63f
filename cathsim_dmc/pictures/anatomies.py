"""An anatomy as a matplotlib figure: lumen, centrelines, goals and inlet."""

import functools
import io
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from cathsim_dmc.anatomy import Anatomy
from cathsim_dmc.anatomy.scan.aorta import is_upright
from cathsim_dmc.pictures.translucent import Glass, ParallelProjection, glass
from cathsim_dmc.style import COLOURS, tidy

_X, _Y = "x, mm (patient's left →)", "y, mm (towards the back →)"
_Z, _BELOW = "z, mm (head ↑)", "-y, mm (towards the front ↑)"
# By name: title, axes of the picture in the world, and their labels.
VIEWS = {
    "front": ("from the front", (1.0, 0.0, 0.0), (0.0, 0.0, 1.0), _X, _Z),
    "left": ("from the left", (0.0, 1.0, 0.0), (0.0, 0.0, 1.0), _Y, _Z),
    "below": ("from below", (1.0, 0.0, 0.0), (0.0, -1.0, 0.0), _X, _BELOW),
}
# Colours of vessels: those of all figures, then those of matplotlib's maps Dark2, tab10
# and tab20b that differ most from them and from the wall.
VESSEL_COLOURS = (*COLOURS, "#66a61e", "#e7298a", "#8c564b", "#9467bd", "#d62728")
VESSEL_COLOURS += ("#a6761d", "#393b79")
_COLUMNS = 7  # of the legend
_GOAL_RADIUS_MM = 8.0  # the published task's
GOAL_COLOUR, GOAL_LIGHT = "#12805c", "#5fd7ac"
LETTERING_IN = 1.2  # height of titles, axis labels and a caption, inches


class Picture(Figure):
    """A figure in the style of `cathsim_dmc.style`, which notebooks show."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        """As `matplotlib.figure.Figure`, on the canvas that needs no screen."""
        super().__init__(*args, **kwargs)
        self.agg = FigureCanvasAgg(self)

    def subplots(self, *args: Any, **kwargs: Any) -> Any:
        """As `matplotlib.figure.Figure.subplots`, in the shared style."""
        made = super().subplots(*args, **kwargs)
        for axes in np.ravel(made):
            axes.set_prop_cycle(color=COLOURS)
            tidy(axes)
        return made

    def _repr_png_(self) -> bytes:
        stream = io.BytesIO()
        self.savefig(stream, format="png")
        return stream.getvalue()


@functools.lru_cache(maxsize=16)
def background(
    surface: Any, view: str, size: int, rest: Any = None
) -> tuple[ParallelProjection, Glass]:
    """Draws a vessel as glass, `size` pixels long, in a view centred on `rest`."""
    _, right, up, *_ = VIEWS[view]
    middle = (rest or surface).vertices
    projection = ParallelProjection.of(middle, right, up, size=size)
    return projection, glass(surface, projection)


def anatomy_figure(anatomy: Anatomy) -> Picture:
    """Draw lumen, centrelines, goals and inlet of an anatomy from three sides.

    The sides of a scan are not named unless it is known to be upright.
    """
    x, y, z = np.ptp(anatomy.surface.vertices, axis=0)
    heights = np.array([z, z, y])
    size, rows, ratios = (13.5, 5.6), 1, None
    if max(x, y) > 2 * z:  # a scan that lies: wide views one above the other
        tall = 13.5 * float(heights.sum() / max(x, y))
        size, rows, ratios = (13.5, tall + 3 * LETTERING_IN), 3, heights
    figure = Picture(figsize=size, layout="constrained")
    panels = figure.subplots(rows, 3 // rows, height_ratios=ratios)
    for axes, view in zip(panels, VIEWS, strict=True):
        draw_anatomy(axes, anatomy, view)
    lines = figure.axes[0].get_legend_handles_labels()[0]
    # matplotlib fills a legend by columns, and it is read by rows.
    rows = [line for column in range(_COLUMNS) for line in lines[column::_COLUMNS]]
    place = {"loc": "outside lower center", "ncols": _COLUMNS}
    figure.legend(handles=rows, fontsize=8, **place)
    figure.suptitle(anatomy.name + ": axes of the scan" * (not is_upright(anatomy)))
    return figure


def draw_anatomy(axes: Any, anatomy: Anatomy, view: str = "front") -> None:
    """Draw an anatomy into axes whose units are millimetres."""
    projection, picture = background(anatomy.surface, view, 450)
    prepare(axes, projection, view, is_upright(anatomy))
    axes.imshow(picture.behind, extent=projection.extent_mm, interpolation="bilinear")
    for number, (name, vessel) in enumerate(anatomy.tree.vessels.items()):
        line = projection.flat_mm(vessel.centreline.points)
        colour = VESSEL_COLOURS[number % len(VESSEL_COLOURS)]
        axes.plot(line[:, 0], line[:, 1], color=colour, lw=1.4, label=name)
        axes.annotate(name, line[-1], (2, 2), textcoords="offset points", fontsize=6)
    for goal in anatomy.goals.values():
        place = projection.flat_mm(goal.position).tolist()
        reach = min(_GOAL_RADIUS_MM, 1e3 * anatomy.goal_room(goal))
        ring = Circle(place, reach, fill=False, ec=GOAL_COLOUR, lw=0.8)
        axes.add_patch(ring)
        axes.plot(place[0], place[1], ".", color=GOAL_COLOUR, ms=4)
    inlet = anatomy.inlet
    ends = inlet.position + np.outer((0.015, -0.015), inlet.direction)
    arrow = {"arrowstyle": "->", "color": "k"}
    head, tail = projection.flat_mm(ends)
    axes.annotate("", head, tail, arrowprops=arrow)


def prepare(
    axes: Any, projection: ParallelProjection, view: str | None, upright: bool = True
) -> None:
    """Give axes the limits of a projection, and the title and labels of a view."""
    axes.set_xlim(projection.extent_mm[:2])
    axes.set_ylim(projection.extent_mm[2:])
    axes.set_aspect("equal")
    axes.set_facecolor("white")
    tidy(axes)
    axes.grid(False)
    if view is not None:
        title, _, _, xlabel, ylabel = VIEWS[view]
        if not upright:  # sides of the patient are not known
            xlabel, ylabel = (text.partition(" (")[0] for text in (xlabel, ylabel))
            title = f"{xlabel[:-4]} and {ylabel[:-4]}"
        axes.set(xlabel=xlabel, ylabel=ylabel)
        axes.set_title(title, fontsize=10)
