"""From a signal to a grey image: quanta, blur, grey levels.

All functions take leading batch axes; the last two axes are (rows, columns). A
signal of 1 is what the detector receives behind the patient where there is neither
vessel nor device.
"""

import math
from collections.abc import Sequence
from functools import cache

import numpy as np
from numpy.typing import ArrayLike
from scipy.ndimage import gaussian_filter
from scipy.special import ndtri

from cathsim_dmc.compiled import compiled

# Quanta per area and air kerma at the detector, 1/(m² Gy): 30174 per mm² and uGy for
# the beam quality RQA5 of IEC 62220-1.
QUANTA_PER_KERMA = 30174.0e6 * 1.0e6

# Air kerma at the detector in one frame, Gy. Low-dose fluoroscopy works at some tens
# of nGy per frame; this is a choice within that range.
FRAME_KERMA = 25.0e-9

# Width (standard deviation) of the detector's point spread, m: a CsI flat panel whose
# transfer function halves near 1.2 line pairs per mm, sqrt(ln 2 / 2) / (pi f). It
# shows at full detector resolution, not on 128 pixels of 2.3 mm.
DETECTOR_BLUR = 0.16e-3

# Share of full white given to the signal 1. Leaves room above for noise and roadmap.
GAIN = 0.75

# Quantiles in the table of normal deviates: two random bytes choose one.
_QUANTILES = 1 << 16


@cache
def _normal_quantiles() -> tuple[np.ndarray, np.ndarray]:
    """Normal deviates z and (z² - 1) / 6, both of mean 0, (_QUANTILES,) float32."""
    z = ndtri((np.arange(_QUANTILES) + 0.5) / _QUANTILES)
    z = z / z.std()
    return z.astype(np.float32), ((z * z - 1.0) / 6.0).astype(np.float32)


def quantum_noise(
    signal: ArrayLike, quanta: float, random_states: Sequence[np.random.RandomState]
) -> np.ndarray:
    """Signal with Poisson noise of `quanta` per pixel at signal 1.

    Counts are drawn from quantiles of the normal distribution with the Cornish-Fisher
    term for skewness, many times faster than numpy's Poisson generator; mean and
    variance are those of Poisson within 1 % from 5 quanta up (a plain pixel of the
    default image has thousands).

    Args:
        signal: (frames, rows, columns), >= 0.
        quanta: mean number of quanta per pixel where the signal is 1, > 0.
        random_states: one for each frame; frames of the same state draw in their order.

    Returns:
        (frames, rows, columns) float32, whole counts over `quanta`.
    """
    frames = np.require(signal, np.float32, ["C", "W"])
    quantiles, skew = _normal_quantiles()
    result = np.empty_like(frames)
    for frame, out, state in zip(frames, result, random_states, strict=True):
        draw = np.frombuffer(state.bytes(2 * frame.size), dtype="<u2")
        _count(frame, np.float32(quanta), draw, quantiles, skew, out)
    return result


@compiled
def _count(frame, quanta, draw, quantiles, skew, out):
    """Writes counts divided by `quanta` of a frame, from each pixel's quantile."""
    zero = np.float32(0.0)
    # The skew term and rounding add 1/18 + 1/12 to the variance, subtracted below.
    excess = np.float32(5.0 / 36.0)
    rows, columns = frame.shape
    for i in range(rows):
        for j in range(columns):
            k = draw[i * columns + j]
            mean = max(frame[i, j], zero) * quanta
            spread = np.sqrt(max(mean - excess, zero))
            counted = np.rint(mean + spread * quantiles[k] + skew[k])
            out[i, j] = max(counted, zero) / quanta


def blurred(signal: ArrayLike, sigma: float) -> np.ndarray:
    """Signal (..., rows, columns) spread by a Gaussian of `sigma` px, float32.

    Edges continue outwards. Below 0.2 px, where a neighbour would get less than 1e-5,
    the signal is returned as it is.
    """
    out = np.asarray(signal, dtype=np.float32)
    if sigma < 0.2:
        return out
    reach = math.ceil(3.0 * sigma)
    return gaussian_filter(out, sigma, mode="nearest", radius=reach, axes=(-2, -1))


def grey(signal: ArrayLike, gain: float = GAIN) -> np.ndarray:
    """8-bit grey levels: round(255 gain signal), limited to 0..255; dark = opaque.

    Signal and levels are (..., rows, columns), signal 1 is behind plain tissue.
    """
    level = np.asarray(signal, dtype=np.float32) * np.float32(255.0 * gain)
    level += np.float32(0.5)
    return np.clip(level, 0.0, 255.0, out=level).astype(np.uint8)
