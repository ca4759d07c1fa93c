"""Writing an MCAP log: frames, readings, calibrations and the files that explain them.

Used by the synthetic site and by tests. The same calls give the same bytes: no clock is asked, chunks are not
compressed unless wanted (pictures do not get smaller, and a compressor's bytes change with its version).
"""

from __future__ import annotations

import base64
import json
import os
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import IO, Any

import numpy as np
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.JointStates_pb2 import JointStates
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from google.protobuf.timestamp_pb2 import Timestamp
from mcap.writer import CompressionType, Writer

from pipeline.logs.channels import SensorSample, schema_data

LIBRARY = "gradetrace"
SECOND = 1_000_000_000
COMPRESSION = {"none": CompressionType.NONE, "zstd": CompressionType.ZSTD, "lz4": CompressionType.LZ4}


class LogWriter:
    """A log being written; a context manager.

    The file appears under its name only when the block ends without an exception, so nobody reads half a log.
    Every message takes `time_ns`, its capture stamp, and `log_time_ns`, when a recorder would have received it
    (the same if left out). Messages are written in the order of the calls.

    Parameters
    ----------
    path
        Of the log.
    chunk_size
        Bytes of messages after which a chunk ends; what a damaged spot costs.
    compression
        ``none``, ``zstd`` or ``lz4``.
    """

    def __init__(self, path: str | os.PathLike[str], chunk_size: int = 1 << 20, compression: str = "none"):
        self.path = Path(path)
        self._partial = self.path.with_name(self.path.name + ".part")
        self._chunk_size = chunk_size
        self._compression = COMPRESSION[compression]
        self._schemas: dict[tuple[str, str], int] = {}
        self._channels: dict[str, tuple[int, str, str]] = {}
        self._sequence: dict[int, int] = {}
        self._file: IO[bytes] | None = None
        self._writer: Writer | None = None

    def __enter__(self) -> LogWriter:
        self._file = self._partial.open("wb")
        self._writer = Writer(self._file, chunk_size=self._chunk_size, compression=self._compression)
        self._writer.start(profile="", library=LIBRARY)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        assert self._writer is not None and self._file is not None
        try:
            if kind is None:
                self._writer.finish()
        finally:
            self._file.close()
            if kind is None:
                self._partial.replace(self.path)
            else:
                self._partial.unlink(missing_ok=True)

    def add_attachment(self, name: str, media_type: str, data: bytes, time_ns: int) -> None:
        """Put a whole file into the log (machine.toml, site.toml)."""
        assert self._writer is not None, "use LogWriter in a with block"
        self._writer.add_attachment(
            create_time=time_ns, log_time=time_ns, name=name, media_type=media_type, data=data
        )

    def camera_calibration(
        self,
        topic: str,
        time_ns: int,
        frame_id: str,
        width: int,
        height: int,
        intrinsics: Sequence[float] | np.ndarray,
        log_time_ns: int | None = None,
    ) -> None:
        """One `foxglove.CameraCalibration`; `intrinsics` is fx fy cx cy k1 k2 p1 p2 k3 (plumb_bob)."""
        fx, fy, cx, cy, *distortion = (float(value) for value in intrinsics)
        message = CameraCalibration(
            timestamp=_timestamp(time_ns),
            frame_id=frame_id,
            width=width,
            height=height,
            distortion_model="plumb_bob",
            D=distortion,
            K=[fx, 0, cx, 0, fy, cy, 0, 0, 1],
            R=[1, 0, 0, 0, 1, 0, 0, 0, 1],
            P=[fx, 0, cx, 0, 0, fy, cy, 0, 0, 0, 1, 0],
        )
        self._add(topic, "foxglove.CameraCalibration", "protobuf", _bytes(message), time_ns, log_time_ns)

    def image(
        self,
        topic: str,
        time_ns: int,
        frame_id: str,
        jpeg: bytes,
        encoding: str = "protobuf",
        log_time_ns: int | None = None,
        format: str = "jpeg",
    ) -> None:
        """One `foxglove.CompressedImage`; `encoding` is protobuf or json, `format` jpeg or png."""
        if encoding == "json":
            picture = base64.b64encode(jpeg).decode()
            data = _json(
                {"timestamp": _sec_nsec(time_ns), "frame_id": frame_id, "data": picture, "format": format}
            )
        else:
            stamp = _timestamp(time_ns)
            data = _bytes(CompressedImage(timestamp=stamp, frame_id=frame_id, data=jpeg, format=format))
        self._add(topic, "foxglove.CompressedImage", encoding, data, time_ns, log_time_ns)

    def raw_image(
        self, topic: str, time_ns: int, frame_id: str, grey: np.ndarray, log_time_ns: int | None = None
    ) -> None:
        """One `foxglove.RawImage` from grey values, (H, W) uint8."""
        height, width = grey.shape
        message = RawImage(
            timestamp=_timestamp(time_ns),
            frame_id=frame_id,
            width=width,
            height=height,
            encoding="mono8",
            step=width,
            data=np.ascontiguousarray(grey, np.uint8).tobytes(),
        )
        self._add(topic, "foxglove.RawImage", "protobuf", _bytes(message), time_ns, log_time_ns)

    def sample(
        self,
        topic: str,
        time_ns: int,
        value: float,
        unit: str = "",
        message: str = "sensor_sample",
        name: str = "",
        encoding: str = "protobuf",
        log_time_ns: int | None = None,
    ) -> None:
        """One raw reading: `gradetrace.SensorSample`, or `foxglove.JointStates` with the one joint `name`."""
        value = float(value)
        if message == "joint_states":
            schema = "foxglove.JointStates"
            if encoding == "json":
                joints = [{"name": name, "position": value}]
                data = _json({"timestamp": _sec_nsec(time_ns), "joints": joints})
            else:
                states = JointStates(timestamp=_timestamp(time_ns))
                states.joints.add(name=name, position=value)
                data = _bytes(states)
        else:
            assert message == "sensor_sample", message
            schema = "gradetrace.SensorSample"
            if encoding == "json":
                data = _json({"timestamp": _sec_nsec(time_ns), "value": value, "unit": unit})
            else:
                reading = SensorSample(value=value, unit=unit)
                reading.timestamp.seconds, reading.timestamp.nanos = divmod(int(time_ns), SECOND)
                data = _bytes(reading)
        self._add(topic, schema, encoding, data, time_ns, log_time_ns)

    def message(
        self,
        topic: str,
        schema_name: str,
        schema_encoding: str,
        schema: bytes,
        encoding: str,
        data: bytes,
        log_time_ns: int,
    ) -> None:
        """Any message, already serialised, with its own schema; what other programs write (ROS 2)."""
        assert self._writer is not None, "use LogWriter in a with block"
        if topic not in self._channels:
            key = (schema_name, schema_encoding)
            if key not in self._schemas:
                self._schemas[key] = self._writer.register_schema(schema_name, schema_encoding, schema)
            channel = self._writer.register_channel(topic, encoding, self._schemas[key])
            self._channels[topic] = (channel, schema_name, encoding)
        channel, known_name, known_encoding = self._channels[topic]
        assert (known_name, known_encoding) == (schema_name, encoding), (
            f"{topic} carries {known_name} already"
        )
        sequence = self._sequence[channel] = self._sequence.get(channel, -1) + 1
        self._writer.add_message(
            channel, log_time=log_time_ns, data=data, publish_time=log_time_ns, sequence=sequence
        )

    def _add(
        self, topic: str, name: str, encoding: str, data: bytes, time_ns: int, log_time_ns: int | None
    ) -> None:
        schema_encoding, schema = ("", b"") if topic in self._channels else schema_data(name, encoding)
        received_ns = int(time_ns if log_time_ns is None else log_time_ns)
        self.message(topic, name, schema_encoding, schema, encoding, data, received_ns)


def _timestamp(time_ns: int) -> Timestamp:
    seconds, nanos = divmod(int(time_ns), SECOND)
    return Timestamp(seconds=seconds, nanos=nanos)


def _sec_nsec(time_ns: int) -> dict[str, int]:
    sec, nsec = divmod(int(time_ns), SECOND)
    return {"sec": sec, "nsec": nsec}


def _bytes(message: Any) -> bytes:
    return message.SerializeToString(deterministic=True)


def _json(value: dict[str, Any]) -> bytes:
    return json.dumps(value, separators=(",", ":")).encode()
