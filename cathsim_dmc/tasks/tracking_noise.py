"""Errors of the tracked points that observations show."""

from collections.abc import Sequence

import numpy as np

from cathsim_dmc.physics.readings import CoaxialReadings, Readings


class TrackingNoise:
    """Independent normal errors of every tracked point, drawn in each control step.

    Rewards, success and images are of the true points.

    Attributes:
        on: Whether there are any.
    """

    def __init__(self, deviation: float, num_simulations: int):
        """Starts without errors.

        Args:
            deviation: Standard deviation of each coordinate, m.
            num_simulations: N.
        """
        self.on = deviation > 0.0
        self._deviation = deviation
        self._line = np.zeros((num_simulations, 0, 3))
        self._devices = np.zeros((num_simulations, 0, 3))

    def draw(
        self,
        readings: Readings,
        devices: CoaxialReadings | None,
        random_states: Sequence[np.random.RandomState],
        fresh: np.ndarray | None,
    ) -> None:
        """Draws the errors of a control step.

        Args:
            readings: Of N simulations.
            random_states: N sources.
            fresh: (K,) numbers of the simulations that have begun an episode; the
                others keep their errors. None for all.
        """
        chosen = np.arange(len(self._line)) if fresh is None else fresh
        self._line = self._drawn(self._line, readings.centreline, chosen, random_states)
        if devices is not None:
            points = devices.points.reshape(len(self._devices), -1, 3)
            self._devices = self._drawn(self._devices, points, chosen, random_states)

    def _drawn(self, errors, points, chosen, random_states):
        drawn = np.zeros(points.shape)
        if errors.shape == points.shape:
            drawn[:] = errors
        for index in chosen.tolist():
            drawn[index] = random_states[index].normal(
                scale=self._deviation, size=points.shape[1:]
            )
        return drawn

    def seen(
        self, readings: Readings, devices: CoaxialReadings | None
    ) -> tuple[Readings, CoaxialReadings | None]:
        """The states with the errors of the present control step, if drawn."""
        if not self._line.size:
            return readings, devices
        line = readings.centreline + self._line
        readings = readings._replace(centreline=line, head=line[:, -1].copy())
        if devices is not None:
            errors = self._devices.reshape(devices.points.shape)
            devices = devices._replace(points=devices.points + errors)
        return readings, devices
