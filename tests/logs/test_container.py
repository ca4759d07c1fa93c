"""Files that lie about their lengths."""

import random
import struct

import pytest
import zstandard

from pipeline.errors import PipelineError
from pipeline.logs.chunks import Damaged, Span, load_span
from pipeline.logs.container import MAGIC
from pipeline.logs.reader import read_log

from .conftest import write


def chunk_record(data: bytes, size: int, compression: bytes) -> bytes:
    body = struct.pack("<QQQI", 1, 2, size, 0) + struct.pack("<I", len(compression)) + compression
    body += struct.pack("<Q", len(data)) + data
    return struct.pack("<BQ", 0x06, len(body)) + body


@pytest.mark.parametrize("promised", [1000, 2**40])
def test_a_chunk_that_unpacks_to_more_than_it_promises_is_refused_before_it_does(tmp_path, promised):
    import tracemalloc

    bomb = zstandard.compress(bytes(200_000_000))
    path = tmp_path / "bomb.mcap"
    record = chunk_record(bomb, promised, b"zstd")
    path.write_bytes(MAGIC + record)
    tracemalloc.start()
    with path.open("rb") as file, pytest.raises(Damaged):
        load_span(file, Span(len(MAGIC), len(record), 1, 2, True, None))
    assert tracemalloc.get_traced_memory()[1] < 20_000_000
    tracemalloc.stop()


def test_any_flipped_byte_gives_a_result_or_a_sentence(tmp_path):
    """No traceback, no hang, no huge allocation, whatever byte is wrong."""
    data = write(tmp_path / "shift.mcap", n=6, chunk_size=2000).read_bytes()
    rng = random.Random(3)
    path = tmp_path / "flipped.mcap"
    for _ in range(300):
        broken = bytearray(data)
        for _ in range(rng.choice([1, 1, 4])):
            broken[rng.randrange(8, len(data))] = rng.choice([0, 1, 0x7F, 0xFF])
        path.write_bytes(broken[: rng.choice([len(data), rng.randrange(9, len(data))])])
        try:
            with read_log(path) as reader:
                assert all(channel.message_count >= 0 for channel in reader.channels)
                reader.attachments()
                reader.calibrations()
                for channel in reader.channels:
                    if channel.carries == "image":
                        list(reader.frames({"cam": channel.topic}))
                    elif channel.carries == "sample":
                        list(reader.samples({"pot": (channel.topic, "value")}))
                assert reader.recovery.lost_seconds >= 0
        except PipelineError as refusal:
            assert "\n" not in str(refusal)
