"""``gradetrace calibrate intrinsics``: pictures of a board in, intrinsics and a sheet out."""

from __future__ import annotations

import datetime
import hashlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.calibration.board import CHESSBOARD, parse_board
from pipeline.calibration.corners import CornerFinder
from pipeline.calibration.procedure import Intrinsics, calibrate_lens
from pipeline.calibration.video import frames_of_video
from pipeline.calibration.views import View, views_of_corner_file
from pipeline.config import load_machine
from pipeline.config.document import decode, read_file
from pipeline.detection.decode import decode_grey
from pipeline.errors import CalibrationError, DetectionError, UsageError
from pipeline.geometry.lenses import BROWN5, LENSES
from pipeline.logs.channels import IMAGE
from pipeline.logs.reader import read_log
from pipeline.report.intrinsics_sheet import intrinsics_sheet
from pipeline.runs import sha256_of_file
from pipeline.stages.calibrated import Written, lens_table, provenance, put_into, put_sheet, refuse_read_only

COMMAND = "gradetrace calibrate intrinsics"
MOST_PICTURES = 400
"""Of a recording that are searched for the board, evenly spread: they are looked at one by one, at some 0.1 s each."""
PICTURES = {".png": "png", ".jpg": "jpeg", ".jpeg": "jpeg"}
VIDEOS = {".mp4", ".avi", ".mov", ".mkv"}
CORNERS = ".vnl"
Watch = Callable[[int], None]


@dataclass(frozen=True)
class Recording:
    """Where pictures come from."""

    source: Path
    topic: str = ""
    """Of a log."""


@dataclass(frozen=True)
class LensWritten(Written):
    """What was written, and the lens."""

    found: Intrinsics


def calibrate_intrinsics(
    source: Path,
    board: str,
    camera: str = "",
    topic: str = "",
    machine: Path | None = None,
    model: str = BROWN5.name,
    distance_m: float = 10.0,
    size: tuple[int, int] | None = None,
    out: Path | None = None,
    watch: Watch = lambda pictures: None,
) -> LensWritten:
    """Calibrate one camera from a recording of a board.

    Parameters
    ----------
    source
        A log, a folder of pictures, a video or a corner file.
    board
        As `pipeline.calibration.board` reads it.
    camera
        Its name in the machine file, or any for the sheet.
    topic
        Of its pictures in the log; left out, the machine file's, or the only one that has pictures.
    machine
        Where the intrinsics go; left out, nowhere but on the sheet.
    model
        ``brown5``, ``brown8`` or ``fisheye``.
    distance_m
        Working distance.
    size
        Width and height of the pictures, px, of a corner file, which does not say.
    out
        Sheet; left out, ``intrinsics-NAME.html``.
    watch
        Told how many pictures were looked at.

    Raises
    ------
    CalibrationError, LogError, ConfigError, UsageError
        Nothing is written then.
    """
    printed, lens = parse_board(board), LENSES[model]
    if machine is not None:
        refuse_read_only(machine)
        topic = topic or _topic_of(machine, camera)
    source = _the_one(source)
    finder = CornerFinder(printed)
    views: list[View]
    if source.suffix == CORNERS:
        if printed.kind != CHESSBOARD:
            raise CalibrationError(
                f"{source}: a corner file has the corners of a chessboard; correct --board"
            )
        if size is None:
            raise UsageError(
                f"{source} does not say how large the pictures were; give --size, for example 1280x720"
            )
        views, odd = views_of_corner_file(read_file(source).decode("utf-8", "replace"), printed)
        if odd and not views:
            raise CalibrationError(
                f"{source}: no picture has the {len(printed.corners_m)} corners of {printed.text}; correct --board"
            )
        searched, date = len(views) + len(odd), _day_of(source)
    else:
        pictures = _Pictures(Recording(source, topic))
        for name, grey in pictures:
            found_size = (grey.shape[1], grey.shape[0])
            if size is not None and found_size != size:
                raise CalibrationError(
                    f"{source}: {name} is {found_size[0]}x{found_size[1]} px, others {size[0]}x{size[1]}; intrinsics "
                    "belong to one size of picture: keep those apart"
                )
            size = found_size
            finder.add(name, grey)
            watch(finder.pictures)
        if not finder.pictures or size is None:
            raise CalibrationError(
                f"{source}: there is no picture that can be read ({pictures.fault or 'none at all'})"
            )
        if not finder.found and (seen := finder.instead()):
            raise CalibrationError(
                f"{source}: the board {printed.text} is in none of {finder.pictures} pictures; {seen}; correct --board"
            )
        if wrong := finder.misprint():
            raise CalibrationError(f"{source}: {wrong}, and correct --board")
        views, searched, date = finder.views(), finder.pictures, pictures.date
    found = calibrate_lens(lens, views, printed, size, distance_m)
    sha256 = _hash_of(source)
    name = camera or source.stem
    sheet = intrinsics_sheet(found, name, printed.text, searched, _origin(source, topic, sha256, date))
    told = found.solution
    values = None
    if lens is BROWN5:
        stamp = provenance(date, COMMAND, source, sha256)
        values = lens_table(found.size, told.intrinsics, told.covariance, stamp)
    out = out or Path(f"intrinsics-{name}.html")
    kept = None
    if machine is not None and values is not None:
        kept = put_into(machine, "machine", {f"cameras.{camera}.intrinsics": values}, sheet, out)
    else:
        put_sheet(sheet, out)
    return LensWritten(
        sheet.sentence, tuple(sheet.remarks), out, machine if kept is not None else None, kept, found
    )


def _topic_of(machine: Path, camera: str) -> str:
    """The topic of a camera of a machine file. Raises ConfigError, UsageError."""
    cameras = load_machine(decode(read_file(machine), str(machine)), str(machine)).cameras
    if camera not in cameras:
        named = f"has no camera '{camera}'" if camera else "may have several cameras"
        raise UsageError(f"{machine} {named}; name one with --camera: {', '.join(sorted(cameras))}")
    return cameras[camera].topic


def _the_one(source: Path) -> Path:
    """A folder's only corner file or video instead of the folder."""
    if not source.is_dir():
        return source
    inside = sorted(path for path in source.iterdir() if path.suffix.lower() in {CORNERS, *VIDEOS})
    pictures = [path for path in source.iterdir() if path.suffix.lower() in PICTURES]
    if pictures or not inside:
        return source
    if len(inside) > 1:
        raise UsageError(f"{source} holds {', '.join(path.name for path in inside)}; name one of them")
    return inside[0]


class _Pictures:
    """Name and grey values of each picture, and the day of the recording once they were gone through."""

    def __init__(self, recording: Recording):
        self.recording = recording
        self.date = _day_of(recording.source)
        self.fault = ""
        """Why a picture could not be read."""

    def __iter__(self) -> Iterator[tuple[str, np.ndarray]]:
        source = self.recording.source
        if source.is_dir():
            yield from self._folder(source)
        elif source.suffix.lower() in VIDEOS:
            yield from frames_of_video(source, MOST_PICTURES)
        else:
            yield from self._log(source)

    def _folder(self, folder: Path) -> Iterator[tuple[str, np.ndarray]]:
        files = sorted(path for path in folder.iterdir() if path.suffix.lower() in PICTURES)
        if not files:
            raise CalibrationError(
                f"{folder}: holds no picture (png, jpg), no video (mp4) and no corner file (vnl)"
            )
        for file in files[:: -(-len(files) // MOST_PICTURES)]:
            try:
                yield file.name, decode_grey(file.read_bytes(), PICTURES[file.suffix.lower()])
            except DetectionError as fault:
                self.fault = f"{file.name}: {fault}"

    def _log(self, log: Path) -> Iterator[tuple[str, np.ndarray]]:
        with read_log(log) as reader:
            counts = {
                c.topic: c.message_count for c in reader.channels if c.carries == IMAGE and c.message_count
            }
            topic = self.recording.topic
            if not topic:
                if len(counts) != 1:
                    on = ", ".join(sorted(counts)) or "none"
                    raise UsageError(f"{log}: pictures are on: {on}; name one with --topic")
                topic = next(iter(counts))
            step = max(-(-counts.get(topic, 0) // MOST_PICTURES), 1)
            for number, frame in enumerate(reader.frames({"board": topic})):
                moment = datetime.datetime.fromtimestamp(frame.time_ns / 1e9, datetime.UTC)
                if number == 0:
                    self.date = moment.date()
                if number % step:
                    continue
                try:
                    grey = decode_grey(frame.data, frame.encoding, frame.width, frame.height)
                except DetectionError as fault:
                    self.fault = str(fault)
                    continue
                yield f"{moment:%H:%M:%S.%f}"[:-3], grey


def _day_of(path: Path) -> datetime.date:
    """When a file, or the newest in a folder, was last changed: the day of a recording that does not say."""
    if not path.exists():
        raise UsageError(f"{path}: no such file or folder")
    files = [path] if path.is_file() else [part for part in path.iterdir() if part.is_file()]
    latest = max((file.stat().st_mtime for file in files), default=path.stat().st_mtime)
    return datetime.datetime.fromtimestamp(latest, datetime.UTC).date()


def _hash_of(source: Path) -> str:
    """sha256 of a file, or of the names and hashes of the pictures in a folder."""
    if source.is_file():
        return sha256_of_file(source)
    digest = hashlib.sha256()
    for file in sorted(path for path in source.iterdir() if path.suffix.lower() in PICTURES):
        digest.update(f"{file.name} {sha256_of_file(file)}\n".encode())
    return digest.hexdigest()


def _origin(source: Path, topic: str, sha256: str, date: datetime.date) -> dict[str, str]:
    recorded = {"recorded": date.isoformat(), "file": source.name, "sha256": sha256}
    return recorded | ({"topic": topic} if topic else {})
