"""From optical depth to a grey image: attenuation, quanta, blur, grey levels.

All functions take leading batch axes; the last two axes are (rows, columns). A
signal of 1 is what the detector receives behind the patient where there is neither
vessel nor device.
"""

import math
from collections.abc import Sequence
from functools import cache

import numpy as np
from numpy.typing import ArrayLike

from cathsim_dmc.imaging import kernel

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

# Below this width, px, a neighbour would get less than 1e-5 of it.
LEAST_BLUR = 0.2

# Quantiles in the table of normal deviates: two random bytes choose one.
_QUANTILES = 1 << 16


def transmission(optical_depth: ArrayLike) -> np.ndarray:
    """Beer-Lambert: share of quanta that pass, exp(-optical_depth), float32."""
    return np.exp(-np.asarray(optical_depth, dtype=np.float32))


def quanta_per_pixel(pitch: float, kerma: float = FRAME_KERMA) -> float:
    """Mean quanta on a pixel of side `pitch` (m) at air kerma `kerma` (Gy)."""
    return QUANTA_PER_KERMA * kerma * pitch**2


@cache
def _normal_quantiles() -> tuple[np.ndarray, np.ndarray]:
    """Normal deviates z and (z² - 1) / 6, both of mean 0, (_QUANTILES,) float32."""
    from scipy.special import ndtri

    z = ndtri((np.arange(_QUANTILES) + 0.5) / _QUANTILES)
    z = z / z.std()
    return z.astype(np.float32), ((z * z - 1.0) / 6.0).astype(np.float32)


def quantum_noise(
    signal: ArrayLike,
    quanta: float,
    random_state: np.random.RandomState | Sequence[np.random.RandomState],
) -> np.ndarray:
    """Signal with Poisson noise of `quanta` per pixel at signal 1.

    Counts are drawn from quantiles of the normal distribution with the Cornish-Fisher
    term for skewness, many times faster than numpy's Poisson generator; mean and
    variance are those of Poisson within 1 % from 5 quanta up (a plain pixel of the
    default image has thousands).

    Args:
        signal: (..., rows, columns), >= 0.
        quanta: mean number of quanta per pixel where the signal is 1.
        random_state: one state, from which frames draw in their order (a batch then
            equals its frames drawn one after the other), or a sequence of states,
            one per frame in the order of the flattened batch.

    Returns:
        (..., rows, columns) float32, whole counts over `quanta`.

    Raises:
        ValueError: if `quanta` is not positive or there are not as many states as
            frames.
    """
    if not quanta > 0.0:
        raise ValueError(f"quanta is {quanta:g} per pixel; it must be > 0.")
    signal = np.require(signal, np.float32, ["C", "W"])
    frames = signal.reshape(-1, *signal.shape[-2:])
    if isinstance(random_state, np.random.RandomState):
        states = [random_state] * len(frames)
    else:
        states = list(random_state)
        if len(states) != len(frames):
            raise ValueError(
                f"{len(states)} random states for {len(frames)} frames; give one, or "
                "one per frame."
            )
    quantiles, skew = _normal_quantiles()
    result = np.empty_like(frames)
    for frame, out, state in zip(frames, result, states, strict=True):
        draw = np.frombuffer(state.bytes(2 * frame.size), dtype="<u2")
        kernel.count(frame, np.float32(quanta), draw, quantiles, skew, out)
    return result.reshape(signal.shape)


def blurred(signal: ArrayLike, sigma: float) -> np.ndarray:
    """Signal spread by a Gaussian of `sigma` pixels; edges continue outwards.

    Args:
        signal: (..., rows, columns).
        sigma: standard deviation, px; below 0.2 px, where a neighbour would get less
            than 1e-5, the signal is returned as it is.

    Returns:
        (..., rows, columns) float32.
    """
    out = np.asarray(signal, dtype=np.float32)
    if sigma < LEAST_BLUR:
        return out
    from scipy.ndimage import gaussian_filter

    reach = math.ceil(3.0 * sigma)
    return gaussian_filter(out, sigma, mode="nearest", radius=reach, axes=(-2, -1))


def grey(signal: ArrayLike, gain: float = GAIN) -> np.ndarray:
    """8-bit grey levels: round(255 gain signal), limited to 0..255; dark = opaque.

    Args:
        signal: (..., rows, columns), 1 behind plain tissue.
        gain: share of full white given to signal 1.

    Returns:
        (..., rows, columns) uint8.
    """
    level = np.asarray(signal, dtype=np.float32) * np.float32(255.0 * gain)
    level += np.float32(0.5)
    return np.clip(level, 0.0, 255.0, out=level).astype(np.uint8)


def roadmap_gain(mask: ArrayLike, opacity: float, gain: float = GAIN) -> np.ndarray:
    """Factor on the signal that lays the vessel over the live image in white.

    A factor, not a blend, so that a device in the vessel keeps its contrast.

    Args:
        mask: (..., rows, columns) bool, where the vessel is.
        opacity: 0 leaves the image as it is, 1 lifts plain tissue to full white.
        gain: share of full white given to plain tissue (see `grey`).

    Returns:
        (..., rows, columns) float32, >= 1 for gains up to 1.
    """
    return np.where(mask, 1.0 + opacity * (1.0 / gain - 1.0), 1.0).astype(np.float32)
