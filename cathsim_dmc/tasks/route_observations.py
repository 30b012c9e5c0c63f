"""Observations of the route to the goal and of the memory of attempts along it."""

from operator import attrgetter

import numpy as np

from cathsim_dmc.physics.device_points import DEVICE_PLACES
from cathsim_dmc.tasks.common_chain import TRACKED_PLACES
from cathsim_dmc.tasks.observation_kind import (
    BIPLANE,
    COAXIAL_ROUTE,
    ROUTE,
    Entry,
    Frame,
    Observation,
    ObservationTable,
    flat,
)
from cathsim_dmc.tasks.retry import COAXIAL_RETRY_ENTRIES, RETRY_ENTRIES, SHOWN
from cathsim_dmc.tasks.route import AHEAD, SIDE_AHEAD, into_frame

_actions, _devices = map(attrgetter, ("actions", "devices"))


def _ahead(name: str, way: str) -> tuple[Entry, ...]:
    """Entries of a route ahead, whose names begin with `name`."""
    places = f"every {1e3 * AHEAD[1]:g} mm from the projection of the head, tip frame"
    points, count = f"{len(AHEAD)} points of {way}, {places}", len(TRACKED_PLACES) - 1
    device = (
        "points along the device, from proximal to distal without the head, tip frame"
    )
    out = "distance of the head outside the lumen, in radii of the lumen there; "
    out += "negative inside"
    return (
        Entry(f"{name}_points", 3 * len(AHEAD), "m", points),
        Entry(
            f"{name}_radii", len(AHEAD), "m", "radii of the lumen at these points", 0
        ),
        Entry(f"{name}_goal", 3, "m", "centre of the goal, tip frame"),
        Entry(f"{name}_device", 3 * count, "m", f"{count} {device}"),
        Entry(f"{name}_deviation", 1, "radius", out, -1),
        Entry(
            f"{name}_action", _actions, "1", "the last action, 0 after a reset", -1, 1
        ),
    )


def route(frame: Frame) -> Observation:
    """Route ahead, device and goal in the tip frame."""
    ahead, state = frame.ahead, frame.readings
    assert ahead is not None
    head, axes = state.head[..., None, :], state.head_frame
    device = frame.chain.tracked(state.centreline)[..., :-1, :] - head
    goal = np.broadcast_to(frame.goal, state.head.shape)[..., None, :] - head
    return {
        "route_points": flat(ahead.points, 2),
        "route_radii": ahead.radii,
        "route_goal": into_frame(goal, axes)[..., 0, :],
        "route_device": flat(into_frame(device, axes), 2),
        "route_deviation": ahead.excess[..., None],
        "route_action": frame.action,
    }


def biplane(frame: Frame) -> Observation:
    """The entries of `route`, reconstructed from the images of two planes."""
    parts = "points", "radii", "goal", "device", "deviation"
    seen = {f"biplane_{part}": frame.images[f"biplane_{part}"] for part in parts}
    return {**seen, "biplane_action": frame.action}


def _retry(key: str) -> Entry:
    length = RETRY_ENTRIES, COAXIAL_RETRY_ENTRIES
    return Entry(key, lambda sizes: length[sizes.devices > 0], "1, N", SHOWN)


def route_retry(frame: Frame) -> Observation:
    """Memory of the attempts along the route, see `retry.shown`."""
    assert frame.retry is not None
    return {"route_retry": frame.retry}


def biplane_retry(frame: Frame) -> Observation:
    """Memory of the attempts along the route through both roadmaps."""
    assert frame.retry is not None
    return {"biplane_retry": frame.retry}


_PLACES_OF_ENDS = f"{len(DEVICE_PLACES)} points along each device, every "
_PLACES_OF_ENDS += f"{1e3 * DEVICE_PLACES[-2]:g} mm, from proximal to its end"
_COAXIAL = (
    Entry(
        "route_gaps",
        _devices,
        "m",
        "distance of the end of each device behind that of the first",
    ),
    Entry(
        "route_lines",
        lambda sizes: 3 * sizes.devices * len(DEVICE_PLACES),
        "m",
        f"{_PLACES_OF_ENDS}, tip frame",
    ),
    Entry(
        "route_sides",
        lambda sizes: 5 * sizes.devices,
        "1",
        "per device: cosine and sine of the rotation of its end, and the direction to "
        f"the point of the route {1e3 * SIDE_AHEAD:g} mm ahead of its end, in the "
        "frame of the device proximal of its shaped end, which turns with that end",
    ),
    Entry("route_load", 2, "N", "as `device_load`"),
)


def route_coaxial(frame: Frame) -> Observation:
    """Route ahead and coaxial devices, all in the tip frame."""
    state, ahead = frame.devices, frame.ahead
    assert state is not None
    assert ahead is not None
    head, axes = frame.readings.head, frame.readings.head_frame
    assert ahead.sides is not None
    points = state.points.reshape(len(head), -1, 3) - head[:, None]
    return {
        **route(frame),
        "route_gaps": state.insertion[:, :1] - state.insertion,
        "route_lines": flat(into_frame(points, axes), 2),
        "route_sides": flat(ahead.sides, 2),
        "route_load": np.stack([state.leading_load, state.lumen_friction], axis=-1),
    }


_TURNS = Entry(
    "route_turns",
    lambda sizes: 2 * sizes.devices,
    "rad",
    "per device: remaining rotation of its end towards the point of the route that the "
    "present attempt pursues, between -pi and pi, and the angle between the direction "
    "to this point and the device proximal of its shaped end",
    -np.pi,
    np.pi,
)


def route_turns(frame: Frame) -> Observation:
    """Remaining rotation and bend angle of each device's end in the present attempt."""
    assert frame.ahead is not None
    assert frame.ahead.turns is not None
    return {"route_turns": flat(frame.ahead.turns, 2)}


def add_to(table: ObservationTable) -> None:
    """Adds the rows of this module to the table of observations."""
    joined = "drives", "devices"
    along = _ahead("route", "the centreline of the route")
    table.row(*along, needs=ROUTE, joined=joined)(route)
    table.row(*_ahead("biplane", "the route through both roadmaps"), needs=BIPLANE)(
        biplane
    )
    table.row(_retry("route_retry"), needs=ROUTE)(route_retry)
    table.row(_retry("biplane_retry"), needs=BIPLANE)(biplane_retry)
    table.row(*along, *_COAXIAL, needs=COAXIAL_ROUTE)(route_coaxial)
    table.row(_TURNS, needs=COAXIAL_ROUTE)(route_turns)
