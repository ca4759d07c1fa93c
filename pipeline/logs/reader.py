"""Reading a log: its channels, frames, sensor readings, calibrations and attachments, and what of it is lost.

Everything streams: a chunk at a time is in memory, however long the log. Messages come in the order of the file;
putting stamps in order is the business of whoever collects them (`pipeline.logs.clock`).
"""

from __future__ import annotations

import hashlib
import os
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import BinaryIO

from pipeline.errors import LogError
from pipeline.logs.cdr import MalformedMessage
from pipeline.logs.channels import CALIBRATION, IMAGE, SAMPLE, Channel
from pipeline.logs.chunks import Damaged, Span, load_span, messages_of
from pipeline.logs.container import Contents, read_contents
from pipeline.logs.messages import (
    Calibration,
    calibration_decoder,
    cannot_read,
    picture_decoder,
    reading_decoder,
)

MAX_ATTACHMENT_BYTES = 16 << 20
"""Of one attachment that is handed out whole; larger ones are only hashed."""
MAX_ATTACHMENTS = 1000


@dataclass(frozen=True)
class Frame:
    """One picture of one camera."""

    camera: str
    time_ns: int
    """Capture stamp, UTC."""
    log_time_ns: int
    """When the recorder received it."""
    data: bytes
    """JPEG or PNG; for raw, height x width grey values."""
    encoding: str
    """jpeg, png or raw."""
    width: int
    """Pixels, of raw pictures; 0 for the others."""
    height: int


@dataclass(frozen=True)
class Sample:
    """One reading of one sensor."""

    sensor: str
    time_ns: int
    raw: float
    log_time_ns: int = 0


@dataclass(frozen=True)
class Recovery:
    """How much of a log could be read."""

    complete: bool
    lost_bytes: int
    lost_seconds: float
    damaged_chunks: int
    sentence: str
    """For the report; empty if nothing is missing."""


def read_log(path: str | os.PathLike[str], contents: Contents | None = None) -> LogReader:
    """A reader of an MCAP log; a context manager.

    Parameters
    ----------
    path
        Of the log.
    contents
        What another reader of the same file has found, so that a cut log is walked only once.

    Raises
    ------
    LogError
        No such file, an empty file, or not an MCAP.
    """
    return LogReader(Path(path), contents or read_contents(Path(path)))


class LogReader:
    """An open log."""

    def __init__(self, path: Path, contents: Contents):
        self.path = path
        self.contents = contents
        self.faults: Counter[tuple[str, str]] = Counter()
        """Messages that could not be understood, by (topic, reason)."""
        self._damaged: dict[Span, str] = {}
        self._file: BinaryIO | None = None

    def __enter__(self) -> LogReader:
        self._file = self.path.open("rb")
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._open_file().close()
        self._file = None

    def _open_file(self) -> BinaryIO:
        assert self._file is not None, "use LogReader in a with block"
        return self._file

    @property
    def channels(self) -> list[Channel]:
        """The channels of the log, by topic; several of one topic and type are one."""
        merged: dict[tuple[str, str, str, str], int] = {}
        for number, raw in self.contents.channels.items():
            key = (raw.topic, raw.schema_name, raw.encoding, raw.schema_encoding)
            merged[key] = merged.get(key, 0) + self.contents.counts.get(number, 0)
        return [
            Channel(topic, name, encoding, count, schema_encoding)
            for (topic, name, encoding, schema_encoding), count in sorted(merged.items())
        ]

    def attachments(self) -> dict[str, bytes]:
        """Attachments by name, the later where two have one name; those over 16 MiB are left out."""
        found = {}
        file = self._open_file()
        for entry in self.contents.attachments[:MAX_ATTACHMENTS]:
            if entry.data_size <= MAX_ATTACHMENT_BYTES:
                file.seek(entry.data_offset)
                found[entry.name] = file.read(entry.data_size)
        return found

    def attachment_hashes(self) -> dict[str, tuple[int, str]]:
        """Bytes and sha256 of each attachment, of any size."""
        hashes = {}
        file = self._open_file()
        for entry in self.contents.attachments[:MAX_ATTACHMENTS]:
            digest, left = hashlib.sha256(), entry.data_size
            file.seek(entry.data_offset)
            while left > 0 and (block := file.read(min(left, 1 << 20))):
                digest.update(block)
                left -= len(block)
            hashes[entry.name] = (entry.data_size, digest.hexdigest())
        return hashes

    def frames(
        self, topics: Mapping[str, str], start_ns: int | None = None, end_ns: int | None = None
    ) -> Iterator[Frame]:
        """Frames of some cameras, in the order of the file.

        Parameters
        ----------
        topics
            Camera name -> topic.
        start_ns, end_ns : int or None
            Only messages *received* in ``[start_ns, end_ns)``: log_time is what an MCAP is indexed by.

        Raises
        ------
        LogError
            A topic that is not in the log, holds no message, or carries something that is no picture.
        """
        wanted = {}
        for camera, topic in topics.items():
            for number in self._channels_of(topic, IMAGE, f"camera '{camera}'"):
                decode = picture_decoder(self._channel(number))
                assert decode is not None
                wanted[number] = (camera, topic, decode)
        for number, log_time_ns, payload in self._messages(frozenset(wanted), start_ns, end_ns):
            camera, topic, decode = wanted[number]
            try:
                picture = decode(payload)
            except MalformedMessage as fault:
                self.faults[topic, str(fault)] += 1
                continue
            yield Frame(
                camera,
                picture.time_ns,
                log_time_ns,
                picture.data,
                picture.encoding,
                picture.width,
                picture.height,
            )

    def samples(
        self,
        sensors: Mapping[str, tuple[str, str]],
        start_ns: int | None = None,
        end_ns: int | None = None,
    ) -> Iterator[Sample]:
        """Readings of some sensors, in the order of the file.

        Parameters
        ----------
        sensors
            Sensor name -> (topic, field); for joint states the field is the joint's name.
        start_ns, end_ns : int or None
            Only messages *received* in ``[start_ns, end_ns)``.

        Raises
        ------
        LogError
            A topic that is not in the log, holds no message, or carries something that is no reading.
        """
        wanted: dict[int, list] = {}
        for sensor, (topic, field) in sensors.items():
            for number in self._channels_of(topic, SAMPLE, f"sensor '{sensor}'"):
                decode = reading_decoder(self._channel(number), field)
                assert decode is not None
                wanted.setdefault(number, []).append((sensor, topic, decode))
        for number, log_time_ns, payload in self._messages(frozenset(wanted), start_ns, end_ns):
            for sensor, topic, decode in wanted[number]:
                try:
                    time_ns, raw = decode(payload)
                except MalformedMessage as fault:
                    self.faults[topic, str(fault)] += 1
                    continue
                yield Sample(sensor, time_ns, raw, log_time_ns)

    def calibrations(self) -> dict[str, Calibration]:
        """The first calibration on each topic that carries them."""
        decoders = {}
        for number in self.contents.channels:
            if decode := calibration_decoder(self._channel(number)):
                decoders[number] = decode
        found: dict[str, Calibration] = {}
        waiting = set(decoders)
        # One pass per channel: the chunk index leads straight to its first message.
        for number in sorted(waiting):
            topic = self.contents.channels[number].topic
            for _, _, payload in self._messages(frozenset([number])):
                try:
                    found.setdefault(topic, decoders[number](payload))
                    break
                except MalformedMessage as fault:
                    self.faults[topic, str(fault)] += 1
        return found

    @property
    def log_time_range(self) -> tuple[int, int] | None:
        """Earliest and latest log_time of what lies in whole chunks, or None where nothing does."""
        spans = [span for span in self.contents.spans if span not in self._damaged]
        if not spans:
            return None
        return min(span.start_ns for span in spans), max(span.end_ns for span in spans)

    @property
    def recovery(self) -> Recovery:
        """What is lost, as far as the log has been read: a damaged chunk is found when it is read."""
        return recovery_of(self.contents, self._damaged)

    def _channel(self, number: int) -> Channel:
        raw = self.contents.channels[number]
        count = self.contents.counts.get(number, 0)
        return Channel(raw.topic, raw.schema_name, raw.encoding, count, raw.schema_encoding)

    def _channels_of(self, topic: str, kind: str, reader: str) -> list[int]:
        """Ids of the channels that carry `kind` on a topic. Raises LogError."""
        here = [number for number, raw in self.contents.channels.items() if raw.topic == topic]
        others = sorted({channel.topic for channel in self.channels if channel.carries == kind})
        listed = (
            f"; {_WHAT[kind]} are on: {', '.join(others[:20])}"
            if others
            else f"; the log has no {_WHAT[kind]}"
        )
        if not here:
            raise LogError(
                f"{self.path}: {reader} reads topic '{topic}', which is not in the log{listed}; "
                "correct 'topic' in machine.toml or give another log"
            )
        usable = [number for number in here if self._channel(number).carries == kind]
        if not usable:
            raise LogError(f"{self.path}: {reader}: {cannot_read(self._channel(here[0]), kind)}{listed}")
        if not any(self.contents.counts.get(number, 0) for number in usable):
            raise LogError(
                f"{self.path}: {reader} reads topic '{topic}', which holds no message{listed}; "
                "was it connected when the log was recorded?"
            )
        return usable

    def _messages(
        self, channels: frozenset[int], start_ns: int | None = None, end_ns: int | None = None
    ) -> Iterator[tuple[int, int, memoryview]]:
        file = self._open_file()
        for span in self.contents.spans:
            if span.channels is not None and not span.channels & channels:
                continue
            if (start_ns is not None and span.end_ns < start_ns) or (
                end_ns is not None and span.start_ns >= end_ns
            ):
                continue
            try:
                for number, log_time_ns, payload in messages_of(load_span(file, span), channels):
                    if (start_ns is None or log_time_ns >= start_ns) and (
                        end_ns is None or log_time_ns < end_ns
                    ):
                        yield number, log_time_ns, payload
            except Damaged as damage:
                self._damaged[span] = str(damage)


_WHAT = {IMAGE: "pictures", SAMPLE: "sensor readings", CALIBRATION: "calibrations"}


def recovery_of(contents: Contents, damaged: Mapping[Span, str]) -> Recovery:
    """What a cut file and its damaged chunks cost, in bytes and seconds."""
    whole = [span for span in contents.spans if span not in damaged]
    start_ns = min((span.start_ns for span in whole), default=0)
    end_ns = max((span.end_ns for span in whole), default=0)
    duration_s = (end_ns - start_ns) * 1e-9
    whole_bytes = sum(span.length for span in whole)
    seconds_per_byte = duration_s / whole_bytes if whole_bytes else 0.0
    lost_bytes, lost_seconds, parts = 0, 0.0, []
    if damaged:
        # A chunk's own times may be what is damaged, so its length is held against the mean rate.
        in_chunks = sum(
            min(max(span.end_ns - span.start_ns, 0) * 1e-9, 10 * span.length * seconds_per_byte)
            for span in damaged
        )
        size = sum(span.length for span in damaged)
        lost_bytes, lost_seconds = lost_bytes + size, lost_seconds + in_chunks
        few = f"{len(damaged)} damaged chunk{'s' if len(damaged) > 1 else ''}"
        parts.append(f"{few} ({size:,} bytes, about {in_chunks:.1f} s) could not be read")
    if contents.broken:
        cut = contents.broken
        estimate = cut.lost_bytes * seconds_per_byte
        promised = ((cut.promised_end_ns or 0) - end_ns) * 1e-9 if whole else 0.0
        # The cut chunk says how far it reached; where it cannot be believed or is cut in its header, the
        # bytes at the log's mean rate have to do. Both say what is lost of the file, not of the shift.
        at_end = promised if 0 < promised < 60 + 10 * estimate else estimate
        lost_bytes, lost_seconds = lost_bytes + cut.lost_bytes, lost_seconds + at_end
        lost = f"about {at_end:.1f} s at its end are lost" if cut.lost_bytes else "it was never closed"
        parts.append(
            f"it breaks off after {cut.offset:,} of {contents.size:,} bytes: {lost}, "
            "and whatever would have been recorded after that"
        )
    return Recovery(
        complete=not parts,
        lost_bytes=lost_bytes,
        lost_seconds=lost_seconds,
        damaged_chunks=len(damaged),
        sentence=f"the log is not whole: {'; '.join(parts)}" if parts else "",
    )
