"""All cores for loops over frames: plain threads around compiled code that lets go of the interpreter lock.

numba's own parallel loops are not used: their thread pools abort the process when a service calls them from two
threads at once, or forks after the first call.
"""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor


def over_blocks(work: Callable[[int, int], None], count: int, block: int) -> None:
    """Call ``work(start, stop)`` for the blocks [0, block), [block, 2 block), … up to ``count``, on all cores.

    ``work`` must be compiled with ``nogil=True`` to gain from it, and must write to its own rows only. An exception
    in one block is raised after the others have ended.
    """
    starts = range(0, count, block)
    if len(starts) <= 1:
        work(0, count)
        return
    with ThreadPoolExecutor(max_workers=min(len(starts), _cores())) as pool:
        list(pool.map(lambda start: work(start, min(start + block, count)), starts))


def _cores() -> int:
    """Count the cores that this process may use: a container is often given fewer than the machine has."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
