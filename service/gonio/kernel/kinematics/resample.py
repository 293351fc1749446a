"""Give a motion at other times than it was solved at."""

from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from scipy.interpolate import make_interp_spline

from gonio.records import TOO_FEW_MARKERS, Motion

_BLOCK = 1024  # frames whose covariances are interpolated at a time: a long trial's are the largest array there is


def resample(motion: Motion, times_s: Float[np.ndarray, " frame"]) -> Motion:
    """Interpolate a motion between its frames by the smoothest curve.

    That is the natural quintic spline, which has the least jerk of all curves through the values; beyond the ends it goes on
    with constant acceleration. A coordinate is NaN unless both frames around it know it, and so is its covariance, which is
    interpolated linearly: the error in between is seldom smaller than at either side.

    Args:
        motion: At least six frames, in equal steps.
        times_s: The times that are wanted, from the motion's first frame to less than a step after its last.
    """
    after = np.clip(np.searchsorted(motion.times_s, times_s - 1e-9), 1, len(motion.times_s) - 1)
    step_s = np.diff(motion.times_s)[after - 1]
    share = np.clip(np.round((times_s - motion.times_s[after - 1]) / step_s, 6), 0.0, 1.0)
    known = np.isfinite(motion.values)
    some = np.flatnonzero(known.any(axis=0))
    filled = motion.values[:, some].copy()
    for column, at in zip(filled.T, known[:, some].T, strict=True):
        if not at.all():
            column[:] = np.interp(motion.times_s, motion.times_s[at], column[at])
    values = np.full((len(times_s), motion.values.shape[1]), np.nan)
    none = np.zeros(len(some))
    natural: Any = ([(3, none), (4, none)],) * 2  # Any: what scipy is annotated with knows no derivatives
    values[:, some] = make_interp_spline(motion.times_s, filled, k=5, bc_type=natural)(times_s)
    # A frame that is not moved needs no neighbour.
    first, second = np.where(share == 1.0, after, after - 1), np.where(share == 0.0, after - 1, after)
    values[~(known[first] & known[second])] = np.nan
    nearest = np.where(share < 0.5, after - 1, after)
    covariance = None if motion.covariance is None else _between(motion.covariance, first, second, share)
    variance = None if motion.sd is None else _between(motion.sd**2, first, second, share)
    lost = np.isnan(values).all(axis=1)
    return replace(
        motion,
        times_s=times_s,
        values=values,
        status=np.where(lost, TOO_FEW_MARKERS, motion.status[nearest]).astype(np.uint8),
        iterations=motion.iterations[nearest],
        residual_rms_m=motion.residual_rms_m[nearest],
        covariance=covariance,
        sd=None if variance is None else np.sqrt(variance),
    )


def _between(
    covariance: Float[np.ndarray, "given ..."],
    first: Int[np.ndarray, " frame"],
    second: Int[np.ndarray, " frame"],
    share: Float[np.ndarray, " frame"],
) -> Float[np.ndarray, "frame ..."]:
    """Interpolate linearly from the covariances, or variances, of ``first`` to those of ``second``; read-only."""
    found = np.empty((len(share), *covariance.shape[1:]))
    for start in range(0, len(share), _BLOCK):
        some = slice(start, start + _BLOCK)
        weight = share[some].reshape(-1, *(1,) * (covariance.ndim - 1))
        found[some] = (1.0 - weight) * covariance[first[some]] + weight * covariance[second[some]]
    found.setflags(write=False)
    return found
