"""What a channel carries: the payload types that are understood, and their schemas.

Protobuf payloads are read and written with our own copies of the message classes, found by the schema's name,
never with the descriptor that stands in the log: field numbers do not change once published, and a log is
somebody else's input.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.JointStates_pb2 import JointStates
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from google.protobuf import timestamp_pb2
from google.protobuf.descriptor_pb2 import FieldDescriptorProto, FileDescriptorProto
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message_factory import GetMessageClass
from mcap_protobuf.schema import build_file_descriptor_set

from pipeline.resources import schema_text

IMAGE, SAMPLE, CALIBRATION = "image", "sample", "calibration"


@dataclass(frozen=True)
class Channel:
    """One channel of a log."""

    topic: str
    schema_name: str
    encoding: str
    """Message encoding: protobuf, json, cdr; anything else cannot be read."""
    message_count: int
    """Messages promised by the summary, or found where there is none."""
    schema_encoding: str = ""

    @property
    def carries(self) -> str | None:
        """What this channel can give: ``image``, ``sample``, ``calibration``, or None where we cannot read it."""
        if (self.encoding, self.schema_name) in SUPPORTED:
            return SUPPORTED[self.encoding, self.schema_name]
        return SAMPLE if self.encoding == "json" else None


SUPPORTED = {
    ("protobuf", "foxglove.CompressedImage"): IMAGE,
    ("json", "foxglove.CompressedImage"): IMAGE,
    ("protobuf", "foxglove.RawImage"): IMAGE,
    ("json", "foxglove.RawImage"): IMAGE,
    ("cdr", "sensor_msgs/msg/CompressedImage"): IMAGE,
    ("cdr", "sensor_msgs/msg/Image"): IMAGE,
    ("protobuf", "gradetrace.SensorSample"): SAMPLE,
    ("json", "gradetrace.SensorSample"): SAMPLE,
    ("protobuf", "foxglove.JointStates"): SAMPLE,
    ("json", "foxglove.JointStates"): SAMPLE,
    ("cdr", "sensor_msgs/msg/JointState"): SAMPLE,
    ("protobuf", "foxglove.CameraCalibration"): CALIBRATION,
    ("json", "foxglove.CameraCalibration"): CALIBRATION,
    ("cdr", "sensor_msgs/msg/CameraInfo"): CALIBRATION,
}


def supported_text(kind: str) -> str:
    """The payloads that carry `kind`, for a message: ``foxglove.RawImage (protobuf, json), ...``."""
    encodings: dict[str, list[str]] = {}
    for (encoding, name), what in SUPPORTED.items():
        if what == kind:
            encodings.setdefault(name, []).append(encoding)
    return ", ".join(f"{name} ({', '.join(known)})" for name, known in encodings.items())


def _sensor_sample_class() -> Any:
    """The class of ``schemas/channels/sensor_sample.proto``; built here because users have no protoc."""
    file = FileDescriptorProto(
        name="gradetrace/sensor_sample.proto",
        package="gradetrace",
        syntax="proto3",
        dependency=["google/protobuf/timestamp.proto"],
    )
    message = file.message_type.add(name="SensorSample")
    one = FieldDescriptorProto.LABEL_OPTIONAL
    message.field.add(
        name="timestamp",
        number=1,
        label=one,
        type=FieldDescriptorProto.TYPE_MESSAGE,
        type_name=".google.protobuf.Timestamp",
        json_name="timestamp",
    )
    message.field.add(
        name="value", number=2, label=one, type=FieldDescriptorProto.TYPE_DOUBLE, json_name="value"
    )
    message.field.add(
        name="unit", number=3, label=one, type=FieldDescriptorProto.TYPE_STRING, json_name="unit"
    )
    pool = DescriptorPool()
    pool.AddSerializedFile(timestamp_pb2.DESCRIPTOR.serialized_pb)
    pool.Add(file)
    return GetMessageClass(pool.FindMessageTypeByName("gradetrace.SensorSample"))


SensorSample = _sensor_sample_class()

PROTOBUF_CLASSES: dict[str, Any] = {
    "foxglove.CompressedImage": CompressedImage,
    "foxglove.RawImage": RawImage,
    "foxglove.CameraCalibration": CameraCalibration,
    "foxglove.JointStates": JointStates,
    "gradetrace.SensorSample": SensorSample,
}


def schema_data(name: str, encoding: str) -> tuple[str, bytes]:
    """Schema encoding and bytes to write beside messages of this type; `encoding` is protobuf or json."""
    if encoding == "protobuf":
        files = build_file_descriptor_set(PROTOBUF_CLASSES[name])
        return "protobuf", files.SerializeToString(deterministic=True)
    assert encoding == "json", encoding
    return "jsonschema", schema_text(f"channels/{name.rsplit('.', 1)[-1]}.json").encode()
