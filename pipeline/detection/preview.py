"""A picture small enough for a page: shrunk, grey, as JPEG of at most so many bytes."""

from __future__ import annotations

import cv2
import numpy as np
import simplejpeg

MAX_WIDTH = 900
"""Pixels. The page is about as wide; tags of 20 px in a picture of 1280 are still seen to be tags."""
MAX_BYTES = 90_000
"""Of the JPEG; as text on the page it is a third longer, 120 kB."""
QUALITIES = (80, 65, 50, 35, 20)
"""Tried in turn. Texture costs bytes; where the lowest is still too much, the picture is made smaller."""


def preview_jpeg(grey: np.ndarray, max_width: int = MAX_WIDTH, max_bytes: int = MAX_BYTES) -> bytes:
    """The picture as grey JPEG; the same picture gives the same bytes.

    Parameters
    ----------
    grey : (H, W) uint8 array
        The whole picture.
    max_width : int
        Wider pictures are shrunk to it by averaging; the borders of both stay the same, so that a corner at ``u`` of
        ``W`` pixels stands at the same part of the width.
    max_bytes : int
        Reached by lower quality, then by a smaller picture.
    """
    width = min(max_width, grey.shape[1])
    while True:
        height = max(1, round(grey.shape[0] * width / grey.shape[1]))
        small = cv2.resize(grey, (width, height), interpolation=cv2.INTER_AREA)
        for quality in QUALITIES:
            data = simplejpeg.encode_jpeg(small[..., None], quality, "GRAY", "Gray")
            if len(data) <= max_bytes:
                return data
        if width <= 16:  # some hundred bytes: nothing is smaller
            return data
        width = max(16, 3 * width // 4)
