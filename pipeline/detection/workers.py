"""All cores at the slices of a log: a process each, replaced when it dies, and no slice tried for ever.

Processes are spawned, never forked (OpenCV keeps locks), have one thread each, and are replaced now and then (the
AprilTag library loses some memory with every picture). When one vanishes, nobody can tell which slice it was at:
those that were under way are repeated one by one, each alone in a process, and what ends that one too is given up.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool

import cv2
import numpy as np

from pipeline.detection.motion import Thumbnails
from pipeline.detection.refine import Refiner
from pipeline.detection.slices import Finders, Search, give_up, is_whole, search_slice, undone, write_piece
from pipeline.detection.spans import Slice
from pipeline.detection.windows import locate
from pipeline.errors import DetectionError
from pipeline.logs.reader import LogReader, read_log

SLICES_PER_PROCESS = 40
LOST_SLICES = 3
"""Slices given up one after the other, with no other suspect done in between, after which the fault is not theirs."""


def search_slices(
    search: Search,
    slices: Sequence[Slice],
    workers: int,
    done: Callable[[Slice], None] | None = None,
    begun: Callable[[], None] | None = None,
) -> None:
    """Write the piece of every slice that has none yet.

    Parameters
    ----------
    search : Search
        What every slice needs.
    slices : sequence of Slice
        In the order in which they are to be done.
    workers : int
        Processes; with 1 the work is done in this one.
    done : callable
        Told each slice when its piece is there, also those that were there before.
    begun : callable
        Called when all is compiled, which the first run takes a minute for, and the first slice begins.

    Raises
    ------
    DetectionError
        Workers vanish whatever they work at.
    ArtefactError
        A piece cannot be written.
    """
    report = done or (lambda _: None)
    waiting = undone(slices)
    # An interrupt that comes while something compiles, or is loaded, is lost in a callback of the compiler.
    if waiting:
        with _interrupts_held():
            warm_up(search)
    if begun is not None:
        begun()
    left = {(part.camera, part.number) for part in waiting}
    for part in slices:
        if (part.camera, part.number) not in left:
            report(part)
    if workers <= 1 or len(slices) <= 1:
        with read_log(search.log, search.contents) as reader:
            finders = Finders(search)
            for part in waiting:
                write_piece(part, search_slice(part, search, reader, finders))
                report(part)
        return
    lost_in_a_row = 0
    while waiting:
        suspects, waiting = _search_in_processes(search, waiting, workers, report)
        for part in suspects:
            again, _ = _search_in_processes(search, [part], 1, report)
            if not again:
                lost_in_a_row = 0
                continue
            lost_in_a_row += 1
            if lost_in_a_row >= LOST_SLICES:
                raise DetectionError(
                    f"a process that searches for markers was killed {lost_in_a_row} times (memory?) at frame "
                    f"{part.frame[0]} of camera '{part.camera}'; free some memory or give fewer --jobs"
                )
            give_up(part)
            report(part)


def warm_up(search: Search) -> None:
    """Compile what is compiled, once and here; every process would else do it by itself and at the same time."""
    grey = np.zeros((48, 48), np.uint8)
    uv = np.array([[[8, 8], [40, 8], [40, 40], [8, 40.0]]])
    family = search.families[0]
    bent = np.array([100.0, 100.0, 24.0, 24.0, 0.01, 0.0, 0.0, 0.0, 0.0])
    Refiner(bent).refine(grey, [family], [0], uv)
    locate(grey, [family], [0], uv[:, None], np.ones(1, int), np.ones(1))
    Thumbnails(48, 48).of(grey)


_ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")


@contextlib.contextmanager
def _single_threaded_children() -> Iterator[None]:
    # They read these while they import numpy, which is before any of our code can run in them.
    before = {name: os.environ.get(name) for name in _ONE_THREAD}
    os.environ.update(dict.fromkeys(_ONE_THREAD, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


@contextlib.contextmanager
def _interrupts_held() -> Iterator[None]:
    """Keep Ctrl-C until the end; to be used in the main thread."""
    # A child is born with this mask: Ctrl-C cannot print its traceback before `_start_worker` runs in it.
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    # The mask is this thread's: the system then gives the signal to another one (Arrow's, BLAS's), and Python would
    # raise it here nevertheless.
    came: list[int] = []
    handler = signal.signal(signal.SIGINT, lambda number, _: came.append(number))
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        signal.signal(signal.SIGINT, handler)
        if came:
            signal.raise_signal(signal.SIGINT)


def _search_in_processes(
    search: Search, slices: Sequence[Slice], workers: int, report: Callable[[Slice], None]
) -> tuple[list[Slice], list[Slice]]:
    """Work through slices with a pool: those under way when a worker vanished, and those not begun by then."""
    with _single_threaded_children():
        pool = ProcessPoolExecutor(
            max_workers=min(workers, len(slices)),
            mp_context=multiprocessing.get_context("spawn"),
            initializer=_start_worker,
            initargs=(search,),
            max_tasks_per_child=SLICES_PER_PROCESS,
        )
        futures: dict[Future[None], Slice] = {}
        ahead = deque(slices)
        try:
            while True:
                # Few are handed over at a time: what is queued is pickled and cannot be called back.
                while len(futures) < 2 * workers and ahead:
                    with _interrupts_held():
                        futures[pool.submit(_work, ahead[0])] = ahead[0]
                    ahead.popleft()
                if not futures:
                    return [], []
                for future in wait(futures, return_when=FIRST_COMPLETED).done:
                    future.result()
                    report(futures[future])
                    del futures[future]
        except BrokenProcessPool:
            suspects = []
            for part in futures.values():
                if is_whole(part):  # written just before
                    report(part)
                else:
                    suspects.append(part)
            return suspects, list(ahead)
        except BaseException:
            for child in multiprocessing.active_children():
                child.terminate()
            raise
        finally:
            pool.shutdown(cancel_futures=True)


_worker: tuple[Search, LogReader, Finders] | None = None


def _start_worker(search: Search) -> None:
    global _worker
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's business
    threading.Thread(target=_end_with_parent, daemon=True).start()
    cv2.setNumThreads(1)
    reader = read_log(search.log, search.contents).__enter__()
    _worker = search, reader, Finders(search)


def _end_with_parent() -> None:
    # A killed parent cannot tell its children; waiting for work they would stay for ever.
    if parent := multiprocessing.parent_process():
        parent.join()
        os._exit(1)


def _work(part: Slice) -> None:
    assert _worker is not None
    search, reader, finders = _worker
    write_piece(part, search_slice(part, search, reader, finders))
