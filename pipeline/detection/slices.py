"""Finding markers in one slice of a log, and keeping what was found as a piece.

A piece is written whole or not at all; pieces that are there already are not made again. What goes on in several
processes is `pipeline.detection.workers`.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from pipeline import tables
from pipeline.config.site import DetectionSettings
from pipeline.detection.acceptance import KnownTags, ghosts, judge
from pipeline.detection.apriltag import TagFinder
from pipeline.detection.boards import Board
from pipeline.detection.decode import Pictures, decode_grey
from pipeline.detection.follow import Follower
from pipeline.detection.motion import Thumbnails
from pipeline.detection.refine import Refiner
from pipeline.detection.seen import Seen, together
from pipeline.detection.spans import Slice, spans_of
from pipeline.detection.windows import WindowDecoder
from pipeline.errors import ArtefactError, DetectionError
from pipeline.logs.container import Contents
from pipeline.logs.reader import Frame, LogReader

SEARCHED = "searched"
CORRUPT = "corrupt picture"
WRONG_SIZE = "wrong size"
MISSING = "not found again"
LOST = "lost with a worker"

GLANCE_SHRINK, SWEEP_SHRINK = 4, 2


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
    intrinsics: dict[str, tuple[float, ...]] = field(default_factory=dict)
    """Camera -> nine numbers; without them the lens is taken to draw straight lines."""
    boards: tuple[Board, ...] = ()


@dataclass(frozen=True)
class Piece:
    """What one slice gave."""

    columns: dict[str, np.ndarray]
    """Columns of the table `detections`."""
    frames: dict[str, int]
    """Frames by what became of them: searched, corrupt picture, ..."""


class Finders:
    """The searches and refinements that one process needs, made as its slices ask for them."""

    def __init__(self, search: Search):
        self._search = search
        settings = search.settings
        self._finder = TagFinder(search.families, settings)
        self._sweeper, self._glancer = (
            TagFinder(
                search.families,
                settings.model_copy(update={"quad_decimate": max(settings.quad_decimate / shrink, 1.0)}),
                shrink,
            )
            for shrink in (SWEEP_SHRINK, GLANCE_SHRINK)
        )
        self._decoder = WindowDecoder(settings)
        self._followers: dict[str, Follower] = {}
        self.pictures = Pictures()
        """For one span at a time."""

    def follower(self, camera: str) -> Follower:
        """Follows the tags in the frames of one camera."""
        if camera not in self._followers:
            intrinsics = self._search.intrinsics.get(camera)
            self._followers[camera] = Follower(
                self._finder,
                self._sweeper,
                self._glancer,
                Refiner(None if intrinsics is None else np.array(intrinsics)),
                self._decoder,
                Thumbnails(*self._search.sizes[camera]),
                self._search.known,
                self._search.boards,
            )
        return self._followers[camera]


def search_slice(part: Slice, search: Search, reader: LogReader, finders: Finders) -> Piece:
    """Every tag of one slice with its status."""
    follower = finders.follower(part.camera)
    outcomes: Counter[str] = Counter()
    rows: list[dict[str, np.ndarray]] = []
    key: tuple[int, Seen] | None = None
    spans = part.spans()
    after: list[int | None] = [*(span[0] for span in spans[1:]), part.ahead[0] if part.ahead else None]
    for next_key, frames in zip(after, spans_of(part, reader)):
        # The key that ends a span begins the next one, and is counted and written there.
        pictures: list[tuple[int, int, np.ndarray]] = []
        finders.pictures.begin()
        for number, frame in frames:
            grey, outcome = _picture(frame, search.sizes[part.camera], finders.pictures)
            outcomes[outcome] += number != next_key
            if grey is not None:
                pictures.append((number, frame.time_ns, grey))
        if not pictures:
            continue
        seen, key = _follow(follower, pictures, key)
        mine = [n for n, (number, _, _) in enumerate(pictures) if number != next_key]
        if not mine:
            continue
        tags = together([seen[n] for n in mine])
        each = [len(seen[n]) for n in mine]
        of_frame = np.repeat(np.array([pictures[n][0] for n in mine], np.int32), each)
        at_ns = np.repeat(np.array([pictures[n][1] for n in mine], np.int64), each)
        status = judge(tags, search.known, search.settings, of_frame)
        real = np.flatnonzero(~ghosts(tags, status, of_frame))
        rows.append(columns_of(tags.of(real), status[real], of_frame[real], at_ns[real]))
    if missing := len(part.frame) - sum(outcomes.values()):
        outcomes[MISSING] = missing
    columns = tables.empty_columns("detections")
    if rows:
        columns = {name: np.concatenate([one[name] for one in rows]) for name in columns}
    return Piece(columns, {name: outcomes[name] for name in sorted(outcomes) if outcomes[name]})


def _follow(
    follower: Follower, pictures: list[tuple[int, int, np.ndarray]], key: tuple[int, Seen] | None
) -> tuple[list[Seen], tuple[int, Seen]]:
    """What is seen in each picture (frame number, stamp, grey values) of a span; and its last frame with what a search
    of it found, which the next span begins with.
    """
    greys = [grey for _, _, grey in pictures]
    first = key[1] if key and key[0] == pictures[0][0] else follower.search(greys[0])
    if len(greys) == 1:
        return [first], (pictures[0][0], first)
    last = follower.search(greys[-1])
    time_s = np.array([time_ns - pictures[0][1] for _, time_ns, _ in pictures]) / 1e9
    return follower.follow(greys, time_s, first, last), (pictures[-1][0], last)


def _picture(frame: Frame, size: tuple[int, int], room: Pictures) -> tuple[np.ndarray | None, str]:
    try:
        grey = decode_grey(frame.data, frame.encoding, frame.width, frame.height, room)
    except DetectionError:
        return None, CORRUPT
    return (grey, SEARCHED) if grey.shape[::-1] == size else (None, WRONG_SIZE)


def columns_of(
    seen: Seen, status: np.ndarray, frame: np.ndarray, time_ns: np.ndarray
) -> dict[str, np.ndarray]:
    """Rows of the table `detections`; frame number and stamp of each tag."""
    columns: dict[str, np.ndarray] = {
        "frame": frame,
        "time_ns": time_ns,
        "family": seen.family,
        "tag_id": seen.tag_id.astype(np.int32),
        "side_px": seen.side_px,
        "hamming": seen.hamming.astype(np.int32),
        "margin": seen.margin,
        "how": seen.how,
        "status": status,
    }
    for name in ("blur_px", "motion_px", "noise", "contrast", "whole"):
        columns[name] = np.where(seen.reason == "", getattr(seen, name), np.nan)
    for k in range(4):
        columns[f"u{k}"], columns[f"v{k}"] = seen.uv[:, k, 0], seen.uv[:, k, 1]
        columns[f"cov{k}_uu"] = seen.cov[:, 2 * k, 2 * k]
        columns[f"cov{k}_uv"] = seen.cov[:, 2 * k, 2 * k + 1]
        columns[f"cov{k}_vv"] = seen.cov[:, 2 * k + 1, 2 * k + 1]
    return columns


def write_piece(part: Slice, piece: Piece) -> None:
    """Keep the result of a slice, whole or not at all. Raises ArtefactError."""
    tables.write_table(part.piece, "detections", piece.columns, {"frames": json.dumps(piece.frames)})


def read_piece(part: Slice) -> Piece:
    """The kept result of a slice. Raises ArtefactError."""
    return Piece(tables.read_table(part.piece, "detections"), _frames(part))


def is_whole(part: Slice) -> bool:
    """Whether the piece of a slice is there and can be read."""
    if not part.piece.exists():
        return False
    try:
        return sum(read_piece(part).frames.values()) == len(part.frame)
    except (ArtefactError, KeyError, ValueError):
        return False


def give_up(part: Slice) -> None:
    """Keep an empty piece of a slice that ends the processes that work on it. Raises ArtefactError."""
    write_piece(part, Piece(tables.empty_columns("detections"), {LOST: len(part.frame)}))


def given_up(slices: Iterable[Slice]) -> list[Slice]:
    """Those slices that were given up. Raises ArtefactError."""
    return [part for part in slices if LOST in _frames(part)]


def _frames(part: Slice) -> dict[str, int]:
    frames: dict[str, int] = json.loads(tables.table_metadata(part.piece)["frames"])
    return frames


def undone(slices: Sequence[Slice]) -> list[Slice]:
    """Those slices that have no whole piece; folders for the pieces are made. Raises ArtefactError."""
    waiting = [part for part in slices if not is_whole(part)]
    for part in waiting:
        try:
            part.piece.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ArtefactError(
                f"{part.piece.parent} cannot be made: {error.strerror or error}; make room or give another --runs"
            ) from error
    return waiting
