"""When the samples of a stream were taken."""

import numpy as np
from jaxtyping import Float

from gonio.errors import InputError
from gonio.records.record import record


@record
class Timebase:
    """A uniform clock: sample ``i`` was taken at ``start_s + i / rate_hz``."""

    rate_hz: float
    start_s: float = 0.0

    def __post_init__(self) -> None:
        if not (np.isfinite(self.rate_hz) and self.rate_hz > 0):
            raise InputError(f"A rate of {self.rate_hz} Hz is impossible.", hint="Give a positive rate in hertz.")

    def times_s(self, count: int) -> Float[np.ndarray, " frame"]:
        """Give the times of the first ``count`` samples, in seconds."""
        return self.start_s + np.arange(count) / self.rate_hz
