"""Everything random in the laboratory: one seed, and a stream of its own for each effect and camera.

So an effect that is switched off, or a camera that is added, changes nothing about the others.
"""

import zlib

import numpy as np
from jaxtyping import Bool, Float
from scipy.signal import lfilter


def stream(seed: int, effect: str, sensor: int) -> np.random.Generator:
    """Give the random numbers of one effect on one sensor."""
    return np.random.default_rng([seed, zlib.crc32(effect.encode()), sensor])


def correlated(
    rng: np.random.Generator, shape: tuple[int, ...], rate_hz: float, correlation_s: float
) -> Float[np.ndarray, " frame *rest"]:
    """Draw unit normal courses over frames (the first axis) whose autocorrelation falls as exp(−t / ``correlation_s``)."""
    keep = np.exp(-1.0 / (rate_hz * correlation_s))
    drawn = rng.standard_normal(shape)
    drawn[1:] *= np.sqrt(1.0 - keep**2)
    return lfilter([1.0], [1.0, -keep], drawn, axis=0)


def spells(
    rng: np.random.Generator, frames: int, rate_hz: float, share: float, length_s: tuple[float, float]
) -> list[slice]:
    """Draw stretches of frames that cover a share of the time; their lengths are uniform, their gaps exponential."""
    found: list[slice] = []
    if share <= 0:
        return found
    length = (length_s[0] + length_s[1]) / 2 * rate_hz
    gap = length * (1.0 - share) / share
    at = -10.0 * (gap + length)  # long before: the recording may begin in a stretch or anywhere in a gap
    while at < frames:
        at += rng.exponential(gap)
        end = at + rng.uniform(*length_s) * rate_hz
        first, last = max(round(at), 0), min(round(end), frames)
        if first < last:
            found.append(slice(first, last))
        at = end
    return found


def chosen(rng: np.random.Generator, shape: tuple[int, ...], share: float) -> Bool[np.ndarray, " *shape"]:
    """Choose a share of things, each for itself."""
    return rng.random(shape) < share
