"""Layout of a recorded episode in the Rerun viewer."""

from collections.abc import Sequence

import numpy as np
import rerun.blueprint as rrb

TIMELINE_TIME = "sim_time"
TIMELINE_STEP = "step"
# Entities of the X-ray planes, frontal first.
FLUOROSCOPY = ("fluoroscopy", "fluoroscopy_lateral")
_PLANE_NAMES = ("Fluoroscopy, frontal", "Fluoroscopy, second plane")

# Distance of the eye in extents of the scene: the viewer's vertical field of view
# is near 45 degrees, which shows 0.83 of the distance.
EYE_DISTANCE = 1.35
# Of the eye from the tip that it follows, and from the robot, m.
TIP_DISTANCE = 0.075
ROBOT_OFFSET = np.array([-0.16, -0.42, 0.2])
_BACKGROUND = (30, 32, 38)


def episode_blueprint(
    centre: Sequence[float],
    extent: float,
    *,
    planes: int,
    distance: bool,
    head: Sequence[float],
    robot: Sequence[float] | None,
    rotation: bool = False,
    living: bool = False,
) -> rrb.Blueprint:
    """Return the layout: scene on the left, X-ray in the middle, series on the right.

    Args:
        centre: (3,) point the eye looks at, world frame (LPS), metres.
        extent: Largest side of the scene in metres.
        distance: Whether the recording has ``series/distance_mm``.
        head: (3,) where the head is at first, metres.
        robot: (3,) where the robot is, or None if the recording has none.
        rotation: Whether the recording has ``series/rotation_deg``, of coaxial devices.
        living: Whether the recording has ``series/vessel``.
    """
    middle = np.asarray(centre, dtype=np.float64)
    insets: list[rrb.View] = [_tip(np.asarray(head, dtype=np.float64))]
    if robot is not None:
        insets.append(_robot(np.asarray(robot, dtype=np.float64)))
    scene = rrb.Vertical(
        _scene(middle, extent), rrb.Horizontal(*insets), row_shares=[3, 2]
    )
    images = [
        rrb.Spatial2DView(origin=origin, name=name)
        for origin, name in zip(FLUOROSCOPY[:planes], _PLANE_NAMES, strict=False)
    ]
    plots = [
        _plot("Reward and its terms", "series/reward", legend=True),
        _plot("Force, mN", "series/force", legend=True),
        _plot("Insertion, mm", "series/insertion_mm"),
        _plot("Action", "series/action"),
    ]
    if rotation:
        plots.insert(3, _plot("Rotation, °", "series/rotation_deg", legend=True))
    if living:
        plots.append(_plot("Heart, breathing, wall", "series/vessel", legend=True))
    if distance:
        plots.insert(1, _plot("Distance to goal, mm", "series/distance_mm"))
    columns = [scene, rrb.Vertical(*images), rrb.Vertical(*plots)]
    if not images:
        del columns[1]
    return rrb.Blueprint(
        rrb.Horizontal(*columns, column_shares=[5, 3.4, 3] if images else [5, 3]),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(
            state="collapsed",
            play_state="playing",
            timeline=TIMELINE_TIME,
            loop_mode="all",
        ),
        auto_views=False,
        auto_layout=False,
    )


def _so_far() -> rrb.VisibleTimeRanges:
    """Everything up to the cursor: where something has been, not where it will go."""
    return rrb.VisibleTimeRanges(
        [
            rrb.VisibleTimeRange(
                timeline,
                start=rrb.TimeRangeBoundary.infinite(),
                end=rrb.TimeRangeBoundary.cursor_relative(),
            )
            for timeline in (TIMELINE_TIME, TIMELINE_STEP)
        ]
    )


def _scene(centre: np.ndarray, extent: float) -> rrb.Spatial3DView:
    # From the front, as in an antero-posterior projection; y points backwards.
    eye = centre + [0.0, -EYE_DISTANCE * extent, 0.0]
    trail = ["world/catheter/trail", "world/heat"]
    return _world("Scene", eye, centre, so_far=trail)


def _tip(head: np.ndarray) -> rrb.Spatial3DView:
    """The neighbourhood of the tip, which the eye follows."""
    return _world(
        "Tip",
        head + [0.0, -TIP_DISTANCE, 0.0],
        head,
        "world/catheter/head",
        contents=["+ $origin/**", "- $origin/goal"],
    )


def _robot(place: np.ndarray) -> rrb.Spatial3DView:
    parts = ["+ $origin/robot/**", "+ $origin/sheath/**", "+ $origin/catheter"]
    return _world("Robot", place + ROBOT_OFFSET, place, contents=parts)


def _world(
    name: str,
    eye: np.ndarray,
    target: np.ndarray,
    tracked: str | None = None,
    contents: Sequence[str] = ("+ $origin/**",),
    so_far: Sequence[str] = ("world/heat",),
) -> rrb.Spatial3DView:
    return rrb.Spatial3DView(
        origin="world",
        name=name,
        contents=list(contents),
        eye_controls=rrb.EyeControls3D(
            kind="orbital",
            position=eye,
            look_target=target,
            eye_up=[0.0, 0.0, 1.0],
            tracking_entity=tracked,
        ),
        background=_BACKGROUND,
        line_grid=False,
        overrides={entity: _so_far() for entity in so_far},
    )


def _plot(name: str, origin: str, legend: bool = False) -> rrb.TimeSeriesView:
    return rrb.TimeSeriesView(
        origin=origin,
        name=name,
        plot_legend=rrb.PlotLegend(corner="LeftTop", visible=legend),
    )
