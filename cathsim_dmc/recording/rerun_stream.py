"""A Rerun stream with the times of one episode's states; series and X-ray images."""

import io
from typing import Any

import numpy as np
import rerun as rr

from cathsim_dmc.recording.coaxial import CoaxialRecord
from cathsim_dmc.recording.episode import Episode
from cathsim_dmc.recording.living import VesselRecord

TIMELINE_TIME, TIMELINE_STEP = "sim_time", "step"
# Entities of the X-ray planes, frontal first.
FLUOROSCOPY = ("fluoroscopy", "fluoroscopy_lateral")
# At this quality noisy frames take about half the size of a PNG.
JPEG_QUALITY = 90
SHAFT_COLOUR = (215, 228, 255)
# Of coaxial devices from the innermost outwards, over and over: a wire is teal, the
# catheter around it looks as a single device does.
DEVICE_COLOURS = ((90, 220, 190), SHAFT_COLOUR, (200, 170, 255))
# Rows of a series: one for each state, of what is measured, of what is commanded.
EVERY, MEASURED, COMMANDED = slice(None), slice(1, None), slice(0, -1)


class Log:
    """Logs entities, static or as whole series.

    Attributes:
        episode: Whose states the rows are.
        coaxial: Its devices, or None if it has a single one.
        vessel: Its vessel, or None if that is rigid and its blood rests.
    """

    def __init__(self, stream: rr.RecordingStream, episode: Episode) -> None:
        """Takes the stream, and the times of the episode."""
        self._stream = stream
        self.episode = episode
        self.coaxial = CoaxialRecord.of(episode)
        self.vessel = VesselRecord.of(episode)
        # Rounded here, since Rerun truncates 0.12 s to 119,999,999 ns.
        self._times = np.round(episode.time * 1e9).astype("timedelta64[ns]")

    def static(self, entity: str, archetype: Any) -> None:
        """Logs what never changes."""
        self._stream.log(entity, archetype, static=True, strict=True)

    def columns(self, entity: str, columns: Any, rows: Any = EVERY) -> None:
        """Sends one row per state in ``rows``; nothing at all for no rows."""
        times, steps = self._times[rows], np.arange(len(self._times))[rows]
        if len(steps):
            indexes = [
                rr.TimeColumn(TIMELINE_TIME, duration=times),
                rr.TimeColumn(TIMELINE_STEP, sequence=steps),
            ]
            self._stream.send_columns(entity, indexes, columns, strict=True)

    def series(
        self, entity: str, values: Any, rows: slice, names: Any, colour: Any = None
    ) -> None:
        """Sends (n,) or (n, C) values as one plot entity of C lines."""
        values = np.asarray(values)
        self.static(f"series/{entity}", rr.SeriesLines(names=names, colors=colour))
        columns = rr.Scalars.columns(scalars=values.ravel())
        if values.ndim == 2:
            columns = columns.partition(np.full(len(values), values.shape[1]))
        self.columns(f"series/{entity}", columns, rows)


def device_colours(count: int) -> np.ndarray:
    """Colours (K, 3) uint8 of coaxial devices, from the innermost outwards."""
    return np.resize(np.array(DEVICE_COLOURS, np.uint8), (count, 3))


def log_series(log: Log) -> None:
    """Log reward with its terms, forces, distance, insertion, vessel and actions."""
    episode, meta = log.episode, log.episode.meta
    mm, mn = 1e3, 1e3
    for entity, values, rows, label, colour in (
        ("reward", episode.reward, MEASURED, "reward", [90, 160, 90]),
        ("force/wall_sum", mn * episode.wall_force_sum, MEASURED, "wall, sum",
         [230, 110, 40]),
        ("force/wall_max", mn * episode.wall_force_max, MEASURED,
         "wall, largest contact", [180, 20, 50]),
        ("force/push", mn * episode.push_force, MEASURED, "push", [80, 120, 210]),
        ("insertion_mm", mm * episode.insertion, EVERY, "insertion, mm",
         [150, 90, 200]),
    ):  # fmt: skip
        log.series(entity, values, rows, label, colour)
    if "distance" in meta:
        away = mm * np.array(meta["distance"])
        log.series("distance_mm", away, EVERY, "distance to goal, mm", [60, 190, 90])
    for name, values in meta.get("reward_terms", {}).items():
        log.series(f"reward/{name}", values, MEASURED, name)
    if (coaxial := log.coaxial) is not None:
        colours = device_colours(len(coaxial.names)).tolist()
        for k, (name, colour) in enumerate(zip(coaxial.names, colours, strict=True)):
            for entity, values, label in (
                (f"insertion_mm/{name}", mm * coaxial.insertion, "mm"),
                (f"rotation_deg/{name}", np.degrees(coaxial.rotation), "base"),
                (f"rotation_deg/{name}_end", np.degrees(coaxial.tip_rotation), "end"),
            ):
                log.series(entity, values[:, k], EVERY, f"{name}, {label}", colour)
    if log.vessel is not None:
        for name, (values, label) in log.vessel.curves().items():
            log.series(f"vessel/{name}", values, EVERY, label)
    # Of several devices, whose names come first; otherwise of joints of the device.
    names = [str(name) for name in meta.get("action_names", ())]
    short = [name.rsplit("/", 1)[-1] for name in names]
    names = short if len(set(short)) == len(names) else names
    log.series("action", episode.action, COMMANDED, names or None)


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
