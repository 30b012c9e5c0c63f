"""The device, its path and its contacts as Rerun entities."""

import numpy as np
import rerun as rr

from cathsim_dmc.recording.coaxial import CoaxialRecord
from cathsim_dmc.recording.episode import Episode
from cathsim_dmc.recording.geometry import (
    force_colours,
    force_scale,
    xyzw,
    z_to,
)
from cathsim_dmc.recording.rerun_stream import Log

# Drawing only: the longest arrow of an episode is about this long.
LONGEST_ARROW = 25e-3
ARROW_RADIUS = 0.7e-3
HEAT_RADIUS = 0.9e-3
TRAIL_RADIUS = 0.25e-3
HEAD_SCALE = 1.8
SHAFT_COLOUR = (215, 228, 255)
HEAD_COLOUR = (255, 200, 0)
TRAIL_COLOUR = (255, 200, 0, 160)
# Of coaxial devices from the innermost outwards, over and over: a wire is teal, the
# catheter around it looks as a single device does.
DEVICE_COLOURS = ((90, 220, 190), SHAFT_COLOUR, (200, 170, 255))


def log_catheter(log: Log, radii: np.ndarray) -> None:
    """Log the device as capsules coloured by what they press, its head and its path.

    Args:
        radii: (L,) radii of the links, metres.
    """
    entity = "world/catheter"
    joints = log.episode.catheter
    states, links = joints.shape[0], joints.shape[1] - 1
    along = np.diff(joints, axis=1)
    colours = np.broadcast_to(np.array(SHAFT_COLOUR, np.uint8), (states, links, 3))
    thickness = np.broadcast_to(radii, (states, links))
    coaxial = CoaxialRecord.of(log.episode)
    if coaxial is not None:
        outermost = coaxial.outermost(joints)
        thickness = coaxial.radii[outermost]
        colours = device_colours(len(coaxial.names))[outermost]
        _log_ends(log, coaxial, entity)
    log.static(entity, rr.Capsules3D.from_fields(fill_mode="solid"))
    capsules = rr.Capsules3D.columns(
        lengths=np.linalg.norm(along, axis=-1).ravel(),
        radii=thickness.ravel(),
        translations=joints[:, :-1].reshape(-1, 3),
        quaternions=xyzw(z_to(along)).reshape(-1, 4),
        colors=link_colours(log.episode, colours).reshape(-1, 3),
    )
    log.columns(entity, capsules.partition(np.full(states, links)))
    head = log.episode.head
    log.static(
        f"{entity}/head",
        rr.Points3D.from_fields(colors=[HEAD_COLOUR], radii=[HEAD_SCALE * radii[-1]]),
    )
    log.columns(f"{entity}/head", rr.Points3D.columns(positions=head))
    if log.episode.steps:
        log.static(
            f"{entity}/trail",
            rr.LineStrips3D.from_fields(colors=[TRAIL_COLOUR], radii=[TRAIL_RADIUS]),
        )
        pieces = np.stack([head[:-1], head[1:]], axis=1)
        log.columns(
            f"{entity}/trail", rr.LineStrips3D.columns(strips=pieces), slice(1, None)
        )


def device_colours(count: int) -> np.ndarray:
    """Colours (K, 3) uint8 of coaxial devices, from the innermost outwards."""
    numbers = np.arange(count) % len(DEVICE_COLOURS)
    return np.array(DEVICE_COLOURS, dtype=np.uint8)[numbers]


def _log_ends(log: Log, coaxial: CoaxialRecord, entity: str) -> None:
    ends = coaxial.ends(log.episode.catheter)
    for k, name in enumerate(coaxial.names):
        where = f"{entity}/{name}"
        look = rr.Points3D.from_fields(
            colors=device_colours(len(coaxial.names))[k : k + 1],
            radii=[HEAD_SCALE * coaxial.radii[k]],
        )
        log.static(where, look)
        log.columns(where, rr.Points3D.columns(positions=ends[:, k]))


def link_colours(episode: Episode, colours: np.ndarray) -> np.ndarray:
    """Colours (T+1, L, 3) uint8 of the links: that of the largest force, or their own.

    Args:
        colours: (T+1, L, 3) uint8, of links that press nothing.
    """
    states, links = episode.catheter.shape[0], episode.catheter.shape[1] - 1
    pressed = np.zeros((states, links))
    magnitude = np.linalg.norm(episode.contact_force, axis=-1)
    row = episode.contact_step + 1
    middle = (episode.catheter[row, :-1] + episode.catheter[row, 1:]) / 2
    away = np.linalg.norm(middle - episode.contact_position[:, None], axis=-1)
    np.maximum.at(pressed, (row, away.argmin(axis=1)), magnitude)
    hot = force_colours(pressed, force_scale(magnitude))
    return np.where(pressed[..., None] > 0, hot, colours)


def arrow_scale(episode: Episode) -> float:
    """Length of an arrow for each newton, metres."""
    return LONGEST_ARROW / force_scale(np.linalg.norm(episode.contact_force, axis=-1))


def log_contacts(log: Log) -> None:
    """Log the forces of each step as arrows, and the places pressed so far."""
    episode = log.episode
    magnitude = np.linalg.norm(episode.contact_force, axis=-1)
    colours = force_colours(magnitude, force_scale(magnitude))
    vectors = arrow_scale(episode) * episode.contact_force
    log.static("world/contacts", rr.Arrows3D.from_fields(radii=[ARROW_RADIUS]))
    arrows = rr.Arrows3D.columns(
        vectors=vectors, origins=episode.contact_position, colors=colours
    )
    # A step without contact is an empty row, which takes the old arrows away.
    rows = slice(1, None)
    log.columns("world/contacts", arrows.partition(episode.contact_counts), rows)
    if len(magnitude):
        log.static("world/heat", rr.Points3D.from_fields(radii=[HEAT_RADIUS]))
        heat = rr.Points3D.columns(positions=episode.contact_position, colors=colours)
        log.columns("world/heat", heat.partition(episode.contact_counts), rows)
