"""How long errors last."""

import numpy as np
from jaxtyping import Bool, Float

NEGLIGIBLE = 0.05


def repeats(
    residual: Float[np.ndarray, "camera frame keypoint 2"], inlier: Bool[np.ndarray, "camera frame keypoint"]
) -> float:
    """Give by how many observations inlying residuals repeat each other: 1 + 2 Σ ρ(lag), up to the first ρ below 0.05.

    The mean of that many residuals in a row varies as a single one does. Lags at which nothing was observed twice count for
    nothing, so that the number is one of observations, not of frames.
    """
    values = np.where(inlier[..., None], residual, 0.0)
    counts = inlier.astype(float)
    variance = (values**2).sum() / max(2 * counts.sum(), 1.0)
    total = 1.0
    for lag in range(1, residual.shape[1] // 4):
        pairs = (counts[:, lag:] * counts[:, :-lag]).sum()
        if pairs == 0 or variance == 0:
            continue
        rho = (values[:, lag:] * values[:, :-lag]).sum() / (2 * pairs * variance)
        if rho < NEGLIGIBLE:
            break
        total += 2 * float(rho)
    return total
