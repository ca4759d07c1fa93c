"""A log in spans and slices: what is searched whole, and what one process works through at a time.

Each camera's frames are cut into *spans* by a grid of time that depends on them alone. The first frame of a span is its
key; a span reaches to the key of the next one, so that tags are followed between two keys. A *slice* is some whole
spans, and needs the next slice's key too. Any slicing and any number of workers therefore gives the same rows.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from pipeline.logs.reader import Frame, LogReader

SPAN_S = 20.0
"""Between keys. At 10 Hz a search of every 200th frame costs a tenth of decoding them all; with glances in between,
spans of 5 s found nothing more on rendered logs."""
SPAN_BYTES = 256_000_000
"""Pictures of a span are kept for the way back, decoded; spans of many or large pictures are cut shorter."""
FEWEST_FRAMES = 8
SLICE_S = 60.0
"""What a kill costs at most, per worker. Each slice searches one key that its neighbour searches too: twice as long
would save 1 % of the time."""


@dataclass(frozen=True)
class Slice:
    """Some frames of one camera, neighbours in time: whole spans."""

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
    starts: tuple[int, ...]
    """Row of the key of each span."""
    ahead: tuple[int, int, int] | None
    """Frame number, capture stamp and log time of the next slice's key; None after the last."""
    piece: Path
    """File that the result goes to."""

    def spans(self) -> list[list[int]]:
        """Frame numbers of each span, from its key to the next key, that one included."""
        ends = [*self.starts[1:], len(self.frame)]
        spans = [self.frame[a : b + 1].tolist() for a, b in zip(self.starts, ends)]
        if self.ahead is not None:
            spans[-1].append(self.ahead[0])
        return spans


def slices_of(
    frames: Mapping[str, np.ndarray],
    topics: Mapping[str, str],
    sizes: Mapping[str, tuple[int, int]],
    folder: Path,
    slice_s: float = SLICE_S,
) -> list[Slice]:
    """The frames of a log in slices, by camera and time.

    Parameters
    ----------
    frames : mapping
        Columns of the table `frames`; the frames of a camera in order of time.
    topics : mapping
        Camera -> topic.
    sizes : mapping
        Camera -> width and height of its pictures.
    folder : Path
        For the pieces.
    slice_s : float
        Length of a slice, seconds; rounded to whole spans.
    """
    found = []
    spans_each = max(1, round(slice_s / SPAN_S))
    for camera, topic in topics.items():
        mine = np.flatnonzero(frames["camera"] == camera)
        if not len(mine):
            continue
        frame, stamp, received = (frames[name][mine] for name in ("frame", "time_ns", "log_time_ns"))
        bins = (stamp - stamp[0]) // int(SPAN_S * 1e9)
        width, height = sizes[camera]
        keys = _keys(bins, max(FEWEST_FRAMES, SPAN_BYTES // max(width * height, 1)))
        of_slice = bins // spans_each
        edges = [*np.flatnonzero(np.diff(of_slice, prepend=-1)).tolist(), len(mine)]
        for number, (a, b) in enumerate(pairwise(edges)):
            found.append(
                Slice(
                    camera,
                    topic,
                    number,
                    frame[a:b],
                    stamp[a:b],
                    received[a:b],
                    tuple(int(key) - a for key in keys[(keys >= a) & (keys < b)]),
                    (int(frame[b]), int(stamp[b]), int(received[b])) if b < len(mine) else None,
                    folder / camera / f"{number:06d}.parquet",
                )
            )
    return found


def _keys(bins: np.ndarray, most: int) -> np.ndarray:
    """Rows at which spans begin: at each new bin of time, and after `most` frames of it."""
    first = np.flatnonzero(np.diff(bins, prepend=-1))
    count = np.diff([*first, len(bins)])
    return np.concatenate([np.arange(a, a + n, most) for a, n in zip(first, count)])


def frames_of(part: Slice, reader: LogReader) -> Iterator[tuple[int, Frame]]:
    """(frame number, frame) of a slice and of the key after it, in the order of the file."""
    keys = zip(part.time_ns.tolist(), part.log_time_ns.tolist())
    waiting = dict(zip(keys, part.frame.tolist()))
    start, end = int(part.log_time_ns.min()), int(part.log_time_ns.max())
    if part.ahead is not None:
        number, time_ns, log_time_ns = part.ahead
        waiting[time_ns, log_time_ns] = number
        start, end = min(start, log_time_ns), max(end, log_time_ns)
    for frame in reader.frames({part.camera: part.topic}, start, end + 1):
        found = waiting.pop((frame.time_ns, frame.log_time_ns), None)
        if found is not None:  # else a repeated stamp, or a frame of a neighbouring slice
            yield found, frame


def spans_of(part: Slice, reader: LogReader) -> Iterator[list[tuple[int, Frame]]]:
    """The frames of each span of a slice in order of time, its last key included; streamed, some spans in memory.

    What the log does not give again is left out.
    """
    spans = part.spans()
    missing = [set(span) for span in spans]
    held: dict[int, Frame] = {}
    of_frame: dict[int, list[int]] = {}
    for index, span in enumerate(spans):
        for number in span:
            of_frame.setdefault(number, []).append(index)
    following = 0

    def taken() -> list[tuple[int, Frame]]:
        span = [(number, held[number]) for number in spans[following] if number in held]
        for number in spans[following]:
            if of_frame[number][-1] == following:
                held.pop(number, None)
        return span

    for number, frame in frames_of(part, reader):
        held[number] = frame
        for index in of_frame[number]:
            missing[index].discard(number)
        while following < len(spans) and not missing[following]:
            yield taken()
            following += 1
    while following < len(spans):
        yield taken()
        following += 1
