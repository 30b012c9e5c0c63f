"""Series over time and X-ray images as Rerun entities."""

import io

import numpy as np
import rerun as rr

from cathsim_dmc.recording.blueprint import FLUOROSCOPY
from cathsim_dmc.recording.coaxial import CoaxialRecord
from cathsim_dmc.recording.drawing import goal_distance
from cathsim_dmc.recording.rerun_device import device_colours
from cathsim_dmc.recording.rerun_stream import Log

# At this quality noisy frames take about half the size of a PNG.
JPEG_QUALITY = 90


def log_series(log: Log) -> None:
    """Log reward with its terms, forces, distance, insertion and actions."""
    episode = log.episode
    every, measured, commanded = slice(None), slice(1, None), slice(0, episode.steps)
    distance = goal_distance(episode)
    away = None if distance is None else 1e3 * distance
    lines = [
        ("reward", episode.reward, measured, "reward", [90, 160, 90]),
        ("distance_mm", away, every, "distance to goal, mm", [60, 190, 90]),
        ("force/wall_sum", 1e3 * episode.wall_force_sum, measured, "wall, sum",
         [230, 110, 40]),
        ("force/wall_max", 1e3 * episode.wall_force_max, measured,
         "wall, largest contact", [180, 20, 50]),
        ("force/push", 1e3 * episode.push_force, measured, "push", [80, 120, 210]),
        ("insertion_mm", 1e3 * episode.insertion, every, "insertion, mm",
         [150, 90, 200]),
    ]  # fmt: skip
    for entity, values, rows, label, colour in lines:
        if values is not None:
            log.series(f"series/{entity}", values, rows, label, colors=colour)
    for name, values in episode.meta.get("reward_terms", {}).items():
        log.series(f"series/reward/{name}", np.array(values), measured, name)
    _log_devices(log)
    # Of several devices, whose names come first; otherwise of joints of the device.
    names = [str(name) for name in episode.meta.get("action_names", ())]
    short = [name.rsplit("/", 1)[-1] for name in names]
    names = short if len(set(short)) == len(names) else names
    log.series("series/action", episode.action, commanded, names or None)


def _log_devices(log: Log) -> None:
    coaxial = CoaxialRecord.of(log.episode)
    if coaxial is None:
        return
    colours = device_colours(len(coaxial.names)).tolist()
    for k, (name, colour) in enumerate(zip(coaxial.names, colours, strict=True)):
        series = {
            f"insertion_mm/{name}": (1e3 * coaxial.insertion, f"{name}, mm"),
            f"rotation_deg/{name}": (np.degrees(coaxial.rotation), f"{name}, base"),
            f"rotation_deg/{name}_end": (
                np.degrees(coaxial.tip_rotation),
                f"{name}, end",
            ),
        }
        for entity, (values, label) in series.items():
            log.series(
                f"series/{entity}", values[:, k], slice(None), label, colors=colour
            )


def log_frames(log: Log, frames: np.ndarray) -> None:
    """Log X-ray images (T+1, H, W, P) as JPEG, one entity for each of P planes."""
    from PIL import Image

    for plane, entity in enumerate(FLUOROSCOPY[: frames.shape[-1]]):
        blobs = []
        for frame in frames[..., plane]:
            buffer = io.BytesIO()
            Image.fromarray(frame).save(buffer, "JPEG", quality=JPEG_QUALITY)
            blobs.append(buffer.getvalue())
        log.static(entity, rr.EncodedImage.from_fields(media_type="image/jpeg"))
        log.columns(entity, rr.EncodedImage.columns(blob=blobs))
