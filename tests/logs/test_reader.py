import tracemalloc

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import IndexType, Writer

from pipeline.errors import LogError
from pipeline.logs.reader import read_log
from pipeline.logs.writer import LogWriter

from .conftest import START, STEP, N, jpeg, write

CAMERAS = {"cab": "/cab/image", "stick": "/stick/image"}
SENSORS = {
    "pot": ("/pot", "value"),
    "pot_json": ("/pot_json", "value"),
    "joints": ("/joints", "bucket"),
    "joints_json": ("/joints_json", "bucket"),
}


def test_every_frame_comes_back_with_its_capture_stamp(log):
    with read_log(log) as reader:
        frames = list(reader.frames(CAMERAS))
        assert reader.recovery.complete
        assert reader.recovery.sentence == ""
    for camera, first, delay in (("cab", 0, 5_000_000), ("stick", 1000, 7_000_000)):
        mine = [frame for frame in frames if frame.camera == camera]
        assert [frame.time_ns for frame in mine] == [START + k * STEP for k in range(N)]
        assert [frame.log_time_ns for frame in mine] == [START + k * STEP + delay for k in range(N)]
        assert [frame.data for frame in mine] == [jpeg(first + k) for k in range(N)]
        assert {frame.encoding for frame in mine} == {"jpeg"}


@pytest.mark.parametrize("sensor", SENSORS)
def test_every_form_of_a_reading_gives_the_same_numbers(log, sensor):
    with read_log(log) as reader:
        samples = list(reader.samples({sensor: SENSORS[sensor]}))
    assert [(s.time_ns, s.raw) for s in samples] == [(START + k * STEP, 0.5 + k) for k in range(N)]


@pytest.mark.parametrize("compression", ["none", "zstd", "lz4"])
def test_channels_count_what_mcaps_own_reader_counts(tmp_path, compression):
    path = write(tmp_path / "shift.mcap", compression=compression)
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
        expected = {
            summary.channels[number].topic: count
            for number, count in summary.statistics.channel_message_counts.items()
        }
    with read_log(path) as reader:
        assert {channel.topic: channel.message_count for channel in reader.channels} == expected
        assert len(list(reader.frames(CAMERAS))) == 2 * N


def test_a_time_range_is_half_open_in_time_of_receipt(log):
    with read_log(log) as reader:
        start, end = START + 10 * STEP + 5_000_000, START + 20 * STEP + 5_000_000
        found = [frame.time_ns for frame in reader.frames({"cab": "/cab/image"}, start, end)]
    assert found == [START + k * STEP for k in range(10, 20)]


def test_raw_pictures_become_grey_values(tmp_path):
    grey = np.arange(12, dtype=np.uint8).reshape(3, 4)
    with LogWriter(tmp_path / "raw.mcap") as log:
        log.raw_image("/raw", START, "cam", grey)
    with read_log(tmp_path / "raw.mcap") as reader:
        (frame,) = reader.frames({"cam": "/raw"})
    assert (frame.encoding, frame.width, frame.height) == ("raw", 4, 3)
    assert np.array_equal(np.frombuffer(frame.data, np.uint8).reshape(3, 4), grey)


def test_the_calibration_comes_in_our_order(log):
    with read_log(log) as reader:
        calibration = reader.calibrations()["/cab/info"]
    assert calibration.problem == ""
    assert (calibration.width, calibration.height) == (640, 480)
    assert calibration.intrinsics.tolist() == [850, 851, 320, 240, 0.1, 0.2, 0.3, 0.4, 0.5]


def test_attachments_and_their_hashes(log):
    import hashlib

    with read_log(log) as reader:
        assert reader.attachments() == {"machine.toml": b"[machine]\n", "site.toml": b"[site]\n"}
        assert reader.attachment_hashes()["site.toml"] == (7, hashlib.sha256(b"[site]\n").hexdigest())


@pytest.mark.parametrize("compression", ["none", "zstd"])
@pytest.mark.parametrize("part", [0.999, 0.9, 0.6, 0.31, 0.1])
def test_a_cut_log_gives_every_whole_chunk_and_says_what_is_lost(tmp_path, part, compression):
    whole = write(tmp_path / "whole.mcap", compression=compression)
    data = whole.read_bytes()
    with whole.open("rb") as stream:
        chunks = make_reader(stream).get_summary().chunk_indexes
    size = int(part * chunks[-1].chunk_start_offset)
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(data[:size])
    kept = [chunk for chunk in chunks if chunk.chunk_start_offset + chunk.chunk_length <= size]
    last_ns = max(chunk.message_end_time for chunk in kept)
    with read_log(cut) as reader:
        frames = list(reader.frames({"cab": "/cab/image"}))
        recovery = reader.recovery
    with whole.open("rb") as stream:
        expected = [
            message.log_time
            for _, _, message in make_reader(stream).iter_messages(
                topics=["/cab/image"], log_time_order=False
            )
        ][: len(frames)]
    assert [frame.log_time_ns for frame in frames] == expected
    assert last_ns - STEP < frames[-1].log_time_ns <= last_ns
    assert not recovery.complete
    # What the file still promises is the end of the chunk that was cut; one chunk here is about 0.3 s.
    in_cut = next(
        (c for c in chunks if c.chunk_start_offset < size < c.chunk_start_offset + c.chunk_length), None
    )
    if in_cut and size - in_cut.chunk_start_offset > 60:
        assert recovery.lost_seconds == pytest.approx((in_cut.message_end_time - last_ns) * 1e-9, abs=1e-6)
    else:
        assert recovery.lost_seconds < 0.5
    assert f"of {size:,} bytes" in recovery.sentence


def test_zeros_at_the_end_are_not_counted_as_lost_data(tmp_path, log):
    data = log.read_bytes()
    path = tmp_path / "zeros.mcap"
    path.write_bytes(data[: len(data) // 2] + bytes(5_000_000))
    with read_log(path) as reader:
        assert len(list(reader.frames({"cab": "/cab/image"}))) > N / 3
        assert reader.recovery.lost_bytes < 10_000


@pytest.mark.parametrize("with_summary", [True, False])
def test_a_damaged_chunk_costs_only_its_own_messages(tmp_path, log, with_summary):
    data = bytearray(log.read_bytes())
    with log.open("rb") as stream:
        chunks = make_reader(stream).get_summary().chunk_indexes
    hit = chunks[len(chunks) // 2]
    data[hit.chunk_start_offset + hit.chunk_length // 2] ^= 0xFF
    if not with_summary:
        del data[-40:]
    path = tmp_path / "damaged.mcap"
    path.write_bytes(data)
    with read_log(path) as reader:
        found = {frame.log_time_ns for frame in reader.frames({"cab": "/cab/image"})}
        list(reader.samples(SENSORS))
        recovery = reader.recovery
    everything = {START + k * STEP + 5_000_000 for k in range(N)}
    missing = everything - found
    assert missing
    assert all(hit.message_start_time <= t <= hit.message_end_time for t in missing)
    assert recovery.damaged_chunks == 1
    assert recovery.lost_seconds == pytest.approx(
        (hit.message_end_time - hit.message_start_time) * 1e-9, abs=1e-6
    )
    assert "1 damaged chunk" in recovery.sentence


def test_a_log_without_its_summary_is_whole_nevertheless(tmp_path, log):
    path = tmp_path / "no_footer.mcap"
    path.write_bytes(log.read_bytes()[:-25])
    with read_log(path) as reader:
        assert len(list(reader.frames(CAMERAS))) == 2 * N
        assert len(reader.attachments()) == 2
        assert reader.recovery.complete


@pytest.mark.parametrize(
    "options", [{"use_chunking": False}, {"index_types": IndexType.NONE}, {"repeat_channels": False}]
)
def test_logs_without_chunks_or_indexes_are_read_too(tmp_path, options):
    path = tmp_path / "plain.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream, **options)
        writer.start()
        schema = writer.register_schema("gradetrace.SensorSample", "jsonschema", b"{}")
        channel = writer.register_channel("/pot", "json", schema)
        for k in range(500):
            text = b'{"timestamp":{"sec":%d,"nsec":0},"value":%d}' % (k + 1, k)
            writer.add_message(channel, k + 1, text, k + 1)
        writer.finish()
    with read_log(path) as reader:
        assert [s.raw for s in reader.samples({"pot": ("/pot", "value")})] == list(range(500))
        assert reader.channels[0].message_count == 500
        assert reader.recovery.complete


def test_memory_does_not_grow_with_the_log(tmp_path):
    picture = b"\xff\xd8" + bytes(200_000)
    path = tmp_path / "long.mcap"
    with LogWriter(path) as log:
        for k in range(200):
            log.image("/cab", START + k * STEP, "cab", picture)
    tracemalloc.start()
    with read_log(path) as reader:
        count = sum(1 for _ in reader.frames({"cab": "/cab"}))
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert count == 200
    assert peak < 8_000_000, "of 40 MB; a chunk is 1 MB"


@pytest.mark.parametrize(
    "name, content, words",
    [
        ("absent.mcap", None, "no such file"),
        ("empty.mcap", b"", "empty"),
        ("shift.mcap.zstd", b"\x28\xb5\x2f\xfd" + bytes(100), "zstd -d"),
        ("shift.db3", b"SQLite format 3\0" + bytes(100), "ros2 bag convert"),
        ("shift.bag", b"#ROSBAG V2.0\n", "ROS 1"),
        ("shift.mcap.gz", b"\x1f\x8b\x08" + bytes(100), "gunzip"),
        ("zeros.mcap", bytes(1000), "zeros"),
        ("notes.txt", b"dear diary", "not an MCAP"),
        ("header.mcap", b"\x89MCAP0\r\n" + b"\x01\xff", "before the first message"),
    ],
)
def test_what_is_no_log_is_refused_in_a_sentence(tmp_path, name, content, words):
    path = tmp_path / name
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(LogError, match=words) as caught:
        read_log(path)
    assert str(path) in str(caught.value)


def test_a_folder_names_the_logs_in_it(log):
    with pytest.raises(LogError, match=r"folder.*shift\.mcap"):
        read_log(log.parent)


def test_a_missing_topic_lists_those_that_carry_pictures(log):
    with read_log(log) as reader, pytest.raises(LogError, match=r"'/nose'.*/cab/image, /stick/image"):
        list(reader.frames({"nose": "/nose"}))


def test_a_topic_that_carries_something_else_says_what_and_what_is_supported(log):
    with (
        read_log(log) as reader,
        pytest.raises(
            LogError,
            match=r"/pot.*gradetrace\.SensorSample.*protobuf.*foxglove\.CompressedImage.*sensor_msgs",
        ),
    ):
        list(reader.frames({"cab": "/pot"}))


def test_messages_that_cannot_be_understood_are_counted_by_reason(tmp_path):
    path = tmp_path / "odd.mcap"
    with LogWriter(path) as log:
        log.image("/cab", START, "cab", b"\xff\xd8")
        log.image("/cab", START + 1, "cab", b"RIFFwebp", format="webp")
        log.message("/cab", "foxglove.CompressedImage", "", b"", "protobuf", b"\xff\xff\xff", START + 2)
        log.sample("/pot", START, float("nan"))
        log.sample("/pot", START + 1, 2.0)
    with read_log(path) as reader:
        assert len(list(reader.frames({"cab": "/cab"}))) == 1
        assert [s.raw for s in reader.samples({"pot": ("/pot", "value")})] == [2.0]
        reasons = {reason: count for (_, reason), count in reader.faults.items()}
    assert sum(reasons.values()) == 3
    assert any("webp" in reason for reason in reasons)
