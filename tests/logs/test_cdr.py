"""ROS 2 messages as another library writes them; its general decoder is the oracle."""

import struct
from types import SimpleNamespace as Message

import numpy as np
import pytest
from mcap_ros2.writer import Writer

from pipeline.logs.cdr import MalformedMessage, joint_state
from pipeline.logs.reader import read_log

HEADER = """
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""
COMPRESSED = "std_msgs/Header header\nstring format\nuint8[] data" + HEADER
IMAGE = (
    "std_msgs/Header header\nuint32 height\nuint32 width\nstring encoding\nuint8 is_bigendian\n"
    "uint32 step\nuint8[] data" + HEADER
)
JOINTS = (
    "std_msgs/Header header\nstring[] name\nfloat64[] position\nfloat64[] velocity\nfloat64[] effort" + HEADER
)
INFO = (
    "std_msgs/Header header\nuint32 height\nuint32 width\nstring distortion_model\nfloat64[] d\nfloat64[9] k\n"
    "float64[9] r\nfloat64[12] p" + HEADER
)
SEC = 1_700_000_000


def header(nanosec, frame_id="cab"):
    return Message(stamp=Message(sec=SEC, nanosec=nanosec), frame_id=frame_id)


@pytest.fixture
def ros2_log(tmp_path):
    path = tmp_path / "ros2.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        compressed = writer.register_msgdef("sensor_msgs/msg/CompressedImage", COMPRESSED)
        image = writer.register_msgdef("sensor_msgs/msg/Image", IMAGE)
        joints = writer.register_msgdef("sensor_msgs/msg/JointState", JOINTS)
        info = writer.register_msgdef("sensor_msgs/msg/CameraInfo", INFO)
        for k in range(5):
            # Frame ids of every length, so that every alignment of what follows occurs.
            head = header(k, "x" * k)
            data = b"\xff\xd8" + bytes([k] * k)
            writer.write_message(
                "/jpeg", compressed, Message(header=head, format="jpeg", data=data), log_time=10 + k
            )
            pixels = bytes(range(24))
            writer.write_message(
                "/raw",
                image,
                Message(
                    header=head, height=2, width=3, encoding="bgr8", is_bigendian=0, step=12, data=pixels
                ),
                log_time=10 + k,
            )
            names = ["boom", "bucket" + "y" * k]
            writer.write_message(
                "/joints",
                joints,
                Message(header=head, name=names, position=[1.5, 2.5 + k], velocity=[], effort=[]),
                log_time=10 + k,
            )
            writer.write_message(
                "/info",
                info,
                Message(
                    header=head,
                    height=480,
                    width=640,
                    distortion_model="plumb_bob",
                    d=[0.1, 0.2, 0.3, 0.4, 0.5],
                    k=[850.0, 0.0, 320.0, 0.0, 851.0, 240.0, 0.0, 0.0, 1.0],
                    r=[0.0] * 9,
                    p=[0.0] * 12,
                ),
                log_time=10 + k,
            )
        writer.finish()
    return path


def test_ros2_messages_come_out_as_they_went_in(ros2_log):
    with read_log(ros2_log) as reader:
        jpegs = list(reader.frames({"cab": "/jpeg"}))
        assert [frame.time_ns for frame in jpegs] == [SEC * 10**9 + k for k in range(5)]
        assert [frame.data for frame in jpegs] == [b"\xff\xd8" + bytes([k] * k) for k in range(5)]
        for k, sample in enumerate(reader.samples({"boom": ("/joints", "boom")})):
            assert (sample.time_ns, sample.raw) == (SEC * 10**9 + k, 1.5)
        calibration = reader.calibrations()["/info"]
        assert calibration.intrinsics.tolist() == [850, 851, 320, 240, 0.1, 0.2, 0.3, 0.4, 0.5]
        assert (calibration.width, calibration.height) == (640, 480)
        assert not reader.faults


def test_a_joint_is_found_by_its_name_and_its_absence_counted(ros2_log):
    with read_log(ros2_log) as reader:
        samples = list(reader.samples({"bucket": ("/joints", "bucketyy")}))
        assert [s.raw for s in samples] == [4.5]
        assert sum(reader.faults.values()) == 4


def test_colour_becomes_the_grey_that_jpeg_would_take(ros2_log):
    with read_log(ros2_log) as reader:
        frame = next(iter(reader.frames({"cab": "/raw"})))
    rows = np.frombuffer(bytes(range(24)), np.uint8).reshape(2, 12)[:, :9].reshape(2, 3, 3).astype(float)
    expected = rows @ [0.114, 0.587, 0.299]
    grey = np.frombuffer(frame.data, np.uint8).reshape(2, 3)
    assert np.abs(grey - expected).max() <= 1


def test_big_endian_is_read_too():
    text = b"bucket\0"
    payload = b"\0\0\0\0" + struct.pack(">iI", 5, 7) + struct.pack(">I", 1) + b"\0" + bytes(3)
    payload += struct.pack(">I", 1) + struct.pack(">I", len(text)) + text + bytes(1)
    payload += struct.pack(">I", 1)
    payload += bytes(-(len(payload) - 4) % 8) + struct.pack(">d", 2.5)
    message = joint_state(memoryview(payload))
    assert message.stamp_ns == 5 * 10**9 + 7
    assert message.names == ["bucket"]
    assert message.position.tolist() == [2.5]


@pytest.mark.parametrize("payload", [b"", b"\0\1\0\0", b"\0\1\0\0" + b"\xff" * 40, b"\7\7\0\0" + bytes(40)])
def test_what_is_no_message_is_malformed_and_nothing_else(payload):
    with pytest.raises(MalformedMessage):
        joint_state(memoryview(payload))
