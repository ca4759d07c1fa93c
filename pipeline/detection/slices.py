"""Finding markers in a whole log: slices of time, a process per core, pieces that survive a kill.

The frames of each camera are cut into slices of `SLICE_S` seconds. A worker opens the log itself, streams one slice
out of it and writes what it finds as one piece, whole or not at all; pieces that are there already are not made
again. Slices depend on nothing but the log, so any number of workers gives the same pieces.

Processes are spawned, never forked (OpenCV keeps locks), have one thread each, and are replaced now and then
(the AprilTag library loses some memory with every picture).
"""

from __future__ import annotations

import contextlib
import json
import multiprocessing
import os
import signal
import threading
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from pipeline import tables
from pipeline.config.site import DetectionSettings
from pipeline.detection.acceptance import KnownTags, judge
from pipeline.detection.apriltag import Found, TagFinder
from pipeline.detection.decode import decode_grey
from pipeline.errors import ArtefactError, DetectionError
from pipeline.logs.container import Contents
from pipeline.logs.reader import Frame, LogReader, read_log

SLICE_S = 25.0
"""What a kill costs at most, per worker; short enough for that, long enough to make opening the log cheap."""
SLICES_PER_PROCESS = 40
LOST_WORKERS = 3
"""Times in a row that a worker may vanish without a slice getting done in between."""

SEARCHED = "searched"
CORRUPT = "corrupt picture"
WRONG_SIZE = "wrong size"
MISSING = "not found again"


@dataclass(frozen=True)
class Slice:
    """Some frames of one camera, neighbours in time."""

    camera: str
    topic: str
    number: int
    """Of the slice among those of its camera."""
    frame: np.ndarray
    """(n,) frame numbers."""
    time_ns: np.ndarray
    """(n,) capture stamps."""
    log_time_ns: np.ndarray
    """(n,) by which the messages are found again."""
    piece: Path
    """File that the result goes to."""


@dataclass(frozen=True)
class Search:
    """What every slice needs."""

    log: Path
    contents: Contents
    families: tuple[str, ...]
    known: KnownTags
    sizes: dict[str, tuple[int, int]]
    """Camera -> width and height its pictures must have."""
    settings: DetectionSettings


@dataclass(frozen=True)
class Piece:
    """What one slice gave."""

    columns: dict[str, np.ndarray]
    """Columns of the table `detections`."""
    frames: dict[str, int]
    """Frames by what became of them: searched, corrupt picture, ..."""


def slices_of(frames: dict[str, np.ndarray], topics: dict[str, str], folder: Path) -> list[Slice]:
    """The frames of a log (columns of the table `frames`) in slices, by camera and time."""
    found = []
    for camera, topic in topics.items():
        mine = np.flatnonzero(frames["camera"] == camera)
        time_ns = frames["time_ns"][mine]
        if not len(mine):
            continue
        bins = (time_ns - time_ns[0]) // int(SLICE_S * 1e9)
        starts = np.flatnonzero(np.diff(bins, prepend=-1))
        for number, rows in enumerate(np.split(mine, starts[1:])):
            piece = folder / camera / f"{number:06d}.parquet"
            frame, stamp, received = (frames[name][rows] for name in ("frame", "time_ns", "log_time_ns"))
            found.append(Slice(camera, topic, number, frame, stamp, received, piece))
    return found


def search_slices(
    search: Search, slices: Sequence[Slice], workers: int, done: Callable[[Slice], None] | None = None
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

    Raises
    ------
    DetectionError
        Workers vanish again and again.
    ArtefactError
        A piece cannot be written.
    """
    report = done or (lambda _: None)
    waiting = []
    for part in slices:
        if _is_whole(part):
            report(part)
        else:
            part.piece.parent.mkdir(parents=True, exist_ok=True)
            waiting.append(part)
    if workers <= 1 or len(waiting) <= 1:
        with read_log(search.log, search.contents) as reader:
            finder = TagFinder(search.families, search.settings)
            for part in waiting:
                write_piece(part, search_slice(part, search, reader, finder))
                report(part)
        return
    lost = 0
    while waiting:
        left = _search_in_processes(search, waiting, workers, report)
        lost = lost + 1 if len(left) == len(waiting) else 1
        waiting = left
        if waiting and lost >= LOST_WORKERS:
            raise DetectionError(
                f"a process that searches for markers was killed {lost} times (memory?) at frame "
                f"{waiting[0].frame[0]} of camera '{waiting[0].camera}'; free some memory or give fewer --workers"
            )


def search_slice(part: Slice, search: Search, reader: LogReader, finder: TagFinder) -> Piece:
    """Every tag of one slice with its status."""
    outcomes: Counter[str] = Counter()
    rows: list[dict[str, Any]] = []
    for number, frame in frames_of(part, reader):
        try:
            grey = decode_grey(frame.data, frame.encoding, frame.width, frame.height)
        except DetectionError:
            outcomes[CORRUPT] += 1
            continue
        if grey.shape[::-1] != search.sizes[part.camera]:
            outcomes[WRONG_SIZE] += 1
            continue
        outcomes[SEARCHED] += 1
        found = finder.find(grey)
        status = judge(found, search.known, grey.shape, search.settings)
        rows.append(columns_of(found, status, number, frame.time_ns))
    if missing := len(part.frame) - sum(outcomes.values()):
        outcomes[MISSING] = missing
    rows.sort(key=lambda one: int(one["frame"][0]) if len(one["frame"]) else -1)
    columns = tables.empty_columns("detections")
    if rows:
        columns = {name: np.concatenate([one[name] for one in rows]) for name in columns}
    return Piece(columns, {name: outcomes[name] for name in sorted(outcomes)})


def frames_of(part: Slice, reader: LogReader) -> Iterator[tuple[int, Frame]]:
    """(frame number, frame) of a slice, in the order of the file."""
    keys = zip(part.time_ns.tolist(), part.log_time_ns.tolist())
    waiting = dict(zip(keys, part.frame.tolist()))
    span = int(part.log_time_ns.min()), int(part.log_time_ns.max()) + 1
    for frame in reader.frames({part.camera: part.topic}, *span):
        number = waiting.pop((frame.time_ns, frame.log_time_ns), None)
        if number is not None:  # else a repeated stamp, or a frame of a neighbouring slice
            yield number, frame


def columns_of(found: Found, status: np.ndarray, frame: int, time_ns: int) -> dict[str, np.ndarray]:
    """Rows of the table `detections` for one frame."""
    n = len(found)
    columns: dict[str, np.ndarray] = {
        "frame": np.full(n, frame, np.int32),
        "time_ns": np.full(n, time_ns, np.int64),
        "family": found.family,
        "tag_id": found.tag_id,
        "side_px": found.side_px,
        "hamming": found.hamming,
        "margin": found.margin,
        "how": np.full(n, "searched", object),
        "status": status,
    }
    for name in ("blur_px", "motion_px", "noise", "contrast", "whole"):
        columns[name] = np.full(n, np.nan)
    for k in range(4):
        columns[f"u{k}"], columns[f"v{k}"] = found.uv[:, k, 0], found.uv[:, k, 1]
        columns[f"cov{k}_uu"] = found.cov[:, k, 0, 0]
        columns[f"cov{k}_uv"] = found.cov[:, k, 0, 1]
        columns[f"cov{k}_vv"] = found.cov[:, k, 1, 1]
    return columns


def write_piece(part: Slice, piece: Piece) -> None:
    """Keep the result of a slice, whole or not at all. Raises ArtefactError."""
    tables.write_table(part.piece, "detections", piece.columns, {"frames": json.dumps(piece.frames)})


def read_piece(part: Slice) -> Piece:
    """The kept result of a slice. Raises ArtefactError."""
    frames = json.loads(tables.table_metadata(part.piece)["frames"])
    return Piece(tables.read_table(part.piece, "detections"), frames)


def _is_whole(part: Slice) -> bool:
    if not part.piece.exists():
        return False
    try:
        return sum(read_piece(part).frames.values()) == len(part.frame)
    except (ArtefactError, KeyError, ValueError):
        return False


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
    # A child is born with this mask: Ctrl-C cannot print its traceback before `_start_worker` runs in it.
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _search_in_processes(
    search: Search, slices: Sequence[Slice], workers: int, report: Callable[[Slice], None]
) -> list[Slice]:
    """Work through slices with a pool; those left undone because a worker vanished."""
    undone = {(part.camera, part.number): part for part in slices}
    with _single_threaded_children():
        pool = ProcessPoolExecutor(
            max_workers=min(workers, len(slices)),
            mp_context=multiprocessing.get_context("spawn"),
            initializer=_start_worker,
            initargs=(search,),
            max_tasks_per_child=SLICES_PER_PROCESS,
        )
        futures: dict[Future[None], Slice] = {}
        ahead = iter(slices)
        try:
            while True:
                # Few are handed over at a time: what is queued is pickled and cannot be called back.
                while len(futures) < 2 * workers and (part := next(ahead, None)) is not None:
                    with _interrupts_held():
                        futures[pool.submit(_work, part)] = part
                if not futures:
                    return list(undone.values())
                for future in wait(futures, return_when=FIRST_COMPLETED).done:
                    part = futures.pop(future)
                    future.result()
                    del undone[part.camera, part.number]
                    report(part)
        except BrokenProcessPool:
            return [part for part in undone.values() if not _is_whole(part)]
        except BaseException:
            for child in multiprocessing.active_children():
                child.terminate()
            raise
        finally:
            pool.shutdown(cancel_futures=True)


_worker: tuple[Search, LogReader, TagFinder] | None = None


def _start_worker(search: Search) -> None:
    global _worker
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's business
    threading.Thread(target=_end_with_parent, daemon=True).start()
    cv2.setNumThreads(1)
    reader = read_log(search.log, search.contents).__enter__()
    _worker = search, reader, TagFinder(search.families, search.settings)


def _end_with_parent() -> None:
    # A killed parent cannot tell its children; waiting for work they would stay for ever.
    if parent := multiprocessing.parent_process():
        parent.join()
        os._exit(1)


def _work(part: Slice) -> None:
    assert _worker is not None
    search, reader, finder = _worker
    write_piece(part, search_slice(part, search, reader, finder))
