"""Frames of a video. OpenCV opens videos by their path and no other way, so here, and only here, a path comes in."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from pipeline.errors import CalibrationError


def frames_of_video(path: Path, most: int) -> Iterator[tuple[str, np.ndarray]]:
    """Name and grey values (H, W) uint8 of at most `most` frames, evenly spread.

    Raises CalibrationError where OpenCV cannot open it.
    """
    video = cv2.VideoCapture(str(path))
    try:
        count = int(video.get(cv2.CAP_PROP_FRAME_COUNT))
        step = max(-(-count // most), 1)
        number = 0
        while video.grab():
            if number % step == 0:
                good, frame = video.retrieve()
                if good:
                    yield (
                        f"frame {number}",
                        frame if frame.ndim == 2 else cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY),
                    )
            number += 1
        if not number:
            raise CalibrationError(
                f"{path}: no frame can be read; convert the video to MP4 (H.264), or to pictures"
            )
    finally:
        video.release()
