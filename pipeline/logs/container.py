"""An MCAP file as spans of messages: where they lie, what is whole, what is lost.

The summary at the end of a log tells where its chunks are. A log that was cut off has none, and one that a bad disk
touched may have a wrong one; then the records are walked from the front, up to the first that is not whole. Either
way a reader gets the same thing, `Contents`, and takes chunk after chunk from it: one damaged chunk costs that chunk.

The file is somebody else's: every length in it is held against the file's size and `MAX_CHUNK_BYTES` before memory
is asked for. mcap's own readers do not serve here: on a cut file they fail with a misleading complaint about
record lengths, without a summary they drop the check of CRCs, and they believe the uncompressed size of a chunk.
"""

from __future__ import annotations

import io
import struct
import zlib
from collections import Counter
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import BinaryIO

from mcap import records
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode

from pipeline.errors import LogError
from pipeline.logs.chunks import (
    CHUNK,
    HEADER,
    MAX_CHUNK_BYTES,
    MESSAGE,
    UNREADABLE,
    Damaged,
    Span,
    load_span,
    records_of,
)

MAGIC = b"\x89MCAP0\r\n"
MAX_SUMMARY_BYTES = 512 << 20
PLAIN_SPAN_BYTES = 4 << 20
"""Messages outside chunks are taken together to about this size."""

_FOOTER = struct.Struct("<QQI")
_FOOTER_BYTES = HEADER.size + _FOOTER.size + len(MAGIC)


@dataclass(frozen=True)
class RawChannel:
    """A channel record with its schema's name."""

    topic: str
    encoding: str
    schema_name: str
    schema_encoding: str
    schema: bytes = field(repr=False, default=b"")


@dataclass(frozen=True)
class AttachmentEntry:
    """Where an attachment lies."""

    name: str
    media_type: str
    data_offset: int
    data_size: int


@dataclass(frozen=True)
class Break:
    """The place where a file stops being readable."""

    offset: int
    lost_bytes: int
    """From there to the end, a tail of zeros not counted."""
    promised_end_ns: int | None
    """Latest log_time that the header of the cut chunk announces."""


@dataclass(frozen=True)
class Contents:
    """What a log holds and where."""

    path: Path
    size: int
    profile: str
    library: str
    spans: tuple[Span, ...]
    channels: dict[int, RawChannel]
    counts: dict[int, int]
    attachments: tuple[AttachmentEntry, ...]
    broken: Break | None = None


def read_contents(path: Path) -> Contents:
    """Where everything lies in a log, whole or not.

    Raises
    ------
    LogError
        No such file, an empty one, or one that is no MCAP.
    """
    found = indexed_contents(path)
    if found is None:
        with path.open("rb") as file:
            found = _by_walking(path, file, _size_of(path))
    return found


def indexed_contents(path: Path) -> Contents | None:
    """The same by the log's own summary alone, in no time; None where it has none that can be used.

    Raises LogError as `read_contents` does.
    """
    size = _size_of(path)
    with path.open("rb") as file:
        _check_magic(path, file.read(64))
        try:
            return _from_summary(path, file, size)
        except (Damaged, *UNREADABLE):
            return None


def _size_of(path: Path) -> int:
    if path.is_dir():
        logs = sorted(child.name for child in path.glob("*.mcap*"))
        hint = f"; name one of the logs in it: {', '.join(logs[:5])}" if logs else ""
        raise LogError(f"{path}: is a folder, not a log{hint}")
    try:
        size = path.stat().st_size
    except OSError as error:
        reason = (
            "no such file" if isinstance(error, FileNotFoundError) else f"cannot be read ({error.strerror})"
        )
        raise LogError(f"{path}: {reason}; give the path of an MCAP log") from None
    if size == 0:
        raise LogError(f"{path}: the file is empty (0 bytes); the recording or the copy of it failed")
    return size


def _check_magic(path: Path, start: bytes) -> None:
    if start.startswith(MAGIC):
        return
    if start.startswith(b"\x28\xb5\x2f\xfd"):
        raise LogError(
            f"{path}: the whole file is compressed with zstd, as rosbag2 does with --compression-mode file; "
            f"unpack it with 'zstd -d {path.name}' and give the unpacked log, and record the next one with "
            "compression inside the MCAP (--storage-preset-profile zstd_fast)"
        )
    kinds = {
        b"SQLite format 3": "a rosbag2 database (sqlite3); convert it: ros2 bag convert with storage_id: mcap",
        b"#ROSBAG": "a ROS 1 bag; convert it: mcap convert in.bag out.mcap",
        b"\x1f\x8b": "compressed with gzip; unpack it with gunzip first",
        b"PK\x03\x04": "a zip archive; unpack it first",
    }
    for magic, what in kinds.items():
        if start.startswith(magic):
            raise LogError(f"{path}: is {what}")
    if not start.strip(b"\0"):
        raise LogError(f"{path}: begins with zeros, no MCAP log; the copy or the disk failed")
    raise LogError(f"{path}: is not an MCAP log (its first bytes are {start[:8].hex(' ')})")


@dataclass
class _Draft:
    """What has been learnt of a file so far."""

    profile: str = ""
    library: str = ""
    spans: list[Span] = field(default_factory=list)
    schemas: dict[int, records.Schema] = field(default_factory=dict)
    channels: dict[int, records.Channel] = field(default_factory=dict)
    counts: Counter[int] = field(default_factory=Counter)
    attachments: list[AttachmentEntry] = field(default_factory=list)

    def note(self, opcode: int, body: memoryview) -> None:
        """Keep a schema or a channel."""
        if opcode == Opcode.SCHEMA:
            schema = records.Schema.read(_stream(body))
            self.schemas.setdefault(schema.id, schema)
        elif opcode == Opcode.CHANNEL:
            channel = records.Channel.read(_stream(body))
            self.channels.setdefault(channel.id, channel)

    def finished(self, path: Path, size: int, broken: Break | None) -> Contents:
        channels = {}
        for number, channel in self.channels.items():
            schema = self.schemas.get(channel.schema_id)
            channels[number] = RawChannel(
                topic=channel.topic,
                encoding=channel.message_encoding,
                schema_name=schema.name if schema else "",
                schema_encoding=schema.encoding if schema else "",
                schema=schema.data if schema else b"",
            )
        return Contents(
            path=path,
            size=size,
            profile=self.profile,
            library=self.library,
            spans=tuple(self.spans),
            channels=channels,
            counts={number: self.counts.get(number, 0) for number in channels},
            attachments=tuple(self.attachments),
            broken=broken,
        )


def _stream(body: memoryview | bytes) -> ReadDataStream:
    return ReadDataStream(io.BytesIO(body))


def _from_summary(path: Path, file: BinaryIO, size: int) -> Contents | None:
    """Contents by the log's own summary; None where it has none, or not all of one. Raises Damaged."""
    draft = _Draft()
    if size < len(MAGIC) + _FOOTER_BYTES:
        return None
    file.seek(size - _FOOTER_BYTES)
    tail = file.read(_FOOTER_BYTES)
    start, _, crc = _FOOTER.unpack_from(tail, HEADER.size)
    length = size - _FOOTER_BYTES - start
    if tail[0] != Opcode.FOOTER or not tail.endswith(MAGIC) or start == 0:
        return None
    if start < len(MAGIC) or not 0 < length <= MAX_SUMMARY_BYTES:
        raise Damaged("the footer points outside the file")
    file.seek(start)
    summary = memoryview(file.read(length))
    if crc and zlib.crc32(tail[: HEADER.size + 16], zlib.crc32(summary)) != crc:
        raise Damaged("the CRC of the summary does not agree")
    statistics = None
    for opcode, body in records_of(summary):
        draft.note(opcode, body)
        if opcode == Opcode.STATISTICS:
            statistics = records.Statistics.read(_stream(body))
        elif opcode == Opcode.CHUNK_INDEX:
            draft.spans.append(_indexed_span(records.ChunkIndex.read(_stream(body)), size))
        elif opcode == Opcode.ATTACHMENT_INDEX:
            index = records.AttachmentIndex.read(_stream(body))
            if entry := _attachment_at(file, index.offset, size):
                draft.attachments.append(entry)
    if statistics is None or (statistics.message_count and not draft.spans):
        return None
    if len(draft.attachments) != statistics.attachment_count:
        return None
    if any(number not in draft.channels for number in statistics.channel_message_counts):
        return None
    draft.counts.update(statistics.channel_message_counts)
    draft.spans.sort(key=lambda span: span.offset)
    _read_header(file, draft)
    return draft.finished(path, size, None)


def _indexed_span(index: records.ChunkIndex, size: int) -> Span:
    if index.chunk_start_offset + index.chunk_length > size:
        raise Damaged("an index points outside the file")
    return Span(
        offset=index.chunk_start_offset,
        length=index.chunk_length,
        start_ns=index.message_start_time,
        end_ns=index.message_end_time,
        chunked=True,
        channels=frozenset(index.message_index_offsets) or None,
    )


def _read_header(file: BinaryIO, draft: _Draft) -> None:
    file.seek(len(MAGIC))
    opcode, length = HEADER.unpack(file.read(HEADER.size))
    if opcode == Opcode.HEADER and length < 4096:
        header = records.Header.read(_stream(file.read(length)))
        draft.profile, draft.library = header.profile, header.library


def _attachment_at(file: BinaryIO, offset: int, size: int) -> AttachmentEntry | None:
    """The attachment whose record begins at `offset`; its data is not read."""
    file.seek(offset)
    head = file.read(HEADER.size + 16 + 4096)
    try:
        opcode, length = HEADER.unpack_from(head)
        if opcode != Opcode.ATTACHMENT:
            return None
        stream = _stream(head[HEADER.size :])
        stream.read(16)
        name, media_type = stream.read_prefixed_string(), stream.read_prefixed_string()
        data_size = stream.read8()
    except UNREADABLE:
        return None
    data_offset = offset + HEADER.size + stream.count
    if data_offset + data_size + 4 > min(size, offset + HEADER.size + length):
        return None
    return AttachmentEntry(name, media_type, data_offset, data_size)


def _by_walking(path: Path, file: BinaryIO, size: int) -> Contents:
    """Contents of a log without a usable summary, as far as its records are whole."""
    draft = _Draft()
    position = len(MAGIC)
    promised_end_ns: int | None = None
    ended = False
    while not ended and size - position >= HEADER.size:
        file.seek(position)
        opcode, length = HEADER.unpack(file.read(HEADER.size))
        end = position + HEADER.size + length
        if opcode == 0 or end > size:
            if opcode == Opcode.CHUNK:
                promised_end_ns = _announced_end(file.read(CHUNK.size))
            break
        try:
            _walk_record(file, draft, opcode, position, length, size)
        except (Damaged, *UNREADABLE):
            if opcode in (Opcode.HEADER, Opcode.SCHEMA, Opcode.CHANNEL):
                break
        ended = opcode == Opcode.DATA_END
        position = end
    broken = None
    if not ended:
        broken = Break(position, _bytes_before_zeros(file, position, size), promised_end_ns)
    if not draft.channels and broken:
        raise LogError(
            f"{path}: breaks off after {position} of {size} bytes, before the first message; nothing can be recovered"
        )
    return draft.finished(path, size, broken)


def _walk_record(file: BinaryIO, draft: _Draft, opcode: int, position: int, length: int, size: int) -> None:
    """Learn what one whole record, whose header was just read, tells."""
    if opcode == Opcode.ATTACHMENT:
        if entry := _attachment_at(file, position, size):
            draft.attachments.append(entry)
    elif opcode == Opcode.CHUNK:
        _walk_chunk(file, draft, position, HEADER.size + length)
    elif opcode == Opcode.MESSAGE:
        channel, _, log_time, _ = MESSAGE.unpack(file.read(MESSAGE.size))
        draft.counts[channel] += 1
        here = Span(position, HEADER.size + length, log_time, log_time, False, frozenset([channel]))
        last = draft.spans[-1] if draft.spans else None
        follows = last and not last.chunked and last.offset + last.length == position
        if last and last.channels and follows and last.length < PLAIN_SPAN_BYTES:
            draft.spans[-1] = replace(
                last,
                length=last.length + here.length,
                start_ns=min(last.start_ns, log_time),
                end_ns=max(last.end_ns, log_time),
                channels=last.channels | {channel},
            )
        else:
            draft.spans.append(here)
    elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL) and length < MAX_CHUNK_BYTES:
        draft.note(opcode, memoryview(file.read(length)))
    elif opcode == Opcode.HEADER and length < 4096:
        header = records.Header.read(_stream(file.read(length)))
        draft.profile, draft.library = header.profile, header.library


def _walk_chunk(file: BinaryIO, draft: _Draft, position: int, length: int) -> None:
    start_ns, end_ns, _, _ = CHUNK.unpack(file.read(CHUNK.size))
    span = Span(position, length, start_ns, end_ns, True, None)
    # A damaged chunk stays in the list: it is counted when it is read.
    draft.spans.append(span)
    seen: Counter[int] = Counter()
    for opcode, body in records_of(load_span(file, span)):
        draft.note(opcode, body)
        if opcode == Opcode.MESSAGE:
            seen[MESSAGE.unpack_from(body)[0]] += 1
    draft.counts.update(seen)
    draft.spans[-1] = replace(span, channels=frozenset(seen))


def _announced_end(head: bytes) -> int | None:
    if len(head) < CHUNK.size:
        return None
    start_ns, end_ns, _, _ = CHUNK.unpack(head)
    return end_ns if start_ns <= end_ns else None


def _bytes_before_zeros(file: BinaryIO, start: int, size: int) -> int:
    """Bytes from `start` to the end of the file, not counting a tail of zeros (a disk that lost power)."""
    end, block = size, 1 << 20
    while end > start:
        begin = max(start, end - block)
        file.seek(begin)
        text = file.read(end - begin).rstrip(b"\0")
        if text:
            return begin + len(text) - start
        end = begin
    return 0
