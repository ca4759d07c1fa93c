import json
import re

import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from pipeline.logs.channels import SensorSample, schema_data
from pipeline.logs.writer import LogWriter
from pipeline.resources import schema_text

from .conftest import START, STEP, N, write


def test_the_same_calls_give_the_same_bytes(tmp_path):
    assert write(tmp_path / "a.mcap").read_bytes() == write(tmp_path / "b.mcap").read_bytes()


def test_another_reader_finds_what_was_written(log):
    """The reader of mcap itself and the descriptors in the file itself are the oracle."""
    with log.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
        statistics = reader.get_summary().statistics
        assert statistics.message_count == 6 * N + 1
        assert statistics.attachment_count == 2
        values = []
        for schema, channel, message, decoded in reader.iter_decoded_messages(topics=["/pot", "/cab/info"]):
            if channel.topic == "/pot":
                assert schema.name == "gradetrace.SensorSample"
                stamp_ns = (
                    decoded.timestamp.ToNanoseconds()
                    if hasattr(decoded.timestamp, "ToNanoseconds")
                    else (decoded.timestamp.seconds * 10**9 + decoded.timestamp.nanos)
                )
                assert stamp_ns == message.log_time
                values.append((stamp_ns, decoded.value, decoded.unit))
            else:
                assert list(decoded.K) == [850, 0, 320, 0, 851, 240, 0, 0, 1]
                assert list(decoded.D) == [0.1, 0.2, 0.3, 0.4, 0.5]
        assert values == [(START + k * STEP, 0.5 + k, "V") for k in range(N)]


def test_json_samples_are_what_their_schema_says(log):
    schema = json.loads(schema_text("channels/SensorSample.json"))
    with log.open("rb") as stream:
        for _, _, message in make_reader(stream).iter_messages(topics=["/pot_json"]):
            sample = json.loads(message.data)
            assert set(schema["required"]) <= set(sample) == set(schema["properties"])
            assert set(sample["timestamp"]) == {"sec", "nsec"}


def test_the_proto_file_is_the_message_that_is_written():
    text = schema_text("channels/sensor_sample.proto")
    written = {name: int(number) for name, number in re.findall(r"^\s+\S+ (\w+) = (\d+);", text, re.M)}
    assert written == {field.name: field.number for field in SensorSample.DESCRIPTOR.fields}
    assert re.search(r"^package gradetrace;$", text, re.M)
    assert SensorSample.DESCRIPTOR.full_name == "gradetrace.SensorSample"
    encoding, data = schema_data("gradetrace.SensorSample", "protobuf")
    assert encoding == "protobuf"
    assert b"google/protobuf/timestamp.proto" in data


def test_a_log_that_was_not_finished_does_not_appear(tmp_path):
    path = tmp_path / "shift.mcap"
    with pytest.raises(RuntimeError), LogWriter(path) as log:
        log.sample("/pot", START, 1.0)
        raise RuntimeError
    assert list(tmp_path.iterdir()) == []
