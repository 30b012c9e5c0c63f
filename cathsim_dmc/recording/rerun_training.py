"""The recording of a training: an episode of every checkpoint, and the curves.

One file for one run. Its timeline is the number of frames that the training has seen:
the states of an episode are counted on from the frames of its checkpoint, and the
figures of metrics.csv stand at their own.
"""

from __future__ import annotations

import os
import uuid
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
from rerun.blueprint import Blueprint
from rerun.chunk import Chunk, RrdReader
from rerun.error_utils import catch_and_log_exceptions

from cathsim_dmc.recording.blueprint import TIMELINE_FRAMES, training_blueprint
from cathsim_dmc.recording.drawing import Drawing, goal_distance
from cathsim_dmc.recording.episode import Episode
from cathsim_dmc.recording.rerun_log import (
    APPLICATION_ID,
    log_motion,
    write_recording,
)
from cathsim_dmc.recording.rerun_scene import log_surroundings
from cathsim_dmc.recording.rerun_stream import Log
from cathsim_dmc.recording.summary import episode_markdown

# Longest wait for a viewer that takes nothing more, s.
VIEWER_PATIENCE = 10.0
_RECORDED = "recorded episode"
_CHECKPOINT = "training/checkpoint"
# Column of metrics.csv: its entity, factor and name in a legend.
_COLUMNS = {
    "success": ("success/mean", 1.0, "mean of the last 100"),
    "episode_reward": ("reward/mean", 1.0, "mean of the last 100"),
    "mean_force": ("force/mean", 1e3, "mean force"),
    "max_force": ("force/max", 1e3, "largest force"),
    "episode_length": ("length/mean", 1.0, "mean of the last 100"),
    "frames_per_second": ("speed/frames", 1.0, "frames a second"),
}
_PLOTS = {
    "Success": "training/success",
    "Reward of an episode": "training/reward",
    "Force, mN": "training/force",
    "Steps of an episode": "training/length",
    "Frames a second": "training/speed",
}
_OMITTED = ("frames", "seconds", "episodes")


class TrainingRecording:
    """Adds episodes and figures to the recording of a run.

    The file is read, extended and put in its place again at every episode, so it is
    whole at any moment and goes on where an earlier process has left it.

    Attributes:
        path: The file, ``*.rrd``.
        frames: Number of frames of the newest checkpoint in it, -1 if there is none.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        window: int,
        viewer: str | None = None,
    ) -> None:
        """Reads what there is.

        Args:
            path: The file. One that cannot be read is renamed to ``*.damaged``.
            window: Largest number of steps of an episode.
            viewer: Address of a viewer that gets everything too, see
                `viewer.live_address`; None for none.
        """
        self.path = Path(path)
        self.frames = self._end = -1
        self._window = window
        self._recording_id = str(uuid.uuid4())
        self._columns: dict[str, None] = {}
        old = self._read()
        self._viewer = self._lost = None
        if viewer is not None:
            self._viewer = rr.RecordingStream(
                APPLICATION_ID, recording_id=self._recording_id
            )
            self._viewer.set_log_tick_enabled(False)
            self._viewer.set_log_time_enabled(False)
            self._viewer.connect_grpc(viewer)
            self._show(lambda stream: stream.send_chunks(old))

    def add(
        self,
        episode: Episode,
        drawing: Drawing,
        frames: int,
        rows: Sequence[Mapping[str, float | None]],
    ) -> None:
        """Add the episode of a checkpoint.

        Args:
            episode: The episode, at most `window` steps long.
            drawing: Vessel, goal and shapes to draw it with.
            frames: Number of frames of the checkpoint.
            rows: Rows of metrics.csv; those that are newer than the checkpoint, or in
                the recording already, are left out.

        Raises:
            OSError: the file cannot be written.
            RuntimeError: if Rerun is switched off by the environment variable RERUN.
        """
        old, before = self._read(), self.frames
        # Where checkpoints follow each other faster than an episode is long.
        begin = max(frames, self._end + 1)
        new = [row for row in rows if before < (row["frames"] or 0) <= frames]
        self._columns |= dict.fromkeys(name for row in new for name in row)
        layout = self._layout(episode, drawing, begin)

        def fill(stream: rr.RecordingStream) -> None:
            log = Log(stream, episode, begin=begin)
            if before < 0:
                log_surroundings(log, drawing)
            log_motion(log, drawing)
            _log_checkpoint(log, frames)
            _log_metrics(stream, new)

        def extend(stream: rr.RecordingStream) -> None:
            stream.send_chunks(old)
            fill(stream)

        title = f"training of {episode.task}"
        write_recording(self.path, layout, title, extend, self._recording_id)
        self.frames, self._end = frames, begin + episode.steps
        self._show(fill, layout)

    def _show(
        self,
        fill: Callable[[rr.RecordingStream], None],
        layout: Blueprint | None = None,
    ) -> None:
        """Send the same to the viewer; one that takes nothing more is left alone."""
        viewer = self._viewer
        if viewer is None:
            return
        try:
            with catch_and_log_exceptions(strict=True):
                if layout is not None:
                    viewer.send_blueprint(layout, make_active=True, make_default=True)
                fill(viewer)
                viewer.flush(timeout_sec=VIEWER_PATIENCE)
        except Exception as error:  # Rerun's own are of no common class.
            print(f"the viewer is left alone from now on: {error}", flush=True)
            # Kept: closing a stream waits for its viewer, for ever if need be.
            self._lost, self._viewer = viewer, None

    def _read(self) -> list[Chunk]:
        """All of the file, with what is to be known of it."""
        if not self.path.exists():
            return []
        try:
            reader = RrdReader(self.path)
            recording = reader.recordings()[0]
            chunks = list(reader.stream())
        except (RuntimeError, ValueError, IndexError, OSError) as error:
            damaged = self.path.with_suffix(self.path.suffix + ".damaged")
            print(f"{self.path} is put aside as {damaged.name}: {error}", flush=True)
            self.path.rename(damaged)
            self.frames = self._end = -1
            return []
        self._recording_id = recording.recording_id
        # Sent anew with every episode.
        chunks = [one for one in chunks if one.entity_path != "/__properties"]
        for chunk in chunks:
            entity = chunk.entity_path.lstrip("/")
            batch = chunk.to_record_batch() if not chunk.is_static else None
            if batch is None or not batch.num_rows:
                continue
            last = max(batch.column(TIMELINE_FRAMES).to_pylist())
            if entity == _CHECKPOINT:
                count = max(value[0] for value in _scalars(batch))
                self.frames = max(self.frames, int(count))
            elif entity == "world/catheter":
                self._end = max(self._end, last)
            elif entity.startswith("training/learner/"):
                self._columns[entity.rpartition("/")[2]] = None
        return chunks

    def _layout(self, episode: Episode, drawing: Drawing, begin: int) -> Blueprint:
        low, high = drawing.vertices.min(0), drawing.vertices.max(0)
        learner = [name for name in self._columns if name not in (*_COLUMNS, *_OMITTED)]
        return training_blueprint(
            (low + high) / 2,
            float((high - low).max()),
            episode.head[0],
            newest=(begin, begin + max(episode.steps, 1)),
            window=self._window,
            distance=goal_distance(episode) is not None,
            plots=_PLOTS,
            learner={
                name.replace("_", " "): f"training/learner/{name}" for name in learner
            },
        )


def _scalars(batch: Any) -> list[list[float]]:
    return batch.column("Scalars:scalars").to_pylist()


def _log_checkpoint(log: Log, frames: int) -> None:
    """Log what the episode came to, at its first state."""
    episode, first = log.episode, slice(0, 1)
    title = f"# Checkpoint of {frames:,} frames\n\n"
    text = title + episode_markdown(episode)
    log.columns(
        "info",
        rr.TextDocument.columns(text=[text], media_type=["text/markdown"]),
        first,
    )
    figures = {
        "success/recorded": float(bool(episode.meta.get("success"))),
        "reward/recorded": float(episode.reward.sum()),
        "force/recorded": 1e3 * float(np.max(episode.wall_force_max, initial=0.0)),
        "length/recorded": float(episode.steps),
    }
    for entity, value in figures.items():
        entity = f"training/{entity}"
        log.static(
            entity,
            rr.SeriesPoints(names=_RECORDED, colors=[230, 110, 40], markers="cross"),
        )
        log.columns(entity, rr.Scalars.columns(scalars=[value]), first)
    log.columns(_CHECKPOINT, rr.Scalars.columns(scalars=[float(frames)]), first)


def _log_metrics(
    stream: rr.RecordingStream, rows: Sequence[Mapping[str, float | None]]
) -> None:
    """Log rows of metrics.csv, a curve for each column."""
    for name in rows[0] if rows else ():
        if name in _OMITTED:
            continue
        entity, factor, label = _COLUMNS.get(name, (f"learner/{name}", 1.0, name))
        known = [(row["frames"], row[name]) for row in rows if row[name] is not None]
        if not known:
            continue
        frames, values = np.array(known, dtype=np.float64).T
        entity = f"training/{entity}"
        stream.log(entity, rr.SeriesLines(names=label), static=True, strict=True)
        stream.send_columns(
            entity,
            [rr.TimeColumn(TIMELINE_FRAMES, sequence=frames.astype(np.int64))],
            rr.Scalars.columns(scalars=factor * values),
            strict=True,
        )
