"""Style of all figures: one set of colours and axes."""

from pathlib import Path
from typing import Any

from cathsim_dmc.files import atomic_path, require_file

# Okabe and Ito's colours, which the colour-blind can tell apart, and print in grey as
# different shades: blue, vermilion, green, purple, orange, light blue, black, grey.
COLOURS = (
    "#0072B2",
    "#D55E00",
    "#009E73",
    "#CC79A7",
    "#E69F00",
    "#56B4E9",
    "#000000",
    "#999999",
)


def tidy(axes: Any) -> None:
    """Hides the top and right side of matplotlib axes and draws a faint grid."""
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(True, color="0.9", linewidth=0.6)
    axes.set_axisbelow(True)


def save(figure: Any, path: str | Path, dpi: int = 110) -> None:
    """Writes a matplotlib figure as PNG, whole or not at all."""
    require_file(path, make=True)
    figure.set_dpi(dpi)
    if layout := figure.get_layout_engine():
        # Applied once: an active layout engine makes matplotlib draw twice.
        layout.execute(figure)
        figure.set_layout_engine("none")
    with atomic_path(path) as temporary:
        figure.savefig(temporary, dpi=dpi, format="png")
