"""How figures look: one set of colours and of axes for all of them."""

from typing import Any

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
    """Leaves matplotlib's axes the two sides that carry scales, and a faint grid."""
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(True, color="0.9", linewidth=0.6)
    axes.set_axisbelow(True)
