"""Work shared out among threads, one for each core that this process may use.

Compiled kernels and numpy's larger operations let go of the interpreter's lock, so threads are enough, and nothing is
copied. What is computed does not depend on how many threads there are: every piece of work is computed alone, and its
results are taken in the order in which the work was given. One core, or work within work, is done in the plain way.
"""

from __future__ import annotations

import os
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from typing import TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")

AHEAD = 2
"""Pieces of work that are begun beyond the one that is waited for: more would only hold memory."""
_inside = threading.local()


def cores() -> int:
    """How many cores this process may use."""
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:  # not on every system
        return os.cpu_count() or 1


class Crew:
    """Threads that wait for work; without a pool everything is done by who asks."""

    def __init__(self, pool: ThreadPoolExecutor | None):
        self._pool = pool

    def each(self, function: Callable[[Item], Result], items: Iterable[Item]) -> Iterator[Result]:
        """The results of a function for some items, in their order; some are begun before they are asked for."""
        if self._pool is None:
            yield from map(function, items)
            return
        waiting: deque[Future[Result]] = deque()
        try:
            for item in items:
                waiting.append(self._pool.submit(_work, function, item))
                if len(waiting) > AHEAD:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        finally:
            for future in waiting:
                future.cancel()


@contextmanager
def crew() -> Iterator[Crew]:
    """As many threads as there are cores, until the end of the block."""
    size = cores()
    if size == 1 or getattr(_inside, "work", False):
        yield Crew(None)
        return
    with ThreadPoolExecutor(size) as pool:
        yield Crew(pool)


def each(function: Callable[[Item], Result], items: Iterable[Item]) -> list[Result]:
    """The results of a function for some items, in their order."""
    with crew() as threads:
        return list(threads.each(function, items))


def _work(function, item):
    _inside.work = True
    return function(item)
