from pathlib import Path

import numpy as np
import pytest

from pipeline.logs.writer import LogWriter

START = 1_700_000_000_000_000_000
STEP = 100_000_000
N = 60


def jpeg(k: int) -> bytes:
    """No picture, but it begins and ends like one and each is another."""
    return (
        b"\xff\xd8"
        + k.to_bytes(4, "big")
        + bytes(np.random.default_rng(k).integers(0, 256, 700, np.uint8))
        + b"\xff\xd9"
    )


def write(path: Path, n: int = N, **options) -> Path:
    """A log of n ticks of 0.1 s: two cameras, sensors in every form, a calibration and two attachments."""
    with LogWriter(path, **({"chunk_size": 4000} | options)) as log:
        log.add_attachment("machine.toml", "application/toml", b"[machine]\n", START)
        log.add_attachment("site.toml", "application/toml", b"[site]\n", START)
        log.camera_calibration(
            "/cab/info", START, "cab", 640, 480, [850, 851, 320, 240, 0.1, 0.2, 0.3, 0.4, 0.5]
        )
        for k in range(n):
            t = START + k * STEP
            log.image("/cab/image", t, "cab", jpeg(k), log_time_ns=t + 5_000_000)
            log.image("/stick/image", t, "stick", jpeg(1000 + k), encoding="json", log_time_ns=t + 7_000_000)
            log.sample("/pot", t, 0.5 + k, "V")
            log.sample("/pot_json", t, 0.5 + k, "V", encoding="json")
            log.sample("/joints", t, 0.5 + k, message="joint_states", name="bucket")
            log.sample("/joints_json", t, 0.5 + k, message="joint_states", name="bucket", encoding="json")
    return path


@pytest.fixture
def log(tmp_path) -> Path:
    return write(tmp_path / "shift.mcap")
