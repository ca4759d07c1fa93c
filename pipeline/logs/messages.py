"""Messages -> pictures, readings and calibrations, whatever they are encoded in."""

from __future__ import annotations

import base64
import binascii
import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from google.protobuf.message import DecodeError

from pipeline.logs import cdr
from pipeline.logs.cdr import MalformedMessage
from pipeline.logs.channels import CALIBRATION, IMAGE, PROTOBUF_CLASSES, SAMPLE, Channel, supported_text

SECOND = 1_000_000_000
MAX_PIXELS = 100_000_000
"""A picture larger than this is refused before anything is allocated."""
MAX_COMPRESSED_BYTES = 64 << 20


@dataclass(frozen=True)
class Picture:
    """One image message."""

    time_ns: int
    data: bytes
    """The compressed picture, or for raw ones height x width grey values."""
    encoding: str
    """jpeg, png or raw."""
    width: int = 0
    """Pixels; 0 for compressed pictures, which say so themselves."""
    height: int = 0


@dataclass(frozen=True)
class Calibration:
    """A camera calibration that stands in the log."""

    topic: str
    time_ns: int
    width: int
    height: int
    intrinsics: np.ndarray
    """(9,) fx fy cx cy k1 k2 p1 p2 k3."""
    problem: str = ""
    """Why it cannot be used; empty if it can."""


Reading = tuple[int, float]
PictureOf = Callable[[memoryview], Picture]
ReadingOf = Callable[[memoryview], Reading]
CalibrationOf = Callable[[memoryview], Calibration]


def picture_decoder(channel: Channel) -> PictureOf | None:
    """What makes pictures of this channel's messages, or None; it raises MalformedMessage."""
    if channel.carries != IMAGE:
        return None
    kind = channel.schema_name.rsplit("/", 1)[-1].rsplit(".", 1)[-1]
    if channel.encoding == "cdr":
        return _ros2_compressed if kind == "CompressedImage" else _ros2_raw
    message = _message_decoder(channel)
    return (
        (lambda payload: _compressed(message(payload)))
        if kind == "CompressedImage"
        else (lambda payload: _raw(message(payload)))
    )


def reading_decoder(channel: Channel, field: str) -> ReadingOf | None:
    """What makes (time_ns, raw) of this channel's messages, or None; it raises MalformedMessage.

    `field` is the field to read, or in joint states the name of the joint.
    """
    if channel.carries != SAMPLE:
        return None
    if channel.encoding == "cdr":
        return lambda payload: _joint_of_ros2(cdr.joint_state(payload), field)
    message = _message_decoder(channel)
    if channel.schema_name == "foxglove.JointStates":
        return lambda payload: _joint(message(payload), field)
    return lambda payload: _value(message(payload), field)


def calibration_decoder(channel: Channel) -> CalibrationOf | None:
    """What makes calibrations of this channel's messages, or None; it raises MalformedMessage."""
    if channel.carries != CALIBRATION:
        return None
    if channel.encoding == "cdr":

        def of_ros2(payload: memoryview) -> Calibration:
            info = cdr.camera_info(payload)
            return _calibration(
                channel.topic, info.stamp_ns, info.width, info.height, info.distortion_model, info.d, info.k
            )

        return of_ros2
    message = _message_decoder(channel)

    def of_foxglove(payload: memoryview) -> Calibration:
        values = message(payload)
        width, height = _number(values, "width"), _number(values, "height")
        model = _get(values, "distortion_model") or ""
        d, k = _numbers(_get(values, "D") or []), _numbers(_get(values, "K") or [])
        return _calibration(channel.topic, _stamp_ns(values), int(width), int(height), str(model), d, k)

    return of_foxglove


def cannot_read(channel: Channel, kind: str) -> str:
    """The sentence for a channel that should carry `kind` (image, sample, calibration) and does not."""
    schema = channel.schema_name or "no schema"
    return (
        f"topic '{channel.topic}' carries {schema} in encoding '{channel.encoding}', which is not read as "
        f"{kind}; supported are {supported_text(kind)}"
    )


def _message_decoder(channel: Channel) -> Callable[[memoryview], Any]:
    """Payload -> message object (protobuf) or dict (JSON)."""
    if channel.encoding == "json":
        return _parse_json
    message_class = PROTOBUF_CLASSES[channel.schema_name]

    def parse(payload: memoryview) -> Any:
        try:
            return message_class.FromString(bytes(payload))
        except DecodeError:
            raise MalformedMessage(f"not a {channel.schema_name} in protobuf") from None

    return parse


def _parse_json(payload: memoryview) -> dict[str, Any]:
    try:
        value = json.loads(bytes(payload))
    except (ValueError, RecursionError):
        raise MalformedMessage("not valid JSON") from None
    if not isinstance(value, dict):
        raise MalformedMessage("no JSON object")
    return value


def _get(values: Any, name: str) -> Any:
    return values.get(name) if isinstance(values, dict) else getattr(values, name, None)


def _number(values: Any, name: str) -> float:
    value = _get(values, name)
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise MalformedMessage(f"field '{name}' holds no number")
    return value


def _numbers(values: Any) -> np.ndarray:
    try:
        return np.array([float(value) for value in values])
    except (TypeError, ValueError):
        raise MalformedMessage("an array holds something that is no number") from None


def _stamp_ns(values: Any) -> int:
    """Nanoseconds of field ``timestamp``: a protobuf Timestamp, or {sec, nsec}; 0 where there is none."""
    stamp = _get(values, "timestamp")
    if stamp is None:
        return 0
    if not isinstance(stamp, dict):
        if not -(2**33) < stamp.seconds < 2**33:
            raise MalformedMessage("timestamp is out of range")
        return stamp.seconds * SECOND + stamp.nanos
    sec, nsec = stamp.get("sec", 0), stamp.get("nsec", 0)
    if type(sec) is not int or type(nsec) is not int or not -(2**33) < sec < 2**33 or not 0 <= nsec < 2**32:
        raise MalformedMessage("timestamp is not {sec, nsec} in whole numbers")
    return sec * SECOND + nsec


def _compressed(values: Any) -> Picture:
    return _picture(_stamp_ns(values), _octets(values), str(_get(values, "format") or ""))


def _ros2_compressed(payload: memoryview) -> Picture:
    message = cdr.compressed_image(payload)
    return _picture(message.stamp_ns, bytes(message.data), message.format)


def _octets(values: Any) -> bytes:
    data = _get(values, "data")
    if isinstance(data, str):
        try:
            return base64.b64decode(data, validate=True)
        except (binascii.Error, ValueError):
            raise MalformedMessage("field 'data' is not base64") from None
    if not isinstance(data, bytes):
        raise MalformedMessage("field 'data' holds no bytes")
    return data


def _picture(time_ns: int, data: bytes, format: str) -> Picture:
    if len(data) > MAX_COMPRESSED_BYTES:
        raise MalformedMessage(f"a compressed picture of {len(data)} bytes")
    # The bytes decide: drivers write 'jpg', 'image/jpeg', 'rgb8; jpeg compressed bgr8' into the format.
    if data.startswith(b"\x89PNG"):
        return Picture(time_ns, data, "png")
    if data.startswith(b"\xff\xd8") or "jp" in format.lower():
        return Picture(time_ns, data, "jpeg")
    if "png" in format.lower():
        return Picture(time_ns, data, "png")
    raise MalformedMessage(f"a picture in format '{format[:40]}'; supported are jpeg and png")


def _raw(values: Any) -> Picture:
    width, height, step = (int(_number(values, name)) for name in ("width", "height", "step"))
    grey = _grey(memoryview(_octets(values)), width, height, step, str(_get(values, "encoding") or ""))
    return Picture(_stamp_ns(values), grey, "raw", width, height)


def _ros2_raw(payload: memoryview) -> Picture:
    message = cdr.image(payload)
    grey = _grey(message.data, message.width, message.height, message.step, message.encoding)
    return Picture(message.stamp_ns, grey, "raw", message.width, message.height)


RAW_CHANNELS = {"mono8": 1, "8UC1": 1, "rgb8": 3, "bgr8": 3, "8UC3": 3, "rgba8": 4, "bgra8": 4}
_LUMA = np.array([77, 150, 29], np.uint16)  # BT.601 times 256, as JPEG's own grey


def _grey(data: memoryview, width: int, height: int, step: int, encoding: str) -> bytes:
    """Height x width grey values of an uncompressed picture."""
    channels = RAW_CHANNELS.get(encoding)
    if channels is None:
        known = ", ".join(RAW_CHANNELS)
        raise MalformedMessage(f"a raw picture in encoding '{encoding[:40]}'; supported are {known}")
    step = step or width * channels
    if not 0 < width * height <= MAX_PIXELS or step < width * channels or len(data) < step * height:
        raise MalformedMessage(f"a raw picture of {width} x {height} with {len(data)} bytes")
    rows = np.frombuffer(data, np.uint8, count=step * height).reshape(height, step)
    pixels = rows[:, : width * channels]
    if channels == 1:
        return pixels.tobytes()
    colours = pixels.reshape(height, width, channels)[..., :3]
    weights = _LUMA if encoding.startswith("rgb") else _LUMA[::-1]
    return (((colours * weights).sum(axis=-1, dtype=np.uint32) + 128) >> 8).astype(np.uint8).tobytes()


def _value(values: Any, field: str) -> Reading:
    return _stamp_ns(values), float(_number(values, field))


def _joint(values: Any, name: str) -> Reading:
    for joint in _get(values, "joints") or []:
        if _get(joint, "name") == name:
            if not isinstance(joint, dict) and not joint.HasField("position"):
                break
            return _stamp_ns(values), float(_number(joint, "position"))
    raise MalformedMessage(f"no joint named '{name}' with a position")


def _joint_of_ros2(message: cdr.Ros2JointState, name: str) -> Reading:
    if name not in message.names or len(message.position) <= message.names.index(name):
        raise MalformedMessage(f"no joint named '{name}' with a position")
    raw = float(message.position[message.names.index(name)])
    if not math.isfinite(raw):
        raise MalformedMessage(f"joint '{name}' holds no number")
    return message.stamp_ns, raw


def _calibration(
    topic: str,
    time_ns: int,
    width: int,
    height: int,
    model: str,
    d: Sequence[float] | np.ndarray,
    k: Sequence[float] | np.ndarray,
) -> Calibration:
    d, k = np.asarray(d, float), np.asarray(k, float)
    problem = ""
    if len(k) != 9 or not np.all(np.isfinite(k)) or k[0] <= 0 or k[4] <= 0:
        problem = "it holds no focal lengths: the camera was not calibrated when it was recorded"
    elif k[1] != 0:
        problem = "its matrix K has a skew, which is not modelled"
    elif not np.all(np.isfinite(d)):
        problem = "its distortion holds something that is no number"
    elif model not in ("plumb_bob", "rational_polynomial", "") and np.any(d):
        problem = f"its distortion model is '{model}'; supported is plumb_bob"
    elif len(d) not in (0, 4, 5) and np.any(d[5:]):
        problem = f"its distortion has {len(d)} coefficients; supported are the five of plumb_bob"
    intrinsics = np.zeros(9)
    if not problem:
        intrinsics[:4] = k[0], k[4], k[2], k[5]
        intrinsics[4 : 4 + min(len(d), 5)] = d[:5]
    return Calibration(topic, time_ns, width, height, intrinsics, problem)
