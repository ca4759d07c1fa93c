"""ROS 2 messages out of CDR: the four types a camera log needs, read by their fixed layout.

A general decoder builds a parser from the message definition in the log; these four have not changed since
ROS 2 began, and reading them directly also serves logs whose definitions are IDL, or missing. The general
decoder is the oracle in the tests.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

import numpy as np


class MalformedMessage(Exception):
    """The bytes of a message are not what its schema promises."""


class CdrReader:
    """Values one after the other out of a CDR payload (XCDR1, either byte order)."""

    def __init__(self, payload: memoryview):
        if len(payload) < 4 or payload[0] != 0 or payload[1] not in (0, 1):
            raise MalformedMessage("not plain CDR")
        self._data = payload[4:]
        self._order = "<" if payload[1] == 1 else ">"
        self._at = 0

    def number(self, code: str) -> int | float:
        """One number; `code` as in `struct`."""
        size = struct.calcsize(code)
        start = -(-self._at // size) * size
        self._at = start + size
        try:
            return struct.unpack_from(self._order + code, self._data, start)[0]
        except struct.error:
            raise MalformedMessage("shorter than its fields") from None

    def octets(self) -> memoryview:
        """A sequence of bytes; nothing is copied."""
        length = int(self.number("I"))
        if length > len(self._data) - self._at:
            raise MalformedMessage("a sequence longer than the message")
        self._at += length
        return self._data[self._at - length : self._at]

    def text(self) -> str:
        """A string."""
        return str(self.octets(), "utf-8", "replace").rstrip("\0")

    def texts(self) -> list[str]:
        """A sequence of strings."""
        count = int(self.number("I"))
        if count > len(self._data) - self._at:
            raise MalformedMessage("a sequence longer than the message")
        return [self.text() for _ in range(count)]

    def doubles(self, count: int | None = None) -> np.ndarray:
        """An array of `count` doubles, or a sequence that says how many."""
        length = int(self.number("I")) if count is None else count
        if length:
            self._at = -(-self._at // 8) * 8
        if 8 * length > len(self._data) - self._at:
            raise MalformedMessage("a sequence longer than the message")
        self._at += 8 * length
        return np.frombuffer(self._data[self._at - 8 * length : self._at], self._order + "f8").astype(float)

    def stamp_ns(self) -> int:
        """A `builtin_interfaces/Time`, nanoseconds."""
        return int(self.number("i")) * 1_000_000_000 + int(self.number("I"))


@dataclass(frozen=True)
class Ros2CompressedImage:
    stamp_ns: int
    frame_id: str
    format: str
    data: memoryview


@dataclass(frozen=True)
class Ros2Image:
    stamp_ns: int
    frame_id: str
    height: int
    width: int
    encoding: str
    step: int
    data: memoryview


@dataclass(frozen=True)
class Ros2JointState:
    stamp_ns: int
    names: list[str]
    position: np.ndarray


@dataclass(frozen=True)
class Ros2CameraInfo:
    stamp_ns: int
    frame_id: str
    height: int
    width: int
    distortion_model: str
    d: np.ndarray
    k: np.ndarray


def compressed_image(payload: memoryview) -> Ros2CompressedImage:
    """`sensor_msgs/msg/CompressedImage`. Raises MalformedMessage."""
    cdr = CdrReader(payload)
    return Ros2CompressedImage(cdr.stamp_ns(), cdr.text(), cdr.text(), cdr.octets())


def image(payload: memoryview) -> Ros2Image:
    """`sensor_msgs/msg/Image`. Raises MalformedMessage."""
    cdr = CdrReader(payload)
    stamp_ns, frame_id = cdr.stamp_ns(), cdr.text()
    height, width = int(cdr.number("I")), int(cdr.number("I"))
    encoding = cdr.text()
    cdr.number("B")  # is_bigendian: only of interest for more than one byte per sample
    return Ros2Image(
        stamp_ns, frame_id, height, width, encoding, step=int(cdr.number("I")), data=cdr.octets()
    )


def joint_state(payload: memoryview) -> Ros2JointState:
    """`sensor_msgs/msg/JointState` up to its positions. Raises MalformedMessage."""
    cdr = CdrReader(payload)
    stamp_ns, _ = cdr.stamp_ns(), cdr.text()
    return Ros2JointState(stamp_ns, cdr.texts(), cdr.doubles())


def camera_info(payload: memoryview) -> Ros2CameraInfo:
    """`sensor_msgs/msg/CameraInfo` up to its matrix k. Raises MalformedMessage."""
    cdr = CdrReader(payload)
    stamp_ns, frame_id = cdr.stamp_ns(), cdr.text()
    height, width = int(cdr.number("I")), int(cdr.number("I"))
    return Ros2CameraInfo(stamp_ns, frame_id, height, width, cdr.text(), d=cdr.doubles(), k=cdr.doubles(9))
