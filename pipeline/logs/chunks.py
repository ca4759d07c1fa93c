"""Chunks of an MCAP file: from bytes that somebody else wrote to messages, checked and bounded.

Every length is held against what holds it and against `MAX_CHUNK_BYTES` before memory is asked for, and every CRC
is checked; mcap's own readers believe the uncompressed size of a chunk.
"""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from typing import BinaryIO

import lz4.frame
import zstandard
from mcap.exceptions import McapError
from mcap.opcode import Opcode

MAX_CHUNK_BYTES = 512 << 20
"""No recorder writes chunks near this; memory stays under it whatever a file promises."""

HEADER = struct.Struct("<BQ")
"""Opcode and length, before every record."""
MESSAGE = struct.Struct("<HIQQ")
CHUNK = struct.Struct("<QQQI")
UNREADABLE = (McapError, struct.error, ValueError, EOFError, RuntimeError, zstandard.ZstdError)
"""What broken bytes make the libraries raise."""


class Damaged(Exception):
    """These bytes are not what an MCAP file promises."""


@dataclass(frozen=True)
class Span:
    """A chunk, or a run of messages outside chunks."""

    offset: int
    """Of its first record in the file."""
    length: int
    """Bytes in the file, record header included."""
    start_ns: int
    """Earliest log_time in it."""
    end_ns: int
    """Latest log_time in it."""
    chunked: bool
    channels: frozenset[int] | None
    """Ids of the channels in it; None where the file does not say."""


def load_span(file: BinaryIO, span: Span) -> memoryview:
    """The records of a span, decompressed and held against their CRC. Raises Damaged."""
    file.seek(span.offset)
    if not span.chunked:
        data = file.read(span.length)
        if len(data) != span.length:
            raise Damaged("the file ends inside a run of messages")
        return memoryview(data)
    if span.length > MAX_CHUNK_BYTES + 1024:
        raise Damaged(f"a chunk of {span.length} bytes")
    data = file.read(span.length)
    if len(data) != span.length or HEADER.unpack_from(data)[0] != Opcode.CHUNK:
        raise Damaged("no chunk where one should be")
    if HEADER.unpack_from(data)[1] != span.length - HEADER.size:
        raise Damaged("a chunk of another length than the index says")
    return _unpack_chunk(memoryview(data)[HEADER.size :])


def messages_of(data: memoryview, wanted: frozenset[int] | None) -> Iterator[tuple[int, int, memoryview]]:
    """Channel id, log_time and payload of the messages among some records. Raises Damaged."""
    for opcode, body in records_of(data):
        if opcode == Opcode.MESSAGE:
            if len(body) < MESSAGE.size:
                raise Damaged("a message shorter than its header")
            channel, _, log_time, _ = MESSAGE.unpack_from(body)
            if wanted is None or channel in wanted:
                yield channel, log_time, body[MESSAGE.size :]


def records_of(data: memoryview) -> Iterator[tuple[int, memoryview]]:
    position, end = 0, len(data)
    while position < end:
        if end - position < HEADER.size:
            raise Damaged("a record header is cut")
        opcode, length = HEADER.unpack_from(data, position)
        position += HEADER.size
        if length > end - position:
            raise Damaged("a record is longer than what holds it")
        yield opcode, data[position : position + length]
        position += length


def _unpack_chunk(body: memoryview) -> memoryview:
    try:
        _, _, size, crc = CHUNK.unpack_from(body)
        name_length = struct.unpack_from("<I", body, CHUNK.size)[0]
        at = CHUNK.size + 4 + name_length
        if name_length > 16 or size > MAX_CHUNK_BYTES:
            raise Damaged(f"a chunk that promises {size} bytes")
        compression = str(body[CHUNK.size + 4 : at], "utf-8")
        packed = body[at + 8 : at + 8 + struct.unpack_from("<Q", body, at)[0]]
        data = _decompressed(packed, compression, size)
    except UNREADABLE as error:
        raise Damaged(str(error)) from None
    if len(data) != size:
        raise Damaged(f"a chunk of {len(data)} bytes that promised {size}")
    if crc and zlib.crc32(data) != crc:
        raise Damaged("a chunk whose CRC does not agree")
    return data


def _decompressed(packed: memoryview, compression: str, size: int) -> memoryview:
    if compression == "":
        return packed
    # One byte more than promised is asked for, so that a bomb is noticed and never unpacked.
    if compression == "zstd":
        with zstandard.ZstdDecompressor().stream_reader(io.BytesIO(packed)) as stream:
            return memoryview(stream.read(size + 1))
    if compression == "lz4":
        return memoryview(lz4.frame.LZ4FrameDecompressor().decompress(bytes(packed), max_length=size + 1))
    raise Damaged(f"compression '{compression}' is not one of zstd, lz4, none")
