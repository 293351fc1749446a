"""How often one caller may ask: a bucket of tokens for each, filled at a constant rate."""

import math
import threading
import time
from collections.abc import Callable

MOST_CALLERS = 10_000


class Pace:
    """Limits the requests of each caller of this process.

    Args:
        per_minute: How many requests a caller may send in a minute; as many may come at once. 0: any number.
        clock: Gives seconds.
    """

    def __init__(self, per_minute: int, clock: Callable[[], float] = time.monotonic) -> None:
        self._per_minute = per_minute
        self._clock = clock
        self._buckets: dict[str, tuple[float, float]] = {}
        self._lock = threading.Lock()

    def wait_s(self, caller: str) -> int:
        """Count a request of a caller. 0: it may go on; else it may not, and another one may in so many seconds."""
        if not self._per_minute:
            return 0
        now_s = self._clock()
        with self._lock:
            tokens, then_s = self._buckets.pop(caller, (float(self._per_minute), now_s))
            tokens = min(tokens + (now_s - then_s) * self._per_minute / 60, self._per_minute)
            allowed = tokens >= 1
            self._buckets[caller] = (tokens - allowed, now_s)
            if len(self._buckets) > MOST_CALLERS:
                del self._buckets[next(iter(self._buckets))]  # the one that was silent for longest
        return 0 if allowed else math.ceil((1 - tokens) * 60 / self._per_minute)
