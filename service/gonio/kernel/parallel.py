"""All cores for loops over frames: plain threads around compiled code that lets go of the interpreter lock.

numba's own parallel loops are not used: their thread pools abort the process when a service calls them from two
threads at once, or forks after the first call.
"""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager
from functools import cache

import scipy.linalg  # noqa: F401 # pyright: ignore[reportUnusedImport] - so that its BLAS is found
from threadpoolctl import ThreadpoolController


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


def one_blas_thread() -> AbstractContextManager[object]:
    """Keep BLAS to one thread: of small matrices its own threads wait for each other longer than they work."""
    return _blas().limit(limits=1, user_api="blas")


@cache
def _blas() -> ThreadpoolController:
    """Find the BLAS libraries of this process, which takes some milliseconds."""
    return ThreadpoolController()


def _cores() -> int:
    """Count the cores that this process may use: a container is often given fewer than the machine has."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
