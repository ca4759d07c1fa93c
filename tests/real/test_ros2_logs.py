"""Logs that other programs wrote."""

import pytest
from mcap.reader import make_reader

from pipeline.errors import LogError
from pipeline.logs.reader import read_log

pytestmark = pytest.mark.real

LOGS = ("cdr_test_0.mcap", "multiple_files_0.mcap", "talker.mcap", "wrong_rmw_test_0.mcap")


@pytest.mark.parametrize("name", LOGS)
def test_topics_and_counts_are_those_of_the_summary(real_data, name):
    path = real_data / "ros2_mcap" / name
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    counts = summary.statistics.channel_message_counts
    expected = {
        (c.topic, c.message_encoding): counts.get(number, 0) for number, c in summary.channels.items()
    }
    with read_log(path) as reader:
        assert {(c.topic, c.encoding): c.message_count for c in reader.channels} == expected
        assert reader.recovery.complete


@pytest.mark.parametrize("name", LOGS)
def test_cut_in_the_middle_they_say_so(real_data, tmp_path, name):
    """Each has one chunk, so nothing is left of it; what must be left is a sentence."""
    path = real_data / "ros2_mcap" / name
    with path.open("rb") as stream:
        (chunk,) = make_reader(stream).get_summary().chunk_indexes
    cut = tmp_path / name
    cut.write_bytes(path.read_bytes()[: chunk.chunk_start_offset + chunk.chunk_length // 2])
    try:
        with read_log(cut) as reader:
            assert not reader.recovery.complete
            assert "breaks off" in reader.recovery.sentence
    except LogError as refusal:
        assert "breaks off" in str(refusal)


def test_an_unknown_encoding_is_named_with_its_topic(real_data):
    with (
        read_log(real_data / "ros2_mcap" / "wrong_rmw_test_0.mcap") as reader,
        pytest.raises(
            LogError,
            match=r"'/test_topic' carries test_msgs/msg/BasicTypes in encoding 'wrong_format'.*supported are",
        ),
    ):
        list(reader.frames({"cab": "/test_topic"}))
