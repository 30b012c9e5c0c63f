"""Course of a heartbeat: inflow of the aorta, and the pulse of pressure it makes."""

import math

import numpy as np

from cathsim_dmc.compiled import law

# Inflow over a beat of 1 s: ms and mL/s (ADAN56, Boileau 2015, as in openBF).
_TIMES = (0, 22, 41, 61, 80, 99, 128, 158, 177, 196, 245, 322, 351, 390, 415, 438, 1000)
_FLOWS = (0, 0, 105, 273, 405, 536, 573, 536, 489, 452, 315, 179, 137, 0, -163, 0, 0)
BEAT = np.interp(np.arange(1001), _TIMES, _FLOWS) / max(_FLOWS)
_COMPLIANCE = 1.2  # s, time constant of the pressure's decay in diastole
SYSTOLE = 0.35  # fraction of a beat in which the root moves out; then it returns


def _pulse() -> np.ndarray:
    """Pressure over a beat of 1 s, scaled to 0 to 1, from the inflow.

    A two-element Windkessel (O. Frank, Z. Biol. 37 (1899) 483), integrated over beats
    until it is periodic.
    """
    count = len(BEAT) - 1
    pressure, course = 0.0, np.zeros(count + 1)
    for _ in range(8):
        for k in range(count):
            pressure += (BEAT[k] - pressure / _COMPLIANCE) / count
            course[k + 1] = pressure
        course[0] = course[-1]
    return (course - course.min()) / np.ptp(course)


PULSE = _pulse()


@law
def place_in(phase, count):
    """Row of a phase in a beat of `count` rows, and fraction towards the next row."""
    place = (phase - math.floor(phase)) * (count - 1)
    first = min(int(place), count - 2) if place >= 0.0 else 0  # NaN has no row
    return first, place - first


@law
def pulse(phase):
    """Pressure (0 to 1) of the pulse at a phase in beats, and its rate per beat."""
    first, share = place_in(phase, len(PULSE))
    slope = PULSE[first + 1] - PULSE[first]
    return PULSE[first] + share * slope, slope * (len(PULSE) - 1)
