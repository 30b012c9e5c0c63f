"""A Rerun stream together with the times of one episode's states."""

from typing import Any

import numpy as np
import rerun as rr

from cathsim_dmc.recording.blueprint import TIMELINE_STEP, TIMELINE_TIME
from cathsim_dmc.recording.episode import Episode


class Log:
    """Logs under a prefix of entity paths, static or as whole series.

    Attributes:
        stream: Where to.
        episode: Whose states the rows are.
    """

    def __init__(self, stream: rr.RecordingStream, episode: Episode) -> None:
        """Takes the times of the episode."""
        self.stream = stream
        self.episode = episode
        steps = np.arange(episode.steps + 1)
        # Rounded here, since Rerun truncates 0.12 s to 119,999,999 ns.
        times = np.round(episode.time * 1e9).astype("timedelta64[ns]")
        self._indexes = {TIMELINE_TIME: times, TIMELINE_STEP: steps}

    def static(self, entity: str, *archetypes: Any) -> None:
        """Logs what never changes."""
        for archetype in archetypes:
            self.stream.log(entity, archetype, static=True, strict=True)

    def columns(
        self, entity: str, columns: Any, rows: slice | np.ndarray = slice(None)
    ) -> None:
        """Sends one row per state in ``rows``; nothing at all for no rows."""
        indexes = []
        for timeline, values in self._indexes.items():
            chosen = values[rows]
            if not len(chosen):
                return
            kind = "duration" if timeline == TIMELINE_TIME else "sequence"
            indexes.append(rr.TimeColumn(timeline, **{kind: chosen}))
        self.stream.send_columns(entity, indexes, columns, strict=True)

    def series(
        self, entity: str, values: np.ndarray, rows: slice, names: Any, **style: Any
    ) -> None:
        """Sends (n,) or (n, C) values as one plot entity of C lines."""
        self.static(entity, rr.SeriesLines(names=names, **style))
        columns = rr.Scalars.columns(scalars=values.ravel())
        if values.ndim == 2:
            columns = columns.partition(np.full(len(values), values.shape[1]))
        self.columns(entity, columns, rows)
