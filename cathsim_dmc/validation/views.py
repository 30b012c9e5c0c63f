"""Three views of an anatomy as a picture."""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure

from cathsim_dmc import style
from cathsim_dmc.anatomy import Anatomy

# Name, axis to the right, axis upwards or downwards, axis towards the reader or away.
VIEWS = (
    ("from the front", 0, (2, 1), (1, -1)),
    ("from the left", 1, (2, 1), (0, 1)),
    ("from below", 0, (1, -1), (2, -1)),
)
_AXES = ("x, to the left", "y, posterior", "z, superior")
_GOAL_RADIUS = 8.0  # mm, the published task's


def draw(anatomy: Anatomy, path: str | Path) -> None:
    """Draws lumen, centrelines, goals and inlet from three sides into a PNG."""
    figure = Figure(figsize=(13.5, 5.6), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(1, 3)
    for ax, view in zip(axes, VIEWS, strict=True):
        draw_view(ax, anatomy, view)
    names, labels = axes[0].get_legend_handles_labels()
    figure.legend(names, labels, fontsize=8, loc="outside lower center", ncols=7)
    figure.suptitle(anatomy.name)
    style.save(figure, path)


def draw_view(ax: Axes, anatomy: Anatomy, view: tuple = VIEWS[0]) -> None:
    """Draws one of the views, millimetres."""
    name, right, (up, sign), (out, towards) = view

    def flat(points: np.ndarray) -> np.ndarray:
        return 1e3 * points[..., [right, up]]

    corners = anatomy.surface.vertices[anatomy.surface.faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.maximum(np.linalg.norm(normal, axis=1), 1e-30)[:, None]
    # The far ones first, lit by how much they face the reader.
    order = np.argsort(towards * corners[:, :, out].mean(axis=1))
    order = order[towards * normal[order, out] > 0.0]
    light = 0.55 + 0.4 * np.abs(normal[order, out])
    look = {"facecolors": np.outer(light, [1.0, 0.86, 0.83]), "edgecolors": "face"}
    ax.add_collection(
        PolyCollection(list(flat(corners[order])), linewidths=0.3, **look)
    )
    for index, (vessel, branch) in enumerate(anatomy.tree.vessels.items()):
        line = flat(branch.centreline.points)
        colour = style.COLOURS[index % len(style.COLOURS)]
        ax.plot(*line.T, color=colour, lw=1.4, label=vessel)
        look = {"textcoords": "offset points", "fontsize": 6}
        ax.annotate(vessel, tuple(line[-1]), (2, 2), **look)
    for goal in anatomy.goals.values():
        place = flat(goal.position)
        angle = np.linspace(0.0, 2.0 * np.pi, 60)
        ring = place + _GOAL_RADIUS * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        ax.plot(*ring.T, color="#157a3c", lw=0.8)
        ax.plot(*place, ".", color="#157a3c", ms=4)
    inlet = flat(anatomy.inlet.position)
    way = flat(anatomy.inlet.position + 0.015 * anatomy.inlet.direction) - inlet
    arrow = {"arrowstyle": "->", "color": "k"}
    ax.annotate("", tuple(inlet + way), tuple(inlet - way), arrowprops=arrow)
    ax.set_aspect("equal")
    ax.autoscale_view()
    ax.set(xlabel=_AXES[right] + ", mm", ylabel=_AXES[up] + ", mm")
    if sign < 0:
        ax.invert_yaxis()
    ax.set_title(name, fontsize=10)
    style.tidy(ax)
    ax.grid(False)
