"""Errors of the tracked points that observations show."""

from collections.abc import Sequence

import numpy as np

from cathsim_dmc.physics.readings import CoaxialReadings, Readings


class TrackingNoise:
    """Independent normal errors of the joints, drawn in each control step.

    So have the head and the points of coaxial devices. A tracked point between two
    joints has the weighted mean of their errors. Rewards, success and images use the
    true points.

    Attributes:
        deviation: Standard deviation of each coordinate, m; 0 for no errors.
    """

    state = ("_errors",)  # see `snapshot`

    def __init__(self, deviation: float):
        self.deviation = deviation
        self._errors: np.ndarray | None = None

    def seen(
        self,
        readings: Readings,
        devices: CoaxialReadings | None,
        random_states: Sequence[np.random.RandomState] | None,
        rows: np.ndarray,
    ) -> tuple[Readings, CoaxialReadings | None]:
        """The states of N simulations with the errors of the present control step.

        Args:
            random_states: N sources of randomness; None for no errors, as before the
                first episode.
            rows: (K,) numbers of the simulations whose errors are drawn; the others
                keep theirs.
        """
        if not self.deviation or random_states is None:
            return readings, devices
        points, nodes = readings.centreline, readings.centreline.shape[1]
        if devices is not None:
            ends = devices.points.reshape(len(points), -1, 3)
            points = np.concatenate([points, ends], axis=1)
        if self._errors is None:
            self._errors = np.zeros(points.shape)
        for index in rows.tolist():
            self._errors[index] = random_states[index].normal(
                scale=self.deviation, size=points.shape[1:]
            )
        points = points + self._errors
        line = points[:, :nodes]
        readings = readings._replace(centreline=line, head=line[:, -1].copy())
        if devices is not None:
            ends = points[:, nodes:].reshape(devices.points.shape)
            devices = devices._replace(points=ends)
        return readings, devices
