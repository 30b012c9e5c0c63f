"""How a recorded episode is laid out in the Rerun viewer."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import rerun.blueprint as rrb

TIMELINE_TIME = "sim_time"
TIMELINE_STEP = "step"

# Distance of the eye in extents of the scene: the viewer's vertical field of view
# is near 45 degrees, which shows 0.83 of the distance.
EYE_DISTANCE = 1.35


def episode_blueprint(
    centre: Sequence[float], extent: float, *, fluoroscopy: bool, distance: bool
) -> rrb.Blueprint:
    """Return the layout: scene on the left, series on the right.

    Args:
        centre: (3,) point the eye looks at, world frame (LPS), metres.
        extent: Largest side of the scene in metres.
        fluoroscopy: Whether the recording has the ``fluoroscopy`` entity.
        distance: Whether the recording has ``series/distance_mm``.
    """
    below: list[rrb.View] = [rrb.TextDocumentView(origin="info", name="Episode")]
    if fluoroscopy:
        below.insert(0, rrb.Spatial2DView(origin="fluoroscopy", name="Fluoroscopy"))
    left = rrb.Vertical(
        _scene(np.asarray(centre, dtype=np.float64), extent),
        rrb.Horizontal(*below),
        row_shares=[2, 1],
    )
    plots = [
        _plot("Reward", "series/reward"),
        _plot("Force, N", "series/force", legend=True),
        _plot("Insertion, mm", "series/insertion_mm"),
        _plot("Action", "series/action", legend=True),
        _plot("All actions", "series/action_all"),
    ]
    if distance:
        plots.insert(1, _plot("Distance to goal, mm", "series/distance_mm"))
    return rrb.Blueprint(
        rrb.Horizontal(left, rrb.Vertical(*plots), column_shares=[3, 2]),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(
            state="collapsed",
            timeline=TIMELINE_TIME,
            play_state="playing",
            loop_mode="all",
        ),
        auto_views=False,
        auto_layout=False,
    )


def _scene(centre: np.ndarray, extent: float) -> rrb.Spatial3DView:
    # The trail is one short piece per step; showing all pieces up to the cursor
    # draws where the head has been without giving away where it will go.
    so_far = [
        rrb.VisibleTimeRange(
            timeline,
            start=rrb.TimeRangeBoundary.infinite(),
            end=rrb.TimeRangeBoundary.cursor_relative(),
        )
        for timeline in (TIMELINE_TIME, TIMELINE_STEP)
    ]
    return rrb.Spatial3DView(
        origin="world",
        name="Scene",
        # From the front, as in an antero-posterior projection; y points backwards.
        eye_controls=rrb.EyeControls3D(
            kind="orbital",
            position=centre + [0.0, -EYE_DISTANCE * extent, 0.0],
            look_target=centre,
            eye_up=[0.0, 0.0, 1.0],
        ),
        line_grid=False,
        overrides={"world/catheter/trail": rrb.VisibleTimeRanges(so_far)},
    )


def _plot(name: str, origin: str, legend: bool = False) -> rrb.TimeSeriesView:
    return rrb.TimeSeriesView(
        origin=origin,
        name=name,
        plot_legend=rrb.PlotLegend(corner="RightTop", visible=legend),
    )
